"""schelling: what restrained and greedy agents get, by how many of the others are restrained, and which
social dilemma that makes.

All mixes of N agents are played: k restrained and N - k greedy ones, for k = 0 to N, each shifted by one
index at a time, so that each index is restrained as often as every other.

R(k) is what an agent gets that restrains itself while k of the N - 1 others do, G(k) what it gets if it is
greedy instead. There is a dilemma if all prefer restraint of all to greed of all, R(N-1) > G(0), and to being
the only one who restrains itself, R(N-1) > R(0), and yet one of two things pulls an agent from it:

    fear    G(0) > R(0): who meets greedy agents only had better be greedy
    greed   G(N-1) > R(N-1): who meets restrained agents only had better be greedy

With both it is a prisoner's dilemma, with greed alone chicken, with fear alone a stag hunt. So a name is one
of the ends, k = 0 and N - 1; a title says where a diagram shows something else between them.

Sources: T. C. Schelling, "Hockey Helmets, Concealed Weapons, and Daylight Saving" (1973); for policies of
agents that learn, E. Hughes et al., "Inequity aversion improves cooperation in intertemporal social dilemmas"
(2018), and J. Perolat et al. (2017); for the names of dilemmas, M. W. Macy and A. Flache, "Learning dynamics
in social dilemmas" (2002).
"""

from collections.abc import Iterator, Sequence
from itertools import product
from math import isnan
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes

from cprl.commons.game import Game
from cprl.evaluation.lanes import (
    agent_named,
    agents_specified,
    fresh_of_specs,
    place_of,
    play,
    roles_of,
    said,
    shifted,
    together,
)
from cprl.evaluation.pages import heading
from cprl.measuring.registry import INCOME
from cprl.measuring.statistics import Estimate, Family, difference, estimate
from cprl.measuring.table import Label, by_replica, where
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.system.defaults import Fresh
from cprl.system.working import working
from cprl.terminal import style
from cprl.terminal.panels import draw_dots
from cprl.terminal.tables import Cell, Cells, Change
from cprl.values import refusal
from cprl.values.arrays import Float64

_NAMES: Final = ("prisoner's dilemma", "chicken", "stag hunt", "no dilemma")
_MIX: Final = "restrained_agents"
"""The label that says how many agents are restrained."""


class Payoffs(NamedTuple):
    """The payoffs of a Schelling diagram of N agents, by replica."""

    restrained: Float64
    """R(k), float64 [R, N]: the mean return of a restrained agent, by the number k = 0 to N - 1 of others
    that are restrained."""
    greedy: Float64
    """G(k), float64 [R, N]: that of a greedy agent."""
    group: Float64
    """float64 [R, N + 1]: the mean return of all agents together, by how many of them are restrained."""


def payoffs_of(table: pa.Table) -> Payoffs:
    """Return the payoffs of a table of `schelling`."""
    agents = len(table["agent"].unique())
    return Payoffs(
        restrained=_payoffs(table, "focal/return", range(1, agents + 1)),
        greedy=_payoffs(table, "background/return", range(agents)),
        group=_payoffs(table, INCOME, range(agents + 1)),
    )


def _payoffs(table: pa.Table, number: str, mixes: Sequence[int]) -> Float64:
    """Return a number by replica and by how many agents are restrained, [R, K]."""
    rows = by_replica(where(table, **{_MIX: tuple(mixes)}), number, [_MIX])
    rows = rows.sort_by([("replica", "ascending"), (_MIX, "ascending")])
    return np.asarray(rows["value"].to_numpy()).reshape(-1, len(mixes))


def margins(restrained: Float64, greedy: Float64) -> Family:
    """Return the margins that make a dilemma, in the unit of the payoffs, replicas paired: "restraint",
    R(N-1) - G(0), what an agent gains if all restrain themselves instead of none; "company", R(N-1) - R(0),
    what a restrained agent gains if all others are restrained, too; "fear", G(0) - R(0); and "greed",
    G(N-1) - R(N-1).

    Args:
        restrained: R(k), float [R, N], see `Payoffs`.
        greedy: G(k), float [R, N].
    """
    if restrained.ndim != 2 or restrained.shape != greedy.shape or restrained.shape[1] < 2:
        raise ValueError(
            f"restrained is {list(restrained.shape)} and greedy {list(greedy.shape)}; allowed: [R, N] both, "
            "at least 2 agents"
        )
    pairs = {
        "restraint": (restrained[:, -1], greedy[:, 0]),
        "company": (restrained[:, -1], restrained[:, 0]),
        "fear": (greedy[:, 0], restrained[:, 0]),
        "greed": (greedy[:, -1], restrained[:, -1]),
    }
    return Family({(name,): difference(*pair, paired=True) for name, pair in pairs.items()})


