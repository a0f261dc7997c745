"""Building the table of a study: reading finished runs, and averaging their episodes in windows."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cprl.envs.unwrap import clock_in
from cprl.experiment import Experiment
from cprl.measuring.outcome import RULE, outcome_of
from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, INCOME_EQUALITY, INSTITUTIONS, METRICS, TOTALS
from cprl.measuring.table import (
    ROW_ORDER,
    WINDOWS,
    by_replica,
    complete,
    gain_metric,
    stored_metrics,
    where,
    world_of,
)
from cprl.measuring.windows import episodes_after, episodes_per_world
from cprl.population import any_learns, has_people
from cprl.runs.episodes import read_episodes, read_rows
from cprl.runs.files import REPORT, read_json
from cprl.runs.recipe import read_recipe, recipe_parts
from cprl.studies.status import Status
from cprl.studies.study import Study, level_text, unique_name
from cprl.studies.tables.tidy_table import (
    CIRCUMSTANCES,
    DAMAGED,
    EVALUATION_PART,
    RANDOM_PART,
    RUN_PARTS,
    TABLE_COLUMNS,
    TRAINING_PART,
    UNKNOWN,
    Circumstances,
    MissingRun,
    StudyDesign,
    StudyTable,
    count_circumstances,
)
from cprl.studies.trials import DirectoryState, trials_of
from cprl.system.defaults import WINDOW_EPISODES
from cprl.system.output import legible
from cprl.values import Positive, checked, is_number
from cprl.values.array_types import Int64

REASONS: Final[dict[DirectoryState, str]] = {
    "missing": "was not begun",
    "begun": "has not ended",
    "stopped": "has not ended",
    "finished": "is finished",
    "refused": "has another recipe than its name says, or none that can be read: was it renamed?",
}


class TooShortError(ValueError):
    """A replica has not finished a single episode in its training."""


@dataclass(frozen=True, kw_only=True)
class RunSource:
    """A run that belongs into a table: its condition, its replicas, and whether it is finished."""

    run: Path
    name: str
    """The name of the run in the table."""
    condition: str
    checksum: str
    """See `cprl.studies.study.Condition`."""
    first: int
    """The number, in the table, of the run's first replica."""
    experiment: Experiment
    reason: str = ""
    """The reason why the run is missing in the table; "" for a finished run."""


def study_table(
    study: Study, runs: Path | str, *, window: int = WINDOW_EPISODES, status: Path | None = None
) -> StudyTable:
    """Return the table of the finished runs of a study.

    Args:
        window: the number of episodes in a window of the training; with 1, rows of the evaluation are single
            episodes too.
        status: the folder in which trials write why they failed, see `cprl.studies.status`.
    """
    return table_of_sources(design_of(study), sources_of(study, Path(runs), status), window=window)


def design_of(study: Study) -> StudyDesign:
    """Return the design of a study, as its table stores it."""
    conditions: dict[str, dict[str, Any]] = {condition.name: {} for condition in study.all_conditions}
    for factor in study.factors:
        plain: dict[int, Any] = {}  # by the identity of a level, as levels that differ may have equal texts
        for condition in study.all_conditions:
            level = condition.levels[factor]
            if id(level) not in plain:
                text = plain_level(level)
                plain[id(level)] = unique_name(text, set(plain.values())) if isinstance(text, str) else text
            conditions[condition.name][factor] = plain[id(level)]
    return StudyDesign(
        name=study.name,
        conditions=conditions,
        reference=study.reference_name,
        is_paired=True,
        is_grid=study.draws is None,
        clocks=clocks_of({condition.name: [condition.experiment] for condition in study.all_conditions}),
        question=study.question,
        expectation=study.expectation,
    )


def clocks_of(experiments: Mapping[str, Iterable[Experiment]]) -> dict[str, int]:
    """Return the maximal number of steps of an episode, by condition, if all its games have one."""
    clocks = {}
    for name, members in experiments.items():
        turns = [clock_in(experiment.game) for experiment in members]
        if None not in turns:
            clocks[name] = max(filter(None, turns))
    return clocks


def sources_of(study: Study, runs: Path, status: Path | None = None) -> list[RunSource]:
    """Return the runs of a study, finished or not.

    Args:
        status: the folder in which trials write why they failed.
    """
    sources = []
    for trial in trials_of(study, runs):
        failure = None if status is None else Status(status, trial.name).failure()
        source = RunSource(
            run=trial.directory,
            name=trial.name,
            condition=trial.condition.name,
            checksum=trial.checksum,
            first=trial.block.first,
            experiment=trial.experiment,
            reason=reason_missing(trial.state(), failure),
        )
        sources.append(source)
    return sources


