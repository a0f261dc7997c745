"""Text for the terminal, in whatever encoding it has."""

import io
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, TextIO, cast
from unicodedata import category

if TYPE_CHECKING:
    from rich.console import Console

PLAIN: Final = str.maketrans(
    {"±": "+-", "\u00d7": "x", "…": "...", "\u2013": "-", "\u2014": "-", "\u2212": "-"}
)
"""What stands for characters that the output cannot show; others become question marks."""

_ODD: Final = ("Cc", "Cs")
"""Of control characters, and of bytes that are no text, as Unicode calls them."""
RESUMES: Final = "To resume: "
"""What stands before the command line that resumes a run."""


class Output:
    """The standard output of the moment, which may be missing, in characters that it has.

    Args:
        stream: gives the stream, or None where there is none.
    """

    def __init__(self, stream: Callable[[], TextIO | None]) -> None:
        self._stream = stream

    @property
    def encoding(self) -> str:
        return getattr(self._stream(), "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        stream = self._stream()
        return stream is not None and not stream.closed and stream.isatty()

    def fileno(self) -> int:
        stream = self._stream()
        if stream is None:
            raise io.UnsupportedOperation("fileno")
        return stream.fileno()

    def write(self, text: str) -> int:
        """Writes, in plainer characters where the stream does not have these."""
        LINE.erase()
        stream = self._stream()
        if stream is not None:
            try:
                stream.write(text)
            except UnicodeEncodeError:
                encoding = self.encoding
                stream.write(text.translate(PLAIN).encode(encoding, "replace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        stream = self._stream()
        if stream is not None:
            stream.flush()


def _behind(stream: TextIO | None) -> TextIO | None:
    """The stream itself where a progress bar of Rich stands before it."""
    return getattr(stream, "rich_proxied_file", stream)


OUT: Final = Output(lambda: _behind(sys.stdout))
ERR: Final = Output(lambda: _behind(sys.stderr))


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    ipython: Any = sys.modules.get("IPython")
    return ipython is not None and type(ipython.get_ipython()).__name__ == "ZMQInteractiveShell"


class NotebookLine:
    """A line of a notebook that is written over, also in a notebook that is executed unseen."""

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, text: str) -> None:
        display: Any = import_module("IPython.display").display
        content = {"text/plain": text}
        if self._handle is None:
            self._handle = display(content, raw=True, display_id=True)
        else:
            self._handle.update(content, raw=True)


class Line:
    """A line on standard error that is written over, and vanishes; what is written on `OUT` or `ERR` erases
    it before."""

    def __init__(self) -> None:
        self._shown = ""
        self._in_notebook: NotebookLine | None = None

    @property
    def is_over_written(self) -> bool:
        """Whether there is a terminal or a notebook to show it."""
        return in_notebook() or ERR.isatty()

    def show(self, text: str) -> None:
        if in_notebook():
            self._in_notebook = self._in_notebook or NotebookLine()
            self._in_notebook.show(text)
            return
        width = shutil.get_terminal_size().columns - 1
        shown = text[:width]
        before = len(self._shown)
        self._shown = ""  # else it would be erased
        ERR.write(f"\r{shown.ljust(before)}")
        ERR.flush()
        self._shown = shown

    def erase(self) -> None:
        if self._in_notebook is not None:
            self._in_notebook.show("")
            self._in_notebook = None
        if self._shown:
            blank = " " * len(self._shown)
            self._shown = ""
            ERR.write(f"\r{blank}\r")
            ERR.flush()


LINE: Final = Line()


def console(output: Output = OUT, *, width: int | None = None) -> "Console":
    """A console that no encoding can stop, by default on standard output; square brackets and colons in
    texts, which may be those of a path, are shown as they are."""
    from rich.console import Console
    from rich.text import Text

    class Plain(Console):
        """Shows no text that a terminal would take for a command."""

        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(legible(text), **options)

    return Plain(file=cast(TextIO, output), width=width, markup=False, emoji=False)


def legible(text: str) -> str:
    """Return a text, which may be the name of a file or of anything in a file of somebody else, as one that
    UTF-8 can hold and that no terminal takes for a command; lines stay."""
    return "".join("?" if category(letter) in _ODD and letter not in "\n\t" else letter for letter in text)


def say(*what: object) -> None:
    OUT.write(legible(" ".join(map(str, what))) + "\n")
    OUT.flush()


def printed(words: Sequence[str]) -> str:
    """A command line to be copied, quoted for the shell of this platform."""
    return subprocess.list2cmdline(words) if sys.platform == "win32" else shlex.join(words)
