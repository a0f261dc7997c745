"""schelling: what restrained and greedy agents get, by how many of the others are restrained.

All mixes of N agents are played: k restrained and N - k greedy ones, for k = 0 to N. Where both kinds play, a
mix is played N times, with the restrained agents at the indices s to s + k - 1, cyclically, for each s, so
that each index is restrained as often as every other. A replica's payoff is the mean over those and its
episodes.

Source: T. C. Schelling, "Hockey Helmets, Concealed Weapons, and Daylight Saving" (1973); for policies of
agents that learn, E. Hughes et al. (2018) and J. Perolat et al. (2017).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from cprl.commons.game import Game
from cprl.custom import trust
from cprl.evaluation.evaluate import INTERVALS, SEED, table_of
from cprl.evaluation.lanes import Fresh, Played, pooled
from cprl.evaluation.populations import agent_named, place_of, play_population
from cprl.measuring.dilemmas import Dilemma, dilemma
from cprl.measuring.statistics import Measured, estimate, social_measures
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.runs.episodes import labelled
from cprl.terminal import style

_ALIKE_WITHOUT_A_BEAM: Final = {"greedy", "territorial"}

Values = NDArray[np.float64]
Who = tuple[int, ...]
"""The indices of the restrained agents, ascending."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SchellingDiagram:
    """The episodes of all mixes of restrained and greedy agents; see the docstring of this module."""

    agents: int
    """N."""
    restrained: str
    greedy: str
    """Who plays restrained, and who greedy: a scripted policy or a run."""
    played: Mapping[Who, Played] = field(repr=False)
    """The episodes by the indices of the restrained agents and the replica."""
    fresh: Fresh

    @cached_property
    def restrained_payoffs(self) -> Values:
        """R(k), float64 [R, N]: the mean return of a restrained agent, by the number k = 0 to N - 1 of
        others that are restrained."""
        return np.stack([self._payoffs(count + 1, of_restrained=True) for count in range(self.agents)], 1)

    @cached_property
    def greedy_payoffs(self) -> Values:
        """G(k), float64 [R, N]: that of a greedy agent, likewise."""
        return np.stack([self._payoffs(count, of_restrained=False) for count in range(self.agents)], 1)

    @cached_property
    def group_payoffs(self) -> Values:
        """float64 [R, N + 1]: the mean return of all agents together, by how many of them are restrained."""
        counts = np.arange(self.agents + 1)
        group = np.zeros((len(self.fresh.replicas), len(counts)))
        group[:, 1:] += counts[1:] * self.restrained_payoffs
        group[:, :-1] += counts[:0:-1] * self.greedy_payoffs
        return group

    def dilemma(self) -> Dilemma:
        return dilemma(self.restrained_payoffs, self.greedy_payoffs)

    def measures(self, count: int) -> dict[str, Measured]:
        """The social metrics of the mixes with so many restrained agents."""
        return social_measures(pooled(self.played[who] for who in self._mixes(count)))

    def table(self) -> pa.Table:
        """All episodes with the columns of `episodes.parquet`, after "restrained", the indices of the
        restrained agents as a text, e.g. "0 1"."""
        return labelled(
            ({"restrained": " ".join(map(str, who))}, replica, episodes)
            for who, played in self.played.items()
            for replica, episodes in played.items()
        )

    def _mixes(self, count: int) -> list[Who]:
        return [who for who in self.played if len(who) == count]

    def _payoffs(self, count: int, *, of_restrained: bool) -> Values:
        """The mean return of a restrained or of a greedy agent, where so many are restrained, [R]."""
        mixes, sums = self._mixes(count), np.zeros(len(self.fresh.replicas))
        for who in mixes:
            alike = [agent for agent in range(self.agents) if (agent in who) == of_restrained]
            for replica, episodes in self.played[who].items():
                sums[replica] += np.mean([episode.return_[alike] for episode in episodes])
        return sums / len(mixes)


