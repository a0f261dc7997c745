"""play_empirical_game: the game whose strategies are stored runs, and whose payoffs are their returns.
analyse: what it amounts to, with what replicas leave open.

For N agents and S runs every composition is played, so many agents of one run and so many of the next:
C = (N + S - 1)! / (N! (S - 1)!), each shifted by one index at a time, so that each run has each index as
often as every other. An agent plays as the run's agent with its index, replica r with replica r.

`pairwise_game` makes a game of two agents of what `crossplay` played. For N = 2 it is the same game; for more
agents a reduction that knows what the first agent gains who deviates from the run of all others, and nothing
of mixes; its equilibria in which one run is played are those of the whole game, the others need not be.

The means over replicas are one game, which is analysed. Only replicas are independent, so the bootstrap draws
as many with replacement, the same ones for all payoffs, and analyses the game of their means anew: the
interval of a run's share is that between the 2.5 and the 97.5 per cent quantiles, and an equilibrium is as
certain as the share of these games that have it. With few replicas such intervals are too narrow.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import permutations
from math import isnan, nan
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from matplotlib.axes import Axes

from cprl.evaluation.cross_play import CrossPlay, Runs, draw_matrix, matrix_height, matrix_table, named_runs
from cprl.evaluation.evaluate import SEED, heading
from cprl.evaluation.lanes import Part, Played, Results, Who, agents_of, fresh_of, shifted
from cprl.measuring.statistics import CONFIDENCE, HOLM, Estimate, estimate, starred
from cprl.system.defaults import EGTA_RESAMPLES
from cprl.system.working import say_how_far, working
from cprl.terminal import style
from cprl.terminal.tables import Cells
from cprl.theory.payoff_table import PayoffTable, Values, compositions
from cprl.theory.solutions import (
    MOST_PROFILES,
    MOST_STRATEGIES,
    AlphaRank,
    Ends,
    Equilibrium,
    alpha_rank,
    equilibria,
    replicator,
    replicator_ends,
)
from cprl.training.agents import LoadedRun
from cprl.values import Range, checked


@dataclass(frozen=True, kw_only=True, eq=False)
class EmpiricalGame(Results):
    """A game of N agents whose strategies are S runs, with the episodes by "runs", the names of all agents'
    runs, or as `CrossPlay` has them; see the docstring of this module."""

    runs: Mapping[str, LoadedRun]
    """The S runs by name."""
    agents: int
    """N of this game: 2 of a pairwise one."""
    of_agents: int
    """The agents of the game that was played."""
    payoffs: Values
    """float64 [R, C, S]: the mean return of an agent of a run by replica and composition, in the rows of
    `cprl.theory.compositions(agents, S)`; NaN where nobody plays as the run."""

    def __repr__(self) -> str:
        return f"EmpiricalGame({', '.join(self.runs)}; {self.agents} agents, {self.fresh})"

    @property
    def names(self) -> list[str]:
        return list(self.runs)

    @property
    def is_reduction(self) -> bool:
        """Whether more agents played than this game has."""
        return self.agents < self.of_agents

    def payoff_table(self, replicas: Sequence[int] | None = None) -> PayoffTable:
        """The mean payoffs over replicas.

        Args:
            replicas: their places in `payoffs`, e.g. a resample; by default all once.
        """
        payoffs = self.payoffs if replicas is None else self.payoffs[list(replicas)]
        return PayoffTable(agents=self.agents, payoffs=payoffs.mean(0))

    @cached_property
    def pairs(self) -> Values:
        """Of a game of two agents, or of the reduction to pairs, float64 [R, S, S]."""
        return np.array([self.payoff_table([place]).pairs for place in range(len(self.payoffs))])


@working("playing all compositions")
def play_empirical_game(
    runs: Runs,
    *,
    episodes: int = 5,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
) -> EmpiricalGame:
    """Plays all compositions of runs.

    Args:
        runs: at least two runs of the same game, as for `crossplay`. With S runs and N agents up to 256
            profiles S^N are allowed, e.g. four runs of four agents; `pairwise_game` has no such bound.
        episodes: episodes of each replica and choice of who plays where, each in its own world; the choices
            are N (C - S) + S.
    """
    named = named_runs(runs)
    names = list(named)
    agents = named[names[0]].game.agents
    if (profiles := len(named) ** agents) > MOST_PROFILES:
        raise ValueError(
            f"{len(named)} runs of {agents} agents have {profiles:,} profiles; allowed: at most "
            f"{MOST_PROFILES}; crossplay and pairwise_game (cprl egta --pairwise) take more"
        )
    fresh = fresh_of(named.values(), episodes=episodes, greedy=greedy, seed=seed, replicas=replicas)
    of_runs = [agents_of(run) for run in named.values()]
    parts: list[Part] = []
    payoffs = []
    for counts in compositions(agents, len(named)).tolist():
        played = {}
        for who in shifted(counts):
            say_how_far(len(parts), None, "populations")
            mixed = [of_runs[run][agent] for agent, run in enumerate(who)]
            played[who] = fresh.play(named[names[who[0]]], mixed, among=named.values())
            parts.append(Part({"runs": " ".join(names[run] for run in who)}, played[who]))
        payoffs.append(_payoffs(len(named), played))
    return EmpiricalGame(
        runs=named, agents=agents, of_agents=agents, payoffs=np.stack(payoffs, 1), fresh=fresh, parts=parts
    )


def pairwise_game(played: CrossPlay) -> EmpiricalGame:
    """The game of two agents that a cross-play makes; see the docstring of this module.

    Args:
        played: the cross-play; its `diagonal` says who plays where both play as one run.
    """
    count, cells = len(played.runs), played.cells
    returns = np.stack([cell.mean_returns("focal") for cell in cells.values()], 1).reshape(-1, count, count)
    return EmpiricalGame(
        runs=played.runs,
        agents=2,
        of_agents=next(iter(played.runs.values())).game.agents,
        payoffs=np.array(
            [PayoffTable.of_pairs(pairs).payoffs for pairs in returns.reshape(-1, count, count)]
        ),
        fresh=played.fresh,
        parts=played.parts,
    )


def _payoffs(runs: int, played: Mapping[Who, Played]) -> Values:
    """The mean return of an agent of each run, [R, S]; NaN for a run that does not play."""
    replicas = next(iter(played.values()))
    payoffs = np.full((len(replicas), runs), np.nan)
    for place, replica in enumerate(replicas):
        for run in {run for who in played for run in who}:
            of_run = [
                one.return_[np.array(who) == run] for who, all_ in played.items() for one in all_[replica]
            ]
            payoffs[place, run] = np.concatenate(of_run).mean()
    return payoffs


@dataclass(frozen=True, kw_only=True, eq=False)
class Analysis:
    """What an empirical game amounts to; see the docstring of this module."""

    game: EmpiricalGame
    table: PayoffTable = field(repr=False)
    """The means over replicas."""
    resamples: int
    """Of the bootstrap; 0 for a single replica."""
    rank: AlphaRank = field(repr=False)
    shares: tuple[Estimate, ...]
    """The share of the agents that play as each run in the long run of alpha-rank, with its interval."""
    pure: dict[tuple[int, ...], float] = field(repr=False)
    """The compositions in which no agent gains by playing as another run, by the number of agents of each
    run, with the share of the resamples that have it too; NaN for a single replica."""
    equilibria: tuple[Equilibrium, ...]
    """By nashpy, of a game of two agents, of a larger one of its reduction; empty for more than 6 runs."""
    in_support: Values = field(repr=False)
    """float64 [S]: the share of the resamples in which a run is played in a symmetric equilibrium of two
    agents; NaN for a single replica, more than 6 runs, and for a game of more agents."""
    ends: Ends = field(repr=False)
    """Where replicator dynamics end."""


@working("analysing the game")
def analyse(game: EmpiricalGame, *, resamples: int = EGTA_RESAMPLES, seed: int = 0) -> Analysis:
    """Analyses an empirical game.

    Args:
        resamples: the number of bootstrap resamples of the replicas.
        seed: the seed of the resampling, and of the starts of the replicator dynamics.

    Raises:
        ModuleNotFoundError: if OpenSpiel or nashpy is not installed.
    """
    resamples = checked("resamples", resamples, Annotated[int, Range(1, 100_000)])
    rng, replicas, table = np.random.default_rng(seed), len(game.payoffs), game.payoff_table()
    drawn = rng.integers(replicas, size=(resamples if replicas > 1 else 0, replicas))
    # Few replicas have few resamples that differ: each is analysed once.
    times = Counter(tuple(sorted(places)) for places in drawn.tolist())
    again = [game.payoff_table(places) for places in times]
    is_small, rank = table.strategies <= MOST_STRATEGIES, alpha_rank(table)
    bounds = np.full((2, table.strategies), np.nan)
    pure, in_support = dict.fromkeys(table.pure_equilibria, nan), np.full(table.strategies, nan)
    if again:
        weights = np.array(list(times.values())) / len(drawn)
        ranks = np.repeat([alpha_rank(resample).shares for resample in again], list(times.values()), axis=0)
        margin = (1 - CONFIDENCE) / 2
        bounds = np.quantile(ranks, [margin, 1 - margin], axis=0)
        pure = {counts: float(weights @ [counts in one.pure_equilibria for one in again]) for counts in pure}
        if table.agents == 2 and is_small:
            in_support = weights @ np.array([_is_played(resample) for resample in again], float)
    return Analysis(
        game=game,
        table=table,
        resamples=len(drawn),
        rank=rank,
        shares=tuple(
            Estimate(value=float(share), low=float(low), high=float(high), replicas=replicas)
            for share, low, high in zip(rank.shares, *bounds, strict=True)
        ),
        pure=pure,
        equilibria=equilibria(table.reduced) if is_small else (),
        in_support=in_support,
        ends=replicator_ends(table, seed=seed),
    )


def _is_played(table: PayoffTable) -> list[bool]:
    """Whether each run is played in a symmetric equilibrium."""
    symmetric = [equilibrium for equilibrium in equilibria(table) if equilibrium.is_symmetric]
    played = {run for equilibrium in symmetric for run in equilibrium.support}
    return [run in played for run in range(table.strategies)]


_LEAST: Final = 0.005
"""Smaller shares are not told."""
_CHOICES: Final = " for each choice of who plays where"


def egta_heading(game: EmpiricalGame) -> str:
    kind = "Pairwise reduction of the empirical game" if game.is_reduction else "Empirical game"
    return heading(kind, game.fresh, game.runs.values(), _CHOICES)


def egta_tables(analysis: Analysis) -> Iterator[Cells]:
    """The payoffs, the runs by alpha-rank, the equilibria, and where replicator dynamics end."""
    yield _payoff_table(analysis.game)
    title = "alpha-rank at the limit of infinite alpha: share of the agents in the long run"
    if analysis.resamples:
        title += f" [95 % interval, {analysis.resamples} resamples of the replicas]"
    is_certain = not np.isnan(analysis.in_support).any()
    columns = ["run", "share", *["resamples in which a symmetric equilibrium plays it"] * is_certain]
    rows = [
        (
            name,
            f"{share.value:.2f}" + f" [{share.low:.2f}, {share.high:.2f}]" * (not isnan(share.low)),
            *[f"{certain:.0%}"] * is_certain,
        )
        for name, share, certain in zip(
            analysis.game.names, analysis.shares, analysis.in_support, strict=True
        )
    ]
    yield Cells(title, columns, rows)
    yield Cells("equilibria", ["", "what is played", "how certain"], list(_ends(analysis)), texts=2)


def _payoff_table(game: EmpiricalGame) -> Cells:
    """By the runs of both of two agents, else by how many agents play as each."""
    if game.agents == 2:
        others = "the other" if game.of_agents == 2 else f"all other {game.of_agents - 1}"
        title = f"return of an agent, by its run and the run of {others}"
        cells = {
            (name, other): estimate(game.pairs[:, row, column])
            for row, name in enumerate(game.names)
            for column, other in enumerate(game.names)
        }
        return matrix_table(title, "an agent \\ others", game.names, cells)
    rows = []
    for place, counts in enumerate(compositions(game.agents, len(game.names)).tolist()):
        means = zip(game.payoffs[:, place].T, counts, strict=True)
        texts = (str(estimate(of_run)) if count else "" for of_run, count in means)
        rows.append((composition_text(counts, game.names), *texts))
    title = "return of an agent of each run, by how many agents play as each"
    return Cells(title, ["agents", *game.names], rows)


def _ends(analysis: Analysis) -> Iterator[tuple[str, str, str]]:
    """What no agent leaves alone, the Nash equilibria, and where the dynamics end."""
    names = analysis.game.names
    for counts, certain in analysis.pure.items():
        resamples = "" if isnan(certain) else f"in {certain:.0%} of the resamples"
        yield "no agent gains by another run", composition_text(counts, names), resamples
    if not analysis.pure:
        yield "no agent gains by another run", "no composition", ""
    of_pairs = "" if analysis.game.agents == 2 else " of pairs"
    for equilibrium in analysis.equilibria:
        both = [mixture_text(side, names) for side in (equilibrium.first, equilibrium.second)]
        played = both[0] if equilibrium.is_symmetric else " against ".join(both)
        yield f"Nash equilibrium{of_pairs} (nashpy)", played, ""
    ends = [mixture_text(mixture, names) for mixture in analysis.ends.mixtures]
    shares = [*analysis.ends.shares, analysis.ends.unsettled]
    for end, share in zip([*ends, "none, or a late one"], shares, strict=True):
        if share > 0:
            yield "end of replicator dynamics", end, f"from {share:.0%} of the starts"


def composition_text(counts: Sequence[int], names: Sequence[str]) -> str:
    """A composition in words, e.g. "3 dqn, 1 ppo"."""
    return ", ".join(f"{count} {name}" for count, name in zip(counts, names, strict=True) if count)


def mixture_text(mixture: Values, names: Sequence[str]) -> str:
    """A mixture in words, e.g. "dqn 0.75, ppo 0.25"; one strategy by its name alone."""
    played = [(name, share) for name, share in zip(names, mixture, strict=True) if share >= _LEAST]
    return played[0][0] if len(played) == 1 else ", ".join(f"{name} {share:.2f}" for name, share in played)


_POINTS: Final = 41
_GRID: Final = 14
_CORNERS: Final = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 3**0.5 / 2]])
_DYNAMICS_HIGH: Final = 22.0


def draw_egta(analysis: Analysis, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draws what one agent gains that plays as another run than all others, with a star where it is not 0 by
    Holm's method; each run's share by alpha-rank, with the most frequent end of replicator dynamics; and the
    phase portrait of these dynamics where there are two or three runs."""
    game, names = analysis.game, analysis.game.names
    usual = np.diagonal(game.pairs, axis1=1, axis2=2)
    gains = {
        (names[played], names[others]): estimate(game.pairs[:, played, others] - usual[:, others])
        for played, others in permutations(range(len(names)), 2)
    }
    texts = dict(zip(gains, starred(list(gains.values()), "+.3g"), strict=True))
    texts |= {(name, name): f"{mean:.3g}" for name, mean in zip(names, usual.mean(0), strict=True)}
    with style.drawing(path, width=width, colours=style.SHADES, is_new=True) as sheet:
        columns = sheet.fitting(2, 24)
        ratios: Any = {"width_ratios": (1.35, 1)} if columns == 2 else {}
        draw_dynamics = {2: _draw_line, 3: _draw_simplex}.get(len(names))
        heights = [matrix_height(names)] * (3 - columns) + [_DYNAMICS_HIGH] * bool(draw_dynamics)
        panels = sheet.panels(2 + bool(draw_dynamics), columns=columns, high=heights, **ratios)
        matrix, rank = panels[:2]
        if draw_dynamics:
            draw_dynamics(panels[2], analysis)
        differences = {pair: gain.value for pair, gain in gains.items()}
        draw_matrix(sheet, matrix, names, differences, texts, share=1.15 / columns)
        matrix.set(xlabel="run of all others", ylabel="run of an agent")
        matrix.set_title("gain of an agent by another run")
        places = np.arange(len(names))
        share, low, high = np.array([(share.value, share.low, share.high) for share in analysis.shares]).T
        rank.barh(places, share, color=style.REPLICA, height=0.6)
        rank.hlines(places, low, high, color=style.PUBLISHED)
        if len(analysis.ends.mixtures):
            label = f"end of replicator dynamics, from {analysis.ends.shares[0]:.0%} of the starts"
            rank.plot(analysis.ends.mixtures[0], places, "D", color=style.MARK, label=label, clip_on=False)
        rank.set_yticks(places, [style.wrapped(name, 9) for name in names])
        rank.set(xlim=(0, 1), ylim=(len(places) - 0.5, -0.5), xlabel="share of the agents in the long run")
        rank.set_title("alpha-rank, infinite alpha")
        kind = (
            f"pairwise reduction of {game.of_agents} agents" if game.is_reduction else f"{game.agents} agents"
        )
        sheet.title = f"Empirical game of {', '.join(names)}"
        sheet.caption = (
            f"{kind}; {game.fresh}{_CHOICES}. {HOLM} for these {len(gains)}; diagonal: an agent's return; "
            f"intervals of shares: 95 % of {analysis.resamples} resamples of the replicas."
        )
    return Path(path)


