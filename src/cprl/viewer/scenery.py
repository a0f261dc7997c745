"""The contents of a recording, with their names and colours."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import rerun as rr
from torchrl.envs import EnvBase

from cprl.commons.colours import (
    APPLE,
    FIRST_AGENT,
    PALETTE,
    Colour,
    agent_colour,
    class_name,
    picture_colour,
)
from cprl.commons.decoding import UNSEEN
from cprl.measuring import now, phases
from cprl.measuring.episodes import decisions_of, metrics_of, yield_of
from cprl.measuring.metrics import FIELDS, METRICS, available, left_out

ORANGE, BLUE, GREEN = (230, 160, 0), (86, 180, 233), (0, 158, 115)
VERMILION, PURPLE, GREY = (213, 94, 0), (204, 121, 167), (150, 150, 150)
"""M. Okabe and K. Ito's colours, which are apart for the colour-blind too, and a grey."""

SOCIAL: Final = {
    "social/collective_return": ("collective return", ORANGE),
    "social/efficiency": ("apples per step", ORANGE),
    "social/equality": ("equality", BLUE),
    "social/sustainability": ("sustainability", GREEN),
    "social/survival_steps": ("survival", (230, 120, 0)),
    "social/peace": ("peace", PURPLE),
    "social/peacefulness": ("peacefulness", PURPLE),
    "social/stock_left": ("apples left", PALETTE[APPLE]),
    "social/yield_share": ("yield share of the steps played", GREEN),
}
"""The name and colour of each line, because viewers assign different colours; agents have their own."""
OTHERS: Final = {
    "time/env_steps_per_s": ("steps per second", GREY),
    "evaluation/greedy_return": ("greedy, evaluated", ORANGE),
    "turn/stock": ("apples", PALETTE[APPLE]),
}
OF_AGENTS: Final = ("return", "loss", "epsilon", "q", "harvested")
RANDOM_PLAY: Final = "random_play"
"""The folder of the lines of random play; each has the name of its metric."""
EVALUATION: Final = "evaluation"
"""The folder of the lines of evaluations while agents are trained, likewise."""
ANOTHER: Final = "another"
"""The name of a phase that matches no pattern of the study."""
BACKGROUND: Final = (24, 26, 32)
"""The background of boards and windows, which sets their dark cells apart from the viewer's own colour."""
STATES: Final = {
    "exploration": BLUE,
    "tragedy": VERMILION,
    "combat": PURPLE,
    "cultivation": GREEN,
    ANOTHER: (120, 120, 120),
    now.BEGINS: (80, 80, 80),
    now.EXPLORING: BLUE,
    now.HARVESTING: GREY,
    now.DECLINE: VERMILION,
    now.RECOVERY: GREEN,
}
"""The colours of phases and live labels, which share one where they mean the same."""
STRIPS: Final = ("now", "phase/found", "phase/as_published")
"""The entities of states: the live label, and the phases that are logged when a long run ends."""

_RUNNING_WIDTH, _RAW_WIDTH, _SINGLE_WIDTH, _THIN_WIDTH = 2.5, 1.0, 0.7, 1.0
_RAW_SHARE, _SINGLE_SHARE = 0.6, 0.35
"""Of a line's colour, in that of its raw values, and of single replicas."""


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
    """Whether phases are found when the run ends: it is long enough, and these metrics tell."""
    has_tags: bool = True
    """Whether the game reports who tagged whom."""
    institutions: tuple[str, ...] = ()
    """The metrics of institutions that the game reports, without the prefix `institutions/`."""
    in_force: tuple[str, ...] = ()
    """What is decided in an episode, in words, e.g. "the tax rate"."""


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
    actions: int = 8
    """The number of actions A."""
    is_replay: bool = False
    """Whether it is one episode of a stored policy; then harvest and stock are plotted turn by turn, and
    there are no curves over episodes."""


def has_lorenz(curves: Curves) -> bool:
    """Whether there is a harvest, and somebody to share it with."""
    return "equality" in curves.metrics and len(curves.agents) > 1


def has_wall(curves: Curves) -> bool:
    """Whether there are boards, and more than the one that is shown anyway."""
    return isinstance(curves, Scene) and curves.replicas > 1


