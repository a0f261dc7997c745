"""The table of finished runs: which runs it is made of, their episodes as rows, and how replicas end."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cprl.envs.unwrap import clock_in
from cprl.experiment import Experiment
from cprl.measuring.outcome import RULE, outcome_of
from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, INCOME_EQUALITY, METRICS
from cprl.measuring.table import WINDOWS, Numbers, complete, labelled, metrics_in, where, world_of
from cprl.measuring.windows import Values, episodes_after, rounds_of
from cprl.population import any_learns
from cprl.runs.checkpoints import REPORT
from cprl.runs.episodes import read_episodes, read_rows
from cprl.runs.files import read_json
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
from cprl.studies.trials import State, trials_of
from cprl.system.output import legible
from cprl.values import Positive, checked

REASONS: Final[dict[State, str]] = {
    "missing": "was not begun",
    "unfinished": "has not ended",
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
    replicas: int
    episodes: int | None
    """That each replica trains; None where it trains so many steps."""
    agents_learn: bool = True
    """Whether any of its agents does."""


def study_table(
    study: Study, runs: Path | str, *, window: int = WINDOW, status: Path | None = None
) -> StudyTable:
    """The table of the finished runs of a study.

    Args:
        window: episodes of a window of training; 1 for episodes one by one, of the evaluation too.
        status: where its trials say why they failed, see `cprl.studies.trials`.
    """
    finished, lacking = sources_of(study, Path(runs), status)
    return table_of(design_of(study), finished, lacking, window=window)


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


def sources_of(study: Study, runs: Path, status: Path | None = None) -> tuple[list[Source], list[Lacking]]:
    """The finished runs of a study, and the others; `status` is where its trials say why they failed."""
    finished, lacking = [], []
    for trial in trials_of(study, runs):
        state, condition, block = trial.state(runs), trial.condition, trial.block
        if state != "finished":
            failure = None if status is None else Status(status, trial.name).failure()
            reason = REASONS[state] if failure is None else f"failed: {failure}"
            lacking.append(Lacking(trial.name, condition.name, block.replicas, reason))
            continue
        source = Source(
            run=runs / trial.name,
            name=trial.name,
            condition=condition.name,
            checksum=trial.checksum,
            first=block.first,
            replicas=block.replicas,
            episodes=trial.experiment.episodes,
            agents_learn=any_learns(trial.experiment.agents),
        )
        finished.append(source)
    return finished, lacking


def plain_level(value: Any) -> Any:
    """A level as a table holds it: a number or truth value as it is, else a text."""
    return value if isinstance(value, bool | int | float) else level_text(value)


def table_of(
    design: Design, sources: Sequence[Source], lacking: Sequence[Lacking], *, window: int = WINDOW
) -> StudyTable:
    """The table of finished runs.

    Args:
        design: the conditions that are compared.
        sources: the runs; what is damaged of them is listed as lacking.
        lacking: other runs, which are listed.
    """
    checked("window", window, Positive)
    rows = []
    damaged = []
    made: dict[str, Circumstances] = {}
    endings: dict[str, Counter[str]] = {}
    lengths: dict[str, dict[str, list[int]]] = {}
    for source in sources:
        try:
            tables = _tables_of(source)
            ended = _endings(tables)
            made_by = circumstances_of(source.run)
            of_run = [_windows(table, source, part, window) for part, table in tables.items()]
        except (ValueError, OSError, KeyError) as error:
            begins = "is too short" if isinstance(error, TooShortError) else DAMAGED
            damaged.append(Lacking(source.name, source.condition, source.replicas, f"{begins}: {error}"))
            continue
        rows += of_run
        made[source.name] = made_by
        endings.setdefault(source.condition, Counter()).update(sorted(ended))
        counted_in = lengths.setdefault(source.condition, {"episodes": [], "steps": []})
        counted_in["episodes"] += _counts(tables[TRAINING])
        steps = _steps_of(source.run)
        counted_in["steps"] += [] if steps is None else [steps]
    learn = [source.agents_learn for source in sources if source.name in made]
    return StudyTable(
        design=design,
        rows=_rows(design, rows, marks(made)),
        window=window,
        lacking=(*lacking, *damaged),
        made=made,
        endings={name: dict(Counter(dict(sorted(of.items()))).most_common()) for name, of in endings.items()},
        ending_rules=(RULE,) * bool(made),
        agents_learn=any(learn) or not learn,
        lengths={
            name: {unit: (min(each), max(each)) for unit, each in of.items()}
            for name, of in lengths.items()
            if of["steps"]
        },
    )


def _tables_of(source: Source) -> dict[str, pa.Table]:
    """Read the episodes of each part of a run, sorted, a row for each agent of each."""
    tables = {}
    for part, name in PARTS.items():
        folder = source.run / "evaluation"
        table = read_episodes(source.run) if name is None else read_rows(folder / f"{name}.parquet")
        _refuse_gaps(table, source, part)
        order = [(column, "ascending") for column in ("replica", "episode", "agent")]
        tables[part] = complete(table.sort_by(order))
    return tables


def _counts(table: pa.Table) -> list[int]:
    """Return how many episodes each replica has ended."""
    return pc.value_counts(where(table, agent=0)["replica"]).field("counts").to_pylist()


def in_windows(table: pa.Table, window: int | None) -> pa.Table:
    """Return the rows of windows of consecutive episodes, for each number and replica.

    In many worlds a window has as many consecutive episodes of each, so that none has more of the short
    episodes, which end sooner. The last window is whole, the first ones may lack worlds that have ended
    fewer.

    Args:
        table: of episodes, sorted by replica, episode and agent.
        window: of so many episodes; None for one window of all.
    """
    one = where(table, agent=0)
    replica = one["replica"].to_numpy()
    world = world_of(one)
    order = []
    firsts = []
    begins = []
    for start, size in zip(*np.unique(replica, return_index=True, return_counts=True)[1:], strict=True):
        place = _windows_of(world[start : start + size], size if window is None else window)
        in_order = np.argsort(place, kind="stable")
        order.append(start + in_order)
        firsts.append(np.flatnonzero(np.diff(place[in_order], prepend=-1)))
        begins.append(firsts[-1] + start)
    chosen = np.concatenate(order)
    begin = np.concatenate(begins)
    lengths = np.diff(np.append(begin, len(chosen)))
    numbers = _numbers_of(table, one)
    values = np.stack(list(numbers.values()))[:, chosen]
    defined = ~np.isnan(values)
    counts = np.add.reduceat(defined.astype(np.int64), begin, axis=1)
    with np.errstate(invalid="ignore"):
        means = np.add.reduceat(np.where(defined, values, 0.0), begin, axis=1) / counts
    columns = {
        "replica": np.tile(replica[begin], len(numbers)),
        "metric": np.repeat(list(numbers), len(begin)),
        "episode": np.tile(np.concatenate(firsts), len(numbers)),
        WINDOWS: np.tile(lengths, len(numbers)),
        "undefined": (lengths - counts).reshape(-1),
        "value": means.reshape(-1),
    }
    return pa.table({name: pa.array(column, _SCHEMA.field(name).type) for name, column in columns.items()})


def _windows_of(world: Numbers, window: int) -> Numbers:
    """Return the number of the window of each episode of a replica, [E]."""
    lanes = len(np.unique(world))
    if lanes == 1 or window == 1:
        return np.arange(len(world)) // window
    after = episodes_after(world) // rounds_of(window, lanes)
    return np.asarray(after.max() - after)


def _numbers_of(table: pa.Table, one: pa.Table) -> dict[str, Values]:
    """Return the numbers of each episode, [E], with the return of each agent."""
    numbers = {name: one[name].to_numpy() for name in metrics_in(table.schema)}
    returns = table["return"].to_numpy().astype(np.float64).reshape(len(one), -1)
    return numbers | {f"agent_{agent}/return": of_agent for agent, of_agent in enumerate(returns.T)}


def _refuse_gaps(table: pa.Table, source: Source, part: str) -> None:
    rows = np.stack([table[name].to_numpy() for name in ("replica", "episode", "agent")], axis=1)
    each, times = np.unique(rows, axis=0, return_counts=True)
    if (times > 1).any():
        replica, episode, _ = each[times > 1][0].tolist()
        raise ValueError(f"{source.name} has episode {episode} of replica {replica} in {part} twice")
    played = np.unique(rows[:, :2], axis=0)
    replicas, counts = np.unique(played[:, 0], return_counts=True)
    wanted = source.episodes if part == TRAINING else counts.max(initial=0)
    if wanted is None:  # of so many steps, in which each replica ends a number of its own
        wanted = counts
        if lacking := sorted(set(range(source.replicas)) - set(replicas.tolist())):
            steps = _steps_of(source.run) or "its"
            raise TooShortError(f"replica {lacking[0]} ended no episode in {steps} steps; train longer")
    is_whole = np.all(counts == wanted) and np.all(counts > 0)
    if replicas.tolist() != list(range(source.replicas)) or not is_whole:
        raise ValueError(
            f"{source.name} has these episodes by replica in {part}: "
            f"{dict(zip(replicas.tolist(), counts.tolist(), strict=True))}; allowed: {wanted} of each of "
            f"{source.replicas} replicas"
        )


def _steps_of(run: Path) -> int | None:
    try:
        steps = read_json(run / REPORT).get("steps")
    except (OSError, ValueError):  # which ends no table
        return None
    return steps if isinstance(steps, int) else None


def _windows(table: pa.Table, source: Source, part: str, window: int) -> pa.Table:
    """Return the windows of a part of a run, with what the study's table says of the run."""
    is_whole = part != TRAINING and window > 1
    rows = in_windows(table, None if is_whole else window)
    labels = {"condition": source.condition, "checksum": source.checksum, "run": source.name, "part": part}
    replica = pc.cast(pc.add(rows["replica"], source.first), pa.int32())
    rows = rows.set_column(rows.column_names.index("replica"), "replica", replica)
    return labelled(rows, **labels).cast(_SCHEMA)


