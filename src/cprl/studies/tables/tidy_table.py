"""StudyTable: the results of a study as one tidy table, with a row for each window of episodes.

Columns:
    condition        its name
    checksum         of the condition, see `cprl.studies.study`
    (each factor)    its level: numbers where all levels are, else texts
    run              the directory of the run
    marks            the versions, git commit and processor in which the run differs from most; "" if none
    replica          its number in the study, int32
    part             "training", "evaluation" or "random", random play in the worlds of the evaluation
    metric           its name, as in docs/metrics.md, without "social/"
    episode          the first episode of the window, int32; in W worlds a window has as many consecutive
                     episodes of each, and its first is that after all earlier windows
    window_episodes  the number of episodes in the window, int32
    undefined        the number of those episodes in which the metric is undefined, int32
    value            the mean over the other episodes, float64; NaN if there are none

Rows are sorted by condition, replica, part, metric and episode, so the same runs always give the same table.
A factor whose path equals another column is called "factor PATH". Summaries and figures need the table alone,
not the runs.
"""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cprl.measuring.table import WINDOWS, where
from cprl.runs.episodes import csv_text, write_table
from cprl.runs.files import STUDY_TABLE_FORMAT, refuse_newer
from cprl.runs.recipe import versions
from cprl.system.defaults import LAST_EPISODES
from cprl.values import METRIC_WORDS, Positive, checked, refusal

METADATA: Final = b"cprl"
"""The key, in the metadata of a parquet file, of everything that a table holds beside its rows."""
TRAINING_PART: Final = "training"
EVALUATION_PART: Final = "evaluation"
RANDOM_PART: Final = "random"
RUN_PARTS: Final = {TRAINING_PART: None, EVALUATION_PART: "trained", RANDOM_PART: "random"}
"""The parts of a run: the training, the evaluation of its agents in fresh worlds, and random play in the same
worlds; with the name of the evaluation's file."""
TABLE_COLUMNS: Final = {
    "condition": pa.string(),
    "checksum": pa.string(),
    "run": pa.string(),
    "marks": pa.string(),
    "replica": pa.int32(),
    "part": pa.string(),
    "metric": pa.string(),
    "episode": pa.int32(),
    WINDOWS: pa.int32(),
    "undefined": pa.int32(),
    "value": pa.float64(),
}
"""The types of a table's columns without those of the factors, which follow "checksum"."""

Circumstances = Mapping[str, str]
"""How a run was made: the version of each package, the checksum of each module of the user's own, the git
commit and the type of processor, by name. If a run was resumed under others, all are joined by " then "."""
UNKNOWN: Final = "not recorded"
CIRCUMSTANCES: Final = {"git": "git commit", "cpu": "processor"}
_NAMED: Final = 4
"""The largest number of runs that a warning names."""


@dataclass(frozen=True, kw_only=True)
class StudyDesign:
    """The design of a study: its conditions, their levels, and how they are compared."""

    name: str
    conditions: Mapping[str, Mapping[str, Any]]
    """The level of each factor by condition, in order: a number, a truth value or a text."""
    reference: str
    """The condition that others are compared with."""
    is_paired: bool
    """True where replicas of the same number have the same seeds in each condition, and, where it has as many
    worlds, the same worlds."""
    is_grid: bool = True
    """True where levels are few and repeat; not so for random draws."""
    notes: tuple[str, ...] = ()
    """Sentences for the summary about what is compared."""
    clocks: Mapping[str, int] = field(default_factory=dict)
    """The maximal number of steps of an episode by condition, for games that have one."""
    question: str = ""
    expectation: str = ""
    """The expectation before the study was run."""

    @property
    def factors(self) -> tuple[str, ...]:
        """Return the names of the factors; () where conditions have names alone."""
        return tuple(next(iter(self.conditions.values())))

    def levels(self, factor: str) -> list[Any]:
        """Return the level of a factor in each condition."""
        return [levels[factor] for levels in self.conditions.values()]


DAMAGED: Final = "is damaged, remove or restore its directory"
"""The beginning of the reason why a run that ended is not part of a table."""


