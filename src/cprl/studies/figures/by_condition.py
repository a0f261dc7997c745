"""Figures of conditions one below the other: means, or differences from the reference."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cprl.arguments import choice, refusal
from cprl.studies.figures.panels import (
    FAINT,
    MOST_CONDITIONS,
    levels_note,
    names_of,
    replicas_text,
    short,
    title_of,
    with_counts,
)
from cprl.studies.tables.comparing import LAST, Compared, Comparison, compare, metrics_of
from cprl.studies.tables.table import StudyTable
from cprl.studies.tables.windows import RANDOM, TRAINING
from cprl.terminal.style import MEAN, RANDOM_LINE, SMALL_PT, head, picture_path, save, wrapped

Kind = Literal["levels", "differences"]


def by_condition(
    table: StudyTable,
    path: Path | str,
    *,
    kind: Kind = "levels",
    metrics: Sequence[str] = (),
    part: str = TRAINING,
    last: int = LAST,
) -> Path:
    """Draws the conditions one below the other: means over replicas, or differences from the reference.

    Args:
        table: the table, of at most `MOST_CONDITIONS` conditions.
        path: the PNG.
        kind: "levels", with random play as dashes; or "differences", with a dashed line at 0.
        metrics: see `by_factor`.
        part: see `cprl.studies.tables.comparing.compare`.
        last: likewise.

    Raises:
        ValueError: for too many conditions, another ending than .png, and for what does not fit.
    """
    choice("kind", kind, ("levels", "differences"))
    design, path = table.design, picture_path(path)
    shown = [own for own in design.conditions if kind == "levels" or own != design.reference]
    if kind == "differences" and not table.replicas[design.reference]:
        raise ValueError(f"the reference {design.reference} has no finished run; allowed: one that has")
    if not 0 < len(shown) <= MOST_CONDITIONS:
        raise refusal("table", table, f"1 to {MOST_CONDITIONS} conditions, not {len(shown)}")
    comparisons = [compare(table, own, part=part, last=last) for own in metrics_of(table, metrics)]
    names = with_counts(names_of(design), table.replicas)
    rows_in = 0.34 if all("\n" not in names[own] for own in shown) else 0.46
    figure = Figure((12.0, rows_in * len(shown) + 1.8), layout="constrained")
    panels = figure.subplots(1, len(comparisons), sharey=True, squeeze=False)[0]
    for axes, comparison in zip(panels, comparisons, strict=True):
        for place, name in enumerate(shown):
            _draw_row(axes, place, comparison.by_name[name], kind)
        if kind == "differences":
            axes.axvline(0, **RANDOM_LINE)
        else:
            _mark_random(axes, shown, compare(table, comparison.metric, part=RANDOM))
        axes.set_title(wrapped(title_of(comparison), 9.5 / len(panels)), fontsize=SMALL_PT)
        axes.set_yticks(range(len(shown)), [names[own] for own in shown])
        axes.tick_params(labelsize=SMALL_PT)
        axes.locator_params(axis="x", nbins=3)
        axes.grid(axis="y", color="#e6e6e6", linewidth=0.6)
        axes.set_axisbelow(True)
    panels[0].set_ylim(len(shown) - 0.4, -0.6)
    figure.supylabel(
        short(design.factors[0]) if len(design.factors) == 1 else "condition", fontsize=SMALL_PT + 1
    )
    replicas, first = replicas_text(table.replicas), comparisons[0]
    if kind == "levels":
        title = f"{design.name}: outcome by condition"
        note = f"{replicas}. {levels_note(first)} Faint: single replicas. Dashed: random play."
    else:
        name = design.reference.replace("\n", " ")
        title = f"{design.name}: difference from {name}"
        how = "Paired by replica" if first.is_paired else "Not paired: each condition has chance of its own"
        note = f"{replicas}. {how}; means of {first.episodes_text}; {first.interval_text}."
    head(figure, title, note)
    return save(figure, path)


def _draw_row(axes: Axes, place: int, own: Compared, kind: Kind) -> None:
    """One condition's mean or difference with its interval."""
    found = own.estimate if kind == "levels" else own.difference
    if kind == "levels":
        values = own.defined
        axes.plot(values, [place + 0.16] * len(values), ".", color=FAINT, markersize=5, zorder=2)
    if found is None:
        why = "no run" if not own.replicas else "undefined" if own.estimate is None else "no pairs"
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1}
        middle: dict[str, Any] = {
            "ha": "center",
            "va": "center",
            "transform": axes.get_yaxis_transform(),
            "bbox": box,
        }
        axes.text(0.5, place, why, fontsize=SMALL_PT, **middle)
        return
    axes.plot([found.low, found.high], [place, place], color=MEAN, linewidth=2.5, alpha=0.6, zorder=3)
    axes.plot([found.value], [place], "o", color=MEAN, markersize=6, zorder=4)


def _mark_random(axes: Axes, shown: Sequence[str], random: Comparison) -> None:
    """Random play under each condition."""
    look: dict[str, Any] = {**RANDOM_LINE, "linestyle": (0, (2, 1))}
    for place, name in enumerate(shown):
        own = random.by_name[name]
        if own.estimate is not None:
            axes.plot([own.estimate.value] * 2, [place - 0.42, place + 0.42], **look)
