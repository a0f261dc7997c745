"""The Rerun recording of a training.

Modules, in the order in which one reads them:
    callback   ViewerCallback: logs a training while it runs
    contents   what of a game is plotted, and what is left out
    story      header, live label, events, and the phases when it ends
    header     the header's texts
    events     new bests, and phases
    plots      the lines of each episode, with running means and random play
    tags       who tagged whom
    views      the views below: which of them a training has, and when they are logged
    wall       the boards of all replicas
    visits     where agents go
    turns      the stock over the turn
    looks      the state of the worlds, noted now for the views to add up later
    lorenz     Lorenz curve and Gini coefficient
    institutions       lines and tabs of games with institutions
    institution_views  their regions on the board, and events
    offences   in a replay: who breaks a rule, and what is paid
    decisions  in a replay: what each agent's policy says of its actions
    compiling  while code is compiled, the live header says so
    filming    which episodes are recorded frame by frame
    recorder   the frames of one world, step by step
    frames     frames collected in memory
    logger     RerunLogger: TorchRL's logger interface on a recording
    media      numbers, histograms and videos, as Rerun takes them
    batches    numbers and texts as columns, in batches
    recipe     the recipe as a table
    names      files and ids of a run's recordings
    exhibition a world that the present policy plays, for viewers alone
    live_board the exhibited board, as viewers get it
    streams    to a file, and served live
    sending    the streams of a recording, each of which may fail without harm
    page       the web viewer's page on 127.0.0.1, and recordings for it
    deadline   calls that may wait for a viewer, with deadlines
    lingering  a finished run stays served until Ctrl-C
    scenery    names and colours of what a recording shows
    panels     several boards in one image
    axes       plots that are not over time
    strokes    numbers, headings and marks of agents, as lines
    stage      frames as Rerun's columns
    tabs       the parts of the layout that show images and drawn plots
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