def schelling(
    where: Any,
    *,
    restrained: str = "sustainable",
    greedy: str = "greedy",
    episodes: int = 5,
    replicas: int = 8,
    seed: int = SEED,
    allow: Sequence[str] = (),
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
    trust(*allow)
    agents = place_of(where).game.agents
    if agents < 2:
        raise ValueError("the game has 1 agent; allowed for a Schelling diagram: at least 2")
    _check_unlike(place_of(where).game, restrained, greedy)
    specs = {
        is_restrained: [agent_named(name_of, agent, replica=None, name=name) for agent in range(agents)]
        for is_restrained, name, name_of in ((True, "restrained", restrained), (False, "greedy", greedy))
    }
    return SchellingDiagram(
        agents=agents,
        restrained=restrained,
        greedy=greedy,
        played={
            who: play_population(
                where,
                [specs[agent in who][agent] for agent in range(agents)],
                episodes=episodes,
                replicas=replicas,
                seed=seed,
            )
            for who in _mixes(agents)
        },
        fresh=Fresh(replicas=tuple(range(replicas)), episodes=episodes, seed=seed),
    )


def _check_unlike(game: Any, restrained: str, greedy: str) -> None:
    """Refuses the same policy twice, also in other words."""
    one, other = (who if who in SCRIPTED_POLICIES else Path(who).resolve() for who in (restrained, greedy))
    if one == other:
        words = f"both {greedy!r}" if restrained == greedy else f"{restrained!r} and {greedy!r}, the same run"
        raise ValueError(f"restrained and greedy are {words}; allowed: two ways to play")
    if isinstance(game, Game) and not game.rules.may_fire and {one, other} <= _ALIKE_WITHOUT_A_BEAM:
        raise ValueError(
            f"restrained is {restrained!r} and greedy {greedy!r}, which play alike without a beam; "
            "allowed: two ways to play"
        )


def _mixes(agents: int) -> list[Who]:
    return [
        tuple(sorted((first + place) % agents for place in range(count)))
        for count in range(agents + 1)
        for first in range(agents if 0 < count < agents else 1)
    ]


_RESTRAINED: Final = "#1b7837"
_GREEDY: Final = "#b2182b"
_SIZE_IN: Final = (7.5, 3.6)


def draw_schelling(diagram: SchellingDiagram, path: Path | str) -> Path:
    """Draws what an agent gets that is restrained or greedy, by how many of the others are restrained; beside
    it what all get together.
    """
    path = style.check_picture(path)
    figure = Figure(_SIZE_IN, layout="constrained")
    single, group = figure.subplots(1, 2)
    for payoffs, who, role, colour, marker in (
        (diagram.restrained_payoffs, diagram.restrained, "restrained", _RESTRAINED, "o"),
        (diagram.greedy_payoffs, diagram.greedy, "greedy", _GREEDY, "s"),
    ):
        _line(single, payoffs, label=f"{role}: {Path(who).name}", color=colour, marker=marker)
    single.set_xlabel(f"restrained agents among the other {diagram.agents - 1}", fontsize=style.SMALL_PT)
    single.set_ylabel("return of the agent", fontsize=style.SMALL_PT)
    single.legend(fontsize=style.SMALL_PT)
    _line(group, diagram.group_payoffs, color=style.MEAN, marker="o")
    group.set_xlabel(f"restrained agents of {diagram.agents}", fontsize=style.SMALL_PT)
    group.set_ylabel("return of all together", fontsize=style.SMALL_PT)
    for axes in (single, group):
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.tick_params(labelsize=style.SMALL_PT)
    note = f"{diagram.fresh} for each choice of restrained agents; bars: 95 % intervals by Student's t"
    style.head(figure, f"Schelling diagram: {diagram.dilemma().name}", note)
    return style.save(figure, path)


def _line(axes: Axes, values: Values, **style_of_line: Any) -> None:
    """Means of [R, K] at 0 to K - 1 with their intervals."""
    estimates = [estimate(payoffs) for payoffs in values.T]
    means = np.array([mean.value for mean in estimates])
    reach = np.abs(np.array([(mean.low, mean.high) for mean in estimates]).T - means)
    axes.errorbar(range(len(means)), means, np.nan_to_num(reach), capsize=2, markersize=5, **style_of_line)
    axes.set_xticks(range(len(means)))


def schelling_tables(diagram: SchellingDiagram) -> Iterator[Table]:
    """The payoffs by the number of restrained others, and the margins between them that make a dilemma."""
    yield table_of(
        f"{diagram.fresh} for each choice of restrained agents, seed {diagram.fresh.seed}\n{INTERVALS}",
        [
            f"restrained among the other {diagram.agents - 1}",
            f"return of {diagram.restrained} (restrained)",
            f"return of {diagram.greedy} (greedy)",
        ],
        [
            (str(count), str(estimate(restrained)), str(estimate(greedy)))
            for count, (restrained, greedy) in enumerate(
                zip(diagram.restrained_payoffs.T, diagram.greedy_payoffs.T, strict=True)
            )
        ],
        texts=0,
    )
    dilemma, last = diagram.dilemma(), diagram.agents - 1
    margins = {
        f"restraint of all instead of none, R({last}) - G(0)": dilemma.restraint,
        f"company of the restrained, R({last}) - R(0)": dilemma.company,
        "fear, G(0) - R(0)": dilemma.fear,
        f"greed, G({last}) - R({last})": dilemma.greed,
    }
    yield table_of(
        f"{dilemma.name}, by returns",
        ["", "difference, paired by replica"],
        [(name, str(margin)) for name, margin in margins.items()],
    )