def reason_missing(state: DirectoryState, failure: str | None = None) -> str:
    """Return the reason why a run is missing in a table; "" for a finished run."""
    if state == "finished":
        return ""
    return REASONS[state] if failure is None else f"failed: {failure}"


def plain_level(value: Any) -> Any:
    """Return a level as a table stores it: numbers and bools unchanged, anything else as text."""
    return value if isinstance(value, bool | int | float) else level_text(value)


def table_of_sources(design: StudyDesign, sources: Sequence[RunSource], *, window: int) -> StudyTable:
    """Return the table of finished runs.

    Args:
        design: the conditions that are compared.
        sources: the runs. Those that are not finished, or damaged, are listed as missing.
    """
    checked("window", window, Positive)
    rows = [_SCHEMA.empty_table()]
    missing = []
    read: list[RunSource] = []
    endings: dict[str, list[str]] = {}
    steps: dict[str, list[int | None]] = {}
    provenance: dict[str, Circumstances] = {}
    for source in sources:
        reason = source.reason
        try:
            if not reason:
                tables = _tables_of(source)
                outcomes = _outcome_words(tables)
                provenance[source.name] = circumstances_of(source.run)
        except TooShortError as error:
            reason = f"is too short: {error}"
        except (ValueError, OSError, KeyError) as error:
            reason = f"{DAMAGED}: {error}"
        if reason:
            missing.append(MissingRun(source.name, source.condition, source.experiment.replicas, reason))
            continue
        read.append(source)
        rows += [_windows(table, source, part, window) for part, table in tables.items()]
        endings.setdefault(source.condition, []).extend(outcomes)
        steps.setdefault(source.condition, []).append(_steps_of(source.run))
    study_rows = _rows(design, pa.concat_tables(rows), differing_circumstances(provenance))
    return StudyTable(
        design=design,
        rows=study_rows,
        window=window,
        missing_runs=tuple(missing),
        provenance=provenance,
        endings={name: dict(Counter(sorted(ended)).most_common()) for name, ended in endings.items()},
        ending_rules=(RULE,) * bool(provenance),
        agents_learn=not read or any(any_learns(source.experiment.agents) for source in read),
        lengths=_lengths(study_rows, steps),
    )


def _lengths(rows: pa.Table, steps: Mapping[str, list[int | None]]) -> dict[str, dict[str, tuple[int, int]]]:
    """Return the smallest and the largest number of episodes and steps of a replica, by condition."""
    if not len(rows):
        return {}
    played = by_replica(where(rows, part=TRAINING_PART), rows["metric"][0].as_py(), ["condition"])
    lengths = {}
    for name, stated in steps.items():
        counts = [count for count in stated if count is not None]
        if counts:
            episodes = where(played, condition=name)["episodes"]
            least, most = pc.min_max(episodes).as_py().values()
            lengths[name] = {"episodes": (least, most), "steps": (min(counts), max(counts))}
    return lengths


def _tables_of(source: RunSource) -> dict[str, pa.Table]:
    """Read the episode tables of the parts of a run, sorted, with a row for each agent. What people played
    stands for their training and for their evaluation; nobody plays at random in its worlds."""
    tables = {}
    parts: dict[str, str | None] = dict(RUN_PARTS)
    if has_people(source.experiment.agents):
        parts = dict.fromkeys((TRAINING_PART, EVALUATION_PART))
    for part, name in parts.items():
        folder = source.run / "evaluation"
        table = read_episodes(source.run) if name is None else read_rows(folder / f"{name}.parquet")
        table = table.sort_by(ROW_ORDER)
        _refuse_gaps(table, source, part)
        tables[part] = complete(table)
    return tables


