"""play_empirical_game: the game whose strategies are stored runs, and whose payoffs are their returns.
analyse: what it amounts to, with what replicas leave open.

Each agent plays as a run, i.e. as the run's agent with its index. For N agents and S runs every composition
is played, so many agents of one run and so many of the next: C = (N + S - 1)! / (N! (S - 1)!). A composition
of several runs is played N times, with the agents of the first run from index s on, cyclically, then those of
the second and so on, for each s, so that each run has each index as often as every other index. Replica r is
that of all runs, in the same worlds for all compositions; agents of one run learned together.

`pairwise_game` makes a game of two agents of what `crossplay` played, the payoffs of one focal agent by its
run and that of the background agents. For N = 2 it is the same game. For more agents it is a reduction that
knows what the first agent gains who deviates from the run of all others, and nothing of mixes; its equilibria
in which one run is played are those of the whole game, the others need not be.

The means over replicas are one game; alpha-rank, the equilibria and the replicator dynamics are those of this
game. Only replicas are independent, so the bootstrap draws as many replicas with replacement, the same ones
for all payoffs, and analyses the game of their means anew: the interval of a run's share is that between the
2.5 and the 97.5 per cent quantiles, and an equilibrium is as certain as the share of these games that have
it. With few replicas such intervals are too narrow rather than too wide.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from cprl.evaluation.cross_play import CrossPlay, Runs, named_runs
from cprl.evaluation.evaluate import SEED, fresh_episodes, how_they_play, table_of
from cprl.evaluation.lanes import Part, Played, Results, agents_of
from cprl.measuring.statistics import CONFIDENCE, Estimate, estimate
from cprl.system.defaults import EGTA_RESAMPLES
from cprl.terminal import style
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

Who = tuple[int, ...]
"""Which run each agent plays as."""


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

    @property
    def pairs(self) -> Values:
        """Of a game of two agents, or of the reduction to pairs, float64 [R, S, S]."""
        return np.array([self.payoff_table([place]).pairs for place in range(len(self.payoffs))])


def play_empirical_game(
    runs: Runs,
    *,
    episodes: int = 5,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
    allow: Sequence[str] = (),
) -> EmpiricalGame:
    """Plays all compositions of runs.

    Args:
        runs: at least two runs of the same game, as for `crossplay`. With S runs and N agents up to 256
            profiles S^N are allowed, e.g. four runs of four agents; `pairwise_game` has no such bound.
        episodes: episodes of each replica and choice of who plays where, each in its own world; the choices
            are N (C - S) + S.
    """
    named = named_runs(runs, allow, command="egta")
    names = list(named)
    agents = named[names[0]].game.agents
    if agents < 2:
        raise ValueError("the game has 1 agent; allowed for an empirical game: at least 2")
    if (profiles := len(named) ** agents) > MOST_PROFILES:
        raise ValueError(
            f"{len(named)} runs of {agents} agents have {profiles:,} profiles; allowed: at most "
            f"{MOST_PROFILES}; crossplay and pairwise_game (cprl egta --pairwise) take more"
        )
    fresh = fresh_episodes(named.values(), episodes=episodes, greedy=greedy, seed=seed, replicas=replicas)
    of_runs = [agents_of(run) for run in named.values()]
    parts, payoffs = [], []
    for counts in compositions(agents, len(named)).tolist():
        played = {}
        for who in _choices(counts):
            mixed = [of_runs[run][agent] for agent, run in enumerate(who)]
            played[who] = fresh.play(named[names[who[0]]], mixed)
            parts.append(Part({"runs": " ".join(names[run] for run in who)}, played[who]))
        payoffs.append(_payoffs(len(named), played))
    return EmpiricalGame(
        runs=named,
        agents=agents,
        of_agents=agents,
        payoffs=np.stack(payoffs, 1),
        fresh=fresh,
        parts=parts,
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


def _choices(counts: Sequence[int]) -> list[Who]:
    """Who plays at which index, for each of N shifts; of one run alone the one way."""
    first = tuple(int(run) for run in np.repeat(np.arange(len(counts)), counts))
    shifts = len(first) if len(set(first)) > 1 else 1
    return [(*first[-shift:], *first[:-shift]) if shift else first for shift in range(shifts)]


def _payoffs(runs: int, played: Mapping[Who, Played]) -> Values:
    """The mean return of an agent of each run, [R, S]; NaN for a run that does not play."""
    payoffs = np.full((len(next(iter(played.values()))), runs), np.nan)
    for place, replica in enumerate(next(iter(played.values()))):
        for run in range(runs):
            returns = [
                episode.return_[np.array(who) == run]
                for who, by_replica in played.items()
                for episode in by_replica[replica]
            ]
            if len(of_run := np.concatenate(returns)):
                payoffs[place, run] = of_run.mean()
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


def analyse(game: EmpiricalGame, *, resamples: int = EGTA_RESAMPLES, seed: int = 0) -> Analysis:
    """Analyses an empirical game.

    Args:
        resamples: the number of bootstrap resamples of the replicas.
        seed: the seed of the resampling, and of the starts of the replicator dynamics.

    Raises:
        ModuleNotFoundError: if OpenSpiel or nashpy is not installed.
    """
    resamples = checked("resamples", resamples, Annotated[int, Range(1, 100_000)])
    rng, replicas = np.random.default_rng(seed), len(game.payoffs)
    table = game.payoff_table()
    drawn = rng.integers(replicas, size=(resamples if replicas > 1 else 0, replicas))
    # Few replicas have few resamples that differ: each is analysed once.
    times = Counter(tuple(sorted(places)) for places in drawn.tolist())
    again = [game.payoff_table(places) for places in times]
    weights = np.array(list(times.values())) / max(1, len(drawn))
    is_small = table.strategies <= MOST_STRATEGIES
    rank = alpha_rank(table)
    return Analysis(
        game=game,
        table=table,
        resamples=len(drawn),
        rank=rank,
        shares=_shares(rank, again, list(times.values()), replicas),
        pure={
            counts: float(weights @ [counts in resample.pure_equilibria for resample in again])
            if again
            else float("nan")
            for counts in table.pure_equilibria
        },
        equilibria=equilibria(table.reduced) if is_small else (),
        in_support=weights @ np.array([_is_played(resample) for resample in again], float)
        if again and table.agents == 2 and is_small
        else np.full(table.strategies, np.nan),
        ends=replicator_ends(table, seed=seed),
    )


def _shares(
    rank: AlphaRank, again: Sequence[PayoffTable], times: Sequence[int], replicas: int
) -> tuple[Estimate, ...]:
    """The shares of alpha-rank, with the middle of those of resamples that were drawn so many times."""
    bounds = np.full((2, len(rank.shares)), np.nan)
    if again:
        ranks = np.repeat([alpha_rank(resample).shares for resample in again], times, axis=0)
        margin = (1 - CONFIDENCE) / 2
        bounds = np.quantile(ranks, [margin, 1 - margin], axis=0)
    return tuple(
        Estimate(value=float(share), low=float(low), high=float(high), replicas=replicas)
        for share, low, high in zip(rank.shares, *bounds, strict=True)
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
    exploring = how_they_play(game.runs.values(), game.fresh)
    kind = "Pairwise reduction of the empirical game" if game.is_reduction else "Empirical game"
    return (
        f"{kind}: {game.fresh}{_CHOICES}, seed {game.fresh.seed}{exploring}\n"
        "returns: mean over replicas [95 % interval by Student's t]"
    )


def egta_tables(analysis: Analysis) -> Iterator[Table]:
    """The payoffs, the runs by alpha-rank, the equilibria, and where replicator dynamics end."""
    yield _payoff_table(analysis.game)
    title = "alpha-rank at the limit of infinite alpha: share of the agents in the long run"
    if analysis.resamples:
        title += f" [95 % interval, {analysis.resamples} resamples of the replicas]"
    is_certain = not np.isnan(analysis.in_support).any()
    columns = ["run", "share", *["resamples in which a symmetric equilibrium plays it"] * is_certain]
    shares = zip(analysis.game.names, analysis.shares, analysis.in_support, strict=True)
    rows = [(name, _share(share), *[f"{certain:.0%}"] * is_certain) for name, share, certain in shares]
    yield table_of(title, columns, rows)
    yield table_of("equilibria", ["", "what is played", "how certain"], _ends(analysis), texts=2)


def _payoff_table(game: EmpiricalGame) -> Table:
    """By the runs of both of two agents, else by how many agents play as each."""
    if game.agents == 2:
        others = "the other" if game.of_agents == 2 else f"all other {game.of_agents - 1}"
        rows = [
            (name, *(str(estimate(payoffs)) for payoffs in game.pairs[:, place].T))
            for place, name in enumerate(game.names)
        ]
        title = f"return of an agent, by its run and that of {others}"
        return table_of(title, ["an agent \\ others", *game.names], rows)
    rows = []
    for place, counts in enumerate(compositions(game.agents, len(game.names)).tolist()):
        payoffs = game.payoffs[:, place].T
        texts = (
            str(estimate(of_run)) if count else "" for of_run, count in zip(payoffs, counts, strict=True)
        )
        rows.append((composition_text(counts, game.names), *texts))
    title = "return of an agent of each run, by how many agents play as each"
    return table_of(title, ["agents", *game.names], rows)


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


def _share(share: Estimate) -> str:
    text = f"{share.value:.2f}"
    return text if isnan(share.low) else f"{text} [{share.low:.2f}, {share.high:.2f}]"


_SIZE_IN: Final = (9.0, 4.3)
_POINTS: Final = 41
_GRID: Final = 14
_CORNERS: Final = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 3**0.5 / 2]])
_UNCERTAIN: Final = "#9a9a9a"


def draw_egta(analysis: Analysis, path: Path | str) -> Path:
    path = style.check_picture(path)
    figure = Figure(_SIZE_IN, layout="constrained")
    dynamics, rank = figure.subplots(1, 2, width_ratios=(1.35, 1))
    draw = {2: _draw_line, 3: _draw_simplex}.get(len(analysis.game.names), _draw_deviations)
    draw(dynamics, analysis)
    _draw_rank(rank, analysis)
    game = analysis.game
    kind = f"pairwise reduction of {game.of_agents} agents" if game.is_reduction else f"{game.agents} agents"
    note = (
        f"{kind}; {game.fresh}{_CHOICES}; intervals: 95 %, of payoffs by Student's t, of shares by "
        f"{analysis.resamples} resamples of the replicas"
    )
    style.head(figure, f"Empirical game of {', '.join(game.names)}", note)
    return style.save(figure, path, colours=style.SHADES)


def _draw_line(axes: Axes, analysis: Analysis) -> None:
    """What the first run gains over the second, by its share, with the points of rest."""
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
    axes.set_xlim(-0.02, 1.02)
    style.write_small(
        axes,
        x=f"share that plays as {first}",
        y=f"return as {first} less that as {second}",
        title="replicator dynamics: rests that attract (filled) or repel",
    )


def _rests(shares: Values, gains: Values) -> list[tuple[float, bool]]:
    """Where nothing changes, and whether shares nearby move there."""
    rests = [(0.0, bool(gains[0] < 0)), (1.0, bool(gains[-1] > 0))]
    for place in np.flatnonzero(gains[:-1] * gains[1:] < 0):
        low, high = gains[place], gains[place + 1]
        at = shares[place] + (shares[place + 1] - shares[place]) * low / (low - high)
        rests.append((float(at), bool(low > 0)))
    return rests


def _draw_simplex(axes: Axes, analysis: Analysis) -> None:
    """The direction in which shares move, where they end, and the corners by name."""
    axes.plot(*np.vstack([_CORNERS, _CORNERS[:1]]).T, color=style.RAW, lw=1)
    mixtures = (compositions(_GRID - 3, 3) + 1) / _GRID
    moves = np.array([replicator(analysis.table.normalised, mixture) for mixture in mixtures]) @ _CORNERS
    lengths = np.linalg.norm(moves, axis=1, keepdims=True)
    arrows = np.divide(moves, lengths, out=np.zeros_like(moves), where=lengths > 0)
    quiver = axes.quiver(
        *(mixtures @ _CORNERS).T, *arrows.T, lengths[:, 0], cmap="viridis", scale=24, width=0.005, pivot="mid"
    )
    bar = axes.figure.colorbar(quiver, ax=axes, shrink=0.6)
    bar.set_label("speed, of payoffs scaled to 0..1", fontsize=style.SMALL_PT)
    bar.ax.tick_params(labelsize=style.SMALL_PT)
    for mixture, share in zip(analysis.ends.mixtures, analysis.ends.shares, strict=True):
        at = mixture @ _CORNERS
        axes.plot(*at, "o", color=style.MARK, markersize=9, zorder=4)
        axes.annotate(f"{share:.0%}", at, (8, 8), textcoords="offset points", fontsize=style.SMALL_PT)
    for corner, name in zip(_CORNERS, analysis.game.names, strict=True):
        is_top = corner[1] > 0
        axes.annotate(
            name,
            corner,
            (0, 16 if is_top else -12),
            textcoords="offset points",
            ha="center",
            va="bottom" if is_top else "top",
            fontsize=style.SMALL_PT,
        )
    axes.set(xlim=(-0.08, 1.08), ylim=(-0.1, 1.06), aspect="equal")
    axes.set_axis_off()
    style.write_small(axes, title="replicator dynamics; dots: where starts end")


def _draw_deviations(axes: Axes, analysis: Analysis) -> None:
    """An arrow from the run that all play to each by which one agent gains."""
    game, names = analysis.game, analysis.game.names
    angles = np.pi / 2 - 2 * np.pi * np.arange(len(names)) / len(names)
    places = np.stack([np.cos(angles), np.sin(angles)], 1)
    pairs = game.pairs
    for to in range(len(names)):
        for start in range(len(names)):
            gain = estimate(pairs[:, to, start] - pairs[:, start, start])
            if to == start or gain.value <= 0:
                continue
            colour, line = (style.MEAN, "-") if gain.low > 0 else (_UNCERTAIN, "--")
            arrow = {"arrowstyle": "-|>", "color": colour, "linestyle": line, "shrinkA": 16, "shrinkB": 16}
            arrow["connectionstyle"] = "arc3,rad=0.12"
            axes.annotate("", places[to], places[start], arrowprops=arrow)
    for (x, y), name, share in zip(places, names, analysis.shares, strict=True):
        axes.plot(x, y, "o", color=style.MARK, markersize=5 + 14 * share.value, zorder=4)
        axes.text(1.32 * x, 1.22 * y, name, ha="center", va="center", fontsize=style.SMALL_PT)
    axes.set(xlim=(-1.6, 1.6), ylim=(-1.4, 1.4), aspect="equal")
    axes.set_axis_off()
    title = "by which run one agent gains where all play another\n(dashed: the interval holds 0)"
    style.write_small(axes, title=title)


def _draw_rank(axes: Axes, analysis: Analysis) -> None:
    """The share of each run in the long run of alpha-rank, with its interval."""
    places = np.arange(len(analysis.shares))
    values = np.array([share.value for share in analysis.shares])
    axes.barh(places, values, color=style.REPLICA, height=0.6)
    for place, share in enumerate(analysis.shares):
        if not isnan(share.low):
            axes.plot([share.low, share.high], [place, place], color=style.PUBLISHED, lw=1.4)
    axes.set_yticks(places, [style.wrapped(name, 1.6) for name in analysis.game.names])
    axes.set(xlim=(0, 1), ylim=(len(places) - 0.5, -0.5))
    style.write_small(axes, x="share of the agents in the long run", title="alpha-rank, infinite alpha")