_SCHEMA: Final = pa.schema(
    [
        *((name, pa.string()) for name in ("condition", "checksum", "run", "part")),
        *(("replica", pa.int32()), ("metric", pa.string()), ("episode", pa.int32())),
        *((WINDOWS, pa.int32()), ("undefined", pa.int32()), ("value", pa.float64())),
    ]
)
"""Of the windows of a run."""


def _rows(design: Design, parts: Sequence[pa.Table], marked: Mapping[str, str]) -> pa.Table:
    """Return the rows of all runs, sorted, with the levels of their conditions."""
    rows = pa.concat_tables([_SCHEMA.empty_table(), *parts]).combine_chunks()
    metrics = _metrics(rows["metric"].unique().to_pylist())
    rows = rows.filter(pc.is_in(rows["metric"], pa.array(metrics, pa.string())))
    orders = {"condition": list(design.conditions), "part": list(PARTS), "metric": metrics}
    keys = {name: pc.index_in(rows[name], pa.array(order, pa.string())) for name, order in orders.items()}
    keys |= {name: rows[name] for name in ("replica", "episode")}
    by = [(name, "ascending") for name in ("condition", "replica", "part", "metric", "episode")]
    in_order = pc.sort_indices(pa.table(keys), sort_keys=by)
    rows = rows.take(in_order)
    condition = keys["condition"].take(in_order)
    columns = {name: rows[name] for name in ("condition", "checksum")}
    for factor in design.factors:
        name = f"factor {factor}" if factor in COLUMNS else factor
        columns[name] = _levels(design.levels(factor)).take(condition)
    columns["run"] = rows["run"]
    run_marks = pa.array(list(marked.values()), pa.string())
    columns["marks"] = run_marks.take(pc.index_in(rows["run"], pa.array(list(marked), pa.string())))
    return pa.table(columns | {name: rows[name] for name in _SCHEMA.names[3:] if name != "run"})


