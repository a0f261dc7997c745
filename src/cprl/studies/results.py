"""write_results: the table of a study, its summary and its figures, made of its finished runs alone."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from cprl.runs.checkpoints import REPORT
from cprl.runs.files import read_json, refuse_links, write_atomically
from cprl.studies.figures.courses import courses
from cprl.studies.figures.diagrams import grids, heat_map, phase_diagram
from cprl.studies.figures.levels import MOST_CONDITIONS, by_condition, by_factor, is_numeric
from cprl.studies.study import Study
from cprl.studies.tables.comparing import LAST, cells, compare, markdown, metric_title, metrics_of
from cprl.studies.tables.sources import EVALUATION, RANDOM, TRAINING, Endings, Source, endings, sources_of
from cprl.studies.tables.table import WINDOW, StudyTable, study_table

TABLE: Final = "table.parquet"
SUMMARY: Final = "summary.md"
FIGURES: Final = "figures"
_STATUS: Final = "status"
_MAPPED: Final = 2
"""Metrics that have a heat map."""

Drawn = tuple[str, str]
"""The name of a figure's file, and what it shows."""


def write_results(
    study: Study,
    out: Path | str,
    runs: Path | str,
    *,
    window: int = WINDOW,
    last: int = LAST,
    again: str = "",
) -> StudyTable:
    """Writes `table.parquet`, `summary.md` and `figures/`; again over what an earlier call wrote.

    Args:
        last: episodes at the end of the training that are compared.
        again: the command line that runs what is lacking, for the summary.

    Returns:
        The table. What is no part of it is named in it and in the summary.

    Raises:
        OSError: where it cannot be written; each file is then whole, an old one or a new one.
    """
    out, folder = Path(out), Path(runs)
    refuse_links(out)
    status = out / _STATUS
    table = study_table(study, folder, window=window, status=status if status.exists() else None)
    metrics = metrics_of(table)
    for own in metrics[:1]:
        compare(table, own, last=last)
    sources = [own for own in sources_of(study, folder)[0] if own.name in table.made]
    found = endings(sources)
    table.write(out / TABLE)
    figures = list(_draw(table, found, out / FIGURES, last)) if metrics else []
    _remove_stale(out / FIGURES, [name for name, _ in figures])
    lines = [*_summary(study, table, found, figures, last, again), *_lengths(table, sources)]
    content = ("\n".join(lines).rstrip() + "\n").encode("utf-8", "replace")
    write_atomically(out / SUMMARY, lambda file: file.write(content))
    return table


def _draw(table: StudyTable, found: Endings, folder: Path, last: int) -> Iterator[Drawn]:
    """Draws what fits the study: by each numeric factor, by condition, and over each two factors."""
    design = table.design
    few = len(design.conditions) <= MOST_CONDITIONS
    every = grids(design)
    for factor in design.factors:
        if is_numeric([own[factor] for own in design.conditions.values()]):
            name = f"by_{_file_name(factor)}.png"
            by_factor(table, factor, folder / name, last=last)
            yield name, f"Outcome by {factor}"
    if few:
        by_condition(table, folder / "levels.png", last=last)
        yield "levels.png", "Outcome by condition"
        courses(table, folder / "courses.png")
        yield "courses.png", "The course of the training"
        phase_diagram(table, found, folder / "phases.png")
        yield "phases.png", "In which phases replicas end"
    if few and len(design.conditions) > 1 and table.replicas[design.reference]:
        by_condition(table, folder / "differences.png", kind="differences", last=last)
        yield "differences.png", f"Differences from {design.reference}"
    for one, other in every:
        pair = f"{_file_name(one)}_{_file_name(other)}"
        for metric in metrics_of(table)[:_MAPPED]:
            name = f"map_{pair}_{metric}.png"
            heat_map(table, (one, other), folder / name, metric=metric, last=last)
            yield name, f"{metric_title(metric)} by {one} and {other}"
        name = f"phases_{pair}.png"
        phase_diagram(table, found, folder / name, factors=(one, other))
        yield name, f"In which phase most replicas end, by {one} and {other}"


def _remove_stale(folder: Path, drawn: Sequence[str]) -> None:
    """Removes figures that an earlier call drew and this one did not."""
    for path in folder.glob("*.png") if folder.exists() else ():
        if path.name not in drawn and re.match(r"(by_|map_|phases|levels|differences|courses)", path.name):
            path.unlink()