def classes(curves: Curves, colour_of: Callable[[int], Colour] = picture_colour) -> Any:
    """Names and colours of the classes on boards, or by another function in windows."""
    known = [
        rr.AnnotationInfo(id=kind, label=class_name(kind), color=colour_of(kind))
        for kind in range(FIRST_AGENT + len(curves.agents))
    ]
    return rr.AnnotationContext([*known, rr.AnnotationInfo(id=UNSEEN, label="", color=(0, 0, 0, 0))])


def lines(curves: Curves) -> dict[str, Any]:
    """The names, colours and widths of each plot's lines, by entity."""
    styles = {
        entity: running(name, colour, curves.replicas)
        for entity, (name, colour) in SOCIAL.items()
        if entity.removeprefix("social/") in curves.metrics
    }
    for metric in curves.metrics:
        styles[f"{RANDOM_PLAY}/{metric}"] = rr.SeriesLines(
            names=["random play"], colors=[GREY], widths=[_THIN_WIDTH]
        )
        styles[f"{EVALUATION}/{metric}"] = rr.SeriesLines(
            names=["greedy, evaluated"], colors=[ORANGE], widths=[_RAW_WIDTH]
        )
    for entity, (name, colour) in OTHERS.items():
        styles[entity] = rr.SeriesLines(names=[name], colors=[colour])
    for agent, name in enumerate(curves.agents):
        for entity in OF_AGENTS:
            styles[f"{name}/{entity}"] = rr.SeriesLines(
                names=[name], colors=[agent_colour(agent)], widths=[_RAW_WIDTH]
            )
        styles[f"{name}/return"] = running(name, agent_colour(agent), replicas=1)
    return styles


def running(name: str, colour: tuple[int, int, int], replicas: int, *, alone: bool = False) -> Any:
    """Thin, dark lines for each of several replicas, a faint one for their mean, and on top a bold one for
    its running mean; `alone` shows that one alone, where others share the plot."""
    singles = replicas if replicas > 1 else 0
    raw = name if replicas == 1 else f"{name}, mean"
    return rr.SeriesLines(
        names=[*(f"replica {replica}" for replica in range(singles)), raw, f"{name}, running mean"],
        colors=[*[_darker(colour, _SINGLE_SHARE)] * singles, _darker(colour, _RAW_SHARE), colour],
        widths=[*[_SINGLE_WIDTH] * singles, _RAW_WIDTH, _RUNNING_WIDTH],
        visible_series=[*[False] * (singles + 1), True] if alone else None,
    )


def _darker(colour: tuple[int, int, int], share: float) -> tuple[int, ...]:
    return tuple(round(share * part) for part in colour)


def state_colours(curves: Curves) -> dict[str, Any]:
    """The colours of live labels and phases, by entity."""
    packed = [red << 24 | green << 16 | blue << 8 | 255 for red, green, blue in STATES.values()]
    names, colours = list(STATES), np.array(packed, np.uint32)  # 0xRRGGBBAA
    configuration = rr.StateConfiguration(values=names, labels=names, colors=colours)
    strips = STRIPS if curves.has_phases else STRIPS[:1]
    return dict.fromkeys(strips, configuration)


_SHOWN: Final[Mapping[str, tuple[str, ...]]] = {
    "phases and new bests": tuple(dict.fromkeys(entry for name in phases.METRICS for entry in METRICS[name])),
    "who tagged whom": ("tagged_by",),
    "the Lorenz curve": ("harvest",),
    "all boards side by side": ("board",),
    "where agents go": ("board",),
    "the stock over the turn": ("board",),
    "the board and what agents see": ("board",),
}
"""The views of a recording besides metrics, and the entries that each needs."""


def curves_of(env: EnvBase, agents: tuple[str, ...], reported: Sequence[str], *, episodes: int) -> Curves:
    """The numbers of an environment that are plotted."""
    metrics = available({**METRICS, "stock_left": FIELDS["stock_left"]}, reported)
    metrics += () if yield_of(env)["sustainable_yield"] is None else ("yield_share",)
    return Curves(
        agents=agents,
        replicas=env.batch_size.numel(),
        metrics=metrics,
        has_phases=episodes in phases.EPISODES and set(phases.METRICS) <= set(metrics),
        has_tags="tagged_by" in reported,
        institutions=metrics_of(env, reported),
        in_force=decisions_of(env) if "in_force" in reported else (),
    )


def missing_in(reported: Sequence[str], *, has_board: bool) -> str:
    """One line that names what the recording lacks, and why; "" if it lacks nothing."""
    return left_out([*reported, *(["board"] if has_board else [])], more=_SHOWN)
