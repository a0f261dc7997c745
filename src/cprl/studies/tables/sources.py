"""The table of finished runs: which runs it is made of, their episodes as rows, and how replicas end."""

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
from cprl.measuring.table import WINDOWS, by_replica, complete, metrics_in, where, world_of
from cprl.measuring.windows import episodes_after, rounds_of
from cprl.population import any_learns
from cprl.runs.episodes import read_episodes, read_rows
from cprl.runs.files import REPORT, read_json
from cprl.runs.recipe import parts_of, read_recipe
from cprl.studies.status import Status
from cprl.studies.study import Study, level_text, unlike
from cprl.studies.tables.table import (
    COLUMNS,
    DAMAGED,
    PARTS,
    RANDOM,
    TRAINING,
    UNKNOWN,
    WINDOW,
    WORDS,
    Circumstances,
    Design,
    Lacking,
    StudyTable,
    counted,
)
from cprl.studies.trials import DirectoryState, trials_of
from cprl.system.output import legible
from cprl.values import Positive, checked
from cprl.values.arrays import Int64

REASONS: Final[dict[DirectoryState, str]] = {
    "missing": "was not begun",
    "begun": "has not ended",
    "stopped": "has not ended",
    "finished": "is finished",
    "refused": "has another recipe than its name says, or none that can be read: was it renamed?",
}


class TooShortError(ValueError):
    """A replica has ended no episode in the steps that it trained."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A run, and which replicas of which condition it holds."""

    run: Path
    name: str
    """What the run is called in the table."""
    condition: str
    checksum: str
    """See `cprl.studies.study.Condition`."""
    first: int
    """The number of its first replica in the table."""
    experiment: Experiment
    reason: str = ""
    """Why it is no part of the table; "" of a finished run."""


def study_table(
    study: Study, runs: Path | str, *, window: int = WINDOW, status: Path | None = None
) -> StudyTable:
    """Return the table of the finished runs of a study.

    Args:
        window: episodes of a window of training; 1 for episodes one by one, of the evaluation too.
        status: where its trials say why they failed, see `cprl.studies.trials`.
    """
    return table_of(design_of(study), sources_of(study, Path(runs), status), window=window)


