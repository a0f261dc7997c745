"""Schelling diagrams: the payoffs of cooperators and defectors, and the social dilemma that they form.

Cooperators restrain themselves, and defectors are greedy. `schelling` plays all mixes of N agents: k
cooperators and N - k defectors, for k = 0 to N. In each mix the cooperators take turns over the agents'
indices, so that every agent cooperates equally often.

R(k) is the return of a cooperator while k of the N - 1 others cooperate; G(k) is that of a defector. The
agents face a dilemma if cooperation of all is better than defection of all, R(N-1) > G(0), and better than
cooperating alone, R(N-1) > R(0), and if one of two temptations exists:

    fear    G(0) > R(0): among defectors, an agent gets more if it defects too
    greed   G(N-1) > R(N-1): among cooperators, an agent gets more if it defects

Fear and greed together make a prisoner's dilemma, greed alone chicken, fear alone a stag hunt. These names
describe the ends of the diagram, k = 0 and k = N - 1. The title of a diagram says if it differs in between.

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
from cprl.evaluation.pages import heading
from cprl.evaluation.populations import (
    agent_named,
    agents_specified,
    fresh_of_specs,
    join_tables,
    play_fresh,
    roles_of,
    rotations,
    table_note,
    world_source_of,
)
from cprl.measuring.registry import INCOME
from cprl.measuring.statistics import Estimate, Family, difference, estimate
from cprl.measuring.table import Label, by_replica, where
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.system.defaults import Fresh
from cprl.system.working import working
from cprl.terminal import style
from cprl.terminal.panels import draw_dots
from cprl.terminal.text_tables import Change, TableCell, TextTable
from cprl.values import refusal
from cprl.values.array_types import Float64

_NAMES: Final = ("prisoner's dilemma", "chicken", "stag hunt", "no dilemma")
_MIX: Final = "restrained_agents"
"""The label of a table for the number of cooperators."""


class Payoffs(NamedTuple):
    """The payoffs of a Schelling diagram of N agents, in each replica."""

    cooperators: Float64
    """R(k), float64 [R, N]: the mean return of a cooperator, by the number k = 0 to N - 1 of other
    cooperators."""
    defectors: Float64
    """G(k), float64 [R, N]: the mean return of a defector, by the number k of cooperators."""
    group: Float64
    """The mean return of all agents together, float64 [R, N + 1], by the number of cooperators."""


def payoffs_of(table: pa.Table) -> Payoffs:
    """Return the payoffs of a table of `schelling`."""
    agents = len(table["agent"].unique())
    return Payoffs(
        cooperators=_payoffs(table, "focal/return", range(1, agents + 1)),
        defectors=_payoffs(table, "background/return", range(agents)),
        group=_payoffs(table, INCOME, range(agents + 1)),
    )


def _payoffs(table: pa.Table, number: str, mixes: Sequence[int]) -> Float64:
    """Return a number of the table, float64 [R, K], by replica and by the number of cooperators."""
    rows = by_replica(where(table, **{_MIX: tuple(mixes)}), number, [_MIX])
    rows = rows.sort_by([("replica", "ascending"), (_MIX, "ascending")])
    return np.asarray(rows["value"].to_numpy()).reshape(-1, len(mixes))


def margins(cooperators: Float64, defectors: Float64) -> Family:
    """Return the four differences of payoffs that decide which dilemma it is, paired by replica.

    They are in the unit of the payoffs:
        restraint  R(N-1) - G(0): what an agent gains if all cooperate instead of none
        company    R(N-1) - R(0): what a cooperator gains if all others cooperate too
        fear       G(0) - R(0)
        greed      G(N-1) - R(N-1)

    Args:
        cooperators: R(k), float [R, N], see `Payoffs`.
        defectors: G(k), float [R, N].
    """
    if cooperators.ndim != 2 or cooperators.shape != defectors.shape or cooperators.shape[1] < 2:
        raise ValueError(
            f"cooperators is {list(cooperators.shape)} and defectors {list(defectors.shape)}; allowed: "
            "[R, N] both, at least 2 agents"
        )
    pairs = {
        "restraint": (cooperators[:, -1], defectors[:, 0]),
        "company": (cooperators[:, -1], cooperators[:, 0]),
        "fear": (defectors[:, 0], cooperators[:, 0]),
        "greed": (defectors[:, -1], cooperators[:, -1]),
    }
    return Family({(name,): difference(*pair, paired=True) for name, pair in pairs.items()})


def candidates(margins: Family) -> tuple[str, ...]:
    """Return the dilemmas that the intervals of the margins allow, the most likely one first."""
    likely = _name(*(one.value > 0 for one in margins.values()))
    allowed = (_name(*signs) for signs in product(*map(_signs, margins.values())))
    return tuple(dict.fromkeys((likely, *allowed)))


def dilemma(margins: Family) -> str:
    """Return the name of the dilemma, or all names that the intervals allow."""
    possible = candidates(margins)
    return " or ".join(possible) if len(possible) < len(_NAMES) else "cannot be told"


def title_of(payoffs: Payoffs) -> str:
    """Return the name of the dilemma, with the points between the ends where it does not hold."""
    at_ends = margins(payoffs.cooperators, payoffs.defectors)
    name = dilemma(at_ends)
    if len(candidates(at_ends)) > 1 or name == _NAMES[-1]:
        return name
    return name + between_the_ends(payoffs.cooperators, payoffs.defectors)


def between_the_ends(cooperators: Float64, defectors: Float64) -> str:
    """Return the end of a title that names the points k at which the diagram disagrees with its ends.

    For example " at the ends, not at 2 of 3": with 2 of 3 others cooperating, defection pays although it does
    not pay at the ends, or the other way round. If it pays at one end only, it may change once in between. If
    the ends agree, points whose interval contains 0 are named as "not shown". "" if there are no such points.

    Args:
        cooperators: R(k), float [R, N], see `Payoffs`.
        defectors: G(k), float [R, N].
    """
    pulls = [difference(*pair, paired=True) for pair in zip(defectors.T, cooperators.T, strict=True)]
    signs = [0 if pull.low <= 0 < pull.high else (-1) ** (pull.value <= 0) for pull in pulls]
    others = len(signs) - 1
    against = [k for k in range(1, others) if signs[k] == -signs[0] and signs[0] in signs[k:]]
    unsure = [k for k in range(1, others) if signs[k] == 0 and signs[0] == signs[-1]]
    parts = [
        f", {claim} {' and '.join(map(str, points))} of {others}"
        for claim, points in (("not at", against), ("not shown at", unsure))
        if points
    ]
    return f" at the ends{''.join(parts)}" if parts else ""


def _name(restraint: bool, company: bool, fear: bool, greed: bool) -> str:
    prisoners, chicken, stag_hunt, none = _NAMES
    if not (restraint and company and (fear or greed)):
        return none
    if fear and greed:
        return prisoners
    return chicken if greed else stag_hunt


def _signs(margin: Estimate) -> Iterator[bool]:
    """Yield the signs that the interval of a margin allows: True for above 0, False for not above 0."""
    if isnan(margin.low) or margin.high > 0:
        yield True
    if isnan(margin.low) or margin.low <= 0:
        yield False


@working("playing mixes")
def schelling(
    game_or_run: Any,
    fresh: Fresh = Fresh(episodes=5),
    *,
    restrained: str = "sustainable",
    greedy: str = "greedy",
) -> pa.Table:
    """Play all mixes of cooperators and defectors: N (N - 1) + 2 populations of N agents.

    Args:
        game_or_run: a game, or a run, a value of `cprl.load`, whose game and transforms are used.
        fresh: which episodes, with each choice of restrained agents; all mixes play in the same worlds.
        restrained: who plays restrained: a scripted policy, or the directory of a run, of whose replica r
            the agent of the same index plays in replica r.
        greedy: who plays greedy, of the same.

    Returns:
        A row for each mix, replica, episode and agent, see `cprl.measuring.table`, by "restrained", the
        indices of the restrained agents, who are focal, e.g. "0 1", and "restrained_agents", their number.
    """
    world_source = world_source_of(game_or_run)
    agents = world_source.game.agents
    if agents < 2:
        raise ValueError("the game has 1 agent; allowed for a Schelling diagram: at least 2")
    _refuse_alike(world_source.game, restrained, greedy)
    cooperators = [agent_named(restrained, agent, name="restrained") for agent in range(agents)]
    defectors = [agent_named(greedy, agent, name="greedy") for agent in range(agents)]
    fresh = fresh_of_specs([*cooperators, *defectors], fresh)
    kinds = [agents_specified(world_source, kind, fresh) for kind in (cooperators, defectors)]

    def parts(count: int) -> Iterator[pa.Table]:
        for kind_of_agent in rotations((count, agents - count)):
            focal = tuple(agent for agent, kind in enumerate(kind_of_agent) if kind == 0)
            mix = [kinds[kind][agent] for agent, kind in enumerate(kind_of_agent)]
            labels: Label = {"restrained": " ".join(map(str, focal)), _MIX: count}
            yield play_fresh(fresh, world_source, mix, labels, roles=roles_of(agents, focal))

    return join_tables(
        (part for count in range(agents + 1) for part in parts(count)),
        heading=heading("Schelling diagram", fresh, (), " for each choice of restrained agents"),
        fresh=fresh,
        restrained=restrained,
        greedy=greedy,
    )


def _refuse_alike(game: Any, restrained: str, greedy: str) -> None:
    """Refuse cooperators and defectors that play the same policy."""
    pair = {
        policy if policy in SCRIPTED_POLICIES else Path(policy).resolve() for policy in (restrained, greedy)
    }
    has_no_beam = isinstance(game, Game) and not game.rules.may_fire
    if len(pair) == 1 or (has_no_beam and pair == {"greedy", "territorial"}):
        raise refusal("greedy", greedy, f"another way to play than restrained, {restrained!r}")


_LOOKS: Final = {"restrained": ("#1b7837", "o"), "greedy": ("#b2182b", "s")}


def draw_schelling(table: pa.Table, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draw the Schelling diagram: the returns of cooperators and defectors, and of all agents together."""
    payoffs = payoffs_of(table)
    possible = candidates(margins(payoffs.cooperators, payoffs.defectors))
    agents = payoffs.cooperators.shape[1]
    with style.drawing(path, width=width, refuse_existing=True) as sheet:
        single, group = sheet.panels(2, columns=sheet.columns_that_fit(2, 24), row_height_em=20)
        for (name, (colour, marker)), returns in zip(_LOOKS.items(), payoffs, strict=False):
            player = Path(table_note(table, name)).name
            label = name if player == name else f"{name}: {player}"
            _draw_line(single, returns, label=label, color=colour, marker=marker)
        _draw_line(group, payoffs.group)
        single.set_xlabel(f"restrained agents among the other {agents - 1}")
        single.set_title("return of the agent")
        group.set_xlabel(f"restrained agents of {agents}")
        group.set_title("return of all together")
        sheet.title = f"Schelling diagram: {title_of(payoffs) if len(possible) == 1 else 'undecided'}"
        sheet.caption = (
            f"{table_note(table, 'fresh')} for each choice of restrained agents; bars: 95 % intervals by "
            "Student's t."
        )
        if len(possible) > 1:
            sheet.caption += f" The intervals allow {' or '.join(possible)}."
    return Path(path)


