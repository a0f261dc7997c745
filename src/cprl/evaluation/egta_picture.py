"""draw_egta: the replicator dynamics of an empirical game, and its alpha-rank.

Of two runs: what the first gains over the second, by how many play as it. Of three: the simplex with the
direction in which shares move. Of more: which run a first deviating agent gains by.
"""

from math import isnan
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cprl.arguments import object_of
from cprl.evaluation.egta import Analysis
from cprl.evaluation.egta_tables import how_much_was_played
from cprl.measuring.statistics import estimate
from cprl.plotting import style
from cprl.theory.evolution import replicator
from cprl.theory.payoff_table import PayoffTable, Values, compositions

_SIZE_IN: Final = (9.0, 4.3)
_POINTS: Final = 41
_GRID: Final = 14
_CORNERS: Final = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 3**0.5 / 2]])
_UNCERTAIN: Final = "#9a9a9a"


def draw_egta(found: Analysis, path: Path | str) -> Path:
    """Draws an analysis.

    Args:
        found: the analysis.
        path: the PNG.

    Raises:
        ValueError: if the name does not end in .png.
        FileExistsError: if the file exists.
    """
    object_of("found", found, Analysis, "what analyse() gave")
    path = style.check_picture(path)
    figure = Figure(_SIZE_IN, layout="constrained")
    dynamics, rank = figure.subplots(1, 2, width_ratios=(1.35, 1))
    draw = {2: _draw_line, 3: _draw_simplex}.get(len(found.game.names), _draw_deviations)
    draw(dynamics, found)
    _draw_rank(rank, found)
    game = found.game
    kind = f"pairwise reduction of {game.of_agents} agents" if game.is_reduction else f"{game.agents} agents"
    note = (
        f"{kind}; {how_much_was_played(game)}; intervals: 95 %, of payoffs by Student's t, of shares by "
        f"{found.resamples} resamples of the replicas"
    )
    style.head(figure, f"Empirical game of {', '.join(game.names)}", note)
    return style.save(figure, path, colours=style.SHADES)


def _draw_line(axes: Axes, found: Analysis) -> None:
    """What the first run gains over the second, by its share, with the points of rest."""
    shares, (first, second) = np.linspace(0, 1, _POINTS), found.game.names
    tables = [found.game.table([place]) for place in range(len(found.game.payoffs))]
    curves = np.array([[_gain(table, share) for share in shares] for table in tables])
    means = [estimate(own) for own in curves.T]
    middle = np.array([own.value for own in means])
    axes.fill_between(
        shares, [own.low for own in means], [own.high for own in means], color=style.REPLICA, alpha=0.35, lw=0
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
    own, other = table.against([share, 1 - share])
    return float(own - other)


def _rests(shares: Values, gains: Values) -> list[tuple[float, bool]]:
    """Where nothing changes, and whether shares nearby move there."""
    found = [(0.0, bool(gains[0] < 0)), (1.0, bool(gains[-1] > 0))]
    for place in np.flatnonzero(gains[:-1] * gains[1:] < 0):
        low, high = gains[place], gains[place + 1]
        at = shares[place] + (shares[place + 1] - shares[place]) * low / (low - high)
        found.append((float(at), bool(low > 0)))
    return found


def _draw_simplex(axes: Axes, found: Analysis) -> None:
    """The direction in which shares move, where they end, and the corners by name."""
    axes.plot(*np.vstack([_CORNERS, _CORNERS[:1]]).T, color=style.RAW, lw=1)
    mixtures = (compositions(_GRID - 3, 3) + 1) / _GRID
    moves = np.array([replicator(found.table.normalised, own) for own in mixtures]) @ _CORNERS
    lengths = np.linalg.norm(moves, axis=1, keepdims=True)
    arrows = np.divide(moves, lengths, out=np.zeros_like(moves), where=lengths > 0)
    quiver = axes.quiver(
        *(mixtures @ _CORNERS).T, *arrows.T, lengths[:, 0], cmap="viridis", scale=24, width=0.005, pivot="mid"
    )
    bar = axes.figure.colorbar(quiver, ax=axes, shrink=0.6)
    bar.set_label("speed, of payoffs scaled to 0..1", fontsize=style.SMALL_PT)
    bar.ax.tick_params(labelsize=style.SMALL_PT)
    for mixture, share in zip(found.ends.mixtures, found.ends.shares, strict=True):
        at = mixture @ _CORNERS
        axes.plot(*at, "o", color=style.MARK, markersize=9, zorder=4)
        axes.annotate(f"{share:.0%}", at, (8, 8), textcoords="offset points", fontsize=style.SMALL_PT)
    for corner, name, (align, height) in zip(
        _CORNERS, found.game.names, (("center", "top"), ("center", "top"), ("center", "bottom")), strict=True
    ):
        offset = (0, 16 if height == "bottom" else -12)
        axes.annotate(
            name, corner, offset, textcoords="offset points", ha=align, va=height, fontsize=style.SMALL_PT
        )
    axes.set(xlim=(-0.08, 1.08), ylim=(-0.1, 1.06), aspect="equal")
    axes.set_axis_off()
    axes.set_title("replicator dynamics; dots: where starts end", fontsize=style.SMALL_PT)


def _draw_deviations(axes: Axes, found: Analysis) -> None:
    """An arrow from the run that all play to each by which one agent gains."""
    game, names = found.game, found.game.names
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
    for (x, y), name, share in zip(places, names, found.shares, strict=True):
        axes.plot(x, y, "o", color=style.MARK, markersize=5 + 14 * share.value, zorder=4)
        axes.text(1.32 * x, 1.22 * y, name, ha="center", va="center", fontsize=style.SMALL_PT)
    axes.set(xlim=(-1.6, 1.6), ylim=(-1.4, 1.4), aspect="equal")
    axes.set_axis_off()
    axes.set_title(
        "by which run one agent gains where all play another\n(dashed: the interval holds 0)",
        fontsize=style.SMALL_PT,
    )


def _draw_rank(axes: Axes, found: Analysis) -> None:
    """The share of each run in the long run of alpha-rank, with its interval."""
    places = np.arange(len(found.shares))
    values = np.array([own.value for own in found.shares])
    axes.barh(places, values, color=style.REPLICA, height=0.6)
    for place, own in enumerate(found.shares):
        if not isnan(own.low):
            axes.plot([own.low, own.high], [place, place], color=style.PUBLISHED, lw=1.4)
    axes.set_yticks(places, [style.wrapped(name, 1.6) for name in found.game.names])
    axes.set(xlim=(0, 1), ylim=(len(places) - 0.5, -0.5))
    axes.tick_params(labelsize=style.SMALL_PT)
    axes.set_xlabel("share of the agents in the long run", fontsize=style.SMALL_PT)
    axes.set_title("alpha-rank, infinite alpha", fontsize=style.SMALL_PT)
