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
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import product
from math import isnan
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes

from cprl.commons.game import Game
from cprl.evaluation.evaluate import SEED, bars_of, heading
from cprl.evaluation.lanes import (
    Fresh,
    Part,
    Results,
    Whose,
    agent_named,
    agents_specified,
    place_of,
    shifted,
)
from cprl.measuring.played import Measured
from cprl.measuring.series import Values
from cprl.measuring.statistics import Estimate, difference, estimate
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.system.working import say_how_far, working
from cprl.terminal import style
from cprl.terminal.tables import Cells
from cprl.values import refusal

_NAMES: Final = ("prisoner's dilemma", "chicken", "stag hunt", "no dilemma")


@dataclass(frozen=True, kw_only=True)
class Dilemma:
    """The margins of a Schelling diagram, over replicas, in the unit of the payoffs."""

    restraint: Estimate
    """R(N-1) - G(0): what an agent gains if all restrain themselves instead of none."""
    company: Estimate
    """R(N-1) - R(0): what a restrained agent gains if all others are restrained, too."""
    fear: Estimate
    """G(0) - R(0)."""
    greed: Estimate
    """G(N-1) - R(N-1)."""

    @property
    def candidates(self) -> tuple[str, ...]:
        """The dilemmas that the intervals allow, most likely first: one where they tell which it is."""
        margins = [getattr(self, field.name) for field in fields(self)]
        likely = _name(*(estimate.value > 0 for estimate in margins))
        return tuple(dict.fromkeys((likely, *(_name(*signs) for signs in product(*map(_signs, margins))))))

    @property
    def name(self) -> str:
        """The dilemma, or those that it may be."""
        return " or ".join(self.candidates) if len(self.candidates) < len(_NAMES) else "cannot be told"


def dilemma(restrained: Values, greedy: Values) -> Dilemma:
    """Which dilemma payoffs make.

    Args:
        restrained: R(k), float [R, N]: of each of R replicas, for k = 0 to N - 1 others that are restrained.
        greedy: G(k), likewise. Replicas are paired.
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
    return Dilemma(**{name: difference(*pair, paired=True) for name, pair in pairs.items()})


def between_the_ends(restrained: Values, greedy: Values) -> str:
    """Where greed pays between the ends of a diagram although it does not at them, or the other way round, as
    what follows a dilemma's name; "" for nowhere.

    Where it pays at one end alone, it may change once from one to the other. Where the ends agree, a point
    whose interval holds 0 is not shown to agree with them.

    Args:
        restrained, greedy: of `dilemma`.
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
    """Whether a margin is above 0, in all ways that its interval allows; without an interval both."""
    if isnan(margin.low) or margin.high > 0:
        yield True
    if isnan(margin.low) or margin.low <= 0:
        yield False


@dataclass(frozen=True, kw_only=True, eq=False)
class SchellingDiagram(Results):
    """The episodes of all mixes of restrained and greedy agents by "restrained", the indices of those who are
    as a text, e.g. "0 1"; see the docstring of this module."""

    agents: int
    """N."""
    restrained: str
    greedy: str
    """Who plays restrained, and who greedy: a scripted policy or a run."""

    @cached_property
    def restrained_payoffs(self) -> Values:
        """R(k), float64 [R, N]: the mean return of a restrained agent, by the number k = 0 to N - 1 of
        others that are restrained."""
        return self._payoffs("focal", range(1, self.agents + 1))

    @cached_property
    def greedy_payoffs(self) -> Values:
        """G(k), float64 [R, N]: that of a greedy agent, likewise."""
        return self._payoffs("background", range(self.agents))

    @cached_property
    def group_payoffs(self) -> Values:
        """float64 [R, N + 1]: the mean return of all agents together, by how many of them are restrained."""
        return self._payoffs("group", range(self.agents + 1))

    def dilemma(self) -> Dilemma:
        return dilemma(self.restrained_payoffs, self.greedy_payoffs)

    @property
    def title(self) -> str:
        """The name of the dilemma, and where between the ends it does not hold, or is not shown to."""
        dilemma = self.dilemma()
        if len(dilemma.candidates) > 1 or dilemma.name == _NAMES[-1]:
            return dilemma.name
        return dilemma.name + between_the_ends(self.restrained_payoffs, self.greedy_payoffs)

    def measures(self, count: int) -> dict[str, Measured]:
        """The social metrics of the mixes with so many restrained agents."""
        return self._mixes(count).estimates()

    def _mixes(self, count: int) -> Results:
        parts = [part for part in self.parts if len(part.focal[0]) == count]
        return Results(parts=parts, fresh=self.fresh)

    def _payoffs(self, whose: Whose, counts: Sequence[int]) -> Values:
        return np.stack([self._mixes(count).mean_returns(whose) for count in counts], 1)


