"""The command `cprl table`: any runs at hand, grouped by fields of their experiments."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import tyro

from cprl.measuring.statistics import Interval
from cprl.output import OUT, console, say
from cprl.runs.files import write_atomically
from cprl.runs.labelled import refuse_to_write_over
from cprl.studies.tables.comparing import LAST, compare, metrics_of
from cprl.studies.tables.pooled import pooled_table
from cprl.studies.tables.table import WINDOW, StudyTable
from cprl.studies.tables.texts import Cells, cells, markdown, rich_table
from cprl.studies.tables.windows import TRAINING

SUFFIXES: Final = (".parquet", ".md")
Part = Literal["training", "evaluation", "random"]


def runs_table(
    runs: tuple[Path, ...],
    /,
    *,
    by: tyro.conf.UseAppendAction[tuple[str, ...]],
    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    part: Part = TRAINING,
    last: int | None = None,
    interval: Interval = "t",
    reference: str | None = None,
    window: int = WINDOW,
    out: Path | None = None,
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
) -> None:
    """Compares any runs, grouped by fields of their experiments, with intervals over replicas.

    Args:
        runs: directories of runs, or of directories that hold them.
        by: the path of a field, e.g. game.rules.freeze-steps, agents.*.algorithm.settings.gamma or name; may
            be repeated.
        metric: what is compared, e.g. collective_return; may be repeated.
        part: of the runs: their training, their agents in fresh worlds, or random play in these.
        last: episodes at the end of the training that are compared, by default 30.
        interval: "t", by Student's t, or "bca", by bootstrap of the replicas.
        reference: the name of the condition that others are compared with, e.g. freeze_steps=25; by default
            the first.
        window: episodes of a row of the table, of which --last compares whole ones and --out FILE.parquet
            writes all; 1 for episodes one by one.
        out: a file to be: .parquet with every window of episodes, replica and metric, or .md with what is
            printed.
        allow: code of your own, module:Class, that a run's recipe may name; may be repeated.
    """
    if out is not None:
        if out.suffix not in SUFFIXES:
            raise ValueError(f"--out is {out}; allowed: a name that ends in {' or '.join(SUFFIXES)}")
        refuse_to_write_over(out)
    if last is not None and part != TRAINING:
        raise ValueError(f"--last counts episodes of the training; allowed: without --part {part}")
    if not runs:
        raise ValueError("cprl table wants at least one run: cprl table RUN... --by FIELD")
    if not by:
        raise ValueError(
            "cprl table wants a field that tells runs apart: cprl table RUN... --by game.rules.freeze-steps"
        )
    found = pooled_table(runs, by=by, window=window, reference=reference, allow=allow)
    compared = _compared(found, metric, part, LAST if last is None else last, interval)
    shown = console(width=None if OUT.isatty() else 250)
    for own in compared:
        shown.print(rich_table(own))
    say(str(found))
    if out is not None:
        _write(found, compared, out)
        say(f"Written: {out}")


def _compared(
    found: StudyTable, metrics: Sequence[str], part: Part, last: int, interval: Interval
) -> list[Cells]:
    """Levels, and differences where there is more than one condition."""
    chosen = metrics_of(found, metrics)
    if not chosen:
        return []
    every = [compare(found, own, part=part, last=last, interval=interval) for own in chosen]
    several = len(found.design.conditions) > 1
    return [cells(every), cells(every, "differences")] if several else [cells(every)]


def _write(found: StudyTable, compared: Sequence[Cells], out: Path) -> None:
    if out.suffix == ".parquet":
        found.write(out)
        return
    lines = [line for own in compared for line in (own.heading, "", *markdown(own))]
    content = "\n".join([*lines, *str(found).split("\n"), ""]).encode()
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(out, lambda file: file.write(content))