def _draw_line(axes: Axes, values: Float64, **look: Any) -> None:
    """Draw the means over replicas of values [R, K], with intervals, at 0 to K - 1."""
    means = [estimate(by_replica) for by_replica in values.T]
    draw_dots(axes, range(len(means)), means, linestyle="-", **look)
    axes.set_xticks(range(len(means)))
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))


def schelling_tables(table: pa.Table) -> Iterator[TextTable]:
    """Yield two tables: the margins of the dilemma, and the payoffs by the number of other cooperators."""
    payoffs = payoffs_of(table)
    last = payoffs.cooperators.shape[1] - 1
    names = (
        f"restraint of all instead of none, R({last}) - G(0)",
        f"company of the restrained, R({last}) - R(0)",
        "fear, G(0) - R(0)",
        f"greed, G({last}) - R({last})",
    )
    changes = margins(payoffs.cooperators, payoffs.defectors).values()
    rows: list[list[TableCell]] = [[name, Change(one)] for name, one in zip(names, changes, strict=True)]
    yield TextTable(f"{title_of(payoffs)}, by returns", ["", "difference, paired by replica"], rows)
    head = [
        f"restrained among the other {last}",
        *(f"return of {table_note(table, name)} ({name})" for name in _LOOKS),
    ]
    pairs = zip(payoffs.cooperators.T, payoffs.defectors.T, strict=True)
    levels: list[list[TableCell]] = [[str(count), *map(estimate, pair)] for count, pair in enumerate(pairs)]
    yield TextTable("return by the number of restrained others", head, levels, texts=0)