@dataclass(frozen=True)
class MissingRun:
    """A run that is missing in a table, with the reason."""

    name: str
    condition: str
    replicas: int
    reason: str

    @property
    def is_damaged(self) -> bool:
        """Return whether the run has ended but cannot be read. The study does not run it again."""
        return self.reason.startswith(DAMAGED)

    def __str__(self) -> str:
        """Return what is missing, and why, in a sentence."""
        replicas = f"{self.replicas} replica{'s' * (self.replicas != 1)}"
        return f"{self.condition}: {self.name}, {replicas}, {self.reason}."


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyTable:
    """The results of a study; see the module for the columns of `rows`."""

    design: StudyDesign
    rows: pa.Table = field(repr=False)
    window: int
    """Episodes of a window of training."""
    missing_runs: tuple[MissingRun, ...] = ()
    """The runs that are not in the table, because they are not finished, failed or damaged."""
    provenance: Mapping[str, Circumstances] = field(default_factory=dict, repr=False)
    """How each run was made, by the name of the run."""
    endings: Mapping[str, Mapping[str, int]] = field(default_factory=dict, repr=False)
    """For each condition with a finished run, how many of its replicas end in each phase; the most frequent
    phase first, ties by name."""
    ending_rules: tuple[str, ...] = field(default=(), repr=False)
    """The rules by which phases are told."""
    lengths: Mapping[str, Mapping[str, tuple[int, int]]] = field(default_factory=dict, repr=False)
    """For each condition, the smallest and the largest number of "episodes" and of environment "steps" of its
    replicas. Conditions whose runs do not report their steps are left out."""
    agents_learn: bool = True
    """True if any agent in its runs learns."""
    last: int = LAST_EPISODES
    """The number of episodes at the end of the training that are compared. The file does not store it."""

    @cached_property
    def version_warnings(self) -> list[str]:
        """Return a sentence for each circumstance in which the runs differ, e.g. the version of torch."""
        sentences = []
        for name, counts in count_circumstances(self.provenance).items():
            if len(counts) == 1:
                continue
            parts: list[str] = []
            for value, number in counts.most_common():
                text = f"{value} in {number} run{'s' * (number != 1)}"
                if parts:
                    runs = [run for run, part in self.provenance.items() if part.get(name, UNKNOWN) == value]
                    text += f" ({abbreviated(runs, _NAMED)})"
                parts.append(text)
            what = CIRCUMSTANCES.get(name, f"version of {name}")
            sentences.append(f"The runs were made under more than one {what}: {'; '.join(parts)}.")
        return sentences

    @cached_property
    def metrics(self) -> tuple[str, ...]:
        """Return the metrics of the table, in order."""
        return tuple(self.rows["metric"].unique().to_pylist()) if len(self.rows) else ()

    @cached_property
    def finished_conditions(self) -> list[str]:
        """Return the conditions that have a finished run. Figures leave out the others."""
        return [name for name in self.design.conditions if self.replicas[name]]

    @cached_property
    def hosted_conditions(self) -> tuple[str, ...]:
        """Return the conditions that people played, whose groups end in no phase of a training."""
        return tuple(name for name, ended in self.endings.items() if not ended)

    @cached_property
    def replicas(self) -> Mapping[str, int]:
        """Return the number of replicas in the table, by condition."""
        pairs = self.rows.select(["condition", "replica"]).group_by(["condition", "replica"]).aggregate([])
        counts = Counter(pairs["condition"].to_pylist())
        return {condition: counts[condition] for condition in self.design.conditions}

    def windows(self, part: str = TRAINING_PART, *, last: int | None = None) -> pa.Table:
        """Return the rows of a part, of which `cprl.measuring.statistics` makes estimates and differences.

        Args:
            part: "training", "evaluation" or "random".
            last: of training the last episodes of each replica, in whole windows; in many worlds as many
                of each, see `cprl.measuring.windows.last_of`. By default as many as the table compares.

        Raises:
            ValueError: for an unknown part, or fewer episodes than a window of the table has.
        """
        checked("part", part, Literal[tuple(RUN_PARTS)])
        rows = where(self.rows, part=part)
        if part != TRAINING_PART:
            return rows
        if last is None:
            last = self.last
        checked("last", last, Positive)
        if last < self.window:
            raise refusal("last", last, f"at least {self.window}, the episodes of a window of the table")
        condition = rows["condition"].combine_chunks().dictionary_encode().indices.to_numpy()
        replica, episode, length = (rows[name].to_numpy() for name in ("replica", "episode", WINDOWS))
        lane = condition * (replica.max(initial=0) + 1) + replica
        ends = np.zeros(lane.max(initial=0) + 1, np.int64)
        np.maximum.at(ends, lane, episode + length)
        longest = np.ones(len(self.design.conditions), np.int64)
        np.maximum.at(longest, condition, length)
        whole = np.where(longest > self.window, -(-last // longest) * longest, last)
        return rows.filter(pa.array(episode >= ends[lane] - whole[condition]))

    def __str__(self) -> str:
        """Return what the table holds, its notes and warnings, and which runs are missing, a line each."""
        return "\n".join(
            [self.summary, *self.design.notes, *self.version_warnings, *map(str, self.missing_runs)]
        )

    @property
    def summary(self) -> str:
        """Return a sentence that counts replicas, conditions, rows and missing runs."""
        lacking = len(self.missing_runs)
        without = f"; {lacking} run{'s are' if lacking != 1 else ' is'} not in it" if lacking else ""
        return (
            f"{self.design.name}: {sum(self.replicas.values())} replicas of "
            f"{sum(map(bool, self.replicas.values()))} of {len(self.design.conditions)} conditions, "
            f"{len(self.rows):,} rows{without}."
        )

    def as_arrow(self) -> pa.Table:
        """Return the rows, with all else that the table holds as metadata."""
        held = {
            "format": STUDY_TABLE_FORMAT,
            "versions": versions(),
            "design": asdict(self.design),
            "lacking": [asdict(run) for run in self.missing_runs],
            "metrics": {name: METRIC_WORDS[name] for name in self.metrics if name in METRIC_WORDS},
            "window": self.window,
            "made": self.provenance,
            **{name: getattr(self, name) for name in _HELD},
        }
        return self.rows.replace_schema_metadata({METADATA: json.dumps(held)})

    def write(self, path: Path | str) -> Path:
        """Write the table to a parquet file, which `read` reads; replace an older file atomically."""
        path = Path(path)
        write_table(path, self.as_arrow(), over=True)
        return path

    def to_csv(self) -> str:
        """Return the rows as CSV, with the names of the columns, e.g. for spreadsheets and R."""
        return csv_text(self.rows)

    @classmethod
    def read(cls, path: Path | str, *, last: int = LAST_EPISODES) -> "StudyTable":
        """Read a table that `write` wrote.

        As a side effect, the titles and units of the user's own metrics become known to this process.

        Raises:
            ValueError: for any other file.
        """
        path = Path(path)
        try:
            rows = pq.read_table(path)
            held = json.loads((rows.schema.metadata or {})[METADATA])
            refuse_newer(path, held, STUDY_TABLE_FORMAT)
            METRIC_WORDS.update(held.get("metrics", {}))
            return cls(
                rows=rows,
                design=StudyDesign(**{**held["design"], "notes": tuple(held["design"]["notes"])}),
                missing_runs=tuple(MissingRun(**run) for run in held["lacking"]),
                window=held["window"],
                provenance=held["made"],
                **{name: held[name] for name in _HELD},
                last=last,
            )
        except (pa.ArrowException, OSError, LookupError, TypeError, json.JSONDecodeError) as error:
            raise ValueError(f"{path} is not the table of a study: {error!r}") from error


_HELD: Final = ("endings", "ending_rules", "lengths", "agents_learn")
"""Fields that JSON can hold as they are."""


def count_circumstances(provenance: Mapping[str, Circumstances]) -> dict[str, Counter[str]]:
    """Count the runs that have each value of each circumstance; of ties, the first run's value is first."""
    counts: dict[str, Counter[str]] = {}
    for name in dict.fromkeys(chain.from_iterable(provenance.values())):
        counts[name] = Counter(run.get(name, UNKNOWN) for run in provenance.values())
    return counts


def abbreviated(names: list[str], most: int) -> str:
    """Return the first names as a text, e.g. "a, b and 3 more"."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"
