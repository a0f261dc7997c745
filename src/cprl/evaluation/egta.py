"""analyse: what an empirical game amounts to, with what replicas leave open.

The means over replicas are one game; alpha-rank, the equilibria and the replicator dynamics are those of this
game. Only replicas are independent, so the bootstrap draws as many replicas with replacement, the same ones
for all payoffs, and analyses the game of their means anew: the interval of a run's share is that between the
2.5 and the 97.5 per cent quantiles, and an equilibrium is as certain as the share of these games that have
it. With few replicas such intervals are too narrow rather than too wide.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from cprl.evaluation.empirical_game import EmpiricalGame
from cprl.evaluation.evaluate import how_they_play, table_of
from cprl.measuring.statistics import CONFIDENCE, Estimate, estimate
from cprl.system.defaults import EGTA_RESAMPLES
from cprl.terminal import style
from cprl.theory.payoff_table import PayoffTable, Values, compositions
from cprl.theory.solutions import (
    MOST_STRATEGIES,
    AlphaRank,
    Ends,
    Equilibrium,
    alpha_rank,
    equilibria,
    replicator,
    replicator_ends,
)
from cprl.values import Range, checked


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
    table = game.table()
    drawn = rng.integers(replicas, size=(resamples if replicas > 1 else 0, replicas))
    # Few replicas have few resamples that differ: each is analysed once.
    times = Counter(tuple(sorted(places)) for places in drawn.tolist())
    again = [(game.table(places), count) for places, count in times.items()]
    rank = alpha_rank(table)
    return Analysis(
        game=game,
        table=table,
        resamples=len(drawn),
        rank=rank,
        shares=_shares(rank, again, replicas),
        pure=_certainty(table, again),
        equilibria=equilibria(table.reduced) if table.strategies <= MOST_STRATEGIES else (),
        in_support=_in_support(table, again),
        ends=replicator_ends(table, seed=seed),
    )


def _shares(rank: AlphaRank, again: list[tuple[PayoffTable, int]], replicas: int) -> tuple[Estimate, ...]:
    bounds = np.full((2, len(rank.shares)), np.nan)
    if again:
        ranks = [np.tile(alpha_rank(resample).shares, (count, 1)) for resample, count in again]
        margin = (1 - CONFIDENCE) / 2
        bounds = np.quantile(np.concatenate(ranks), [margin, 1 - margin], axis=0)
    return tuple(
        Estimate(value=float(share), low=float(low), high=float(high), replicas=replicas)
        for share, low, high in zip(rank.shares, *bounds, strict=True)
    )


def _certainty(table: PayoffTable, again: list[tuple[PayoffTable, int]]) -> dict[tuple[int, ...], float]:
    times: Counter[tuple[int, ...]] = Counter()
    for resample, count in again:
        for counts in resample.pure_equilibria:
            times[counts] += count
    total = sum(count for _, count in again)
    return {counts: times[counts] / total if total else float("nan") for counts in table.pure_equilibria}


def _in_support(table: PayoffTable, again: list[tuple[PayoffTable, int]]) -> Values:
    shares = np.zeros(table.strategies)
    if not again or table.agents > 2 or table.strategies > MOST_STRATEGIES:
        return np.full(table.strategies, np.nan)
    for resample, count in again:
        symmetric = [equilibrium for equilibrium in equilibria(resample) if equilibrium.is_symmetric]
        shares[sorted({run for equilibrium in symmetric for run in equilibrium.support})] += count
    return shares / sum(count for _, count in again)


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
    game = analysis.game
    yield _pairs(game) if game.agents == 2 else _compositions(game)
    yield _runs(analysis)
    yield _equilibria_table(analysis)


def _pairs(game: EmpiricalGame) -> Table:
    others = "the other" if game.of_agents == 2 else f"all other {game.of_agents - 1}"
    pairs = np.array([game.table([place]).pairs for place in range(len(game.payoffs))])
    rows = [
        (name, *(str(estimate(pairs[:, place, other])) for other in range(len(game.names))))
        for place, name in enumerate(game.names)
    ]
    title = f"return of an agent, by its run and that of {others}"
    return table_of(title, ["an agent \\ others", *game.names], rows)


def _compositions(game: EmpiricalGame) -> Table:
    rows = [
        (
            composition_text(counts, game.names),
            *(
                str(estimate(game.payoffs[:, place, run])) if count else ""
                for run, count in enumerate(counts)
            ),
        )
        for place, counts in enumerate(compositions(game.agents, len(game.names)).tolist())
    ]
    title = "return of an agent of each run, by how many agents play as each"
    return table_of(title, ["agents", *game.names], rows)


def _runs(analysis: Analysis) -> Table:
    title = "alpha-rank at the limit of infinite alpha: share of the agents in the long run"
    if analysis.resamples:
        title += f" [95 % interval, {analysis.resamples} resamples of the replicas]"
    is_certain = not np.isnan(analysis.in_support).any()
    columns = ["run", "share", *["resamples in which a symmetric equilibrium plays it"] * is_certain]
    rows = [
        (name, _share(share), *[f"{certain:.0%}"] * is_certain)
        for name, share, certain in zip(
            analysis.game.names, analysis.shares, analysis.in_support, strict=True
        )
    ]
    return table_of(title, columns, rows)


def _equilibria_table(analysis: Analysis) -> Table:
    names, rows = analysis.game.names, []
    for counts, certain in analysis.pure.items():
        resamples = "" if isnan(certain) else f"in {certain:.0%} of the resamples"
        rows.append(("no agent gains by another run", composition_text(counts, names), resamples))
    if not analysis.pure:
        rows.append(("no agent gains by another run", "no composition", ""))
    of_pair = (
        "Nash equilibrium (nashpy)" if analysis.game.agents == 2 else "Nash equilibrium of pairs (nashpy)"
    )
    for equilibrium in analysis.equilibria:
        both = [mixture_text(side, names) for side in (equilibrium.first, equilibrium.second)]
        rows.append((of_pair, both[0] if equilibrium.is_symmetric else " against ".join(both), ""))
    for mixture, share in zip(analysis.ends.mixtures, analysis.ends.shares, strict=True):
        starts = f"from {share:.0%} of the starts"
        rows.append(("end of replicator dynamics", mixture_text(mixture, names), starts))
    if analysis.ends.unsettled > 0:
        starts = f"from {analysis.ends.unsettled:.0%} of the starts"
        rows.append(("end of replicator dynamics", "none, or a late one", starts))
    return table_of("equilibria", ["", "what is played", "how certain"], rows, texts=2)


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
    tables = [analysis.game.table([place]) for place in range(len(analysis.game.payoffs))]
    curves = np.array([[_gain(table, share) for share in shares] for table in tables])
    means = [estimate(gains) for gains in curves.T]
    middle = np.array([mean.value for mean in means])
    axes.fill_between(
        shares,
        [mean.low for mean in means],
        [mean.high for mean in means],
        color=style.REPLICA,
        alpha=0.35,
        lw=0,
    )
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
    axes.set_xlabel(f"share that plays as {first}", fontsize=style.SMALL_PT)
    axes.set_ylabel(f"return as {first} less that as {second}", fontsize=style.SMALL_PT)
    axes.tick_params(labelsize=style.SMALL_PT)
    axes.set_title("replicator dynamics: rests that attract (filled) or repel", fontsize=style.SMALL_PT)


def _gain(table: PayoffTable, share: float) -> float:
    first, second = table.against([share, 1 - share])
    return float(first - second)


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
    for corner, name, (align, height) in zip(
        _CORNERS,
        analysis.game.names,
        (("center", "top"), ("center", "top"), ("center", "bottom")),
        strict=True,
    ):
        offset = (0, 16 if height == "bottom" else -12)
        axes.annotate(
            name, corner, offset, textcoords="offset points", ha=align, va=height, fontsize=style.SMALL_PT
        )
    axes.set(xlim=(-0.08, 1.08), ylim=(-0.1, 1.06), aspect="equal")
    axes.set_axis_off()
    axes.set_title("replicator dynamics; dots: where starts end", fontsize=style.SMALL_PT)


def _draw_deviations(axes: Axes, analysis: Analysis) -> None:
    """An arrow from the run that all play to each by which one agent gains."""
    game, names = analysis.game, analysis.game.names
    angles = np.pi / 2 - 2 * np.pi * np.arange(len(names)) / len(names)
    places = np.stack([np.cos(angles), np.sin(angles)], 1)
    pairs = np.array([game.table([place]).pairs for place in range(len(game.payoffs))])
    for to in range(len(names)):
        for start in range(len(names)):
            gain = estimate(pairs[:, to, start] - pairs[:, start, start])
            if to == start or gain.value <= 0:
                continue
            colour, line = (style.MEAN, "-") if gain.low > 0 else (_UNCERTAIN, "--")
            axes.annotate(
                "",
                places[to],
                places[start],
                arrowprops={
                    "arrowstyle": "-|>",
                    "color": colour,
                    "linestyle": line,
                    "shrinkA": 16,
                    "shrinkB": 16,
                    "connectionstyle": "arc3,rad=0.12",
                },
            )
    for (x, y), name, share in zip(places, names, analysis.shares, strict=True):
        axes.plot(x, y, "o", color=style.MARK, markersize=5 + 14 * share.value, zorder=4)
        axes.text(1.32 * x, 1.22 * y, name, ha="center", va="center", fontsize=style.SMALL_PT)
    axes.set(xlim=(-1.6, 1.6), ylim=(-1.4, 1.4), aspect="equal")
    axes.set_axis_off()
    axes.set_title(
        "by which run one agent gains where all play another\n(dashed: the interval holds 0)",
        fontsize=style.SMALL_PT,
    )


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
    axes.tick_params(labelsize=style.SMALL_PT)
    axes.set_xlabel("share of the agents in the long run", fontsize=style.SMALL_PT)
    axes.set_title("alpha-rank, infinite alpha", fontsize=style.SMALL_PT)