def _draw_line(axes: Axes, analysis: Analysis) -> None:
    """What the first of two runs gains over the second, by its share, with the points of rest."""
    shares, (first, second) = np.linspace(0, 1, _POINTS), analysis.game.names
    tables = [analysis.game.payoff_table([place]) for place in range(len(analysis.game.payoffs))]
    curves = [[np.subtract(*table.against([share, 1 - share])) for share in shares] for table in tables]
    means = [estimate(gains) for gains in np.transpose(curves)]
    middle, low, high = np.array([(mean.value, mean.low, mean.high) for mean in means]).T
    axes.fill_between(shares, low, high, color=style.REPLICA, alpha=0.35, lw=0)
    axes.plot(shares, middle, color=style.MEAN)
    axes.axhline(0, color=style.RAW, lw=1, zorder=1)
    for at, is_stable in _rests(shares, middle):
        face = style.MARK if is_stable else "white"
        axes.plot(at, 0, "o", markersize=8, color=style.MARK, markerfacecolor=face, clip_on=False, zorder=4)
    for start in (0.12, 0.37, 0.62, 0.87):
        ahead = 0.03 if np.interp(start, shares, middle) > 0 else -0.03
        axes.annotate(
            "", (start + ahead, 0), (start - ahead, 0), arrowprops={"arrowstyle": "->", "color": style.MARK}
        )
    axes.set(
        xlim=(-0.02, 1.02), xlabel=f"share that plays as {first}", ylabel=f"return as {first} less {second}"
    )
    axes.set_title("replicator dynamics, filled: attracts")


