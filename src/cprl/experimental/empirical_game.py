"""Empirical games: each agent chooses one of several stored runs to play for it, and gets its return.

`play_empirical_game` measures the payoffs of the game, and `analyse` finds its equilibria and dynamics.

A composition says how many of the N agents play as each of the S runs. All C = (N + S - 1)! / (N! (S - 1)!)
compositions are played. In each, the runs take turns over the agents' indices. The agent with index i plays
as agent i of its run, and replica r as replica r.

`pairwise_game` builds a game of two agents from a cross-play, which is cheaper. For N = 2 it is the same
game. For more agents it is a reduction: it knows what a single agent gains that deviates from all others, but
no other compositions. Its equilibria with a single run are equilibria of the whole game; others need not be.

The game of the mean payoffs over replicas is analysed. Intervals come from a bootstrap over replicas, since
only replicas are independent: it draws replicas with replacement, the same ones for all payoffs, and analyses
the game of their means. The interval of a run's share is between the 2.5 % and 97.5 % quantiles, and the
certainty of an equilibrium is the share of resamples that have it. Few replicas give too narrow intervals.
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

from cprl.evaluation.cross_play import CELL_LABELS, FOCAL_RETURN, Runs, load_by_name
from cprl.evaluation.pages import heading, matrix_table
from cprl.evaluation.populations import agents_of, fresh_for, join_tables, play_fresh, rotations, table_note
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
from cprl.measuring.statistics import (
    CONFIDENCE,
    HOLM_NOTE,
    Estimate,
    Family,
    curve_interval,
    estimate,
    judge_family,
)
from cprl.measuring.table import FOCAL, ROLE, by_replica
from cprl.system.defaults import EGTA_RESAMPLES, Fresh
from cprl.system.working import note_progress, working
from cprl.terminal import picture_files, style
from cprl.terminal.panels import draw_line, draw_matrix, matrix_height
from cprl.terminal.text_tables import TextTable
from cprl.values import Range, checked
from cprl.values.array_types import Float64

COMPOSITION: Final = "composition"
"""The label of a table for the composition: how many agents play as each run."""
_EACH: Final = " for each choice of who plays where"


@working("playing all compositions")
def play_empirical_game(runs: Runs, fresh: Fresh = Fresh(episodes=5)) -> pa.Table:
    """Play all compositions of the agents of several runs.

    Args:
        runs: at least two runs of the same game, as for `crossplay`. With S runs and N agents up to 256
            profiles S^N are allowed, e.g. four runs of four agents; `crossplay` has no such bound.
        fresh: which episodes, for each choice of who plays where; the choices are N (C - S) + S.

    Returns:
        A row for each choice, replica, episode and agent, see `cprl.measuring.table`, by "composition", how
        many agents play as each run, and "runs", the names of all agents' runs; "role" is the name of the
        agent's own.
    """
    by_name = load_by_name(runs)
    names = list(by_name)
    agents = by_name[names[0]].game.agents
    profiles = len(names) ** agents
    if profiles > MOST_PROFILES:
        raise ValueError(
            f"{len(names)} runs of {agents} agents have {profiles:,} profiles; allowed: at most "
            f"{MOST_PROFILES}; crossplay and pairwise_game (cprl egta --pairwise) take more"
        )
    fresh = fresh_for(by_name.values(), fresh)
    stored = [agents_of(run) for run in by_name.values()]
    parts: list[pa.Table] = []
    for counts in compositions(agents, len(names)).tolist():
        for choice in rotations(counts):
            note_progress(len(parts), None, "populations")
            mixed = [stored[run][agent] for agent, run in enumerate(choice)]
            roles = [names[run] for run in choice]
            labels = {COMPOSITION: composition_text(counts, names), "runs": " ".join(roles)}
            parts.append(
                play_fresh(
                    fresh, by_name[roles[0]], mixed, labels, roles=roles, compared_runs=by_name.values()
                )
            )
    title = heading("Empirical game", fresh, by_name.values(), _EACH)
    return join_tables(parts, heading=title, fresh=fresh)


def pairwise_game(played: pa.Table) -> pa.Table:
    """Return the table of a cross-play under the heading of an empirical game.

    The rows stay as they are: `games_in` reads a table with the column `FOCAL` as a game of two agents, whose
    payoffs are the returns of focal and background agents. The diagonal of the cross-play holds the episodes
    in which both play as the same run.
    """
    kind = "Empirical game" if _agents_in(played) == 2 else "Pairwise reduction of the empirical game"
    title = table_note(played, "heading").replace("Cross-play", kind, 1)
    return played.replace_schema_metadata({**(played.schema.metadata or {}), b"heading": title.encode()})


def games_in(table: pa.Table) -> tuple[list[str], list[PayoffTable]]:
    """Return the names of the runs in a table, and the game that each replica measured.

    Args:
        table: of `play_empirical_game` or `pairwise_game`.
    """
    replicas = sorted(table["replica"].unique().to_pylist())
    if FOCAL in table.column_names:
        names = table[FOCAL].unique().to_pylist()
        pairs = list(product(names, repeat=2))
        means = _values(by_replica(table, FOCAL_RETURN, CELL_LABELS), ("replica", *CELL_LABELS), "value")
        games = []
        for replica in replicas:
            payoffs = np.array([means[replica, *pair] for pair in pairs])
            games.append(PayoffTable.from_pairs(payoffs.reshape(len(names), len(names))))
        return names, games
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
    """Return the values of a column by the values of other columns."""
    columns = (table[name].to_pylist() for name in keys)
    return dict(zip(zip(*columns, strict=True), table[value].to_pylist(), strict=True))


def _agents_in(table: pa.Table) -> int:
    """Return the number of agents in each episode of a table."""
    return int(pc.max(table["agent"]).as_py()) + 1


def mean_game(games: Sequence[PayoffTable]) -> PayoffTable:
    """Return the game of the mean payoffs."""
    payoffs = np.mean([game.payoffs for game in games], 0)
    return PayoffTable(agents=games[0].agents, payoffs=payoffs)


@dataclass(frozen=True, kw_only=True, eq=False)
class Analysis:
    """The analysis of an empirical game of S runs; see the module's docstring."""

    names: Sequence[str]
    """The names of the runs."""
    games: Sequence[PayoffTable] = field(repr=False)
    """The game that each replica measured."""
    played_agents: int
    """The number of agents of the game that was played; more than those of `games`, where these are a
    reduction."""
    played: str
    """The episodes that were played, in words."""
    mean: PayoffTable = field(repr=False)
    """The game of the mean payoffs over replicas."""
    resamples: int
    """The number of resamples of the bootstrap; 0 for a single replica."""
    rank: AlphaRank = field(repr=False)
    shares: tuple[Estimate, ...]
    """For each run, the share of agents that play as it in the long run of alpha-rank, with its interval."""
    pure: dict[tuple[int, ...], float] = field(repr=False)
    """The pure equilibria: compositions in which no agent gains by playing as another run. The values are the
    shares of resamples that have the equilibrium too; NaN for a single replica."""
    equilibria: tuple[Equilibrium, ...]
    """The Nash equilibria by nashpy; those of the reduction for more than two agents; empty for more than 6
    runs."""
    in_support: Float64 = field(repr=False)
    """float64 [S]: for each run, the share of resamples with a symmetric equilibrium that plays it. NaN for a
    single replica, for more than 6 runs, and for more than two agents."""
    ends: Ends = field(repr=False)
    """The ends of replicator dynamics."""

    @property
    def pairs(self) -> Float64:
        """Return the return of an agent that plays as one run while all others play as another, float64
        [R, S, S]."""
        return np.array([game.pairs for game in self.games])

    @property
    def is_reduction(self) -> bool:
        """Return whether the analysed game is a pairwise reduction of the game that was played."""
        return self.played_agents > self.mean.agents


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
    return replace(analysis, played_agents=_agents_in(table), played=table_note(table, "fresh") + _EACH)


