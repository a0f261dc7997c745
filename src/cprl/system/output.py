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

PLAIN_CHARACTERS: Final = str.maketrans(
    {"±": "+-", "\u00d7": "x", "…": "...", "\u2013": "-", "\u2014": "-", "\u2212": "-"}
)
"""Plain characters for those that the output cannot show; others become question marks."""

_ODD: Final = ("Cc", "Cs")
"""The categories of Unicode of control characters, and of bytes that are no text."""
RESUME_PREFIX: Final = "To resume: "
"""The words before the command line that resumes a run."""


class Output:
    """The current standard output or error, written in characters that its encoding has; it may be missing.

    Args:
        stream: returns the current stream, or None if there is none.
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
        """Write a text, in plainer characters where the encoding lacks some."""
        LINE.erase()
        stream = self._stream()
        if stream is not None:
            try:
                stream.write(text)
            except UnicodeEncodeError:
                encoding = self.encoding
                stream.write(text.translate(PLAIN_CHARACTERS).encode(encoding, "replace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        stream = self._stream()
        if stream is not None:
            stream.flush()


def _unwrapped(stream: TextIO | None) -> TextIO | None:
    """Return the stream itself if a progress bar of Rich has replaced it."""
    return getattr(stream, "rich_proxied_file", stream)


OUT: Final = Output(lambda: _unwrapped(sys.stdout))
ERR: Final = Output(lambda: _unwrapped(sys.stderr))


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    ipython: Any = sys.modules.get("IPython")
    return ipython is not None and type(ipython.get_ipython()).__name__ == "ZMQInteractiveShell"


class NotebookLine:
    """A line of a notebook's output that is overwritten, also where the notebook runs without a browser."""

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
    """A status line on standard error that is overwritten and vanishes; text on `OUT` or `ERR` erases it
    first."""

    def __init__(self) -> None:
        self._text = ""
        self._in_notebook: NotebookLine | None = None

    @property
    def is_over_written(self) -> bool:
        """Return whether there is a terminal or a notebook, where the line can be overwritten."""
        return in_notebook() or ERR.isatty()

    def show(self, text: str) -> None:
        if in_notebook():
            self._in_notebook = self._in_notebook or NotebookLine()
            self._in_notebook.show(text)
            return
        width = shutil.get_terminal_size().columns - 1
        text = text[:width]
        before = len(self._text)
        self._text = ""  # so that writing does not erase it
        ERR.write(f"\r{text.ljust(before)}")
        ERR.flush()
        self._text = text

    def erase(self) -> None:
        if self._in_notebook is not None:
            self._in_notebook.show("")
            self._in_notebook = None
        if self._text:
            blank = " " * len(self._text)
            self._text = ""
            ERR.write(f"\r{blank}\r")
            ERR.flush()


LINE: Final = Line()


def console(output: Output = OUT, *, width: int | None = None) -> "Console":
    """Return a console of Rich that works with any encoding, by default on standard output. It shows square
    brackets and colons, which may be part of a path, unchanged."""
    from rich.console import Console
    from rich.text import Text

    class Plain(Console):
        """A console without characters that a terminal would take for a command."""

        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(legible(text), **options)

    return Plain(file=cast(TextIO, output), width=width, markup=False, emoji=False)


def legible(text: str) -> str:
    """Return an untrusted text, such as the name of a file, without control characters and with what UTF-8
    lacks replaced; line breaks stay."""
    return "".join("?" if category(letter) in _ODD and letter not in "\n\t" else letter for letter in text)


def say(*what: object) -> None:
    OUT.write(legible(" ".join(map(str, what))) + "\n")
    OUT.flush()


def quote_command(words: Sequence[str]) -> str:
    """Return a command line quoted for the shell of this platform."""
    return subprocess.list2cmdline(words) if sys.platform == "win32" else shlex.join(words)