def _rests(shares: Values, gains: Values) -> list[tuple[float, bool]]:
    """Where nothing changes, and whether shares nearby move there."""
    rests = [(0.0, bool(gains[0] < 0)), (1.0, bool(gains[-1] > 0))]
    for place in np.flatnonzero(gains[:-1] * gains[1:] < 0):
        low, high = gains[place], gains[place + 1]
        at = shares[place] + (shares[place + 1] - shares[place]) * low / (low - high)
        rests.append((float(at), bool(low > 0)))
    return rests


def _draw_simplex(axes: Axes, analysis: Analysis) -> None:
    """The direction in which the shares of three runs move, where they end, and the corners by name."""
    axes.plot(*np.vstack([_CORNERS, _CORNERS[:1]]).T, color=style.RAW, lw=1)
    mixtures = (compositions(_GRID - 3, 3) + 1) / _GRID
    moves = np.array([replicator(analysis.table.normalised, mixture) for mixture in mixtures]) @ _CORNERS
    lengths = np.linalg.norm(moves, axis=1, keepdims=True)
    arrows = np.divide(moves, lengths, out=np.zeros_like(moves), where=lengths > 0)
    axes.quiver(
        *(mixtures @ _CORNERS).T, *arrows.T, lengths[:, 0], cmap="viridis", scale=24, width=0.005, pivot="mid"
    )
    for mixture, share in zip(analysis.ends.mixtures, analysis.ends.shares, strict=True):
        at = mixture @ _CORNERS
        axes.plot(*at, "o", color=style.MARK, markersize=9, zorder=4)
        offset = (9, -9) if at[1] > _CORNERS[:, 1].max() - 0.1 else (8, 8)  # not over the name of the top
        axes.annotate(f"{share:.0%}", at, offset, textcoords="offset points")
    for corner, name in zip(_CORNERS, analysis.game.names, strict=True):
        at, side = ((0, 3), "bottom") if corner[1] > 0 else ((0, -3), "top")
        axes.annotate(name, corner, at, textcoords="offset points", ha="center", va=side)
    axes.set(xlim=(-0.08, 1.08), ylim=(-0.1, 1.06), aspect="equal")
    axes.set_axis_off()
    axes.set_title("replicator dynamics, bright: fast")