def candidates(margins: Family) -> tuple[str, ...]:
    """Return the dilemmas that the intervals of margins allow, most likely first: one where they tell which
    it is."""
    likely = _name(*(one.value > 0 for one in margins.values()))
    allowed = (_name(*signs) for signs in product(*map(_signs, margins.values())))
    return tuple(dict.fromkeys((likely, *allowed)))


def dilemma(margins: Family) -> str:
    """Return the dilemma that margins make, or those that it may be."""
    possible = candidates(margins)
    return " or ".join(possible) if len(possible) < len(_NAMES) else "cannot be told"


def title_of(payoffs: Payoffs) -> str:
    """Return the name of the dilemma, and where between the ends it does not hold, or is not shown to."""
    of_ends = margins(payoffs.restrained, payoffs.greedy)
    name = dilemma(of_ends)
    if len(candidates(of_ends)) > 1 or name == _NAMES[-1]:
        return name
    return name + between_the_ends(payoffs.restrained, payoffs.greedy)


def between_the_ends(restrained: Float64, greedy: Float64) -> str:
    """Return where greed pays between the ends of a diagram although it does not at them, or the other way
    round, as what follows a dilemma's name; "" for nowhere.

    Where it pays at one end alone, it may change once from one to the other. Where the ends agree, a point
    whose interval holds 0 is not shown to agree with them.

    Args:
        restrained, greedy: of `margins`.
    """
    pulls = [difference(*pair, paired=True) for pair in zip(greedy.T, restrained.T, strict=True)]
    signs = [0 if pull.low <= 0 < pull.high else (-1) ** (pull.value <= 0) for pull in pulls]
    others = len(signs) - 1
    against = [k for k in range(1, others) if signs[k] == -signs[0] and signs[0] in signs[k:]]
    unsure = [k for k in range(1, others) if signs[k] == 0 and signs[0] == signs[-1]]
    parts = [
        f", {words} {' and '.join(map(str, points))} of {others}"
        for words, points in (("not at", against), ("not shown at", unsure))
        if points
    ]
    return f" at the ends{''.join(parts)}" if parts else ""


def _name(restraint: bool, company: bool, fear: bool, greed: bool) -> str:
    prisoners, chicken, stag_hunt, none = _NAMES
    if not (restraint and company and (fear or greed)):
        return none
    return prisoners if fear and greed else chicken if greed else stag_hunt


def _signs(margin: Estimate) -> Iterator[bool]:
    """Yield whether a margin is above 0, in all ways that its interval allows; without an interval both."""
    if isnan(margin.low) or margin.high > 0:
        yield True
    if isnan(margin.low) or margin.low <= 0:
        yield False


@working("playing mixes")
def schelling(
    where: Any,
    fresh: Fresh = Fresh(episodes=5),
    *,
    restrained: str = "sustainable",
    greedy: str = "greedy",
) -> pa.Table:
    """Let restrained and greedy agents play in all mixes: N (N - 1) + 2 populations.

    Args:
        where: a game, or a run, a value of `cprl.load`, whose game and transforms are used.
        fresh: which episodes, with each choice of restrained agents; all mixes play in the same worlds.
        restrained: who plays restrained: a scripted policy, or the directory of a run, of whose replica r
            the agent of the same index plays in replica r.
        greedy: who plays greedy, of the same.

    Returns:
        A row for each mix, replica, episode and agent, see `cprl.measuring.table`, by "restrained", the
        indices of the restrained agents, who are focal, e.g. "0 1", and "restrained_agents", their number.
    """
    place = place_of(where)
    agents = place.game.agents
    if agents < 2:
        raise ValueError("the game has 1 agent; allowed for a Schelling diagram: at least 2")
    _refuse_alike(place.game, restrained, greedy)
    specs = [
        [agent_named(who, agent, name=name) for agent in range(agents)]
        for name, who in (("restrained", restrained), ("greedy", greedy))
    ]
    fresh = fresh_of_specs([*specs[0], *specs[1]], fresh)
    kinds = [agents_specified(place, kind, fresh) for kind in specs]

    def parts(count: int) -> Iterator[pa.Table]:
        for kind_of_agent in shifted((count, agents - count)):
            who = tuple(agent for agent, kind in enumerate(kind_of_agent) if kind == 0)
            mix = [kinds[kind][agent] for agent, kind in enumerate(kind_of_agent)]
            labels: Label = {"restrained": " ".join(map(str, who)), _MIX: count}
            yield play(fresh, place, mix, labels, roles=roles_of(agents, who))

    return together(
        (part for count in range(agents + 1) for part in parts(count)),
        heading=heading("Schelling diagram", fresh, (), " for each choice of restrained agents"),
        fresh=fresh,
        restrained=restrained,
        greedy=greedy,
    )