def analyse_games(
    names: Sequence[str], games: Sequence[PayoffTable], *, resamples: int = EGTA_RESAMPLES, seed: int = 0
) -> Analysis:
    """Analyse the games that replicas measured; see `analyse`."""
    resamples = checked("resamples", resamples, Annotated[int, Range(1, 100_000)])
    replicas = len(games)
    mean = mean_game(games)
    rng = np.random.default_rng(seed)
    resampled = rng.integers(replicas, size=(resamples if replicas > 1 else 0, replicas))
    # Few replicas have few resamples that differ: each is analysed once, and weighted by how often it came.
    multiplicity = Counter(tuple(sorted(indices)) for indices in resampled.tolist())
    resampled_games = []
    for indices in multiplicity:
        resampled_games.append(mean_game([games[index] for index in indices]))
    rank = alpha_rank(mean)
    is_small = mean.strategies <= MOST_STRATEGIES
    nash_equilibria = equilibria(mean.reduced) if is_small else ()
    bounds = np.full((2, mean.strategies), np.nan)
    pure = dict.fromkeys(mean.pure_equilibria, nan)
    in_support = np.full(mean.strategies, nan)
    if resampled_games:
        counts = list(multiplicity.values())
        weights = np.array(counts) / len(resampled)
        ranks = np.repeat([alpha_rank(game).shares for game in resampled_games], counts, axis=0)
        margin = (1 - CONFIDENCE) / 2
        bounds = np.quantile(ranks, [margin, 1 - margin], axis=0)
        for composition in pure:
            is_pure = [composition in game.pure_equilibria for game in resampled_games]
            pure[composition] = float(weights @ is_pure)
        if mean.agents == 2 and is_small:
            in_support = weights @ np.array([_is_played(game) for game in resampled_games], float)
    shares = (
        Estimate(value=float(share), low=float(low), high=float(high), replicas=replicas)
        for share, low, high in zip(rank.shares, *bounds, strict=True)
    )
    return Analysis(
        names=names,
        games=games,
        played_agents=mean.agents,
        played="",
        mean=mean,
        resamples=len(resampled),
        rank=rank,
        shares=tuple(shares),
        pure=pure,
        equilibria=nash_equilibria,
        in_support=in_support,
        ends=replicator_ends(mean, seed=seed),
    )