def _metrics(names: Sequence[str]) -> list[str]:
    """Return metrics in the order of tables: those of the registry, returns of single agents, and others.

    The income is among them where it is not the harvest.
    """
    order = list(METRICS)
    moves_money = INCOME_EQUALITY in names or any(name.startswith("institutions/") for name in names)
    if COLLECTIVE_RETURN in names and not moves_money:
        names = [name for name in names if name != INCOME]

    def place(name: str) -> tuple[int, int, str]:
        if name in METRICS:
            return 0, order.index(name), ""
        is_of_agent = name.startswith("agent_")
        return (1, len(name), name) if is_of_agent else (2, 0, name)

    return sorted(names, key=place)


def _levels(levels: Sequence[Any]) -> pa.Array:
    """The levels of all conditions as a column: numbers, truth values, or else texts."""
    if all(isinstance(level, bool) for level in levels):
        return pa.array(levels, pa.bool_())
    if all(isinstance(level, int | float) and not isinstance(level, bool) for level in levels):
        is_whole = all(isinstance(level, int) and abs(level) < 2**63 for level in levels)
        return pa.array(levels, pa.int64() if is_whole else pa.float64())
    return pa.array(list(map(str, levels)), pa.string())


def circumstances_of(run: Path) -> Circumstances:
    """What the recipe of a run says of how it was made."""
    recipe = read_recipe(run)
    each = [_circumstances(part) for part in parts_of(recipe)]
    names = dict.fromkeys(name for circumstances in each for name in circumstances)
    values = {name: [circumstances.get(name, UNKNOWN) for circumstances in each] for name in names}
    return {name: " then ".join(value for value, _ in groupby(in_order)) for name, in_order in values.items()}


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
    """What of each run's circumstances differs from those of most runs, e.g. "torch, git commit", or "".

    Args:
        made: the circumstances by run, in the order of the table.
    """
    usual = {name: counts.most_common(1)[0][0] for name, counts in counted(made).items()}
    return {
        run: ", ".join(
            WORDS.get(name, name)
            for name, value in usual.items()
            if circumstances.get(name, UNKNOWN) != value
        )
        for run, circumstances in made.items()
    }


def _endings(tables: Mapping[str, pa.Table]) -> list[str]:
    """Return how the training of each replica went, in a word."""
    training, random = tables[TRAINING], tables[RANDOM]
    number = COLLECTIVE_RETURN if COLLECTIVE_RETURN in random.column_names else INCOME
    by_chance = float(np.mean(where(random, agent=0)[number].to_numpy()))
    replicas = sorted(training["replica"].unique().to_pylist())
    outcomes = [outcome_of(where(training, replica=replica), random=by_chance) for replica in replicas]
    return [outcome.word for outcome in outcomes]
