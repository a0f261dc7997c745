"""StudyTable: what came out of the runs of a study, as one tidy table.

Columns:
    condition        its name
    checksum         of the condition, see `cprl.studies.study`
    (each factor)    its level: numbers where all levels are, else texts
    run              the directory of the run
    marks            what of its versions, git commit and processor differs from most runs'; "" if nothing
    replica          its number in the study, int32
    part             "training", "evaluation" or "random", random play in the worlds of the evaluation
    metric           its name, as in docs/metrics.md, without "social/"; "net" is the return of all agents
    episode          the first episode of the window, int32
    window_episodes  episodes of the window, int32
    undefined        episodes of the window in which the metric is undefined, int32
    value            the mean over its other episodes, float64; NaN where there are none

Rows are sorted by condition, replica, part, metric and episode, so that the same runs give the same table.
A factor with the name of another column is called "factor NAME".
"""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cprl.arguments import WINDOW as WINDOW
from cprl.arguments import integer
from cprl.runs.episodes import write_table
from cprl.runs.files import STUDY_TABLE_FORMAT, refuse_newer
from cprl.runs.recipe import read_recipe, versions
from cprl.studies.study import Study
from cprl.studies.tables.sources import (
    Design,
    Lacking,
    Source,
    Windows,
    design_of,
    rows_of,
    sources_of,
    windows_of,
)

METADATA: Final = b"cprl"
"""The key of the metadata: the study, its conditions, how the runs were made, and what is lacking."""


