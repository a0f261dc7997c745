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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations, product
from math import isnan, nan
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes

from cprl.evaluation.cross_play import OF_FOCAL, PAIR, Runs, named_runs
from cprl.evaluation.lanes import agents_of, fresh_for, play, said, shifted, together
from cprl.evaluation.pages import heading, matrix_cells
from cprl.experimental.payoff_table import PayoffTable, compositions
from cprl.experimental.solutions import (
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
from cprl.measuring.statistics import CONFIDENCE, HOLM, Estimate, Family, curve_interval, estimate, judged
from cprl.measuring.table import FOCAL, ROLE, by_replica
from cprl.system.defaults import EGTA_RESAMPLES, Fresh
from cprl.system.working import say_how_far, working
from cprl.terminal import style
from cprl.terminal.panels import draw_line, draw_matrix, matrix_height
from cprl.terminal.tables import Cells
from cprl.values import Range, checked
from cprl.values.arrays import Float64

COMPOSITION: Final = "composition"
"""The label that says how many agents play as each run."""
_EACH: Final = " for each choice of who plays where"


@working("playing all compositions")
def play_empirical_game(runs: Runs, fresh: Fresh = Fresh(episodes=5)) -> pa.Table:
    """Let agents of runs play in all compositions.

    Args:
        runs: at least two runs of the same game, as for `crossplay`. With S runs and N agents up to 256
            profiles S^N are allowed, e.g. four runs of four agents; `crossplay` has no such bound.
        fresh: which episodes, for each choice of who plays where; the choices are N (C - S) + S.

    Returns:
        A row for each choice, replica, episode and agent, see `cprl.measuring.table`, by "composition", how
        many agents play as each run, and "runs", the names of all agents' runs; "role" is the name of the
        agent's own.
    """
    named = named_runs(runs)
    names = list(named)
    agents = named[names[0]].game.agents
    profiles = len(named) ** agents
    if profiles > MOST_PROFILES:
        raise ValueError(
            f"{len(named)} runs of {agents} agents have {profiles:,} profiles; allowed: at most "
            f"{MOST_PROFILES}; crossplay and pairwise_game (cprl egta --pairwise) take more"
        )
    fresh = fresh_for(named.values(), fresh)
    of_runs = [agents_of(run) for run in named.values()]
    parts: list[pa.Table] = []
    for counts in compositions(agents, len(named)).tolist():
        for who in shifted(counts):
            say_how_far(len(parts), None, "populations")
            mixed = [of_runs[run][agent] for agent, run in enumerate(who)]
            roles = [names[run] for run in who]
            labels = {COMPOSITION: composition_text(counts, names), "runs": " ".join(roles)}
            parts.append(play(fresh, named[roles[0]], mixed, labels, roles=roles, among=named.values()))
    title = heading("Empirical game", fresh, named.values(), _EACH)
    return together(parts, heading=title, fresh=fresh)


def pairwise_game(played: pa.Table) -> pa.Table:
    """Return the table of a cross-play as that of the game of two agents that it makes, see the docstring of
    this module.

    The diagonal of the cross-play says who plays where both play as one run.
    """
    kind = "Empirical game" if _agents_in(played) == 2 else "Pairwise reduction of the empirical game"
    title = said(played, "heading").replace("Cross-play", kind, 1)
    return played.replace_schema_metadata({**(played.schema.metadata or {}), b"heading": title.encode()})


def games_in(table: pa.Table) -> tuple[list[str], list[PayoffTable]]:
    """Return the names of the strategies of a table's game, and what it pays in each replica.

    Args:
        table: of `play_empirical_game` or `pairwise_game`.
    """
    replicas = sorted(table["replica"].unique().to_pylist())
    if FOCAL in table.column_names:
        names = table[FOCAL].unique().to_pylist()
        pairs = list(product(names, repeat=2))
        means = _values(by_replica(table, OF_FOCAL, PAIR), ("replica", *PAIR), "value")
        matrices = [np.array([means[replica, *pair] for pair in pairs]) for replica in replicas]
        size = len(names), len(names)
        return names, [PayoffTable.of_pairs(matrix.reshape(size)) for matrix in matrices]
    names = table[ROLE].unique().to_pylist()
    agents = _agents_in(table)
    keys = ("replica", COMPOSITION, ROLE)
    grouped = table.group_by(keys, use_threads=False).aggregate([("return", "mean")])
    means = _values(grouped, keys, "return_mean")
    every = [composition_text(counts, names) for counts in compositions(agents, len(names)).tolist()]
    games = []
    for replica in replicas:
        cells = product([replica], every, names)
        payoffs = np.array([means.get(cell, nan) for cell in cells])
        games.append(PayoffTable(agents=agents, payoffs=payoffs.reshape(len(every), -1)))
    return names, games


def _values(table: pa.Table, keys: Sequence[str], value: str) -> dict[tuple[Any, ...], float]:
    """Return a column by the values of others."""
    columns = (table[name].to_pylist() for name in keys)
    return dict(zip(zip(*columns, strict=True), table[value].to_pylist(), strict=True))


def _agents_in(table: pa.Table) -> int:
    """Return how many agents play in each episode of a table."""
    return int(pc.max(table["agent"]).as_py()) + 1


def mean_of(games: Sequence[PayoffTable]) -> PayoffTable:
    """Return the game of the mean payoffs."""
    payoffs = np.mean([game.payoffs for game in games], 0)
    return PayoffTable(agents=games[0].agents, payoffs=payoffs)


@dataclass(frozen=True, kw_only=True, eq=False)
class Analysis:
    """What an empirical game of S runs amounts to; see the docstring of this module."""

    names: Sequence[str]
    """Of the runs."""
    games: Sequence[PayoffTable] = field(repr=False)
    """What each replica pays."""
    of_agents: int
    """The agents of the game that was played; more than those of `games` where these are a reduction."""
    played: str
    """What was played, in words."""
    mean: PayoffTable = field(repr=False)
    """What replicas pay on average."""
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
    in_support: Float64 = field(repr=False)
    """float64 [S]: the share of the resamples in which a run is played in a symmetric equilibrium of two
    agents; NaN for a single replica, more than 6 runs, and for a game of more agents."""
    ends: Ends = field(repr=False)
    """Where replicator dynamics end."""

    @property
    def pairs(self) -> Float64:
        """What an agent of a run gets where all others play as another, float64 [R, S, S]."""
        return np.array([game.pairs for game in self.games])

    @property
    def is_reduction(self) -> bool:
        return self.of_agents > self.mean.agents


@working("analysing the game")
def analyse(table: pa.Table, *, resamples: int = EGTA_RESAMPLES, seed: int = 0) -> Analysis:
    """Analyse an empirical game.

    Args:
        table: of `play_empirical_game` or `pairwise_game`.
        resamples: the number of bootstrap resamples of the replicas.
        seed: the seed of the resampling, and of the starts of the replicator dynamics.

    Raises:
        ModuleNotFoundError: if OpenSpiel or nashpy is not installed.
    """
    names, games = games_in(table)
    analysis = analyse_games(names, games, resamples=resamples, seed=seed)
    return replace(analysis, of_agents=_agents_in(table), played=said(table, "fresh") + _EACH)


def analyse_games(
    names: Sequence[str], games: Sequence[PayoffTable], *, resamples: int = EGTA_RESAMPLES, seed: int = 0
) -> Analysis:
    """Analyse the game that replicas measured, see `analyse`."""
    resamples = checked("resamples", resamples, Annotated[int, Range(1, 100_000)])
    replicas = len(games)
    mean = mean_of(games)
    rng = np.random.default_rng(seed)
    drawn = rng.integers(replicas, size=(resamples if replicas > 1 else 0, replicas))
    # Few replicas have few resamples that differ: each is analysed once.
    times = Counter(tuple(sorted(places)) for places in drawn.tolist())
    again = [mean_of([games[place] for place in places]) for places in times]
    rank = alpha_rank(mean)
    is_small = mean.strategies <= MOST_STRATEGIES
    bounds = np.full((2, mean.strategies), np.nan)
    pure = dict.fromkeys(mean.pure_equilibria, nan)
    in_support = np.full(mean.strategies, nan)
    if again:
        counts = list(times.values())
        weights = np.array(counts) / len(drawn)
        ranks = np.repeat([alpha_rank(resample).shares for resample in again], counts, axis=0)
        margin = (1 - CONFIDENCE) / 2
        bounds = np.quantile(ranks, [margin, 1 - margin], axis=0)
        pure = {counts: float(weights @ [counts in one.pure_equilibria for one in again]) for counts in pure}
        if mean.agents == 2 and is_small:
            in_support = weights @ np.array([_is_played(resample) for resample in again], float)
    shares = (
        Estimate(value=float(share), low=float(low), high=float(high), replicas=replicas)
        for share, low, high in zip(rank.shares, *bounds, strict=True)
    )
    return Analysis(
        names=names,
        games=games,
        of_agents=mean.agents,
        played="",
        mean=mean,
        resamples=len(drawn),
        rank=rank,
        shares=tuple(shares),
        pure=pure,
        equilibria=equilibria(mean.reduced) if is_small else (),
        in_support=in_support,
        ends=replicator_ends(mean, seed=seed),
    )


def _is_played(game: PayoffTable) -> list[bool]:
    """Return whether each run is played in a symmetric equilibrium."""
    symmetric = [equilibrium for equilibrium in equilibria(game) if equilibrium.is_symmetric]
    played = {run for equilibrium in symmetric for run in equilibrium.support}
    return [run in played for run in range(game.strategies)]


_LEAST: Final = 0.005
"""Smaller shares are not listed."""


def egta_cells(analysis: Analysis) -> Iterator[Cells]:
    """Yield the payoffs, the runs by alpha-rank, the equilibria, and where replicator dynamics end."""
    yield _payoff_cells(analysis)
    title = "alpha-rank at the limit of infinite alpha: share of the agents in the long run"
    if analysis.resamples:
        title += f" [95 % interval, {analysis.resamples} resamples of the replicas]"
    head = ["run", "share"]
    rows = []
    for name, share in zip(analysis.names, analysis.shares, strict=True):
        interval = "" if isnan(share.low) else f" [{share.low:.2f}, {share.high:.2f}]"
        rows.append([name, f"{share.value:.2f}{interval}"])
    if not np.isnan(analysis.in_support).any():
        head.append("resamples in which a symmetric equilibrium plays it")
        for row, certain in zip(rows, analysis.in_support, strict=True):
            row.append(f"{certain:.0%}")
    yield Cells(title, head, rows)
    yield Cells("equilibria", ["", "what is played", "how certain"], list(_ends(analysis)), texts=2)


def _payoff_cells(analysis: Analysis) -> Cells:
    """Return payoffs by the runs of both of two agents, else by how many agents play as each."""
    names = analysis.names
    agents = analysis.mean.agents
    if agents == 2:
        levels = {
            (name, other, "return"): estimate(analysis.pairs[:, row, column])
            for row, name in enumerate(names)
            for column, other in enumerate(names)
        }
        others = f"all other {analysis.of_agents - 1}" if analysis.is_reduction else "the other"
        title = f"return of an agent, by its run and the run of {others}"
        return matrix_cells(Family(levels, ("an agent", "others")), "return", title)
    rows = []
    for place, counts in enumerate(compositions(agents, len(names)).tolist()):
        row: list[Any] = [composition_text(counts, names)]
        for run, count in enumerate(counts):
            payoffs = [game.payoffs[place, run] for game in analysis.games]
            row.append(estimate(payoffs) if count else "")
        rows.append(row)
    title = "return of an agent of each run, by how many agents play as each"
    return Cells(title, ["agents", *names], rows)


def _ends(analysis: Analysis) -> Iterator[tuple[str, str, str]]:
    """Yield what no agent leaves alone, the Nash equilibria, and where the dynamics end."""
    names = analysis.names
    for counts, certain in analysis.pure.items():
        resamples = "" if isnan(certain) else f"in {certain:.0%} of the resamples"
        yield "no agent gains by another run", composition_text(counts, names), resamples
    if not analysis.pure:
        yield "no agent gains by another run", "no composition", ""
    of_pairs = "" if analysis.mean.agents == 2 else " of pairs"
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
    """Return a composition in words, e.g. "3 dqn, 1 ppo"."""
    return ", ".join(f"{count} {name}" for count, name in zip(counts, names, strict=True) if count)


def mixture_text(mixture: Float64, names: Sequence[str]) -> str:
    """Return a mixture in words, e.g. "dqn 0.75, ppo 0.25"; one strategy by its name alone."""
    played = [(name, share) for name, share in zip(names, mixture, strict=True) if share >= _LEAST]
    return played[0][0] if len(played) == 1 else ", ".join(f"{name} {share:.2f}" for name, share in played)


_POINTS: Final = 41
_GRID: Final = 14
_CORNERS: Final = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 3**0.5 / 2]])
_DYNAMICS_HIGH: Final = 22.0


