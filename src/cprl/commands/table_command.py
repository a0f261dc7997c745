"""`cprl table`: compare any runs, or the runs of a study."""

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import tyro

from cprl.commands.flags import TableFiles, TableFlags
from cprl.runs.recipe import read_recipe, runs_in
from cprl.system.defaults import LAST_EPISODES, STUDY_TABLE, WINDOW_EPISODES
from cprl.system.output import OUT, say

if TYPE_CHECKING:
    from cprl.studies import StudyTable
    from cprl.terminal.text_tables import TextTable

_TRAINING: Final = "training"
Part = Literal["training", "evaluation", "random"]


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Options of what a table compares."""

    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A metric that is compared, e.g. collective_return; may be repeated."""
    part: Part = _TRAINING
    """The part of the runs: their training, their agents in fresh worlds, or random play in these worlds."""
    last: int | None = None
    """Episodes at the end of the training that are compared, by default 30."""

    def __post_init__(self) -> None:
        if self.last is not None and self.part != _TRAINING:
            raise ValueError(f"--last counts episodes of the training; allowed: without --part {self.part}")


def table(
    runs: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN [RUN ...]", help_behavior_hint="")],
    /,
    *,
    by: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    compare: Annotated[Compare, tyro.conf.arg(name="")] = Compare(),
    reference: str | None = None,
    window: int | None = None,
    files: TableFlags = TableFiles(),
    summary: bool = False,
    figures: Literal["png", "pdf", "svg"] | None = None,
) -> None:
    """Compare any runs, grouped by fields of their experiments, and print intervals over replicas.

    A row is a window of episodes of a replica and a metric. Ends with exit code 1 where a damaged run had to
    be left out; it is named.

    Args:
        runs: Directories of runs, or of directories that hold them, with --by, or where people played some;
            or the directory of a study.
        by: The path of a field, e.g. game.rules.freeze-steps, agents.*.algorithm.settings.gamma or name; may
            be repeated.
        reference: The name of the condition that others are compared with, e.g. freeze_steps=25; by default
            the first, or the reference of the study.
        window: Episodes of a row of the table, of which --last compares whole ones, 10 by default; 1 for
            episodes one by one; with --by.
        summary: Write summary.md and the figures of a study again, from its table alone.
        figures: Draw the figures of a study into its figures/ as png, pdf or svg, of the metrics asked for.
    """
    compared = {name: value for name, value in vars(compare).items() if value != getattr(Compare, name)}
    files.check(summary=summary, figures=figures, reference=reference, **compared)
    if not runs:
        raise ValueError("cprl table needs at least one run: cprl table RUN... --by FIELD")
    if not by and not (runs[0] / STUDY_TABLE).exists() and _people_played(runs):
        by = ("game.institutions", "agents")
    for flag, value in (("--summary", summary), ("--figures", figures)):
        if value and by:
            raise ValueError(f"{flag} is of a study; allowed: without --by, cprl table STUDY {flag}")
    if by:
        study_table = _pool_runs(runs, by, reference, window)
    else:
        study_table = _read_study_table(runs, reference, window)
    if files.csv:
        OUT.write(study_table.to_csv())
        _exit_if_damaged(study_table)
        return
    last = LAST_EPISODES if compare.last is None else compare.last
    study_table = replace(study_table, last=last)
    tables = _print_comparison(study_table, compare)
    if summary:
        from cprl.studies.results import summarise_again

        say(f"Written: {summarise_again(study_table, runs[0])}")
    if figures is not None:
        from cprl.studies.results import draw_figures

        for path in draw_figures(study_table, runs[0], suffix=f".{figures}", metrics=compare.metric):
            say(f"Figure: {path}")
    rows = study_table.rows
    if compare.metric:
        from cprl.measuring.table import where

        rows = where(rows, metric=compare.metric)
    files.write(replace(study_table, rows=rows).as_arrow(), tables, notes=str(study_table).split("\n"))
    _exit_if_damaged(study_table)


def _people_played(runs: Sequence[Path]) -> bool:
    """Return whether people played any of the runs, which are then told apart by treatments and agents."""
    with suppress(ValueError):  # where some are no runs, a field is asked for
        agents = chain.from_iterable(read_recipe(run)["experiment"]["agents"] for run in runs_in(runs))
        return {"kind": "Person"} in agents
    return False


def _pool_runs(
    runs: Sequence[Path], by: Sequence[str], reference: str | None, window: int | None
) -> "StudyTable":
    """Return the table of any runs, grouped by the fields `by`."""
    runs_in(runs)  # refuses what is no run before torch is imported

    from cprl.studies.tables.pooled import pooled_table

    if window is None:
        window = WINDOW_EPISODES
    return pooled_table(runs, by=by, window=window, reference=reference)


def _print_comparison(study_table: "StudyTable", compare: Compare) -> "list[TextTable]":
    """Print means, differences and effects, and what the table holds; return the tables for files."""
    from cprl.studies.tables.comparing import comparison_tables, without_unfinished
    from cprl.studies.tables.effects import effect_tables
    from cprl.terminal.text_tables import print_tables

    compared = comparison_tables(study_table, compare.metric, part=compare.part)
    effects = effect_tables(study_table, compare.metric, part=compare.part)
    print_tables([*map(without_unfinished, compared), *effects])
    say(str(study_table))
    return [*compared, *effects]


def _exit_if_damaged(table: "StudyTable") -> None:
    """Exit with code 1 if a damaged run was left out, so that no script takes the table for complete."""
    if any(run.is_damaged for run in table.missing_runs):
        sys.exit(1)


def _read_study_table(runs: Sequence[Path], reference: str | None, window: int | None) -> "StudyTable":
    """Read the table of a study, and set another reference if one is given."""
    path = runs[0] / STUDY_TABLE
    if len(runs) > 1 or not path.exists():
        raise ValueError(
            "cprl table needs a field in which runs differ: cprl table RUN... --by game.rules.freeze-steps; "
            "or the directory of one study with its table.parquet: cprl table STUDY"
        )
    if window is not None:
        raise ValueError("--window is for runs; allowed: with --by, as a study's table has its windows")
    from cprl.studies import StudyTable

    table = StudyTable.read(path)
    if reference is None:
        return table
    if reference not in table.design.conditions:
        names = ", ".join(list(table.design.conditions)[:10])
        raise ValueError(f"--reference is {reference}; allowed: the name of a condition: {names}")
    return replace(table, design=replace(table.design, reference=reference))
