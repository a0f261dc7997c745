"""StudyTable: what came out of the runs of a study, as one tidy table of windows of episodes.

Columns:
    condition        its name
    checksum         of the condition, see `cprl.studies.study`
    (each factor)    its level: numbers where all levels are, else texts
    run              the directory of the run
    marks            what of its versions, git commit and processor differs from most runs'; "" if nothing
    replica          its number in the study, int32
    part             "training", "evaluation" or "random", random play in the worlds of the evaluation
    metric           its name, as in docs/metrics.md, without "social/"
    episode          the first episode of the window, int32; in W worlds a window has as many consecutive
                     episodes of each, and its first is that after all earlier windows
    window_episodes  episodes of the window, int32
    undefined        episodes of the window in which the metric is undefined, int32
    value            the mean over its other episodes, float64; NaN where there are none

Rows are sorted by condition, replica, part, metric and episode, so that the same runs give the same table.
A factor with the name of another column is called "factor NAME". Summaries and figures are made of a table
alone.
"""

import io
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from cprl.measuring.table import WINDOWS, where
from cprl.runs.episodes import write_table
from cprl.runs.files import STUDY_TABLE_FORMAT, refuse_newer
from cprl.runs.recipe import versions
from cprl.system.defaults import LAST as LAST
from cprl.system.defaults import WINDOW as WINDOW
from cprl.values import OWN_METRICS, Positive, checked, refusal

METADATA: Final = b"cprl"
"""The key of all that a table holds beside its rows, see the fields of `StudyTable`."""
TRAINING: Final = "training"
EVALUATION: Final = "evaluation"
RANDOM: Final = "random"
PARTS: Final = {TRAINING: None, EVALUATION: "trained", RANDOM: "random"}
"""The parts of a run: its training, its agents in fresh worlds afterwards, and random play in these worlds;
with the name of the table that holds it."""
COLUMNS: Final = (
    *("condition", "checksum", "run", "marks", "replica", "part", "metric"),
    *("episode", "window_episodes", "undefined", "value"),
)
"""All but those of factors, which follow "checksum"."""

Circumstances = Mapping[str, str]
"""The version of each package, the checksum of each module of the user's own, the git commit and the type of
processor, by name. Where a run was resumed under others, all of them in order, with " then " between them."""
UNKNOWN: Final = "not recorded"
WORDS: Final = {"git": "git commit", "cpu": "processor"}
_NAMED: Final = 4
"""The largest number of runs that a sentence names."""


@dataclass(frozen=True, kw_only=True)
class Design:
    """The conditions that a table compares."""

    name: str
    conditions: Mapping[str, Mapping[str, Any]]
    """The level of each factor by condition, in order: a number, a truth value or a text."""
    reference: str
    """The condition that others are compared with."""
    is_paired: bool
    """Whether replicas of the same number have the same seeds in each condition, and, where it has as many
    worlds, the same worlds."""
    is_grid: bool = True
    """Whether levels are few and repeat; not so for random draws."""
    notes: tuple[str, ...] = ()
    """Sentences on what is compared."""
    clocks: Mapping[str, int] = field(default_factory=dict)
    """The turns of an episode at most, by condition, where its game says so."""
    question: str = ""
    expectation: str = ""
    """Before it was run."""

    @property
    def factors(self) -> tuple[str, ...]:
        """Return the names of the factors; () where conditions have names alone."""
        return tuple(next(iter(self.conditions.values())))

    def levels(self, factor: str) -> list[Any]:
        """Return the level of a factor in each condition."""
        return [levels[factor] for levels in self.conditions.values()]


DAMAGED: Final = "is damaged, remove or restore its directory"
"""How the reason begins why a run that ended is not part of a table."""


