"""The Rerun recording of a training.

Modules, in the order in which one reads them:
    callback   ViewerCallback: logs a training while it runs; its lines, and who tagged whom
    story      header, live label, events, and the phases when it ends
    views      the boards of all replicas, where agents go, stock over the turn, Lorenz curve, institutions
    frames     which episodes are recorded frame by frame, and the frames of one world
    replay     what policies say of their actions, who breaks a rule, and what is paid
    exhibition a world that the present policy plays, for viewers alone
    logger     RerunLogger: TorchRL's logger interface on a recording
    streams    to a file and served live, each of which may fail without harm
    page       the web viewer's page on 127.0.0.1, and recordings for it
    watching   a finished run stays served until Ctrl-C
    scenery    what a recording shows, with names and colours
    institutions  lines and tabs of games with institutions
    panels     places in the viewer: several boards in one image, and plots that are not over time
    stage      frames as Rerun's columns, agents as lines
    blueprint  the layout of the viewer
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
