"""Lingering: a finished run's recording stays served until the process is asked to end."""

import signal
from collections.abc import Callable
from threading import Event, current_thread, main_thread
from types import FrameType
from typing import Final

from cprl.system.output import console
from cprl.viewer.logger import RerunLogger

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_SERVED: Final = ("serve", "spawn")


def check_linger(linger: bool, watch: str) -> None:
    """Refuses to linger where nothing is served, before the run starts.

    Raises:
        ValueError: names what was asked for and what is allowed.
    """
    if linger and watch not in _SERVED:
        raise ValueError(
            f'linger is True, but watch is "{watch}", which serves nothing; allowed: watch "serve" or "spawn"'
        )
    if linger and current_thread() is not main_thread():
        raise ValueError("linger is True in another thread than the main one, which alone gets signals")


def linger(logger: RerunLogger, play_on: Callable[[Event], None] | None = None) -> None:
    """Says where the recording stays served, waits for Ctrl-C (SIGINT) or SIGTERM, and closes the recording;
    a second signal in the meantime changes nothing.

    Args:
        logger: whose recording is served.
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
