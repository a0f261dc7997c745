"""What a table is made of: runs, each with its condition and its replicas; and what is lacking."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cprl.measuring import social
from cprl.measuring.now import DECLINE, HARVESTING, LEAST_LOSS, LOST, RECOVERY, REGAINED, TRAGEDY
from cprl.measuring.phases import FEWEST_EPISODES
from cprl.runs.curves import Values, as_curves, curves_of, phases_of, running_mean
from cprl.runs.episodes import read_episodes, read_table
from cprl.studies.status import Status
from cprl.studies.study import Study, level_text, unlike
from cprl.studies.trials import State, trials_of
from cprl.terminal.course import BELOW_RANDOM, LAST_EPISODES, PEAK_EPISODES, PEAK_OVER_RANDOM
from cprl.terminal.figures import COLOURS as PHASE_COLOURS
from cprl.terminal.figures import UNNAMED

REASONS: Final[dict[State, str]] = {
    "missing": "was not begun",
    "unfinished": "has not ended",
    "finished": "is finished",
    "refused": "has another recipe than its name says, or none that can be read: was it renamed?",
}


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
    episodes: int
    """That each replica trains."""


@dataclass(frozen=True)
class Lacking:
    """A run that is not part of a table, and why."""

    name: str
    condition: str
    replicas: int
    reason: str

    def __str__(self) -> str:
        """In a sentence."""
        replicas = f"{self.replicas} replica{'s' * (self.replicas != 1)}"
        return f"{self.condition}: {self.name}, {replicas}, {self.reason}."


@dataclass(frozen=True, kw_only=True)
class Design:
    """The conditions that a table compares."""

    name: str
    conditions: Mapping[str, Mapping[str, Any]]
    """The level of each factor by condition, in order: a number, a truth value or a text."""
    reference: str
    """The condition that others are compared with."""
    is_paired: bool
    """Whether replicas of the same number have the same seeds and worlds in each condition."""
    is_grid: bool = True
    """Whether levels are few and repeat; not so for random draws."""
    notes: tuple[str, ...] = field(default=())
    """Sentences on what is compared."""

    @property
    def factors(self) -> tuple[str, ...]:
        """The names of the factors; () where conditions have names alone."""
        first = next(iter(self.conditions.values()))
        return tuple(first)


def design_of(study: Study) -> Design:
    """The conditions of a study."""
    levels: dict[str, dict[int, Any]] = {name: {} for name in study.factors}
    for name, own in ((name, own) for own in study.all_conditions for name in study.factors):
        at = own.levels[name]
        if id(at) not in levels[name]:
            plain = plain_level(at)
            alike = set(levels[name].values())
            levels[name][id(at)] = unlike(plain, alike) if isinstance(plain, str) else plain
    return Design(
        name=study.name,
        conditions={
            own.name: {name: levels[name][id(own.levels[name])] for name in study.factors}
            for own in study.all_conditions
        },
        reference=study.reference_name,
        is_paired=True,
        is_grid=study.draws is None,
    )


def sources_of(study: Study, runs: Path, status: Path | None = None) -> tuple[list[Source], list[Lacking]]:
    """The finished runs of a study, and the others; `status` is where its trials say why they failed."""
    finished, lacking = [], []
    for trial in trials_of(study):
        state, of = trial.state(runs), trial.condition
        if state == "finished":
            source = Source(
                run=runs / trial.name,
                name=trial.name,
                condition=of.name,
                checksum=of.checksum,
                first=trial.block.first,
                replicas=trial.block.replicas,
                episodes=trial.experiment.episodes,
            )
            finished.append(source)
        else:
            failure = None if status is None else Status(status, trial.name).failure()
            reason = REASONS[state] if failure is None else f"failed: {failure}"
            lacking.append(Lacking(trial.name, of.name, trial.block.replicas, reason))
    return finished, lacking


def plain_level(value: Any) -> Any:
    """A level as a table holds it: a number or truth value as it is, else a text."""
    return value if isinstance(value, bool | int | float) else level_text(value)


TRAINING: Final = "training"
EVALUATION: Final = "evaluation"
RANDOM: Final = "random"
PARTS: Final = {TRAINING: None, EVALUATION: "trained", RANDOM: "random"}
"""The parts of a run: its training, its agents in fresh worlds afterwards, and random play in these worlds;
with the name of the table that holds it."""
NET: Final = "net"
"""The return of all agents together: harvest - fines + transfers, where a game has institutions."""


class Windows(NamedTuple):
    """A metric in one part of a run, for R replicas and W windows."""

    part: str
    metric: str
    episodes: NDArray[np.int64]
    """The first episode of each window, [W]."""
    lengths: NDArray[np.int64]
    """Episodes of each window, [W]; the last one may be shorter."""
    undefined: NDArray[np.int64]
    """Episodes in which the metric is undefined, [R, W]."""
    values: Values
    """Means over the episodes in which it is defined, [R, W]; NaN where there are none."""


def windows_of(source: Source, window: int) -> Iterator[Windows]:
    """Every metric of every part of a finished run.

    In training, windows are of so many episodes; evaluation and random play are one window each, but for
    `window=1`.

    Raises:
        FileNotFoundError: if a part is missing.
    """
    for part, table_name in PARTS.items():
        if table_name is None:
            table = read_episodes(source.run)
        else:
            table = read_table(source.run / "evaluation" / f"{table_name}.parquet")
        _check_episodes(table, source, part)
        curves = as_curves(table)
        curves[NET] = np.sum([own for name, own in curves.items() if name.startswith("return_")], axis=0)
        for metric, values in curves.items():
            length = window if part == TRAINING or window == 1 else values.shape[1]
            yield Windows(part, metric, *in_windows(values, length))


def in_windows(values: Values, window: int) -> tuple[Any, Any, Any, Values]:
    """First episodes, [W], lengths, [W], undefined episodes, [R, W], and means, [R, W], of values [R, E]."""
    firsts = np.arange(0, values.shape[1], window)
    lengths = np.diff(np.append(firsts, values.shape[1]))
    defined = ~np.isnan(values)
    counts = np.add.reduceat(defined.astype(np.int64), firsts, axis=1)
    with np.errstate(invalid="ignore"):
        means = np.add.reduceat(np.where(defined, values, 0.0), firsts, axis=1) / counts
    return firsts, lengths, lengths - counts, means


def ordered(metrics: set[str]) -> list[str]:
    """Metrics in the order of tables: social ones, returns of single agents, those of institutions."""
    social_ones = [*social.METRICS, "yield_share", NET]

    def place(name: str) -> tuple[int, int, str]:
        if name in social_ones:
            return 0, social_ones.index(name), ""
        number = name.removeprefix("return_")
        return (1, int(number), "") if number.isdecimal() else (2, 0, name)

    return sorted(metrics, key=place)


def _check_episodes(table: pa.Table, source: Source, part: str) -> None:
    """Raises a ValueError unless each episode of each replica is there once."""
    replica, episode, agent = (table[name].to_numpy() for name in ("replica", "episode", "agent"))
    rows = np.stack([replica, episode, agent], axis=1)
    each, times = np.unique(rows, axis=0, return_counts=True)
    if (times > 1).any():
        twice = each[times > 1][0].tolist()
        raise ValueError(f"{source.name} has episode {twice[1]} of replica {twice[0]} in {part} twice")
    played = np.unique(rows[:, :2], axis=0)
    replicas, counts = np.unique(played[:, 0], return_counts=True)
    wanted = source.episodes if part == TRAINING else counts.max(initial=0)
    if replicas.tolist() != list(range(source.replicas)) or not (counts == wanted).all() or not wanted:
        found = dict(zip(replicas.tolist(), counts.tolist(), strict=True))
        raise ValueError(
            f"{source.name} has these episodes by replica in {part}: {found}; allowed: {wanted} of each of "
            f"{source.replicas} replicas"
        )


COLUMNS: Final = {
    "condition": pa.string(),
    "checksum": pa.string(),
    "run": pa.string(),
    "marks": pa.string(),
    "replica": pa.int32(),
    "part": pa.string(),
    "metric": pa.string(),
    "episode": pa.int32(),
    "window_episodes": pa.int32(),
    "undefined": pa.int32(),
    "value": pa.float64(),
}
"""All but those of factors, which follow "checksum"."""
_NUMBERS: Final = ("replica", "episode", "window_episodes", "undefined", "value")


def column_of(factor: str) -> str:
    """The column of a factor."""
    return f"factor {factor}" if factor in COLUMNS else factor


def rows_of(design: Design, found: list[tuple[Source, list[Windows]]], marked: Mapping[str, str]) -> pa.Table:
    """The sorted rows of a table, with the columns that `cprl.studies.tables.table` lists.

    Args:
        found: runs, and what was measured in them.
        marked: the marks of each run by its name.
    """
    names = list(design.conditions)
    is_net_known = not any(own.metric == "collective_return" for _, every in found for own in every)
    is_net_known |= any(own.metric.startswith("institutions/") for _, every in found for own in every)
    kept = [(source, own) for source, every in found for own in every if own.metric != NET or is_net_known]
    metrics, parts, runs = ordered({own.metric for _, own in kept}), list(PARTS), [own for own, _ in found]
    places = {id(source): nth for nth, source in enumerate(runs)}
    blocks: dict[str, list[NDArray[Any]]] = {
        name: [] for name in (*_NUMBERS, "condition", "part", "metric", "run")
    }
    for source, own in kept:
        replicas, windows = own.values.shape
        shape = (replicas, windows)
        cells: dict[str, Any] = {
            "condition": names.index(source.condition),
            "run": places[id(source)],
            "part": parts.index(own.part),
            "metric": metrics.index(own.metric),
            "replica": source.first + np.arange(replicas)[:, None],
            "episode": own.episodes,
            "window_episodes": own.lengths,
            "undefined": own.undefined,
            "value": own.values,
        }
        for name, cell in cells.items():
            blocks[name].append(np.broadcast_to(cell, shape).reshape(-1))
    arrays = {name: np.concatenate([np.zeros(0, np.int64), *own]) for name, own in blocks.items()}
    keys = ("condition", "replica", "part", "metric", "episode")
    order = np.lexsort([arrays[name] for name in reversed(keys)])
    arrays = {name: own[order] for name, own in arrays.items()}
    _refuse_twice(arrays, keys, names)
    columns: dict[str, pa.Array] = {
        "condition": _texts(names, arrays["condition"]),
        "checksum": _texts([own.checksum for own in runs], arrays["run"]),
    }
    for factor in design.factors:
        levels = _levels([own[factor] for own in design.conditions.values()])
        columns[column_of(factor)] = levels.take(pa.array(arrays["condition"]))
    columns |= {
        "run": _texts([own.name for own in runs], arrays["run"]),
        "marks": _texts([marked[own.name] for own in runs], arrays["run"]),
        "replica": pa.array(arrays["replica"], pa.int32()),
        "part": _texts(parts, arrays["part"]),
        "metric": _texts(metrics, arrays["metric"]),
    }
    columns |= {
        name: pa.array(arrays[name], COLUMNS[name])
        for name in ("episode", "window_episodes", "undefined", "value")
    }
    return pa.table(columns)


def _refuse_twice(arrays: Mapping[str, NDArray[Any]], keys: tuple[str, ...], names: list[str]) -> None:
    """Raises a ValueError where a row is there twice."""
    same = np.ones(max(len(arrays["value"]) - 1, 0), bool)
    for name in keys:
        same &= arrays[name][1:] == arrays[name][:-1]
    if same.any():
        at = int(same.argmax())
        raise ValueError(
            f"replica {arrays['replica'][at]} of the condition {names[arrays['condition'][at]]!r} is "
            "there twice"
        )


def _texts(names: list[str], codes: NDArray[Any]) -> pa.Array:
    return pa.array(names, pa.string()).take(pa.array(codes, pa.int64()))


def _levels(levels: list[Any]) -> pa.Array:
    """The levels of all conditions as a column: whole numbers, numbers, truth values, or else texts."""
    if all(isinstance(own, bool) for own in levels):
        return pa.array(levels, pa.bool_())
    if all(isinstance(own, int | float) and not isinstance(own, bool) for own in levels):
        whole = all(isinstance(own, int) and abs(own) < 2**63 for own in levels)
        return pa.array(levels, pa.int64() if whole else pa.float64())
    return pa.array([own if isinstance(own, str) else str(own) for own in levels], pa.string())


NO_BETTER: Final = "no better"
COLOURS: Final = {
    **PHASE_COLOURS,
    HARVESTING: "#c7e9c0",
    RECOVERY: "#c6dbef",
    DECLINE: "#d9c9b6",
    NO_BETTER: "#cfcfcf",
}
"""Of labels, light enough for text before them."""
BY_PHASES: Final = f"the last phase that cprl.measuring.phases finds, from {FEWEST_EPISODES:,} episodes on"
BY_RETURNS: Final = "its last 30 episodes against its peak and random play, see cprl.studies.tables.sources"


@dataclass(frozen=True, kw_only=True)
class Endings:
    """In which phase the replicas of each condition end."""

    labels: Mapping[str, Mapping[int, str]]
    """By condition and number of the replica; none for conditions without a finished run."""
    rules: tuple[str, ...]
    """How they were found, one for short trainings and one for long ones."""

    def counts(self, condition: str) -> Counter[str]:
        """How many replicas of a condition have each label, the most frequent one first."""
        return Counter(sorted(self.labels.get(condition, {}).values()))

    def most_frequent(self, condition: str) -> tuple[str, int, int] | None:
        """The most frequent label of a condition, how many replicas have it, and how many there are.

        Of equally frequent ones the first by name; None without a finished run.
        """
        found = self.counts(condition)
        if not found:
            return None
        label, number = found.most_common(1)[0]
        return label, number, found.total()


def endings(sources: list[Source]) -> Endings:
    """The phases in which the replicas of finished runs end."""
    labels: dict[str, dict[int, str]] = {}
    rules: dict[str, None] = {}
    for source in sources:
        found, rule = _labels(source)
        rules[rule] = None
        numbered = {source.first + nth: own for nth, own in enumerate(found)}
        labels[source.condition] = {**labels.get(source.condition, {}), **numbered}
    return Endings(labels=labels, rules=tuple(rules))


def _labels(source: Source) -> tuple[list[str], str]:
    """The label of each replica of a run, and by which rule."""
    curves = curves_of(source.run)
    of_each = [{name: own[nth : nth + 1] for name, own in curves.items()} for nth in range(source.replicas)]
    by_phases = [phases_of(own, resamples=1) for own in of_each]
    if all(own is not None for own in by_phases):
        return [own[1][-1].label or UNNAMED for own in by_phases if own is not None], BY_PHASES
    agents = sum(name.startswith("return_") for name in curves)
    random = float(_harvest(as_curves(read_table(source.run / "evaluation" / "random.parquet"))).mean())
    return [ending(own, random=random, agents=agents) for own in _harvest(curves)], BY_RETURNS


def ending(returns: Values, *, random: float, agents: int) -> str:
    """In which phase a replica of a short training ends; see the module.

    Args:
        returns: of all agents together by episode, [E].
        random: the mean of random play.
        agents: how many there are.
    """
    tens, means = running_mean(returns, PEAK_EPISODES), running_mean(returns, LAST_EPISODES)
    peak, at, last = float(tens.max()), int(tens.argmax()), float(means[-1])
    low = float(means[min(at, len(means) - 1) :].min())

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
    if "collective_return" in curves:
        return curves["collective_return"]
    return np.asarray(np.sum([own for name, own in curves.items() if name.startswith("return_")], axis=0))
