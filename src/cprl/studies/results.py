"""write_results: the table of a study, its summary and its figures, made of its finished runs alone.

The summary and the figures are made of the table: `summarise_again` makes them again where runs are gone.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isnan
from pathlib import Path
from typing import Final

from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, title, unit
from cprl.measuring.statistics import Estimate, form_for
from cprl.runs.files import refuse_links, write_atomically
from cprl.studies.figures import DRAWN, figures_of
from cprl.studies.study import STATUS, Study
from cprl.studies.tables.comparing import (
    compared_cells,
    differences_of,
    episodes_text,
    metrics_of,
    pairing_text,
)
from cprl.studies.tables.effects import effect_cells, effects_of, weights_of
from cprl.studies.tables.sources import study_table
from cprl.studies.tables.table import EVALUATION, LAST, RANDOM, TRAINING, WINDOW, StudyTable
from cprl.system.defaults import STUDY_TABLE
from cprl.terminal.tables import Cells, cell, markdown

SUMMARY: Final = "summary.md"
FIGURES: Final = "figures"


def write_results(
    study: Study,
    out: Path | str,
    runs: Path | str,
    *,
    window: int = WINDOW,
    last: int = LAST,
    again: str = "",
) -> StudyTable:
    """Write `table.parquet`, `summary.md` and `figures/`; again over what an earlier call wrote.

    Args:
        last: episodes at the end of the training that are compared.
        again: the command line that runs what is lacking, for the summary.

    Returns:
        The table. What is no part of it is named in it and in the summary.
    """
    out = Path(out)
    refuse_links(out)
    table = replace(study_table(study, runs, window=window, status=out / STATUS), last=last)
    table.windows()  # refuses before anything is written
    table.write(out / STUDY_TABLE)
    draw(table, out)
    write_summary(table, out, again=again)
    return table


def summarise_again(table: StudyTable, out: Path) -> Path:
    """Write `summary.md` of a table alone, with an earlier one's line that runs what is lacking, and draw the
    figures that are there, so that both are of the same episodes and the same reference."""
    table.windows()  # refuses before anything is written
    if (out / FIGURES).exists():
        draw(table, out)
    earlier = (out / SUMMARY).read_text("utf-8", "replace") if (out / SUMMARY).exists() else ""
    again = re.search("^This line runs what is lacking.*?: `(.*)`$", earlier, re.MULTILINE)
    return write_summary(table, out, again=again[1] if again else "")


def draw(table: StudyTable, out: Path, *, suffix: str = ".png", metrics: Sequence[str] = ()) -> list[Path]:
    """Draw the figures that fit a study into `figures/`, and return them; those of an earlier call with the
    same suffix go.

    Args:
        suffix: ".png", ".pdf" or ".svg".
        metrics: by default those that are compared.
    """
    refuse_links(out)
    metrics_of(table, metrics)  # refuses before anything is drawn
    figures = {name: draw_it for name, _, draw_it in figures_of(table, suffix=suffix, metrics=metrics)}
    drawn = [draw_it(out / FIGURES / name) for name, draw_it in figures.items()]
    for path in (out / FIGURES).glob(f"*{suffix}"):
        if path.name not in figures and DRAWN.fullmatch(path.name):
            path.unlink()
    return drawn


def write_summary(table: StudyTable, out: Path, *, again: str = "") -> Path:
    """Write `summary.md` of a table alone, with the figures that are there; see `write_results`."""
    design = table.design
    lines = [f"# {design.name}", ""]
    for word, text in (("Question", design.question), ("Expected before it was run", design.expectation)):
        lines += [f"**{word}.** {text}", ""] if text else []
    lines += [table.summary, ""]
    if table.lacking:
        damaged = any(run.is_damaged for run in table.lacking)
        what = "what is lacking" + ", damaged runs once their directories are removed" * damaged
        line = f"This line runs {what}: `{again}`" if again else f"Running the study again runs {what}."
        lines += ["## What is not in these results", "", *(f"- {run}" for run in table.lacking), "", line, ""]
    if table.metrics:
        lines += [*_compared(table, TRAINING), *_compared(table, EVALUATION), *_phases(table)]
        figures = [figure for figure in figures_of(table) if (out / FIGURES / figure[0]).exists()]
        lines += ["## Figures", ""] if figures else []
        for name, what, _ in figures:
            lines += [f"![{what}]({FIGURES}/{name})", ""]
        lines += [*_made(table), *_lengths(table)]
    content = ("\n".join(lines).rstrip() + "\n").encode("utf-8", "replace")
    write_atomically(out / SUMMARY, lambda file: file.write(content))
    return out / SUMMARY


def _compared(table: StudyTable, part: str) -> list[str]:
    tables = compared_cells(table, part=part) + effect_cells(table, part=part)
    if part == EVALUATION:
        tables += compared_cells(table, part=RANDOM)[:1]
    agents = "Trained agents" if table.agents_learn else "The agents"
    lines = ["## Training" if part == TRAINING else f"## {agents} in fresh worlds", ""]
    for each in tables:
        lines += [each.heading, "", *markdown(each)]
    return lines


def _phases(table: StudyTable) -> list[str]:
    rows = ["| condition | replicas | end in |", "|---|---:|---|"]
    for condition in table.design.conditions:
        counts = table.endings.get(condition, {})
        phases = ", ".join(f"{phase} {number}" for phase, number in counts.items())
        rows.append(f"| {cell(condition)} | {sum(counts.values())} | {phases or '-'} |")
    heading = f"In which phase a replica ends: {'; '.join(table.ending_rules)}."
    return ["## Phases", "", heading, "", *rows, ""]


def _made(table: StudyTable) -> list[str]:
    first = next(iter(table.made.values()), {})
    lines = [f"- {sentence}" for sentence in table.mixed]
    lines = lines or [f"All under {', '.join(f'{name} {value}' for name, value in first.items())}."]
    return ["## How the runs were made", "", *lines, ""]


def _lengths(table: StudyTable) -> list[str]:
    ranges = {
        condition: [table.lengths[condition][name] for name in ("episodes", "steps")]
        for condition in table.design.conditions
        if condition in table.lengths
    }
    what = (
        "How long each replica trained. The replicas of a run take each step together until every one has "
        "played its episodes; those whose episodes are short play and learn on, in episodes that are in no "
        "table."
    )
    if any(least < most for (least, most), _ in ranges.values()):
        what += " Where steps are counted, each plays as many as it ends in these."
    rows = [
        [condition, *(f"{least:,}" if least == most else f"{least:,} to {most:,}" for least, most in pairs)]
        for condition, pairs in ranges.items()
    ]
    lines = markdown(Cells(what, ["condition", "episodes", "environment steps"], rows))
    return [what, "", *lines] if rows else []


def answer_of(table: StudyTable) -> str:
    """Return in Markdown what differs in the episodes of the evaluation: of a grid the effects of its
    factors, else conditions from the reference; "" without any.

    It is about income where money moves, and then about the harvest too; else about the first metric.
    """
    if not table.metrics or len(table.design.conditions) < 2:
        return ""
    metrics = metrics_of(table, part=EVALUATION)
    subjects = {INCOME: _INCOME, COLLECTIVE_RETURN: _HARVEST}
    if not subjects.keys() <= set(metrics):
        subjects = {metrics[0]: title(metrics[0])}
    beside = f"beside {cell(table.design.reference)}, {pairing_text(table)}"
    family = differences_of(table, metrics, part=EVALUATION)
    tests = f"{family.tests} differences of their table below"
    parts = []
    for metric, words in subjects.items():
        if weights_of(table):
            family = effects_of(table, metric, part=EVALUATION)
            beside = "effects of each factor over all cells of the grid, paired by replica"
            tests = f"{family.tests} effects on a metric"
        changes = {name: one for (name, number), one in family.items() if number == metric}
        parts += [f"- {words}:", *_lines(changes, unit(metric))]
    what = f"In {episodes_text(table, EVALUATION)}, {beside}"
    what += f"; by Holm's method for the {tests}:" if family.tests else ":"
    return "\n".join([what, "", *parts])


_INCOME: Final = "**Income** of all agents together (harvest - fines + transfers), apples"
_HARVEST: Final = "**Harvest** (collective return), apples"
_NONE: Final = "no difference shown"
_ALONE: Final = "not shown among so many, though it would be alone"
_UNTOLD: Final = "cannot be told, as one replica has no interval"


def _lines(differences: Mapping[str, Estimate], unit_of: str) -> list[str]:
    """Return lines on which differences are more and less than 0; of those not shown, how large one would
    have to be."""
    by_kind: dict[str, list[str]] = {kind: [] for kind in ("more", "less", _NONE, _ALONE, _UNTOLD)}
    for name, one in differences.items():
        text = f"{cell(name)} {one:+}"
        if one.differs:
            kind = "more" if one.value > 0 else "less"
        elif isnan(one.reach):
            kind = _UNTOLD
        elif abs(one.value) > one.reach:
            kind = _ALONE
        else:
            kind = _NONE
            size = f"{one.reach:{form_for(one.value, one.low, one.high)}} {unit_of}".rstrip()
            text += f" (differences below {size} would not show)" if one.reach else ""
        by_kind[kind].append(text)
    return [f"  - {kind}: {'; '.join(texts)}" for kind, texts in by_kind.items() if texts]
