"""The table of finished runs: which runs it is made of, their episodes as rows, and how replicas end."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cprl.envs.unwrap import clock_in
from cprl.experiment import Experiment
from cprl.measuring.now import LEAST_LOSS, LOST, REGAINED
from cprl.measuring.phases import FEWEST_EPISODES, UNNAMED
from cprl.measuring.registry import INCOME, METRICS
from cprl.measuring.table import Numbers
from cprl.measuring.windows import (
    LAST_EPISODES,
    Values,
    episodes_after,
    mean_of_worlds,
    rounds_of,
    running_mean,
)
from cprl.population import any_learns
from cprl.runs.checkpoints import REPORT
from cprl.runs.curves import as_curves, phases_of, worlds_of
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
from cprl.training.course import BELOW_RANDOM, PEAK_EPISODES, PEAK_OVER_RANDOM
from cprl.values import Positive, checked

REASONS: Final[dict[State, str]] = {
    "missing": "was not begun",
    "unfinished": "has not ended",
    "finished": "is finished",
    "refused": "has another recipe than its name says, or none that can be read: was it renamed?",
}

Windows = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Values]
"""A metric of a replica in W windows, [W]: the first episode of each, and its episodes, of which the last
window may have fewer; the episodes in which it is undefined, and the mean over the others, NaN where there
are none."""


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
    measured: list[_Measured] = []
    damaged: list[Lacking] = []
    for source in sources:
        try:
            measured.append(_measured(source, window))
        except (ValueError, OSError, KeyError) as error:
            begins = "is too short" if isinstance(error, TooShortError) else DAMAGED
            reason = f"{begins}: {error}"
            damaged.append(Lacking(source.name, source.condition, source.replicas, reason))
    made = {run.source.name: run.circumstances for run in measured}
    by_condition: dict[str, list[_Measured]] = {}
    for run in measured:
        by_condition.setdefault(run.source.condition, []).append(run)
    return StudyTable(
        design=design,
        rows=_rows(design, measured, marks(made)),
        window=window,
        lacking=(*lacking, *damaged),
        made=made,
        endings={
            name: dict(Counter(sorted(phase for run in runs for phase in run.phases)).most_common())
            for name, runs in by_condition.items()
        },
        ending_rules=tuple(dict.fromkeys(run.rule for run in measured)),
        agents_learn=any(run.source.agents_learn for run in measured) or not measured,
        lengths={
            name: {
                "episodes": _range(number for run in runs for number in run.episodes),
                "steps": _range(steps),
            }
            for name, runs in by_condition.items()
            if (steps := [run.steps for run in runs if run.steps is not None])
        },
    )


def _range(numbers: Iterable[int]) -> tuple[int, int]:
    ordered = sorted(numbers)
    return ordered[0], ordered[-1]


class _Measured(NamedTuple):
    """What a table takes from a run."""

    source: Source
    windows: Sequence[Mapping[tuple[str, str], Windows]]
    """Of each replica, by part and metric."""
    phases: Sequence[str]
    """In which each replica ends."""
    rule: str
    """How these were told."""
    circumstances: Circumstances
    episodes: Sequence[int]
    """Those that each replica ended in training."""
    steps: int | None
    """Those that its report says a replica trained."""


def _measured(source: Source, window: int) -> _Measured:
    """Reads a finished run.

    In training, windows are of so many episodes; evaluation and random play are one window each, but for
    `window=1`.
    """
    windows: list[dict[tuple[str, str], Windows]] = [{} for _ in range(source.replicas)]
    curves: dict[str, list[dict[str, Values]]] = {}
    worlds: dict[str, list[Numbers]] = {}
    for part, name in PARTS.items():
        folder = source.run / "evaluation"
        table = read_episodes(source.run) if name is None else read_rows(folder / f"{name}.parquet")
        _refuse_gaps(table, source, part)
        # one by one: in as many steps, each replica ends a number of episodes of its own
        replica = table["replica"].to_numpy()
        of_replicas = [table.filter(replica == number) for number in range(source.replicas)]
        curves[part] = list(map(as_curves, of_replicas))
        worlds[part] = [worlds_of(rows)[0] for rows in of_replicas]
        for of_replica, by_name, world in zip(windows, curves[part], worlds[part], strict=True):
            for metric, values in by_name.items():
                length = window if part == TRAINING or window == 1 else values.shape[1]
                of_replica[part, metric] = _in_windows(values[0], length, world)
    phases, rule = _phases(curves, worlds[TRAINING])
    episodes = [by_name["return_0"].shape[1] for by_name in curves[TRAINING]]
    made = circumstances_of(source.run)
    return _Measured(source, windows, phases, rule, made, episodes, _steps_of(source.run))


def _in_windows(values: Values, window: int, world: Numbers) -> Windows:
    """Windows of consecutive episodes; of many worlds, of as many consecutive ones of each, so that no window
    has more of the short episodes, which end sooner. The last window is whole, the first ones may lack worlds
    that have ended fewer."""
    lanes = len(np.unique(world))
    if lanes == 1 or window == 1:
        firsts = np.arange(0, len(values), window)
    else:
        to_end = episodes_after(world) // rounds_of(window, lanes)
        order = np.argsort(-to_end, kind="stable")
        values = values[order]
        firsts = np.flatnonzero(np.diff(to_end[order], prepend=-1))
    lengths = np.diff(np.append(firsts, len(values)))
    defined = ~np.isnan(values)
    counts = np.add.reduceat(defined.astype(np.int64), firsts)
    with np.errstate(invalid="ignore"):
        means = np.add.reduceat(np.where(defined, values, 0.0), firsts) / counts
    return firsts, lengths, lengths - counts, means


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


def _rows(design: Design, measured: Sequence[_Measured], marked: Mapping[str, str]) -> pa.Table:
    sources = [run.source for run in measured]
    numbers = [(source.condition, source.first + row) for source in sources for row in range(source.replicas)]
    for (name, number), times in Counter(numbers).items():
        if times > 1:
            raise ValueError(f"replica {number} of the condition {name!r} is there twice")
    names, parts, metrics = list(design.conditions), list(PARTS), _metrics(measured)
    blocks = []
    for place, run in enumerate(measured):
        at = names.index(run.source.condition)
        for replica, of_replica in enumerate(run.windows, run.source.first):
            for (part, metric), windows in of_replica.items():
                if metric in metrics:
                    codes = at, replica, parts.index(part), metrics.index(metric)
                    blocks.append(np.broadcast_arrays(*codes, *windows, place))
    columns = [np.concatenate(arrays) for arrays in zip(*blocks, strict=True)] or [np.zeros(0, np.int64)] * 9
    order = np.lexsort(columns[4::-1])  # the first five, the first one first
    condition, replicas, part_code, metric_code, episode, length, undefined, value, place_of_run = (
        column[order] for column in columns
    )

    def texts(words: Sequence[str], codes: NDArray[np.int64]) -> pa.Array:
        return pa.array(words, pa.string()).take(pa.array(codes))

    rows = {
        "condition": texts(names, condition),
        "checksum": texts([source.checksum for source in sources], place_of_run),
    }
    for factor in design.factors:
        column = f"factor {factor}" if factor in COLUMNS else factor
        rows[column] = _levels(design.levels(factor)).take(pa.array(condition))
    rows |= {
        "run": texts([source.name for source in sources], place_of_run),
        "marks": texts([marked[source.name] for source in sources], place_of_run),
        "replica": pa.array(replicas, pa.int32()),
        "part": texts(parts, part_code),
        "metric": texts(metrics, metric_code),
        "episode": pa.array(episode, pa.int32()),
        "window_episodes": pa.array(length, pa.int32()),
        "undefined": pa.array(undefined, pa.int32()),
        "value": pa.array(value, pa.float64()),
    }
    return pa.table(rows)


def _metrics(measured: Sequence[_Measured]) -> list[str]:
    """Metrics in the order of tables: social ones, returns of single agents, those of institutions.

    The return of all agents together is among them where it is not the harvest.
    """
    metrics = {metric for run in measured for _, metric in run.windows[0]}
    if "collective_return" in metrics and not any(name.startswith("institutions/") for name in metrics):
        metrics.discard(INCOME)
    order = [name for name in METRICS if not METRICS[name].is_of_institutions]

    def place(name: str) -> tuple[int, int, str]:
        if name in order:
            return 0, order.index(name), ""
        agent = name.removeprefix("return_")
        return (1, int(agent), "") if agent.isdecimal() else (2, 0, name)

    return sorted(metrics, key=place)


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


HARVESTING, TRAGEDY, DECLINE = "harvesting", "tragedy", "decline"
RECOVERY, NO_BETTER = "recovery", "no better"
"""How short trainings end, see `ending`."""
BY_PHASES: Final = f"the last phase of its course, from {FEWEST_EPISODES:,} episodes on"
BY_RETURNS: Final = (
    f"its last {LAST_EPISODES} episodes against its peak and random play ({NO_BETTER}: no mean of "
    f"{PEAK_EPISODES} episodes reached {PEAK_OVER_RANDOM} times random play)"
)


def _phases(
    curves: Mapping[str, Sequence[dict[str, Values]]], worlds: Sequence[Numbers]
) -> tuple[list[str], str]:
    """In which phase each replica ends, and by which rule; `curves` are those of each, by the parts of the
    run, `worlds` those of the episodes of training."""
    training = curves[TRAINING]
    by_phases = [phases_of(by_name) for by_name in training]
    if all(phases is not None for phases in by_phases):
        return [phases[-1].label or UNNAMED for phases in by_phases if phases is not None], BY_PHASES
    agents = sum(name.startswith("return_") for name in training[0])
    random = float(np.concatenate([_harvest(by_name) for by_name in curves[RANDOM]]).mean())
    ends = [
        ending(_harvest(by_name)[0], random=random, agents=agents, worlds=world)
        for by_name, world in zip(training, worlds, strict=True)
    ]
    return ends, BY_RETURNS


def ending(returns: Values, *, random: float, agents: int, worlds: Numbers | None = None) -> str:
    """In which phase a replica of a short training ends.

    Args:
        returns: of all agents together by episode, [E].
        random: the mean of random play.
        agents: how many there are.
        worlds: that of each episode, [E], if there are several, which then count alike.
    """
    lanes = 1 if worlds is None else len(np.unique(worlds))
    after = 0
    if worlds is None or lanes == 1:
        tens, means = running_mean(returns, PEAK_EPISODES), running_mean(returns, LAST_EPISODES)
    else:
        tens, means = (mean_of_worlds(returns, worlds, size) for size in (PEAK_EPISODES, LAST_EPISODES))
        tens = tens[~np.isnan(means)]
        means = means[~np.isnan(means)]
        after = (rounds_of(LAST_EPISODES, lanes) - rounds_of(PEAK_EPISODES, lanes)) * lanes
    peak, at, last = float(tens.max()), int(tens.argmax()), float(means[-1])
    low = float(means[min(at + after, len(means) - 1) :].min())

    def is_lost(mean: float) -> bool:
        return bool(peak - mean >= max(LOST * (peak - random), LEAST_LOSS * peak))

    if peak < PEAK_OVER_RANDOM * random:
        return NO_BETTER
    if is_lost(low) and last >= low + REGAINED * (peak - low):
        return RECOVERY
    if last <= BELOW_RANDOM * random:
        return TRAGEDY if agents > 1 else DECLINE
    return DECLINE if is_lost(last) else HARVESTING


def _harvest(curves: Mapping[str, Values]) -> Values:
    """The collective return, [R, E]; of games without a harvest the return of all agents."""
    return curves.get("collective_return", curves[INCOME])