def gains_by_switching(analysis: Analysis) -> Family:
    """Return what one agent gains that plays as another run than all others: by its run and theirs."""
    names = analysis.names
    pairs = analysis.pairs
    gains = {
        (names[played], names[others], "return"): estimate(
            pairs[:, played, others] - pairs[:, others, others]
        )
        for played, others in permutations(range(len(names)), 2)
    }
    return judged(gains, ("an agent", "others"))


def draw_egta(analysis: Analysis, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draw what one agent gains that plays as another run than all others, with a star where it is not 0 by
    Holm's method; each run's share by alpha-rank, with the most frequent end of replicator dynamics; and the
    phase portrait of these dynamics where there are two or three runs."""
    names = {name: name for name in analysis.names}
    gains = gains_by_switching(analysis)
    texts = {key[:2]: f"{gain.value:+.3g}" + " *" * gain.differs for key, gain in gains.items()}
    at_home = np.diagonal(analysis.pairs, axis1=1, axis2=2).mean(0)
    texts |= {(name, name): f"{mean:.3g}" for name, mean in zip(names, at_home, strict=True)}
    draw_dynamics = {2: _draw_line, 3: _draw_simplex}.get(len(names))
    with style.drawing(path, width=width, colours=style.SHADES, is_new=True) as sheet:
        columns = sheet.fitting(2, 24)
        ratios: Any = {"width_ratios": (1.35, 1)} if columns == 2 else {}
        heights = [matrix_height(len(names))] * (3 - columns) + [_DYNAMICS_HIGH] * bool(draw_dynamics)
        panels = sheet.panels(2 + bool(draw_dynamics), columns=columns, high=heights, **ratios)
        matrix, rank = panels[:2]
        if draw_dynamics:
            draw_dynamics(panels[2], analysis)
        values = {key[:2]: gain.value for key, gain in gains.items()}
        draw_matrix(sheet, matrix, names, names, values, texts, share=1.15 / columns)
        matrix.set(xlabel="run of all others", ylabel="run of an agent")
        matrix.set_title("gain of an agent by another run")
        _draw_ranks(rank, analysis)
        kind = f"{analysis.of_agents} agents"
        if analysis.is_reduction:
            kind = f"pairwise reduction of {kind}"
        sheet.title = f"Empirical game of {', '.join(names)}"
        sheet.caption = (
            f"{kind}; {analysis.played}. {HOLM} for these {len(gains)}; diagonal: an agent's return; "
            f"intervals of shares: 95 % of {analysis.resamples} resamples of the replicas."
        )
    return Path(path)


def _draw_ranks(axes: Axes, analysis: Analysis) -> None:
    """Draw each run's share by alpha-rank, and the most frequent end of replicator dynamics."""
    places = np.arange(len(analysis.names))
    axes.barh(places, [share.value for share in analysis.shares], color=style.REPLICA, height=0.6)
    low = [share.low for share in analysis.shares]
    high = [share.high for share in analysis.shares]
    axes.hlines(places, low, high, color=style.PUBLISHED)
    if len(analysis.ends.mixtures):
        label = f"end of replicator dynamics, from {analysis.ends.shares[0]:.0%} of the starts"
        axes.plot(analysis.ends.mixtures[0], places, "D", color=style.MARK, label=label, clip_on=False)
    axes.set_yticks(places, [style.wrapped(name, 9) for name in analysis.names])
    axes.set(xlim=(0, 1), ylim=(len(places) - 0.5, -0.5), xlabel="share of the agents in the long run")
    axes.set_title("alpha-rank, infinite alpha")


def _draw_line(axes: Axes, analysis: Analysis) -> None:
    """Draw what the first of two runs gains over the second, by its share, with the fixed points."""
    first, second = analysis.names
    shares = np.linspace(0, 1, _POINTS)
    curves = [[np.subtract(*game.against([share, 1 - share])) for share in shares] for game in analysis.games]
    middle, low, high = curve_interval(curves)
    draw_line(axes, shares, (middle, low, high))
    axes.axhline(0, color=style.RAW, lw=1, zorder=1)
    for at, is_stable in _fixed_points(shares, middle):
        face = style.MARK if is_stable else "white"
        axes.plot(at, 0, "o", markersize=8, color=style.MARK, markerfacecolor=face, clip_on=False, zorder=4)
    arrow = {"arrowstyle": "->", "color": style.MARK}
    for start in (0.12, 0.37, 0.62, 0.87):
        ahead = 0.03 if np.interp(start, shares, middle) > 0 else -0.03
        axes.annotate("", (start + ahead, 0), (start - ahead, 0), arrowprops=arrow)
    axes.set(
        xlim=(-0.02, 1.02), xlabel=f"share that plays as {first}", ylabel=f"return as {first} less {second}"
    )
    axes.set_title("replicator dynamics, filled: attracts")


def _fixed_points(shares: Float64, gains: Float64) -> list[tuple[float, bool]]:
    """Return where nothing changes, and whether shares nearby move there."""
    points = [(0.0, bool(gains[0] < 0)), (1.0, bool(gains[-1] > 0))]
    for place in np.flatnonzero(gains[:-1] * gains[1:] < 0):
        low, high = gains[place : place + 2]
        at = shares[place] + (shares[place + 1] - shares[place]) * low / (low - high)
        points.append((float(at), bool(low > 0)))
    return points


def _draw_simplex(axes: Axes, analysis: Analysis) -> None:
    """Draw the direction in which the shares of three runs move, where they end, and the corners by name."""
    axes.plot(*np.vstack([_CORNERS, _CORNERS[:1]]).T, color=style.RAW, lw=1)
    mixtures = (compositions(_GRID - 3, 3) + 1) / _GRID
    moves = np.array([replicator(analysis.mean.normalised, mixture) for mixture in mixtures]) @ _CORNERS
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
    for corner, name in zip(_CORNERS, analysis.names, strict=True):
        at, side = ((0, 3), "bottom") if corner[1] > 0 else ((0, -3), "top")
        axes.annotate(name, corner, at, textcoords="offset points", ha="center", va=side)
    axes.set(xlim=(-0.08, 1.08), ylim=(-0.1, 1.06), aspect="equal")
    axes.set_axis_off()
    axes.set_title("replicator dynamics, bright: fast")
