"""The contents of a recording, with their names and colours."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cprl.commons.colours import (
    APPLE,
    FIRST_AGENT,
    PALETTE,
    Colour,
    agent_colour,
    class_colour,
    class_name,
    picture_colour,
)
from cprl.commons.decoding import UNSEEN

SOCIAL: Final = {
    "social/collective_return": ("collective return", (230, 160, 0)),
    "social/efficiency": ("apples per step", (230, 160, 0)),
    "social/equality": ("equality", (86, 180, 233)),
    "social/sustainability": ("sustainability", (0, 158, 115)),
    "social/survival_steps": ("survival", (230, 120, 0)),
    "social/peace": ("peace", (204, 121, 167)),
    "social/peacefulness": ("peacefulness", (204, 121, 167)),
    "social/stock_left": ("apples left", PALETTE[APPLE]),
}
"""The name and colour of each line, because viewers assign different colours; agents have their own."""
OTHERS: Final = {
    "time/env_steps_per_s": ("steps per second", (150, 150, 150)),
    "evaluation/greedy_return": ("greedy, evaluated", (230, 160, 0)),
    "turn/stock": ("apples", PALETTE[APPLE]),
}
TOO_EARLY: Final = "too early to tell"
OF_AGENTS: Final = ("return", "loss", "epsilon", "q", "harvested")
PHASE_COLOURS: Final = {
    "exploration": (86, 180, 233),
    "tragedy": (213, 94, 0),
    "combat": (204, 121, 167),
    "cultivation": (0, 158, 115),
    "another": (120, 120, 120),
    TOO_EARLY: (60, 60, 60),
}

_MEAN_WIDTH, _AGENT_WIDTH, _SINGLE_WIDTH, _SINGLE_SHARE = 2.5, 1.5, 0.7, 0.45


@dataclass(frozen=True, kw_only=True)
class Curves:
    """The numbers that a recording plots; a game without a board has nothing else."""

    agents: tuple[str, ...]
    """The names of the agents, agent 0 first."""
    replicas: int = 1
    """The number of replicas: each is a thin line, and their mean a thick one."""
    metrics: tuple[str, ...] = tuple(name.removeprefix("social/") for name in SOCIAL)
    """The metrics that the game reports, without the prefix `social/`."""
    has_phases: bool = True
    """Whether phases can be detected from these metrics."""
    has_tags: bool = True
    """Whether the game reports who tagged whom."""


@dataclass(frozen=True, kw_only=True)
class Scene(Curves):
    """The contents of the board that a recording shows."""

    height: int
    width: int
    walls: tuple[tuple[int, int], ...]
    """(row, col) of each cell of inner wall."""
    sites: tuple[tuple[int, int], ...]
    """(row, col) of each of the K sites, the cells where apples grow."""
    window: tuple[int, int]
    """(X, Y) of a window."""
    is_replay: bool = False
    """Whether it is one episode of a stored policy; then harvest and stock are plotted turn by turn, and
    there are no curves over episodes."""


def classes(curves: Curves) -> Any:
    """Names and colours of the classes on boards."""
    return _classes(curves, picture_colour)


def window_classes(curves: Curves) -> Any:
    """Names of the classes in windows, in the study's colours."""
    return _classes(curves, class_colour)


def _classes(curves: Curves, colour_of: Callable[[int], Colour]) -> Any:
    import rerun as rr

    known = [
        rr.AnnotationInfo(id=kind, label=class_name(kind), color=colour_of(kind))
        for kind in range(FIRST_AGENT + len(curves.agents))
    ]
    return rr.AnnotationContext([*known, rr.AnnotationInfo(id=UNSEEN, label="", color=(0, 0, 0, 0))])


def lines(curves: Curves) -> dict[str, Any]:
    """The names, colours and widths of each plot's lines, by entity."""
    import rerun as rr

    styles = {
        entity: _mean_and_singles(name, colour, curves.replicas)
        for entity, (name, colour) in SOCIAL.items()
        if entity.removeprefix("social/") in curves.metrics
    }
    for entity, (name, colour) in OTHERS.items():
        styles[entity] = rr.SeriesLines(names=[name], colors=[colour])
    for agent, name in enumerate(curves.agents):
        for entity in OF_AGENTS:
            styles[f"{name}/{entity}"] = rr.SeriesLines(
                names=[name], colors=[agent_colour(agent)], widths=[_AGENT_WIDTH]
            )
    return styles


def _mean_and_singles(name: str, colour: tuple[int, int, int], replicas: int) -> Any:
    """A thin, dark line for each of several replicas, and a thick one on top for their mean."""
    import rerun as rr

    if replicas == 1:
        return rr.SeriesLines(names=[name], colors=[colour])
    dark = tuple(round(_SINGLE_SHARE * part) for part in colour)
    return rr.SeriesLines(
        names=[*(f"replica {replica}" for replica in range(replicas)), f"{name}, mean"],
        colors=[*[dark] * replicas, colour],
        widths=[*[_SINGLE_WIDTH] * replicas, _MEAN_WIDTH],
    )


def phase_states() -> Any:
    """The colours of phases."""
    import rerun as rr

    packed = [red << 24 | green << 16 | blue << 8 | 255 for red, green, blue in PHASE_COLOURS.values()]
    return rr.StateConfiguration(
        values=list(PHASE_COLOURS), labels=list(PHASE_COLOURS), colors=np.array(packed, np.uint32)
    )