def _is_played(game: PayoffTable) -> list[bool]:
    """Return whether each run is played in a symmetric equilibrium."""
    symmetric = [equilibrium for equilibrium in equilibria(game) if equilibrium.is_symmetric]
    played = {run for equilibrium in symmetric for run in equilibrium.support}
    return [run in played for run in range(game.strategies)]


_LEAST: Final = 0.005
"""The smallest share that is listed."""


def egta_tables(analysis: Analysis) -> Iterator[TextTable]:
    """Yield tables of the payoffs, of the runs' shares by alpha-rank, and of equilibria and dynamics."""
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
    yield TextTable(title, head, rows)
    yield TextTable("equilibria", ["", "what is played", "how certain"], list(_ends(analysis)), texts=2)


def _payoff_cells(analysis: Analysis) -> TextTable:
    """Return the table of payoffs: by the runs of two agents, or by compositions of more agents."""
    names = analysis.names
    agents = analysis.mean.agents
    if agents == 2:
        levels = {
            (name, other, "return"): estimate(analysis.pairs[:, row, column])
            for row, name in enumerate(names)
            for column, other in enumerate(names)
        }
        others = f"all other {analysis.played_agents - 1}" if analysis.is_reduction else "the other"
        title = f"return of an agent, by its run and the run of {others}"
        return matrix_table(Family(levels, ("an agent", "others")), "return", title)
    rows = []
    for place, counts in enumerate(compositions(agents, len(names)).tolist()):
        row: list[Any] = [composition_text(counts, names)]
        for run, count in enumerate(counts):
            payoffs = [game.payoffs[place, run] for game in analysis.games]
            cell = estimate(payoffs) if count else ""
            row.append(cell)
        rows.append(row)
    title = "return of an agent of each run, by how many agents play as each"
    return TextTable(title, ["agents", *names], rows)


