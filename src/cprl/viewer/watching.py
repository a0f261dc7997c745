"""How a run is watched: what its `watch` may say, and that a finished run stays served until Ctrl-C."""

import signal
from collections.abc import Callable
from threading import Event, current_thread, main_thread
from types import FrameType
from typing import TYPE_CHECKING, Final

from cprl import arguments
from cprl.system.output import console

if TYPE_CHECKING:
    from cprl.viewer.logger import RerunLogger

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
SERVED: Final = ("serve", "spawn")


def check_watch(watch: str, *, can_be_off: bool = True) -> None:
    """Checks a recipe's `watch` before the run starts.

    Args:
        watch: "file", or live as well, see `open_live`; "off" for no recording.
        can_be_off: whether "off" is allowed.
    """
    arguments.choice("watch", watch, ("file", *(("off",) if can_be_off else ()), *SERVED))


def check_linger(linger: bool, watch: str) -> None:
    """Refuses to linger where nothing is served, before the run starts."""
    if linger and watch not in SERVED:
        raise ValueError(
            f'linger is True, but watch is "{watch}", which serves nothing; allowed: watch "serve" or "spawn"'
        )
    if linger and current_thread() is not main_thread():
        raise ValueError("linger is True in another thread than the main one, which alone gets signals")


def linger(logger: "RerunLogger", play_on: Callable[[Event], None] | None = None) -> None:
    """Says where the recording stays served, waits for Ctrl-C (SIGINT) or SIGTERM, and closes the recording;
    a second signal in the meantime changes nothing.

    Args:
        play_on: called meanwhile; returns when the event is set, or when there is nothing to play.
    """
    if not logger.is_served:
        console().print("The recording is no longer served.")
        return
    asked = Event()

    def stop(number: int, frame: FrameType | None) -> None:
        asked.set()

    usual = {number: signal.signal(number, stop) for number in _SIGNALS}
    try:
        console().print(
            f"The recording stays served at {logger.addresses['browser']} until Ctrl-C",
            soft_wrap=True,
            highlight=False,
        )
        if play_on is not None:
            play_on(asked)
        while not asked.wait(1.0):
            pass
        logger.shutdown()
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
