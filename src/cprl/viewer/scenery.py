"""Scenery: what a recording shows, and the names and colours of it."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cprl.commons.colours import FIRST_AGENT, agent_colour, class_colour, class_name
from cprl.commons.seeing import UNSEEN

SOCIAL: Final = {
    "social/collective_return": ("collective return", (230, 160, 0)),
    "social/efficiency": ("apples per step", (230, 160, 0)),
    "social/equality": ("equality", (86, 180, 233)),
    "social/sustainability": ("sustainability", (0, 158, 115)),
    "social/survival_steps": ("survival", (230, 120, 0)),
    "social/peace": ("peace", (204, 121, 167)),
    "social/peacefulness": ("peacefulness", (204, 121, 167)),
    "social/stock_left": ("apples left", (0, 200, 0)),
}
"""The name and colour of a line, since the viewers' own colours differ; agents have theirs."""
OTHERS: Final = {
    "time/env_steps_per_s": ("steps per second", (150, 150, 150)),
    "evaluation/greedy_return": ("greedy, evaluated", (230, 160, 0)),
    "turn/stock": ("apples", (0, 200, 0)),
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
class Scene:
    """What is on the board that a recording shows."""

    height: int
    width: int
    walls: tuple[tuple[int, int], ...]
    """(row, col) of each cell of inner wall."""
    sites: tuple[tuple[int, int], ...]
    """(row, col) of each cell where an apple can hang, K."""
    agents: tuple[str, ...]
    """Names of the agents, agent 0 first."""
    window: tuple[int, int]
    """(X, Y) of a window."""
    replicas: int = 1
    """How many replicas' metrics are drawn: each of them thinly, and their mean."""
    is_replay: bool = False
    """Whether it is one episode of a stored policy: then harvest and stock are told turn by turn, and there
    are no curves over episodes."""


def classes(scene: Scene | None) -> Any:
    """Names and colours of the classes on boards and in windows."""
    import rerun as rr

    known = [
        rr.AnnotationInfo(id=kind, label=class_name(kind), color=class_colour(kind))
        for kind in range(FIRST_AGENT + (len(scene.agents) if scene else 0))
    ]
    return rr.AnnotationContext([*known, rr.AnnotationInfo(id=UNSEEN, label="", color=(0, 0, 0, 0))])


def lines(scene: Scene | None) -> dict[str, Any]:
    """The names, colours and widths of each plot's lines, by entity."""
    import rerun as rr

    replicas = scene.replicas if scene else 1
    styles = {entity: _mean_and_singles(name, colour, replicas) for entity, (name, colour) in SOCIAL.items()}
    for entity, (name, colour) in OTHERS.items():
        styles[entity] = rr.SeriesLines(names=[name], colors=[colour])
    for agent, name in enumerate(scene.agents if scene else ()):
        for entity in OF_AGENTS:
            styles[f"{name}/{entity}"] = rr.SeriesLines(
                names=[name], colors=[agent_colour(agent)], widths=[_AGENT_WIDTH]
            )
    return styles


def _mean_and_singles(name: str, colour: tuple[int, int, int], replicas: int) -> Any:
    """A thin, dark line for each of several replicas, and over them a thick one for their mean."""
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