def _ends(analysis: Analysis) -> Iterator[tuple[str, str, str]]:
    """Yield rows for pure equilibria, Nash equilibria, and ends of the replicator dynamics."""
    names = analysis.names
    for counts, certain in analysis.pure.items():
        resamples = "" if isnan(certain) else f"in {certain:.0%} of the resamples"
        yield "no agent gains by another run", composition_text(counts, names), resamples
    if not analysis.pure:
        yield "no agent gains by another run", "no composition", ""
    which = "" if analysis.mean.agents == 2 else " of pairs"
    for equilibrium in analysis.equilibria:
        both = [mixture_text(side, names) for side in (equilibrium.first, equilibrium.second)]
        played = both[0] if equilibrium.is_symmetric else " against ".join(both)
        yield f"Nash equilibrium{which} (nashpy)", played, ""
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
"""Points of the line that shows the dynamics of two runs."""
_GRID: Final = 14
"""Steps of the grid of arrows along an edge of the triangle that shows the dynamics of three runs."""
_CORNERS: Final = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 3**0.5 / 2]])
"""The corners (x, y) of that triangle: all agents play as run 0, 1, 2."""
_DYNAMICS_HIGH: Final = 22.0
"""The height of the panel with the dynamics, in em."""


def gains_by_switching(analysis: Analysis) -> Family:
    """Return the gain of an agent that plays as another run than all others, by its run and theirs."""
    names = analysis.names
    pairs = analysis.pairs
    gains = {
        (names[played], names[others], "return"): estimate(
            pairs[:, played, others] - pairs[:, others, others]
        )
        for played, others in permutations(range(len(names)), 2)
    }
    return judge_family(gains, ("an agent", "others"))