def _refuse_gaps(table: pa.Table, source: RunSource, part: str) -> None:
    """Refuse a sorted episode table that has an episode twice, or in which episodes are missing."""
    replica, episode, agent = (table[name].to_numpy() for name in ("replica", "episode", "agent"))
    begins = (np.diff(replica, prepend=-1) != 0) | (np.diff(episode, prepend=-1) != 0)
    for row in np.flatnonzero(~begins & (np.diff(agent, prepend=-1) == 0))[:1]:
        raise ValueError(
            f"{source.name} has episode {episode[row]} of replica {replica[row]} in {part} twice"
        )
    counts = Counter(replica[begins].tolist())
    replicas = list(range(source.experiment.replicas))
    expected = source.experiment.episodes
    if part != TRAINING_PART:
        expected = max(counts.values(), default=0)
    missing = [replica for replica in replicas if replica not in counts]
    if expected is None and missing:
        steps = _steps_of(source.run) or "its"
        raise TooShortError(f"replica {missing[0]} ended no episode in {steps} steps; train longer")
    # Where steps are counted, each replica ends a number of its own.
    is_whole = set(counts.values()) == {expected} or expected is None
    if list(counts) != replicas or not is_whole:
        raise ValueError(
            f"{source.name} has these episodes by replica in {part}: {dict(counts)}; allowed: {expected} of "
            f"each of {len(replicas)} replicas"
        )


def _steps_of(run: Path) -> int | None:
    """Return the trained steps that a run's report states; None if it does not state them."""
    try:
        steps = read_json(run / REPORT).get("steps")
    except (OSError, ValueError):  # which ends no table
        return None
    return steps if isinstance(steps, int) else None


def _outcome_words(tables: Mapping[str, pa.Table]) -> list[str]:
    """Return a word for the outcome of each replica's training, e.g. "tragedy"; none for people."""
    if RANDOM_PART not in tables:
        return []
    training = tables[TRAINING_PART]
    random = tables[RANDOM_PART]
    random_return = float(np.mean(where(random, agent=0)[gain_metric(random)].to_numpy()))
    replicas = sorted(training["replica"].unique().to_pylist())
    outcomes = [outcome_of(where(training, replica=replica), random=random_return) for replica in replicas]
    return [outcome.word for outcome in outcomes]


def _windows(table: pa.Table, source: RunSource, part: str, window: int) -> pa.Table:
    """Return a row for each window of a part of a run, for each metric and replica.

    A window of the training has a fixed number of consecutive episodes. With many worlds it has the same
    number of episodes of every world. Otherwise short episodes, which end sooner, would fill the windows.
    Worlds that have finished fewer episodes are missing in the first windows. Any other part is a single
    window, unless the window is 1.
    """
    rows = where(table, agent=0)
    replica = rows["replica"].to_numpy()
    size = window if part == TRAINING_PART or window == 1 else len(rows)
    world = world_of(rows)
    windows = [_window_indices(world[replica == number], size) for number in np.unique(replica)]
    place = np.concatenate(windows)
    group = replica * (place.max() + 1) + place
    order = np.argsort(group, kind="stable")
    begin = np.flatnonzero(np.diff(group[order], prepend=-1))
    lengths = np.diff(np.append(begin, len(order)))
    metrics = [name for name in stored_metrics(table.schema) if name not in TOTALS]
    numbers = {name: rows[name].to_numpy() for name in metrics}
    returns = table["return"].to_numpy().astype(np.float64).reshape(len(rows), -1)
    numbers |= {f"agent_{agent}/return": values for agent, values in enumerate(returns.T)}
    values = np.stack(list(numbers.values()))[:, order]
    defined = ~np.isnan(values)
    counts = np.add.reduceat(defined.astype(np.int64), begin, axis=1)
    with np.errstate(invalid="ignore"):
        means = np.add.reduceat(np.where(defined, values, 0.0), begin, axis=1) / counts
    labels = {"condition": source.condition, "checksum": source.checksum, "run": source.name, "part": part}
    columns = {
        **{name: [text] * means.size for name, text in labels.items()},
        "replica": np.tile(source.first + replica[begin], len(numbers)),
        "metric": np.repeat(list(numbers), len(begin)),
        "episode": np.tile(begin - np.searchsorted(replica, replica[begin]), len(numbers)),
        WINDOWS: np.tile(lengths, len(numbers)),
        "undefined": (lengths - counts).reshape(-1),
        "value": means.reshape(-1),
    }
    return pa.table({field.name: pa.array(columns[field.name], field.type) for field in _SCHEMA})


def _window_indices(world: Int64, window: int) -> Int64:
    """Return the index of the window of each episode of a replica, int64 [E].

    Args:
        world: the world of each episode, int64 [E].
    """
    lanes = len(np.unique(world))
    if lanes == 1 or window == 1:
        return np.arange(len(world)) // window
    after = episodes_after(world) // episodes_per_world(window, lanes)
    return np.asarray(after.max() - after)


