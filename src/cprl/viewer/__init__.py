"""The Rerun recording of a training.

Modules, in the order in which one reads them:
    callback   ViewerCallback: logs a training while it runs, by a list of views
    story      header, live label, events, and the phases when it ends
    pictures   View; lines, tags, all boards at once, where agents go, stock over the turn, Lorenz curve
    board      which episodes are recorded frame by frame, and how a board looks
    replay     what policies say of their actions, who breaks a rule, and what is paid
    exhibition a world that the current policy plays, for viewers alone
    layout     what a recording shows, with names and colours, and where the viewer shows it
    logger     RerunLogger: TorchRL's logger interface on a recording
    live       the streams of a recording, to a file and served live, each of which may fail without harm
    page       Rerun's viewers, native and in a browser; a finished run stays served until Ctrl-C
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
