"""Stopping: SIGINT and SIGTERM of the process that runs a study, whose workers shall save what they have."""

import signal
from threading import current_thread, main_thread
from types import FrameType, TracebackType
from typing import Any, Final, NoReturn, Self

from cprl.runs.checkpoints import interruption
from cprl.system.output import console

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


class Stopping:
    """Counts how often this process was asked to stop; a context manager.

    The handlers only count: what is done about it is up to the loop that looks at `asked`. Python handles
    signals in the main thread only; in other threads handlers stay as they are.
    """

    def __init__(self) -> None:
        self.asked = 0
        self._number: int = signal.SIGINT
        self._usual: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in _SIGNALS if current_thread() is main_thread() else ():
            self._usual[number] = signal.signal(number, self._ask)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for number, usual in self._usual.items() if current_thread() is main_thread() else ():
            signal.signal(number, usual)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked += 1
        self._number = number
        if self.asked == 1:
            console().print(
                "Stopping: each trial finishes its step and saves a checkpoint; signal again to kill them.",
                soft_wrap=True,
            )

    def end(self, left: int) -> NoReturn:
        """Say how many trials are left, and raise what `interruption` makes of the signal."""
        trials = "1 trial is" if left == 1 else f"{left} trials are"
        console().print(f"Stopped; {trials} left. The same line again continues the study.", soft_wrap=True)
        raise interruption(self._number)