@dataclass(frozen=True)
class Lacking:
    """A run that is not part of a table, and why."""

    name: str
    condition: str
    replicas: int
    reason: str

    @property
    def is_damaged(self) -> bool:
        """Return whether it ended and cannot be read, so that nothing runs it again."""
        return self.reason.startswith(DAMAGED)

    def __str__(self) -> str:
        """In a sentence."""
        replicas = f"{self.replicas} replica{'s' * (self.replicas != 1)}"
        return f"{self.condition}: {self.name}, {replicas}, {self.reason}."


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyTable:
    """The results of a study; see the module for the columns of `rows`."""

    design: Design
    rows: pa.Table = field(repr=False)
    window: int
    """Episodes of a window of training."""
    lacking: tuple[Lacking, ...] = ()
    """The runs that are no part of it: not finished, failed or damaged."""
    made: Mapping[str, Circumstances] = field(default_factory=dict, repr=False)
    """Versions, git commit and processor of each run in it."""
    endings: Mapping[str, Mapping[str, int]] = field(default_factory=dict, repr=False)
    """How many replicas of a condition end in each phase, the most frequent one first, equally frequent ones
    by name; none for conditions without a finished run."""
    ending_rules: tuple[str, ...] = field(default=(), repr=False)
    """How phases were told, one for short trainings and one for long ones."""
    lengths: Mapping[str, Mapping[str, tuple[int, int]]] = field(default_factory=dict, repr=False)
    """The least and the most "episodes" and environment "steps" of the replicas of a condition; none where
    the reports of its runs do not say how many steps."""
    agents_learn: bool = True
    """Whether any agent of its runs learns."""
    last: int = LAST
    """Episodes at the end of the training that are compared, in whole windows; its file does not say it."""

    @cached_property
    def mixed(self) -> list[str]:
        """Return how its runs were made in different circumstances, in sentences; [] if in the same."""
        sentences = []
        for name, counts in counted(self.made).items():
            if len(counts) == 1:
                continue
            parts: list[str] = []
            for value, number in counts.most_common():
                runs = [run for run, made in self.made.items() if made.get(name, UNKNOWN) == value]
                text = f"{value} in {number} run{'s' * (number != 1)}"
                parts.append(f"{text} ({some(runs, _NAMED)})" if parts else text)
            what = WORDS.get(name, f"version of {name}")
            sentences.append(f"The runs were made under more than one {what}: {'; '.join(parts)}.")
        return sentences

    @cached_property
    def metrics(self) -> tuple[str, ...]:
        """Return the metrics in it, in order."""
        return tuple(self.rows["metric"].unique().to_pylist()) if len(self.rows) else ()

    @cached_property
    def replicas(self) -> Mapping[str, int]:
        """Return how many replicas of each condition are in it."""
        pairs = self.rows.select(["condition", "replica"]).group_by(["condition", "replica"]).aggregate([])
        counts = Counter(pairs["condition"].to_pylist())
        return {condition: counts[condition] for condition in self.design.conditions}

    def windows(self, part: str = TRAINING, *, last: int | None = None) -> pa.Table:
        """Return the rows of a part, of which `cprl.measuring.statistics` makes estimates and differences.

        Args:
            part: "training", "evaluation" or "random".
            last: of training the last episodes of each replica, in whole windows; in many worlds as many
                of each, see `cprl.measuring.windows.last_of`. By default as many as the table compares.
        """
        checked("part", part, Literal[tuple(PARTS)])
        rows = where(self.rows, part=part)
        if part != TRAINING:
            return rows
        last = checked("last", self.last if last is None else last, Positive)
        if last < self.window:
            raise refusal("last", last, f"at least {self.window}, the episodes of a window of the table")
        condition = rows["condition"].combine_chunks().dictionary_encode().indices.to_numpy()
        replica, episode, length = (rows[name].to_numpy() for name in ("replica", "episode", WINDOWS))
        of_replica = condition * (replica.max(initial=0) + 1) + replica
        ends = np.zeros(of_replica.max(initial=0) + 1, np.int64)
        np.maximum.at(ends, of_replica, episode + length)
        longest = np.ones(len(self.design.conditions), np.int64)
        np.maximum.at(longest, condition, length)
        whole = np.where(longest > self.window, -(-last // longest) * longest, last)
        return rows.filter(pa.array(episode >= ends[of_replica] - whole[condition]))

    def __str__(self) -> str:
        """Return what it holds, what it lacks and what is mixed, in sentences."""
        return "\n".join([self.summary, *self.design.notes, *self.mixed, *map(str, self.lacking)])

    @property
    def summary(self) -> str:
        """Return what it holds, in a sentence."""
        lacking = len(self.lacking)
        without = f"; {lacking} run{'s are' if lacking != 1 else ' is'} not in it" if lacking else ""
        return (
            f"{self.design.name}: {sum(self.replicas.values())} replicas of "
            f"{sum(map(bool, self.replicas.values()))} of {len(self.design.conditions)} conditions, "
            f"{len(self.rows):,} rows{without}."
        )

    def write(self, path: Path | str) -> Path:
        """Write a parquet file atomically, which `read` gives back; replace an older one."""
        path = Path(path)
        held = {
            "format": STUDY_TABLE_FORMAT,
            "versions": versions(),
            "design": asdict(self.design),
            "lacking": [asdict(run) for run in self.lacking],
            "metrics": {name: OWN_METRICS[name] for name in self.metrics if name in OWN_METRICS},
            **{name: getattr(self, name) for name in _HELD},
        }
        rows = self.rows.replace_schema_metadata({METADATA: json.dumps(held)})
        write_table(path, rows, over=True)
        return path

    def to_csv(self) -> str:
        """Return the rows as CSV, with the names of the columns, e.g. for spreadsheets and R."""
        file = io.BytesIO()
        pyarrow.csv.write_csv(self.rows, file)
        return file.getvalue().decode()

    @classmethod
    def read(cls, path: Path | str, *, last: int = LAST) -> "StudyTable":
        """Return the table of a file that `write` wrote; raise a ValueError for any other.

        Titles and units of the user's own metrics are known from then on.
        """
        path = Path(path)
        try:
            rows = pq.read_table(path)
            held = json.loads((rows.schema.metadata or {})[METADATA])
            refuse_newer(path, held, STUDY_TABLE_FORMAT)
            OWN_METRICS.update(held.get("metrics", {}))
            return cls(
                rows=rows,
                design=Design(**{**held["design"], "notes": tuple(held["design"]["notes"])}),
                lacking=tuple(Lacking(**run) for run in held["lacking"]),
                **{name: held[name] for name in _HELD},
                last=last,
            )
        except (pa.ArrowException, OSError, LookupError, TypeError, json.JSONDecodeError) as error:
            raise ValueError(f"{path} is not the table of a study: {error!r}") from error


_HELD: Final = ("window", "made", "endings", "ending_rules", "lengths", "agents_learn")
"""Fields that JSON can hold as they are."""


def counted(made: Mapping[str, Circumstances]) -> dict[str, Counter[str]]:
    """Count the runs that have each value of each circumstance; of equally many the first run's is first."""
    names = dict.fromkeys(name for circumstances in made.values() for name in circumstances)
    return {name: Counter(run.get(name, UNKNOWN) for run in made.values()) for name in names}


def some(names: list[str], most: int) -> str:
    """Return the first names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"