_SCHEMA: Final = pa.schema([(name, dtype) for name, dtype in TABLE_COLUMNS.items() if name != "marks"])
"""The columns of the windows of a run."""


def _rows(design: StudyDesign, rows: pa.Table, marked: Mapping[str, str]) -> pa.Table:
    """Return the rows of a study's table: the windows of all runs, sorted, with the levels of conditions."""
    orders = {
        "condition": list(design.conditions),
        "part": list(RUN_PARTS),
        "metric": _metrics(rows["metric"].unique().to_pylist()),
    }
    rows = rows.combine_chunks()
    for name, order in orders.items():
        rows = rows.append_column(f"#{name}", pc.index_in(rows[name], pa.array(order, pa.string())))
    rows = rows.filter(pc.is_valid(rows["#metric"]))
    keys = ("#condition", "replica", "#part", "#metric", "episode")
    rows = rows.sort_by([(name, "ascending") for name in keys])
    places = pc.index_in(rows["run"], pa.array(list(marked), pa.string()))
    marks = pa.array(list(marked.values()), pa.string()).take(places)
    table = rows.append_column("marks", marks).select(list(TABLE_COLUMNS))
    for position, factor in enumerate(design.factors, start=2):  # after the condition and its checksum
        column = f"factor {factor}" if factor in TABLE_COLUMNS else factor
        table = table.add_column(position, column, _levels(design.levels(factor)).take(rows["#condition"]))
    return table


def _metrics(names: Sequence[str]) -> list[str]:
    """Return metrics in the order of tables: registered metrics, returns of single agents, then others.

    Income is left out if no money moves, because it then equals the harvest.
    """
    moves_money = INCOME_EQUALITY in names or any(name.startswith(INSTITUTIONS) for name in names)
    if COLLECTIVE_RETURN in names and not moves_money:
        names = [name for name in names if name != INCOME]
    order = {name: place for place, name in enumerate(METRICS)}
    return sorted(
        names,
        key=lambda name: (order.get(name, len(order)), not name.startswith("agent_"), len(name), name),
    )


def _levels(levels: Sequence[Any]) -> pa.Array:
    """Return the levels of all conditions as a column of numbers, of bools, or else of texts."""
    if all(isinstance(level, bool) for level in levels):
        return pa.array(levels, pa.bool_())
    if all(map(is_number, levels)):
        is_whole = all(isinstance(level, int) and abs(level) < 2**63 for level in levels)
        kind = pa.int64() if is_whole else pa.float64()
        return pa.array(levels, kind)
    return pa.array(list(map(str, levels)), pa.string())


def circumstances_of(run: Path) -> Circumstances:
    """Return how a run was made, from its recipe."""
    each = [_circumstances(part) for part in recipe_parts(read_recipe(run))]
    joined = {}
    for name in dict.fromkeys(chain.from_iterable(each)):
        in_order = groupby(part.get(name, UNKNOWN) for part in each)
        joined[name] = " then ".join(value for value, _ in in_order)
    return joined


def _circumstances(recipe: Mapping[str, Any]) -> dict[str, str]:
    """Return versions, user's code, git commit and processor from one part of a recipe.

    A run that was resumed has a part for each time.
    """
    versions = recipe.get("versions") or {}
    circumstances = {name: str(version) for name, version in versions.items() if version is not None}
    circumstances |= {module: str(digest)[:12] for module, digest in (recipe.get("code") or {}).items()}
    git = recipe.get("git")
    if isinstance(git, Mapping):
        circumstances["git"] = f"{str(git.get('commit'))[:12]}{' with changes' if git.get('dirty') else ''}"
    if recipe.get("cpu"):
        circumstances["cpu"] = str(recipe["cpu"])
    return {legible(name): legible(value) for name, value in circumstances.items()}


def differing_circumstances(provenance: Mapping[str, Circumstances]) -> dict[str, str]:
    """Return, for each run, the circumstances in which it differs from most runs, e.g. "torch, git commit".

    Args:
        provenance: the circumstances by run, in the order of the table.
    """
    usual = {name: counts.most_common(1)[0][0] for name, counts in count_circumstances(provenance).items()}
    marked = {}
    for run, circumstances in provenance.items():
        names = [name for name in usual if circumstances.get(name, UNKNOWN) != usual[name]]
        marked[run] = ", ".join(CIRCUMSTANCES.get(name, name) for name in names)
    return marked
