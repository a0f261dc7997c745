"""write_results: write the table of a study, its summary and its figures from its finished runs.

The summary and the figures need the table alone. So `summarise_again` can write them after the runs are gone.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from cprl.runs.files import refuse_links, write_text
from cprl.studies.study import STATUS, Study
from cprl.studies.study_figures import DRAWN, figures_of
from cprl.studies.tables.comparing import compared_metrics, comparison_tables
from cprl.studies.tables.effects import effect_tables
from cprl.studies.tables.sources import study_table
from cprl.studies.tables.tidy_table import (
    EVALUATION_PART,
    RANDOM_PART,
    TRAINING_PART,
    StudyTable,
)
from cprl.system.defaults import LAST_EPISODES, STUDY_TABLE
from cprl.terminal.text_tables import TextTable, escape_cell, markdown

SUMMARY: Final = "summary.md"
FIGURES: Final = "figures"


def write_results(
    study: Study,
    out: Path | str,
    runs: Path | str,
    *,
    last: int = LAST_EPISODES,
    again: str = "",
) -> StudyTable:
    """Write `table.parquet`, `summary.md` and `figures/` of a study; replace those of an earlier call.

    Args:
        out: the directory of the study.
        runs: the directory of its runs.
        last: the number of episodes at the end of the training that are compared.
        again: the command line that runs missing trials; the summary shows it.

    Returns:
        The table. It names the runs that are missing, and so does the summary.
    """
    out = Path(out)
    refuse_links(out)
    table = replace(study_table(study, runs, status=out / STATUS), last=last)
    table.windows()  # refuses before anything is written
    table.write(out / STUDY_TABLE)
    draw_figures(table, out)
    write_summary(table, out, again=again)
    return table


def summarise_again(table: StudyTable, out: Path) -> Path:
    """Write the summary again from a table alone, and draw the figures again if there are any.

    Summary and figures then compare the same episodes with the same reference. The line that runs missing
    trials is taken from the earlier summary.
    """
    table.windows()  # refuses before anything is written
    if (out / FIGURES).exists():
        draw_figures(table, out)
    earlier = (out / SUMMARY).read_text("utf-8", "replace") if (out / SUMMARY).exists() else ""
    lines = re.findall("^This line runs what is lacking.*?: `(.*)`$", earlier, re.MULTILINE)
    return write_summary(table, out, again="".join(lines[:1]))


def draw_figures(
    table: StudyTable, out: Path, *, suffix: str = ".png", metrics: Sequence[str] = ()
) -> list[Path]:
    """Draw the figures of a study into `figures/`, and return their paths.

    Figures of an earlier call with the same suffix that are not drawn again are removed.

    Args:
        suffix: ".png", ".pdf" or ".svg".
        metrics: the metrics that are drawn; by default those that are compared.
    """
    refuse_links(out)
    compared_metrics(table, metrics)  # refuses before anything is drawn
    figures = {name: draw_it for name, _, draw_it in figures_of(table, suffix=suffix, metrics=metrics)}
    drawn = [draw_it(out / FIGURES / name) for name, draw_it in figures.items()]
    for path in (out / FIGURES).glob(f"*{suffix}"):
        if path.name not in figures and DRAWN.fullmatch(path.name):
            path.unlink()
    return drawn


def write_summary(table: StudyTable, out: Path, *, again: str = "") -> Path:
    """Write `summary.md` from a table, with links to the figures that exist; see `write_results`."""
    design = table.design
    lines = [f"# {design.name}", ""]
    for word, text in (("Question", design.question), ("Expected before it was run", design.expectation)):
        lines += [f"**{word}.** {text}", ""] if text else []
    lines += [table.summary, ""]
    if table.missing_runs:
        damaged = any(run.is_damaged for run in table.missing_runs)
        what = "what is lacking" + ", damaged runs once their directories are removed" * damaged
        line = f"This line runs {what}: `{again}`" if again else f"Running the study again runs {what}."
        lines += [
            "## What is not in these results",
            "",
            *(f"- {run}" for run in table.missing_runs),
            "",
            line,
            "",
        ]
    if table.metrics:
        lines += [*_compared(table, TRAINING_PART), *_compared(table, EVALUATION_PART), *_phases(table)]
        figures = [figure for figure in figures_of(table) if (out / FIGURES / figure[0]).exists()]
        lines += ["## Figures", ""] if figures else []
        for name, what, _ in figures:
            lines += [f"![{what}]({FIGURES}/{name})", ""]
        lines += [*_provenance(table), *_lengths(table)]
    return write_text(out / SUMMARY, "\n".join(lines).rstrip() + "\n")


def _compared(table: StudyTable, part: str) -> list[str]:
    """Return the section of the summary that compares conditions in one part of the runs."""
    tables = comparison_tables(table, part=part) + effect_tables(table, part=part)
    if part == EVALUATION_PART:
        tables += comparison_tables(table, part=RANDOM_PART)[:1]
    agents = "Trained agents" if table.agents_learn else "The agents"
    lines = ["## Training" if part == TRAINING_PART else f"## {agents} in fresh worlds", ""]
    for each in tables:
        lines += [each.heading, "", *markdown(each)]
    return lines


def _phases(table: StudyTable) -> list[str]:
    rows = ["| condition | replicas | end in |", "|---|---:|---|"]
    for condition in table.design.conditions:
        counts = table.endings.get(condition, {})
        phases = ", ".join(f"{phase} {number}" for phase, number in counts.items())
        rows.append(f"| {escape_cell(condition)} | {sum(counts.values())} | {phases or '-'} |")
    heading = f"In which phase a replica ends: {'; '.join(table.ending_rules)}."
    return ["## Phases", "", heading, "", *rows, ""]


def _provenance(table: StudyTable) -> list[str]:
    first = next(iter(table.provenance.values()), {})
    lines = [f"- {sentence}" for sentence in table.version_warnings]
    lines = lines or [f"All under {', '.join(f'{name} {value}' for name, value in first.items())}."]
    return ["## How the runs were made", "", *lines, ""]


def _lengths(table: StudyTable) -> list[str]:
    """Return the section of the summary that says how long replicas trained."""
    what = (
        "How long each replica trained. The replicas of a run take each step together until every one has "
        "played its episodes; those whose episodes are short play and learn on, in episodes that are in no "
        "table."
    )
    rows = []
    differ = False
    for condition in table.design.conditions:
        lengths = table.lengths.get(condition)
        if lengths is not None:
            least, most = lengths["episodes"]
            differ |= least < most
            rows.append([condition, _range(least, most), _range(*lengths["steps"])])
    if differ:
        what += " Where steps are counted, each plays as many as it ends in these."
    lines = markdown(TextTable(what, ["condition", "episodes", "environment steps"], rows))
    return [what, "", *lines] if rows else []


def _range(least: int, most: int) -> str:
    return f"{least:,}" if least == most else f"{least:,} to {most:,}"