def _refuse_alike(game: Any, restrained: str, greedy: str) -> None:
    """Refuse the same policy twice, also in other words."""
    pair = {who if who in SCRIPTED_POLICIES else Path(who).resolve() for who in (restrained, greedy)}
    has_no_beam = isinstance(game, Game) and not game.rules.may_fire
    if len(pair) == 1 or (has_no_beam and pair == {"greedy", "territorial"}):
        raise refusal("greedy", greedy, f"another way to play than restrained, {restrained!r}")


_LOOKS: Final = {"restrained": ("#1b7837", "o"), "greedy": ("#b2182b", "s")}


def draw_schelling(table: pa.Table, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draw what an agent gets that is restrained or greedy, by how many of the others are restrained; beside
    it what all get together."""
    payoffs = payoffs_of(table)
    possible = candidates(margins(payoffs.restrained, payoffs.greedy))
    agents = payoffs.restrained.shape[1]
    with style.drawing(path, width=width, is_new=True) as sheet:
        single, group = sheet.panels(2, columns=sheet.fitting(2, 24), high=20)
        for name, (colour, marker) in _LOOKS.items():
            player = Path(said(table, name)).name
            label = name if player == name else f"{name}: {player}"
            _draw_line(single, getattr(payoffs, name), label=label, color=colour, marker=marker)
        _draw_line(group, payoffs.group)
        single.set_xlabel(f"restrained agents among the other {agents - 1}")
        single.set_title("return of the agent")
        group.set_xlabel(f"restrained agents of {agents}")
        group.set_title("return of all together")
        sheet.title = f"Schelling diagram: {title_of(payoffs) if len(possible) == 1 else 'undecided'}"
        sheet.caption = (
            f"{said(table, 'fresh')} for each choice of restrained agents; bars: 95 % intervals by "
            "Student's t."
        )
        if len(possible) > 1:
            sheet.caption += f" The intervals allow {' or '.join(possible)}."
    return Path(path)


def _draw_line(axes: Axes, values: Float64, **look: Any) -> None:
    """Draw the means of [R, K] at 0 to K - 1 with their intervals."""
    means = [estimate(of_mix) for of_mix in values.T]
    draw_dots(axes, range(len(means)), means, linestyle="-", **look)
    axes.set_xticks(range(len(means)))
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))


def schelling_cells(table: pa.Table) -> Iterator[Cells]:
    """Yield the margins that make a dilemma, and the payoffs by the number of restrained others."""
    payoffs = payoffs_of(table)
    last = payoffs.restrained.shape[1] - 1
    names = (
        f"restraint of all instead of none, R({last}) - G(0)",
        f"company of the restrained, R({last}) - R(0)",
        "fear, G(0) - R(0)",
        f"greed, G({last}) - R({last})",
    )
    changes = margins(payoffs.restrained, payoffs.greedy).values()
    rows: list[list[Cell]] = [[name, Change(one)] for name, one in zip(names, changes, strict=True)]
    yield Cells(f"{title_of(payoffs)}, by returns", ["", "difference, paired by replica"], rows)
    head = [
        f"restrained among the other {last}",
        *(f"return of {said(table, name)} ({name})" for name in _LOOKS),
    ]
    pairs = zip(payoffs.restrained.T, payoffs.greedy.T, strict=True)
    levels: list[list[Cell]] = [[str(count), *map(estimate, pair)] for count, pair in enumerate(pairs)]
    yield Cells("return by the number of restrained others", head, levels, texts=0)
