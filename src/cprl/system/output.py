"""Text for the terminal: a closed standard output or one of another encoding never ends a training."""

import atexit
import contextlib
import io
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Final, TextIO, cast

from rich.console import Console

from cprl.checks import shown

PLAIN: Final = str.maketrans(
    {"±": "+-", "\u00d7": "x", "…": "...", "\u2013": "-", "\u2014": "-", "\u2212": "-"}
)
"""What stands for characters that the output cannot show; others become question marks."""

RESUMES: Final = "To resume: "
"""What stands before the command line that resumes a run."""


class Output(io.TextIOBase):
    """The standard output of the moment. What can no longer be written is dropped, which is said once.

    The file descriptor then leads to the null device, so that nothing else that prints fails either, nor the
    interpreter when it exits.

    Args:
        stream: gives the stream, or None where there is none.
    """

    def __init__(self, stream: Callable[[], TextIO | None]) -> None:
        self._stream, self._told = stream, False
        self.run: Path | None = None
        """The run that goes on without the output, for the sentence that says so."""

    def __del__(self) -> None:
        """Flushes nothing: since Python 3.13 `sys` may be gone by then, and `keep_output` has flushed."""

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """That of the stream."""
        return getattr(self._stream(), "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        """Whether the stream is a terminal."""
        try:
            stream = self._stream()
            return stream is not None and stream.isatty()
        except ValueError:  # it was closed
            return False

    def fileno(self) -> int:
        """The file descriptor of the stream."""
        stream = self._stream()
        if stream is None:
            raise io.UnsupportedOperation("fileno")
        return stream.fileno()

    def writable(self) -> bool:
        """Yes."""
        return True

    def write(self, text: str) -> int:
        """Writes, in plainer characters where the stream does not have these."""
        stream = self._stream()
        if stream is not None:
            try:
                try:
                    stream.write(text)
                except UnicodeEncodeError:
                    encoding = self.encoding
                    stream.write(text.translate(PLAIN).encode(encoding, "replace").decode(encoding))
            except (OSError, ValueError) as error:
                self._close(stream, error)
        return len(text)

    def flush(self) -> None:
        """Flushes the stream."""
        stream = self._stream()
        if stream is not None:
            try:
                stream.flush()
            except (OSError, ValueError) as error:
                self._close(stream, error)

    def _close(self, stream: TextIO, error: Exception) -> None:
        with contextlib.suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, stream.fileno())
            os.close(null)
        if self._told or self is ERR:
            return
        self._told = True
        where = f" The run continues; it is in {self.run}." if self.run else ""
        why = getattr(error, "strerror", None) or error
        ERR.write(f"Standard output was closed ({why}); nothing more is printed.{where}\n")
        ERR.flush()


def _behind(stream: TextIO | None) -> TextIO | None:
    """The stream itself where a progress bar of Rich stands before it."""
    return getattr(stream, "rich_proxied_file", stream)


OUT: Final = Output(lambda: _behind(sys.stdout))
ERR: Final = Output(lambda: _behind(sys.stderr))


def console(output: Output = OUT, *, width: int | None = None) -> Console:
    """A console that no closed output and no encoding can stop, by default on standard output.

    Square brackets and colons in texts are shown as they are: they may be those of a path or a name. What is
    to have a style is a `rich.text.Text`.
    """
    return Console(file=cast(TextIO, output), width=width, markup=False, emoji=False)


def say(*what: object) -> None:
    """Prints a line, like `print`; what cannot be a text is shortened."""
    OUT.write(" ".join(map(_text, what)) + "\n")
    OUT.flush()


def printed(words: Sequence[str]) -> str:
    """A command line to be copied, quoted for the shell of this platform."""
    return subprocess.list2cmdline(words) if sys.platform == "win32" else shlex.join(words)


def _text(value: object) -> str:
    try:
        return str(value)
    except Exception:  # of whatever kind a user's object raises; one that holds itself, a RecursionError
        return shown(value)


@cache
def keep_output() -> None:
    """Prepares this process for an output that is closed, from the beginning or at any time.

    Standard streams that are closed already lead to the null device, so that no file of the run gets their
    number. When the interpreter exits, what is left in their buffers is dropped where it cannot be written.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
            if null != number:
                os.close(null)
    for output in (ERR, OUT):
        atexit.register(output.flush)