@working("playing mixes")
def schelling(
    where: Any,
    *,
    restrained: str = "sustainable",
    greedy: str = "greedy",
    episodes: int = 5,
    replicas: int = 8,
    seed: int = SEED,
) -> SchellingDiagram:
    """Plays all mixes of restrained and greedy agents: N (N - 1) + 2 populations.

    Args:
        where: a game, or a run, a value of `cprl.load`, whose game and transforms are used.
        restrained: who plays restrained: a scripted policy, or the directory of a run, of whose replica r
            the agent of the same index plays in replica r.
        episodes: episodes of each replica and choice of restrained agents, each in its own world.
        replicas: the number of replicas R; of scripted policies, of independent groups of episodes.
        seed: the seed of the worlds, in which all mixes play, and of all random numbers.
    """
    place = place_of(where)
    agents = place.game.agents
    if agents < 2:
        raise ValueError("the game has 1 agent; allowed for a Schelling diagram: at least 2")
    _refuse_alike(place.game, restrained, greedy)
    fresh = Fresh(replicas=tuple(range(replicas)), episodes=episodes, seed=seed)
    kinds = [
        agents_specified(place, [agent_named(who, agent, name=name) for agent in range(agents)], fresh)
        for name, who in (("restrained", restrained), ("greedy", greedy))
    ]
    parts: list[Part] = []
    for count in range(agents + 1):
        for kind_of_agent in shifted((count, agents - count)):
            who = tuple(agent for agent, kind in enumerate(kind_of_agent) if kind == 0)
            mix = [kinds[kind][agent] for agent, kind in enumerate(kind_of_agent)]
            say_how_far(len(parts), agents * (agents - 1) + 2, "populations")
            parts.append(Part({"restrained": " ".join(map(str, who))}, fresh.play(place, mix), (who,)))
    return SchellingDiagram(agents=agents, restrained=restrained, greedy=greedy, parts=parts, fresh=fresh)


def _refuse_alike(game: Any, restrained: str, greedy: str) -> None:
    """Refuses the same policy twice, also in other words."""
    pair = {who if who in SCRIPTED_POLICIES else Path(who).resolve() for who in (restrained, greedy)}
    has_no_beam = isinstance(game, Game) and not game.rules.may_fire
    if len(pair) == 1 or (has_no_beam and pair == {"greedy", "territorial"}):
        raise refusal("greedy", greedy, f"another way to play than restrained, {restrained!r}")


_RESTRAINED: Final = "#1b7837"
_GREEDY: Final = "#b2182b"


def draw_schelling(diagram: SchellingDiagram, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draws what an agent gets that is restrained or greedy, by how many of the others are restrained; beside
    it what all get together."""
    with style.drawing(path, width=width, is_new=True) as sheet:
        single, group = sheet.panels(2, columns=sheet.fitting(2, 24), high=20)
        for payoffs, who, role, colour, marker in (
            (diagram.restrained_payoffs, diagram.restrained, "restrained", _RESTRAINED, "o"),
            (diagram.greedy_payoffs, diagram.greedy, "greedy", _GREEDY, "s"),
        ):
            name = Path(who).name
            label = role if name == role else f"{role}: {name}"
            _line(single, payoffs, label=label, color=colour, marker=marker)
        single.set_xlabel(f"restrained agents among the other {diagram.agents - 1}")
        single.set_title("return of the agent")
        _line(group, diagram.group_payoffs, color=style.MEAN, marker="o")
        group.set_xlabel(f"restrained agents of {diagram.agents}")
        group.set_title("return of all together")
        for axes in (single, group):
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        candidates = diagram.dilemma().candidates
        sheet.title = f"Schelling diagram: {diagram.title if len(candidates) == 1 else 'undecided'}"
        sheet.caption = (
            f"{diagram.fresh} for each choice of restrained agents; bars: 95 % intervals by Student's t."
        )
        if len(candidates) > 1:
            sheet.caption += f" The intervals allow {' or '.join(candidates)}."
    return Path(path)


def _line(axes: Axes, values: Values, **look: Any) -> None:
    """Means of [R, K] at 0 to K - 1 with their intervals."""
    means, reach = bars_of(map(estimate, values.T))
    axes.errorbar(range(len(means)), means, reach, capsize=2, markersize=5, **look)
    axes.set_xticks(range(len(means)))


def schelling_tables(diagram: SchellingDiagram) -> Iterator[Cells]:
    """The margins that make a dilemma, and the payoffs by the number of restrained others."""
    dilemma, last = diagram.dilemma(), diagram.agents - 1
    margins = {
        f"restraint of all instead of none, R({last}) - G(0)": dilemma.restraint,
        f"company of the restrained, R({last}) - R(0)": dilemma.company,
        "fear, G(0) - R(0)": dilemma.fear,
        f"greed, G({last}) - R({last})": dilemma.greed,
    }
    rows = [(name, str(margin)) for name, margin in margins.items()]
    yield Cells(f"{diagram.title}, by returns", ["", "difference, paired by replica"], rows)
    payoffs = zip(diagram.restrained_payoffs.T, diagram.greedy_payoffs.T, strict=True)
    yield Cells(
        heading("Schelling diagram", diagram.fresh, (), " for each choice of restrained agents"),
        [
            f"restrained among the other {diagram.agents - 1}",
            f"return of {diagram.restrained} (restrained)",
            f"return of {diagram.greedy} (greedy)",
        ],
        [(str(count), *(str(estimate(values)) for values in pair)) for count, pair in enumerate(payoffs)],
        texts=0,
    )