def _summary(
    study: Study, table: StudyTable, found: Endings, figures: Sequence[Drawn], last: int, again: str
) -> list[str]:
    """The lines of the summary."""
    lines = [f"# {study.name}", ""]
    for word, own in (("Question", study.question), ("Expected before it was run", study.expectation)):
        lines += [f"**{word}.** {own}", ""] if own else []
    lines += [table.summary, ""]
    lines += _lacking(table, again)
    if not table.metrics:
        return lines
    lines += _compared(table, TRAINING, last)
    lines += _compared(table, EVALUATION, last)
    lines += _phases(table, found)
    lines += ["## Figures", ""] if figures else []
    for name, what in figures:
        lines += [f"![{what}]({FIGURES}/{name})", ""]
    if len(table.design.conditions) > MOST_CONDITIONS:
        lines += [
            f"There are no figures by condition, as there are more than {MOST_CONDITIONS} conditions.",
            "",
        ]
    return lines + _made(table)


def _lacking(table: StudyTable, again: str) -> list[str]:
    if not table.lacking:
        return []
    how = (
        f"This line runs what is lacking: `{again}`"
        if again
        else "Running the study again runs what is lacking."
    )
    return ["## What is not in these results", "", *(f"- {own}" for own in table.lacking), "", how, ""]


def _compared(table: StudyTable, part: str, last: int) -> list[str]:
    """Levels and differences of a part of the runs."""
    chosen = metrics_of(table)
    every = [compare(table, own, part=part, last=last) for own in chosen]
    lines = ["## Training" if part == TRAINING else "## Trained agents in fresh worlds", ""]
    levels = cells(every)
    lines += [levels.heading, "", *markdown(levels)]
    if len(table.design.conditions) > 1:
        differences = cells(every, "differences")
        count = len(differences.rows) * len(chosen)
        lines += [
            f"{differences.heading} Bold: the interval excludes 0, as that of about one in twenty would by "
            f"chance; these are {count}.",
            "",
            *markdown(differences),
        ]
    if part == EVALUATION:
        random = cells([compare(table, own, part=RANDOM) for own in chosen])
        lines += [random.heading, "", *markdown(random)]
    return lines


def _phases(table: StudyTable, found: Endings) -> list[str]:
    rows = []
    for condition in table.design.conditions:
        counts = found.counts(condition)
        texts = [f"{label} {number}" for label, number in counts.most_common()]
        rows.append(
            f"| {condition.replace('|', chr(92) + '|')} | {counts.total()} | {', '.join(texts) or '-'} |"
        )
    rules = "; ".join(found.rules)
    head = ["| condition | replicas | end in |", "|---|---:|---|"]
    return ["## Phases", "", f"In which phase a replica ends: {rules}.", "", *head, *rows, ""]


def _made(table: StudyTable) -> list[str]:
    """Under which versions the runs were made."""
    first = next(iter(table.made.values()), {})
    lines = ["## How the runs were made", ""]
    if table.mixed:
        return [*lines, *(f"- {own}" for own in table.mixed), ""]
    return [*lines, f"All under {', '.join(f'{name} {own}' for name, own in first.items())}.", ""]


def _lengths(table: StudyTable, sources: Sequence[Source]) -> list[str]:
    """How long the runs of each condition were, where their reports say so."""
    rows = []
    for condition in table.design.conditions:
        own = [source for source in sources if source.condition == condition]
        steps = {steps for source in own if (steps := _steps_of(source.run)) is not None}
        if steps:
            episodes = _range({source.episodes for source in own})
            rows.append(f"| {condition.replace('|', chr(92) + '|')} | {episodes} | {_range(steps)} |")
    if not rows:
        return []
    what = (
        "How long each replica trained. The replicas of a run take each step together until every one has "
        "played its episodes; those whose episodes are short play and learn on, in episodes that are in no "
        "table."
    )
    return [what, "", "| condition | episodes | environment steps |", "|---|---:|---:|", *rows, ""]


def _steps_of(run: Path) -> int | None:
    """Those that a run says it trained; None for a report of before, or one that cannot be read."""
    try:
        steps = read_json(run / REPORT).get("steps")
    except (OSError, ValueError):
        return None
    return steps if isinstance(steps, int) else None


def _range(numbers: set[int]) -> str:
    """The numbers, from the least to the most."""
    least, most = min(numbers), max(numbers)
    return f"{least:,}" if least == most else f"{least:,} to {most:,}"


def _file_name(factor: str) -> str:
    """A factor as a part of a file's name."""
    return re.sub(r"[^A-Za-z0-9]+", "_", factor.replace("*", "all")).strip("_")
