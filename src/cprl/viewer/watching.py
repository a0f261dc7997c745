"""How a run is watched: what its `watch` may say, and that a finished run stays served until Ctrl-C."""

import signal
from collections.abc import Callable
from threading import Event, current_thread, main_thread
from types import FrameType
from typing import TYPE_CHECKING, Final, Literal, get_args

from cprl.system.output import console
from cprl.values import checked

if TYPE_CHECKING:
    from cprl.viewer.logger import RerunLogger

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
Served = Literal["serve", "spawn"]


def check_watch(watch: str, *, can_be_off: bool = True) -> None:
    """Checks a recipe's `watch` before the run starts.

    Args:
        watch: "file", or live as well, see `open_live`; "off" for no recording.
    """
    checked("watch", watch, Literal["file", "off"] | Served if can_be_off else Literal["file"] | Served)


def check_linger(linger: bool, watch: str) -> None:
    """Refuses to linger where nothing is served, before the run starts."""
    if linger and watch not in get_args(Served):
        raise ValueError(
            f'linger is True, but watch is "{watch}", which serves nothing; allowed: watch "serve" or "spawn"'
        )
    if linger and current_thread() is not main_thread():
        raise ValueError("linger is True in another thread than the main one, which alone gets signals")


def linger(logger: "RerunLogger", play_on: Callable[[Event], None] | None = None) -> None:
    """Says where the recording stays served, waits for Ctrl-C (SIGINT) or SIGTERM, and closes the recording;
    a second signal in the meantime changes nothing.
    """
    if not logger.is_served:
        console().print("The recording is no longer served.")
        return
    stopping = Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopping.set()

    usual = {number: signal.signal(number, stop) for number in _SIGNALS}
    try:
        console().print(
            f"The recording stays served at {logger.addresses['browser']} until Ctrl-C",
            soft_wrap=True,
            highlight=False,
        )
        if play_on is not None:
            play_on(stopping)
        while not stopping.wait(1.0):
            pass
        logger.shutdown()
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