def draw_egta(analysis: Analysis, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draw an analysis in two or three panels.

    They show the gain of an agent that switches to another run, with a star if it is significant by Holm's
    method; each run's share by alpha-rank; and, for two or three runs, the phase portrait of the replicator
    dynamics.
    """
    names = {name: name for name in analysis.names}
    gains = gains_by_switching(analysis)
    texts = {key[:2]: f"{gain.value:+.3g}" + " *" * gain.differs for key, gain in gains.items()}
    at_home = np.diagonal(analysis.pairs, axis1=1, axis2=2).mean(0)
    texts |= {(name, name): f"{mean:.3g}" for name, mean in zip(names, at_home, strict=True)}
    draw_dynamics = {2: _draw_line, 3: _draw_simplex}.get(len(names))
    with style.drawing(path, width=width, colours=picture_files.PNG_SHADES, refuse_existing=True) as sheet:
        columns = sheet.columns_that_fit(2, 24)
        ratios: Any = {"width_ratios": (1.35, 1)} if columns == 2 else {}
        heights = [matrix_height(len(names))] * (3 - columns) + [_DYNAMICS_HIGH] * bool(draw_dynamics)
        panels = sheet.panels(2 + bool(draw_dynamics), columns=columns, row_height_em=heights, **ratios)
        matrix, rank = panels[:2]
        if draw_dynamics:
            draw_dynamics(panels[2], analysis)
        values = {key[:2]: gain.value for key, gain in gains.items()}
        draw_matrix(sheet, matrix, names, names, values, texts, share=1.15 / columns)
        matrix.set(xlabel="run of all others", ylabel="run of an agent")
        matrix.set_title("gain of an agent by another run")
        _draw_ranks(rank, analysis)
        kind = f"{analysis.played_agents} agents"
        if analysis.is_reduction:
            kind = f"pairwise reduction of {kind}"
        sheet.title = f"Empirical game of {', '.join(names)}"
        sheet.caption = (
            f"{kind}; {analysis.played}. {HOLM_NOTE} for these {len(gains)}; diagonal: an agent's return; "
            f"intervals of shares: 95 % of {analysis.resamples} resamples of the replicas."
        )
    return Path(path)


def _draw_ranks(axes: Axes, analysis: Analysis) -> None:
    """Draw each run's share by alpha-rank, and the most frequent end of replicator dynamics."""
    places = np.arange(len(analysis.names))
    axes.barh(places, [share.value for share in analysis.shares], color=style.REPLICA_COLOUR, height=0.6)
    low = [share.low for share in analysis.shares]
    high = [share.high for share in analysis.shares]
    axes.hlines(places, low, high, color=style.PUBLISHED_COLOUR)
    if len(analysis.ends.mixtures):
        label = f"end of replicator dynamics, from {analysis.ends.shares[0]:.0%} of the starts"
        axes.plot(analysis.ends.mixtures[0], places, "D", color=style.MARK_COLOUR, label=label, clip_on=False)
    axes.set_yticks(places, [style.wrapped(name, 9) for name in analysis.names])
    axes.set(xlim=(0, 1), ylim=(len(places) - 0.5, -0.5), xlabel="share of the agents in the long run")
    axes.set_title("alpha-rank, infinite alpha")


def _draw_line(axes: Axes, analysis: Analysis) -> None:
    """Draw the advantage of the first of two runs by its share of the population, with the fixed points."""
    first, second = analysis.names
    shares = np.linspace(0, 1, _POINTS)
    curves = []
    for game in analysis.games:
        curves.append([np.subtract(*game.against([share, 1 - share])) for share in shares])
    middle, low, high = curve_interval(curves)
    draw_line(axes, shares, (middle, low, high))
    axes.axhline(0, color=style.RAW_COLOUR, lw=1, zorder=1)
    for at, is_stable in _fixed_points(shares, middle):
        face = style.MARK_COLOUR if is_stable else "white"
        axes.plot(
            at, 0, "o", markersize=8, color=style.MARK_COLOUR, markerfacecolor=face, clip_on=False, zorder=4
        )
    arrow = {"arrowstyle": "->", "color": style.MARK_COLOUR}
    for start in (0.12, 0.37, 0.62, 0.87):
        ahead = 0.03 if np.interp(start, shares, middle) > 0 else -0.03
        axes.annotate("", (start + ahead, 0), (start - ahead, 0), arrowprops=arrow)
    axes.set(
        xlim=(-0.02, 1.02), xlabel=f"share that plays as {first}", ylabel=f"return as {first} less {second}"
    )
    axes.set_title("replicator dynamics, filled: attracts")


def _fixed_points(shares: Float64, gains: Float64) -> list[tuple[float, bool]]:
    """Return the fixed points of the dynamics of two runs, each with whether it is stable."""
    points = [(0.0, bool(gains[0] < 0)), (1.0, bool(gains[-1] > 0))]
    for place in np.flatnonzero(gains[:-1] * gains[1:] < 0):
        low, high = gains[place : place + 2]
        at = shares[place] + (shares[place + 1] - shares[place]) * low / (low - high)
        points.append((float(at), bool(low > 0)))
    return points


def _draw_simplex(axes: Axes, analysis: Analysis) -> None:
    """Draw the dynamics of the shares of three runs in a triangle, with their ends."""
    axes.plot(*np.vstack([_CORNERS, _CORNERS[:1]]).T, color=style.RAW_COLOUR, lw=1)
    mixtures = (compositions(_GRID - 3, 3) + 1) / _GRID
    moves = np.array([replicator(analysis.mean.normalised, mixture) for mixture in mixtures]) @ _CORNERS
    lengths = np.linalg.norm(moves, axis=1, keepdims=True)
    arrows = np.divide(moves, lengths, out=np.zeros_like(moves), where=lengths > 0)
    axes.quiver(
        *(mixtures @ _CORNERS).T, *arrows.T, lengths[:, 0], cmap="viridis", scale=24, width=0.005, pivot="mid"
    )
    for mixture, share in zip(analysis.ends.mixtures, analysis.ends.shares, strict=True):
        at = mixture @ _CORNERS
        axes.plot(*at, "o", color=style.MARK_COLOUR, markersize=9, zorder=4)
        offset = (9, -9) if at[1] > _CORNERS[:, 1].max() - 0.1 else (8, 8)  # not over the name of the top
        axes.annotate(f"{share:.0%}", at, offset, textcoords="offset points")
    for corner, name in zip(_CORNERS, analysis.names, strict=True):
        at, side = ((0, 3), "bottom") if corner[1] > 0 else ((0, -3), "top")
        axes.annotate(name, corner, at, textcoords="offset points", ha="center", va=side)
    axes.set(xlim=(-0.08, 1.08), ylim=(-0.1, 1.06), aspect="equal")
    axes.set_axis_off()
    axes.set_title("replicator dynamics, bright: fast")