Circumstances = Mapping[str, str]
"""The version of each package, the checksum of each module of the user's own, the git commit and the type of
processor, by name. Where a run was resumed under others, all of them in order, with " then " between them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyTable:
    """The results of a study; see the module for the columns of `rows`."""

    design: Design
    rows: pa.Table = field(repr=False)
    window: int
    lacking: tuple[Lacking, ...]
    """The runs that are no part of it: not finished, failed or damaged."""
    made: Mapping[str, Circumstances] = field(repr=False)
    """Versions, git commit and processor of each run in it."""

    @cached_property
    def mixed(self) -> list[str]:
        """How its runs were made in different circumstances, in sentences; [] if in the same."""
        return sentences(self.made)

    @cached_property
    def metrics(self) -> tuple[str, ...]:
        """The metrics in it, in order."""
        return tuple(self.rows["metric"].unique().to_pylist()) if len(self.rows) else ()

    @cached_property
    def replicas(self) -> Mapping[str, int]:
        """How many replicas of each condition are in it."""
        pairs = self.rows.select(["condition", "replica"]).group_by(["condition", "replica"]).aggregate([])
        found = pairs["condition"].to_pylist()
        return {name: found.count(name) for name in self.design.conditions}

    @cached_property
    def comparisons(self) -> dict[Any, Any]:
        """What `compare` in comparing.py has computed of it, so that figures and texts share it."""
        return {}

    def __str__(self) -> str:
        """What it holds, what it lacks and what is mixed, in sentences."""
        return "\n".join([self.summary, *self.design.notes, *self.mixed, *map(str, self.lacking)])

    @property
    def summary(self) -> str:
        """What it holds, in a sentence."""
        lacking = len(self.lacking)
        without = f"; {lacking} run{'s are' if lacking != 1 else ' is'} not in it" if lacking else ""
        return (
            f"{self.design.name}: {sum(self.replicas.values())} replicas of "
            f"{sum(map(bool, self.replicas.values()))} of {len(self.design.conditions)} conditions, "
            f"{len(self.rows):,} rows{without}."
        )

    def to_pandas(self) -> Any:
        """The rows as a `pandas.DataFrame`; raises an ImportError where pandas is not installed."""
        if find_spec("pandas") is None:
            raise ImportError("to_pandas needs pandas, which is not installed; run: pip install pandas")
        return self.rows.to_pandas()

    def values(self, condition: str, metric: str, part: str) -> dict[str, NDArray[Any]] | None:
        """The rows of a condition in one part as arrays for R replicas and W windows.

        Returns:
            "replica", [R]; "episode" and "window_episodes", [W]; "undefined" and "value", [R, W]. None if
            there are none. Of windows that not every replica has, only those that all have.
        """
        rows = self._parts.get((condition, part, metric))
        if rows is None:
            return None
        replica, episode = rows["replica"], rows["episode"]
        replicas, place = np.unique(replica, return_inverse=True)
        episodes, times = np.unique(episode, return_counts=True)
        episodes = episodes[times == len(replicas)]
        kept = np.isin(episode, episodes)
        at = place[kept], np.searchsorted(episodes, episode[kept])
        found: dict[str, NDArray[Any]] = {"replica": replicas, "episode": episodes}
        for name in ("undefined", "value", "window_episodes"):
            found[name] = np.zeros((len(replicas), len(episodes)), rows[name].dtype)
            found[name][at] = rows[name][kept]
        found["window_episodes"] = found["window_episodes"][0]
        return found

    @cached_property
    def _parts(self) -> dict[tuple[str, str, str], dict[str, NDArray[Any]]]:
        """The rows by condition, part and metric."""
        keys = [
            self.rows[name].combine_chunks().dictionary_encode() for name in ("condition", "part", "metric")
        ]
        codes = np.stack([own.indices.to_numpy(zero_copy_only=False) for own in keys], axis=1)
        names = [own.dictionary.to_pylist() for own in keys]
        numbers = {
            name: self.rows[name].to_numpy()
            for name in ("replica", "episode", "window_episodes", "undefined", "value")
        }
        each, group = np.unique(codes, axis=0, return_inverse=True)
        order = np.argsort(group.reshape(-1), kind="stable")
        cuts = np.searchsorted(group.reshape(-1)[order], np.arange(1, len(each)))
        return {
            (names[0][at[0]], names[1][at[1]], names[2][at[2]]): {
                name: own[which] for name, own in numbers.items()
            }
            for at, which in zip(each.tolist(), np.split(order, cuts), strict=True)
        }

    def write(self, path: Path | str) -> Path:
        """Writes a parquet file atomically, which `read` gives back; replaces an older one."""
        path = Path(path)
        write_table(path, self.rows, over=True)
        return path

    @classmethod
    def read(cls, path: Path | str) -> "StudyTable":
        """The table of a file that `write` wrote; raises a ValueError for any other."""
        path = Path(path)
        try:
            rows = pq.read_table(path)
            held = json.loads((rows.schema.metadata or {})[METADATA])
        except (pa.ArrowException, OSError, KeyError, ValueError) as error:
            raise ValueError(f"{path} is not the table of a study: {error!r}") from error
        refuse_newer(path, held, STUDY_TABLE_FORMAT)
        if held.get("format") != STUDY_TABLE_FORMAT:
            raise ValueError(f"{path} has the format {held.get('format')}; allowed: {STUDY_TABLE_FORMAT}")
        design = held["design"]
        return cls(
            design=Design(
                **{**design, "conditions": dict(design["conditions"]), "notes": tuple(design["notes"])}
            ),
            rows=rows,
            window=held["window"],
            lacking=tuple(Lacking(**own) for own in held["lacking"]),
            made=held["made"],
        )


def study_table(
    study: Study, runs: Path | str, *, window: int = WINDOW, status: Path | str | None = None
) -> StudyTable:
    """The table of the finished runs of a study.

    Args:
        window: episodes of a window of training; 1 for episodes one by one, of the evaluation too.
        status: where its trials say why they failed, see `cprl.studies.trials`.
    """
    folder = Path(runs)
    finished, lacking = sources_of(study, folder, None if status is None else Path(status))
    return table_of(design_of(study), finished, lacking, window=window)


def table_of(
    design: Design, sources: list[Source], lacking: list[Lacking], *, window: int = WINDOW
) -> StudyTable:
    """The table of finished runs.

    Args:
        design: the conditions that are compared.
        sources: the runs; what is damaged of them is listed as lacking.
        lacking: other runs, which are listed.
    """
    integer("window", window, 1)
    found: list[tuple[Source, list[Windows]]] = []
    made: dict[str, Circumstances] = {}
    out = list(lacking)
    for source in sources:
        try:
            found.append((source, list(windows_of(source, window))))
            made[source.name] = circumstances_of(source.run)
        except (ValueError, OSError, KeyError) as error:
            found = [own for own in found if own[0] is not source]
            reason = f"is damaged: {error}"
            out.append(Lacking(source.name, source.condition, source.replicas, reason))
    rows = rows_of(design, found, marks(made))
    held = {
        "format": STUDY_TABLE_FORMAT,
        "design": {**asdict(design), "conditions": [[*pair] for pair in design.conditions.items()]},
        "window": window,
        "versions": versions(),
        "lacking": [vars(own) for own in out],
        "made": made,
        "mixed": sentences(made),
    }
    rows = rows.replace_schema_metadata({METADATA: json.dumps(held, sort_keys=False)})
    return StudyTable(design=design, rows=rows, window=window, lacking=tuple(out), made=made)


UNKNOWN: Final = "not recorded"
WORDS: Final = {"git": "git commit", "cpu": "processor"}
_NAMED: Final = 4
"""The largest number of runs that a sentence names."""


def circumstances_of(run: Path) -> Circumstances:
    """What the recipe of a run says of how it was made."""
    recipe = read_recipe(run)
    every = [_of(recipe), *(_of(own) for own in (*recipe.get("extended", ()), *recipe.get("resumed", ())))]
    names = dict.fromkeys(name for own in every for name in own)
    return {name: _joined([own.get(name, UNKNOWN) for own in every]) for name in names}


def marks(made: Mapping[str, Circumstances]) -> dict[str, str]:
    """What of each run's circumstances differs from those of most runs, e.g. "torch, git commit", or "".

    Of circumstances that equally many runs have, the first run's count as those of most.

    Args:
        made: the circumstances by run, in the order of the table.
    """
    usual = {name: _counted(made, name).most_common(1)[0][0] for name in _names(made)}
    return {
        run: ", ".join(
            WORDS.get(name, name) for name, value in usual.items() if own.get(name, UNKNOWN) != value
        )
        for run, own in made.items()
    }


def sentences(made: Mapping[str, Circumstances]) -> list[str]:
    """How the runs of a table were made in different circumstances, a sentence for each."""
    found = []
    for name in _names(made):
        counted = _counted(made, name)
        if len(counted) == 1:
            continue
        parts = []
        for nth, (value, number) in enumerate(counted.most_common()):
            runs = [run for run, own in made.items() if own.get(name, UNKNOWN) == value]
            named = f" ({_some(runs)})" if nth else ""
            parts.append(f"{value} in {number} run{'s' * (number != 1)}{named}")
        found.append(
            f"The runs were made under more than one {WORDS.get(name, f'version of {name}')}: "
            f"{'; '.join(parts)}."
        )
    return found


def _of(recipe: Mapping[str, Any]) -> dict[str, str]:
    found = {name: str(own) for name, own in (recipe.get("versions") or {}).items() if own is not None}
    found |= {module: str(digest)[:12] for module, digest in (recipe.get("code") or {}).items()}
    git = recipe.get("git")
    if isinstance(git, Mapping):
        found["git"] = f"{str(git.get('commit'))[:12]}{' with changes' if git.get('dirty') else ''}"
    if recipe.get("cpu"):
        found["cpu"] = str(recipe["cpu"])
    return found


def _joined(values: list[str]) -> str:
    """Values in order, without one that follows itself."""
    return " then ".join(own for nth, own in enumerate(values) if not nth or own != values[nth - 1])


def _names(made: Mapping[str, Circumstances]) -> list[str]:
    return list(dict.fromkeys(name for own in made.values() for name in own))


def _counted(made: Mapping[str, Circumstances], name: str) -> Counter[str]:
    return Counter(own.get(name, UNKNOWN) for own in made.values())


def _some(runs: list[str]) -> str:
    more = f" and {len(runs) - _NAMED} more" if len(runs) > _NAMED else ""
    return f"{', '.join(runs[:_NAMED])}{more}"