def design_of(study: Study) -> Design:
    conditions: dict[str, dict[str, Any]] = {condition.name: {} for condition in study.all_conditions}
    for factor in study.factors:
        plain: dict[int, Any] = {}  # by the identity of a level, as levels that differ may have equal texts
        for condition in study.all_conditions:
            level = condition.levels[factor]
            if id(level) not in plain:
                text = plain_level(level)
                plain[id(level)] = unlike(text, set(plain.values())) if isinstance(text, str) else text
            conditions[condition.name][factor] = plain[id(level)]
    return Design(
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
    """Return the turns of an episode at most, by condition, where all its games say so."""
    clocks = {name: [clock_in(one.game) for one in of_one] for name, of_one in experiments.items()}
    return {name: max(filter(None, each)) for name, each in clocks.items() if None not in each}


def sources_of(study: Study, runs: Path, status: Path | None = None) -> list[Source]:
    """Return the runs of a study; `status` is where its trials say why they failed."""
    sources = []
    for trial in trials_of(study, runs):
        failure = None if status is None else Status(status, trial.name).failure()
        source = Source(
            run=runs / trial.name,
            name=trial.name,
            condition=trial.condition.name,
            checksum=trial.checksum,
            first=trial.block.first,
            experiment=trial.experiment,
            reason=reason_of(trial.state(runs), failure),
        )
        sources.append(source)
    return sources


def reason_of(state: DirectoryState, failure: str | None = None) -> str:
    """Return why a run is no part of a table; "" of a finished one."""
    if state == "finished":
        return ""
    return REASONS[state] if failure is None else f"failed: {failure}"


def plain_level(value: Any) -> Any:
    """Return a level as a table holds it: a number or truth value as it is, else a text."""
    return value if isinstance(value, bool | int | float) else level_text(value)


def table_of(design: Design, sources: Sequence[Source], *, window: int = WINDOW) -> StudyTable:
    """Return the table of finished runs.

    Args:
        design: the conditions that are compared.
        sources: the runs; what is not finished, or damaged, is listed as lacking.
    """
    checked("window", window, Positive)
    rows = [_SCHEMA.empty_table()]
    lacking = []
    read: list[Source] = []
    endings: dict[str, list[str]] = {}
    steps: dict[str, list[int]] = {}
    made: dict[str, Circumstances] = {}
    for source in sources:
        reason = source.reason
        try:
            if not reason:
                tables = _tables_of(source)
                words = _endings(tables)
                made[source.name] = circumstances_of(source.run)
        except TooShortError as error:
            reason = f"is too short: {error}"
        except (ValueError, OSError, KeyError) as error:
            reason = f"{DAMAGED}: {error}"
        if reason:
            lacking.append(Lacking(source.name, source.condition, source.experiment.replicas, reason))
            continue
        read.append(source)
        rows += [_windows(table, source, part, window) for part, table in tables.items()]
        endings.setdefault(source.condition, []).extend(words)
        steps.setdefault(source.condition, []).extend(_steps_of(source.run))
    study_rows = _rows(design, pa.concat_tables(rows), marks(made))
    return StudyTable(
        design=design,
        rows=study_rows,
        window=window,
        lacking=tuple(lacking),
        made=made,
        endings={name: dict(Counter(sorted(words)).most_common()) for name, words in endings.items()},
        ending_rules=(RULE,) * bool(made),
        agents_learn=not read or any(any_learns(source.experiment.agents) for source in read),
        lengths=_lengths(study_rows, steps),
    )


def _lengths(rows: pa.Table, steps: Mapping[str, list[int]]) -> dict[str, dict[str, tuple[int, int]]]:
    """Return the least and the most episodes and steps of replicas, of conditions whose steps are known."""
    if not len(rows):
        return {}
    played = by_replica(where(rows, part=TRAINING), rows["metric"][0].as_py(), ["condition"])
    lengths = {}
    for name in (name for name, of_runs in steps.items() if of_runs):
        episodes = where(played, condition=name)["episodes"]
        least, most = pc.min_max(episodes).as_py().values()
        lengths[name] = {"episodes": (least, most), "steps": (min(steps[name]), max(steps[name]))}
    return lengths


def _tables_of(source: Source) -> dict[str, pa.Table]:
    """Read the episodes of each part of a run, sorted, a row for each agent of each."""
    tables = {}
    for part, name in PARTS.items():
        folder = source.run / "evaluation"
        table = read_episodes(source.run) if name is None else read_rows(folder / f"{name}.parquet")
        table = table.sort_by([(column, "ascending") for column in ("replica", "episode", "agent")])
        _refuse_gaps(table, source, part)
        tables[part] = complete(table)
    return tables


def _refuse_gaps(table: pa.Table, source: Source, part: str) -> None:
    """Refuse a sorted table that has an episode twice, or lacks some."""
    replica, episode, agent = (table[name].to_numpy() for name in ("replica", "episode", "agent"))
    begins = (np.diff(replica, prepend=-1) != 0) | (np.diff(episode, prepend=-1) != 0)
    for row in np.flatnonzero(~begins & (np.diff(agent, prepend=-1) == 0))[:1]:
        raise ValueError(
            f"{source.name} has episode {episode[row]} of replica {replica[row]} in {part} twice"
        )
    counts = Counter(replica[begins].tolist())
    replicas = list(range(source.experiment.replicas))
    wanted = source.experiment.episodes if part == TRAINING else max(counts.values(), default=0)
    if wanted is None and (missing := [replica for replica in replicas if replica not in counts]):
        steps = [*_steps_of(source.run), "its"][0]
        raise TooShortError(f"replica {missing[0]} ended no episode in {steps} steps; train longer")
    # Where steps are counted, each replica ends a number of its own.
    is_whole = set(counts.values()) == {wanted} or wanted is None
    if list(counts) != replicas or not is_whole:
        raise ValueError(
            f"{source.name} has these episodes by replica in {part}: {dict(counts)}; allowed: {wanted} of "
            f"each of {len(replicas)} replicas"
        )


def _steps_of(run: Path) -> list[int]:
    """Return how many steps the report of a run says that it trained; nothing where it does not say."""
    try:
        steps = read_json(run / REPORT).get("steps")
    except (OSError, ValueError):  # which ends no table
        return []
    return [steps] if isinstance(steps, int) else []


def _endings(tables: Mapping[str, pa.Table]) -> list[str]:
    """Return how the training of each replica went, in a word."""
    training = tables[TRAINING]
    random = tables[RANDOM]
    number = COLLECTIVE_RETURN if COLLECTIVE_RETURN in random.column_names else INCOME
    by_chance = float(np.mean(where(random, agent=0)[number].to_numpy()))
    replicas = sorted(training["replica"].unique().to_pylist())
    outcomes = [outcome_of(where(training, replica=replica), random=by_chance) for replica in replicas]
    return [outcome.word for outcome in outcomes]


def _windows(table: pa.Table, source: Source, part: str, window: int) -> pa.Table:
    """Return the windows of a part of a run, for each number and replica.

    In training, windows are of so many consecutive episodes; in many worlds of as many of each, so that
    none has more of the short episodes, which end sooner, and the first ones may lack worlds that have ended
    fewer.
    Another part is one window, but where episodes stand one by one.
    """
    one = where(table, agent=0)
    replica = one["replica"].to_numpy()
    size = window if part == TRAINING or window == 1 else len(one)
    world = world_of(one)
    places = [_places(world[replica == number], size) for number in np.unique(replica)]
    place = np.concatenate(places)
    group = replica * (place.max() + 1) + place
    order = np.argsort(group, kind="stable")
    begin = np.flatnonzero(np.diff(group[order], prepend=-1))
    lengths = np.diff(np.append(begin, len(order)))
    metrics = [name for name in metrics_in(table.schema) if name not in TOTALS]
    numbers = {name: one[name].to_numpy() for name in metrics}
    returns = table["return"].to_numpy().astype(np.float64).reshape(len(one), -1)
    numbers |= {f"agent_{agent}/return": of_agent for agent, of_agent in enumerate(returns.T)}
    values = np.stack(list(numbers.values()))[:, order]
    defined = ~np.isnan(values)
    counts = np.add.reduceat(defined.astype(np.int64), begin, axis=1)
    with np.errstate(invalid="ignore"):
        means = np.add.reduceat(np.where(defined, values, 0.0), begin, axis=1) / counts
    columns = {
        **{name: [text] * means.size for name, text in _labels_of(source, part).items()},
        "replica": np.tile(source.first + replica[begin], len(numbers)),
        "metric": np.repeat(list(numbers), len(begin)),
        "episode": np.tile(begin - np.searchsorted(replica, replica[begin]), len(numbers)),
        WINDOWS: np.tile(lengths, len(numbers)),
        "undefined": (lengths - counts).reshape(-1),
        "value": means.reshape(-1),
    }
    return pa.table({field.name: pa.array(columns[field.name], field.type) for field in _SCHEMA})


def _labels_of(source: Source, part: str) -> dict[str, str]:
    return {"condition": source.condition, "checksum": source.checksum, "run": source.name, "part": part}


def _places(world: Int64, window: int) -> Int64:
    """Return the number of the window of each episode of a replica, [E]."""
    lanes = len(np.unique(world))
    if lanes == 1 or window == 1:
        return np.arange(len(world)) // window
    after = episodes_after(world) // rounds_of(window, lanes)
    return np.asarray(after.max() - after)


_SCHEMA: Final = pa.schema(
    [
        *((name, pa.string()) for name in ("condition", "checksum", "run", "part", "metric")),
        *((name, pa.int32()) for name in ("replica", "episode", WINDOWS, "undefined")),
        ("value", pa.float64()),
    ]
)
"""Of the windows of a run."""


def _rows(design: Design, rows: pa.Table, marked: Mapping[str, str]) -> pa.Table:
    """Return the windows of all runs, sorted, with the levels of their conditions."""
    orders = {
        "condition": list(design.conditions),
        "part": list(PARTS),
        "metric": _metrics(rows["metric"].unique().to_pylist()),
    }
    rows = rows.combine_chunks()
    for name, order in orders.items():
        rows = rows.append_column(f"#{name}", pc.index_in(rows[name], pa.array(order, pa.string())))
    rows = rows.filter(pc.is_valid(rows["#metric"]))
    keys = ("#condition", "replica", "#part", "#metric", "episode")
    rows = rows.sort_by([(name, "ascending") for name in keys])
    columns = {name: rows[name] for name in COLUMNS if name != "marks"}
    for factor in design.factors:
        column = f"factor {factor}" if factor in COLUMNS else factor
        columns[column] = _levels(design.levels(factor)).take(rows["#condition"])
    places = pc.index_in(rows["run"], pa.array(list(marked), pa.string()))
    columns["marks"] = pa.array(list(marked.values()), pa.string()).take(places)
    names = list(columns)
    factors = names[len(COLUMNS) - 1 : -1]
    return pa.table(columns).select([*COLUMNS[:2], *factors, *COLUMNS[2:]])


def _metrics(names: Sequence[str]) -> list[str]:
    """Return metrics in the order of tables: those of the registry, returns of single agents, and others.

    The income is among them where it is not the harvest.
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
    """Return the levels of all conditions as a column: numbers, truth values, or else texts."""
    if all(isinstance(level, bool) for level in levels):
        return pa.array(levels, pa.bool_())
    if all(isinstance(level, int | float) and not isinstance(level, bool) for level in levels):
        is_whole = all(isinstance(level, int) and abs(level) < 2**63 for level in levels)
        return pa.array(levels, pa.int64() if is_whole else pa.float64())
    return pa.array(list(map(str, levels)), pa.string())


def circumstances_of(run: Path) -> Circumstances:
    """Return what the recipe of a run says of how it was made."""
    each = [_circumstances(part) for part in parts_of(read_recipe(run))]
    joined = {}
    for name in dict.fromkeys(chain.from_iterable(each)):
        in_order = groupby(made.get(name, UNKNOWN) for made in each)
        joined[name] = " then ".join(value for value, _ in in_order)
    return joined


def _circumstances(recipe: Mapping[str, Any]) -> dict[str, str]:
    versions = recipe.get("versions") or {}
    made = {name: str(version) for name, version in versions.items() if version is not None}
    made |= {module: str(digest)[:12] for module, digest in (recipe.get("code") or {}).items()}
    git = recipe.get("git")
    if isinstance(git, Mapping):
        made["git"] = f"{str(git.get('commit'))[:12]}{' with changes' if git.get('dirty') else ''}"
    if recipe.get("cpu"):
        made["cpu"] = str(recipe["cpu"])
    return {legible(name): legible(value) for name, value in made.items()}


def marks(made: Mapping[str, Circumstances]) -> dict[str, str]:
    """Return what of each run's circumstances differs from those of most runs, e.g. "torch, git commit", or
    "".

    Args:
        made: the circumstances by run, in the order of the table.
    """
    usual = {name: counts.most_common(1)[0][0] for name, counts in counted(made).items()}
    marked = {}
    for run, circumstances in made.items():
        names = [name for name in usual if circumstances.get(name, UNKNOWN) != usual[name]]
        marked[run] = ", ".join(WORDS.get(name, name) for name in names)
    return marked
