"""The Rerun recording of a training.

Modules, in the order in which one reads them:
    names      entities, and colours that several parts share
    scene      the numbers and the board that a recording shows, and where parts of pictures stand
    board      how a board looks, frame by frame: from frames to Rerun's columns
    layout     how lines look, and where the viewer shows what
    page       Rerun's viewers, native and in a browser
    live       the streams of a recording, to a file and served live, each of which may fail without harm
    logger     RerunLogger: TorchRL's logger interface on a recording
    view       View, a part of a recording; lines over episodes
    frames     which episodes are recorded turn by turn; the boards of all replicas
    pictures   tags, visits, stock over the turn, Lorenz curve: functions of the episodes seen
    header     the header, the live label, and events
    replay_views  action values, violations and payments, turn by turn in a replay
    callback   ViewerCallback: shows a training while it runs, by a list of views

Each imports only from those above it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cprl.viewer.logger import RerunLogger

__all__ = ["RerunLogger"]


def __getattr__(name: str) -> Any:
    if name == "RerunLogger":  # with it come the learners and the layout, half a second of import
        return getattr(import_module("cprl.viewer.logger"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
