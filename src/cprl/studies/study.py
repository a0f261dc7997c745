"""Study: an experiment that is run under several conditions, with the same replicas in each.

`Study` describes the conditions, and `Condition` is one of them. A study is a frozen value: it can be stored
as `study.json` and read again (`read_study`), and running it is the business of `cprl.studies.run`.
"""

import json
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from itertools import chain, count
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from cprl.algorithms.base import TrainingEngine
from cprl.experiment.engine import engine_of
from cprl.experiment.experiment import MOST_SEED, Experiment
from cprl.population import refuse_people
from cprl.runs.files import STUDY_FORMAT, digest_of, read_json, refuse_newer
from cprl.runs.recipe import RECIPE_FILE, with_runs_moved
from cprl.studies.factors import (
    MOST_CONDITIONS,
    Design,
    Factor,
    Level,
    all_combinations,
    changes_from_config,
    changes_to_config,
    checked_factors,
    draw_combinations,
    factor_from_config,
    factor_to_config,
    with_changes,
)
from cprl.system.defaults import REPLICAS_PER_RUN
from cprl.values import (
    DirectoryName,
    Range,
    Value,
    did_you_mean,
    refusal,
    refuse_live,
    short_repr,
    without_defaults,
)

CONDITION_FORMAT: Final = 1
"""The version of the checksum. Increase it when a default of `Experiment` or of a value in
`cprl.values.KINDS` changes: checksums leave defaults out, so the same checksum would mean two experiments."""
NOT_IN_CHECKSUM: Final = ("name", "seed", "replicas", "on_nan")
"""The fields of an experiment that its checksum leaves out, because they do not decide its numbers: its name,
the seed and number of the replicas, and what happens at a number that is not finite."""
BLOCK_SEED_STEP: Final = 1000
"""The difference between the seeds of two blocks. It is more than 1, because the evaluation of a run uses
the seed after the run's own."""
CONDITION: Final = "condition"
"""The column of a table that holds the names of named conditions."""
UNCHANGED: Final = "unchanged"
"""The name of the only condition of a study without factors."""


@dataclass(frozen=True, eq=False)
class Condition:
    """A condition of a study: the experiment that is trained, and how it differs from other conditions.

    Args:
        experiment: the experiment; the study decides its seed and its replicas.
        levels: the level of each factor, by the factor's path: a value, or the name of a level.
        name: the name of the condition, unique in its study.
    """

    experiment: Experiment
    levels: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""

    @cached_property
    def engine(self) -> TrainingEngine:
        """Return the engine that trains its replicas."""
        return engine_of(self.experiment)

    @cached_property
    def checksum(self) -> str:
        """Return 12 hexadecimal digits that identify everything that decides the numbers, except the seed.

        Fields with their default value are left out. So a later version of cprl, which may have more fields,
        computes the same checksum.
        """
        return self.checksum_in(".")

    def checksum_in(self, runs: Path | str) -> str:
        """Return the checksum for runs in a directory.

        `Frozen` agents name the run that they come from by its path. The checksum uses paths relative to the
        directory, so that it does not depend on the working directory.
        """
        config = with_runs_moved(self.experiment.to_config(), ".", runs)
        config["engine"] = self.engine
        table = {name: value for name, value in config.items() if name not in NOT_IN_CHECKSUM}
        differing = without_defaults(table, Experiment)
        if differing["engine"] == "compiled":  # the default when the format began
            del differing["engine"]
        content = {"format": CONDITION_FORMAT, "experiment": differing}
        return digest_of(json.dumps(content, sort_keys=True), size=6)


@dataclass(frozen=True, kw_only=True)
class Block:
    """The replicas of a condition that a single run trains."""

    first: int
    """The number of the block's first replica, counted over the whole study."""
    replicas: int
    """The number of replicas in the block."""
    seed: int
    """The seed of the run."""


Replicas: TypeAlias = Annotated[int, Range(1, 2**20)]


@dataclass(frozen=True, eq=False)
class Study(Value, stored=False):
    """An experiment under several conditions: all combinations of factors, random draws, or named conditions.

    Args:
        experiment: the experiment that all conditions start from.
        factors: the values to try for each field, by the field's path, see `cprl.studies.factors`. Instead of
            a list of values, a factor may be a table of named levels, each a table of values by path, or,
            with `draws`, a distribution.
        conditions: named conditions instead of factors: for each name a table of values by path. The empty
            table `{}` is the unchanged experiment.
        draws: the number of random combinations to draw, instead of running all combinations.
        design: the way to draw them: "random" draws each combination independently; "latin_hypercube" covers
            the range of each factor evenly; "sobol" covers all ranges together evenly, for any number of
            draws.
        replicas: the number of replicas of each condition; by default that of the experiment.
        block: the largest number of replicas that one run trains together. With smaller blocks, more
            processes can share the work.
        reference: the name of the condition that the others are compared with; by default the first condition
            that equals the experiment, or else the first of all.
        name: the name of the study; by default that of the experiment.
        question: what the study asks; the report quotes it.
        expectation: what you expected before the study was run; the report quotes it.
    """

    experiment: Experiment
    factors: Mapping[str, Factor] = field(default_factory=dict)
    conditions: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, kw_only=True)
    draws: Annotated[int, Range(1, MOST_CONDITIONS)] | None = field(default=None, kw_only=True)
    design: Design = field(default="random", kw_only=True)
    replicas: Replicas | None = field(default=None, kw_only=True)
    block: Replicas = field(default=REPLICAS_PER_RUN, kw_only=True)
    reference: str | None = field(default=None, kw_only=True)
    name: DirectoryName | Literal[""] = field(default="", kw_only=True)
    question: str = field(default="", kw_only=True)
    expectation: str = field(default="", kw_only=True)

    def __repr__(self) -> str:
        return (
            f"Study({self.name!r}, {len(self.all_conditions)} conditions, {self.replicas} replicas of each)"
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        values = {
            "factors": checked_factors(self.factors),
            "conditions": {name: dict(levels) for name, levels in self.conditions.items()},
            "replicas": self.experiment.replicas if self.replicas is None else self.replicas,
            "name": self.name or self.experiment.name,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        if self.factors and self.conditions:
            raise ValueError("a study has factors and conditions; allowed: one of them")
        if self.draws is not None and not self.factors:
            raise ValueError("draws is given without factors; allowed: factors to draw from")
        if self.draws is None and self.design != "random":
            raise refusal("design", self.design, "with draws, how many combinations it has")
        if self.blocks[-1].seed > MOST_SEED:
            raise ValueError(f"the experiment's seed is {self.experiment.seed}; allowed: a lower one")
        for condition in self.all_conditions:
            refuse_people(condition.experiment.agents)
        names = [condition.name for condition in self.all_conditions]
        if self.reference_name not in names:
            raise refusal("reference", self.reference, f"the name of a condition: {', '.join(names[:10])}")
        refuse_live(self.to_config(), where=f"the study {self.name!r}")

    @cached_property
    def all_conditions(self) -> tuple[Condition, ...]:
        """Return the conditions, each with its experiment and a name of its own."""
        by_checksum: dict[str, Condition] = {}
        assert self.replicas is not None
        base = replace(self.experiment, replicas=self.replicas)
        for name, levels in self._levels():
            values = {factor: level.value for factor, level in levels.items()}
            condition = Condition(experiment_at(base, levels), values, name)
            same = by_checksum.setdefault(condition.checksum, condition)
            if same is not condition and self.draws is None:
                raise ValueError(f"conditions {same.name!r} and {name!r} are equal; allowed: each once")
            if len(by_checksum) == self.draws:
                break
        if self.draws is not None and len(by_checksum) < self.draws:
            raise ValueError(
                f"draws is {self.draws}; the factors have no more than {len(by_checksum)} combinations that "
                "differ, or this design finds no more"
            )
        return with_unique_names(by_checksum.values())

    def _levels(self) -> Iterator[tuple[str, dict[str, Level]]]:
        """Yield the name and levels of each condition. Random draws yield more than `draws` of them, since
        some may be equal."""
        if self.conditions:
            yield from ((name, {CONDITION: Level(name, levels)}) for name, levels in self.conditions.items())
        elif not self.factors:
            yield UNCHANGED, {CONDITION: Level(UNCHANGED, {})}
        else:
            combinations: Iterable[dict[str, Level]]
            if self.draws is None:
                combinations = all_combinations(self.factors)
            else:
                seed = self.experiment.seed
                combinations = draw_combinations(self.factors, self.draws, seed=seed, design=self.design)
            for levels in combinations:
                yield condition_name({factor: level.value for factor, level in levels.items()}), levels

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """Return the blocks of replicas. Every condition has a run for each block."""
        assert self.replicas is not None
        return tuple(
            Block(
                first=first,
                replicas=min(self.block, self.replicas - first),
                seed=self.experiment.seed + BLOCK_SEED_STEP * (first // self.block),
            )
            for first in range(0, self.replicas, self.block)
        )

    @property
    def reference_name(self) -> str:
        """Return the name of the condition that others are compared with."""
        if self.reference is not None:
            return self.reference
        same = Condition(self.experiment).checksum
        unchanged = (condition.name for condition in self.all_conditions if condition.checksum == same)
        return next(unchanged, self.all_conditions[0].name)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the paths of the factors, or ("condition",) where conditions have names instead."""
        return tuple(self.factors) if self.factors else (CONDITION,)

    def to_config(self, directory: str | Path | None = None) -> dict[str, Any]:
        """Return the study as a table that JSON can hold.

        Args:
            directory: where the table will be stored. Paths of the runs of `Frozen` agents are relative to
                it.
        """
        table: dict[str, Any] = {
            "experiment": self.experiment.to_config(),
            "factors": {name: factor_to_config(factor) for name, factor in self.factors.items()},
            "conditions": {name: changes_to_config(levels) for name, levels in self.conditions.items()},
        }
        if directory is not None:
            table = with_runs_moved(table, ".", directory)
        return {
            "format": STUDY_FORMAT,
            "experiment": table["experiment"],
            "factors": [*map(list, table["factors"].items())],
            "conditions": [*map(list, table["conditions"].items())],
            **{name: getattr(self, name) for name in _PLAIN},
        }

    @classmethod
    def from_config(cls, table: Mapping[str, Any], *, directory: str | Path | None = None) -> "Study":
        """Return the study of a table that `to_config` returned, stored in the directory.

        Raises:
            ValueError: for a table of another format, or with unknown or wrong fields.
        """
        refuse_newer("the study", table, STUDY_FORMAT)
        if table.get("format") != STUDY_FORMAT:
            raise refusal("the study's format", table.get("format"), str(STUDY_FORMAT))
        known = ("format", "experiment", "factors", "conditions", *_PLAIN)
        if unknown := [name for name in table if name not in known]:
            close = did_you_mean(unknown[0], known)
            raise ValueError(f"the study has no {short_repr(unknown[0])}{close}; allowed: {', '.join(known)}")
        try:
            values = {"experiment": {**table["experiment"]}}
            values |= {name: dict(table[name]) for name in ("factors", "conditions")}
            if directory is not None:
                values = with_runs_moved(values, directory, ".")
            experiment = Experiment.from_config(values["experiment"])
            factors = {name: factor_from_config(name, part) for name, part in values["factors"].items()}
            conditions = {name: changes_from_config(part) for name, part in values["conditions"].items()}
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"the study has no table that it could have: {error!r}") from error
        plain = {name: table[name] for name in _PLAIN if name in table}
        return cls(experiment, factors, conditions=conditions, **plain)

    def __eq__(self, other: object) -> bool:
        return self.to_config() == other.to_config() if isinstance(other, Study) else NotImplemented

    def __hash__(self) -> int:
        return hash((self.name, self.replicas, self.block))


_PLAIN: Final = ("name", "question", "expectation", "draws", "design", "replicas", "block", "reference")
"""The fields of a study that its table holds unchanged."""


def experiment_at(experiment: Experiment, levels: Mapping[str, Level]) -> Experiment:
    """Return the experiment with the changes of one level of each factor; refuse levels that contradict each
    other.

    Raises:
        ValueError: if two levels change the same field, or one that the study itself decides.
    """
    paths = [path for level in levels.values() for path in level.changes]
    if len(set(paths)) < len(paths):
        raise ValueError(f"two factors change the same field, of {', '.join(paths)}; allowed: one each")
    refused = [path for path in paths if path in ("seed", "replicas", "name")]
    if refused:
        raise ValueError(f"a factor is {refused[0]}, which the study itself decides; allowed: other fields")
    changes = {path: value for level in levels.values() for path, value in level.changes.items()}
    return with_changes(experiment, changes) if changes else experiment


LEVEL_SEPARATOR: Final = ", "
"""The separator of the levels in the name of a condition."""


def condition_name(levels: Mapping[str, Any]) -> str:
    """Return the name of a condition, e.g. "freeze_steps=5, gamma=0.9".

    Args:
        levels: the level of each factor, by the factor's path.
    """
    short = short_names(levels)
    return LEVEL_SEPARATOR.join(f"{short[path]}={level_text(value)}" for path, value in levels.items())


def with_unique_names(conditions: Iterable[Condition]) -> tuple[Condition, ...]:
    """Return the conditions with unique names: a condition whose name is taken gets a number, e.g. "DQN #2".

    Names can be equal because they tell only the class and the first field of a value.
    """
    conditions = tuple(conditions)
    taken = {condition.name for condition in conditions}
    by_name: dict[str, Condition] = {}
    for condition in conditions:
        name = unique_name(condition.name, taken) if condition.name in by_name else condition.name
        taken.add(name)
        by_name[name] = condition if name == condition.name else replace(condition, name=name)
    return tuple(by_name.values())


def unique_name(name: str, taken: Container[str]) -> str:
    """Return the name, or with the lowest free number behind it if it is taken, e.g. "beam #2"."""
    numbered = (f"{name} #{number}" for number in count(2))
    return next(free for free in chain([name], numbered) if free not in taken)


def levels_in(name: str) -> list[str]:
    """Return the levels in the name of a condition, e.g. ["cells=(8, 8)", "gamma=0.9"].

    Commas within brackets, of a tuple or an agent, do not separate levels.
    """
    levels: list[str] = []
    open_brackets = 0
    for part in name.split(LEVEL_SEPARATOR):
        if open_brackets:
            levels[-1] += LEVEL_SEPARATOR + part
        else:
            levels.append(part)
        opened = sum((character in "([{") - (character in ")]}") for character in part)
        open_brackets = max(0, open_brackets + opened)
    return levels


def level_text(value: Any) -> str:
    """Return a short text for a level, for names of conditions and for figures.

    A dataclass is named by its class and its first field that is no bool, e.g. "Learning(DQN)" or
    "MLP((8, 8))".
    """
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple):
        return f"({', '.join(map(level_text, value))})"
    if not is_dataclass(value) or isinstance(value, type):
        return value if isinstance(value, str) else short_repr(value)
    kind = type(value).__name__
    values = (getattr(value, part.name) for part in fields(value))
    first = next((part for part in values if not isinstance(part, bool)), "")
    inner = type(first).__name__ if is_dataclass(first) else level_text(first)
    is_redundant = first is None or not inner or inner.startswith(kind)  # e.g. DQN(DQNSettings)
    return kind if is_redundant else f"{kind}({inner})"


def short_names(factors: Iterable[str]) -> dict[str, str]:
    """Return a short name for each path: its last part, or the whole path where that is a number or not
    unique."""
    last = {path: path.rpartition(".")[2] for path in factors}
    names = list(last.values())
    return {path: path if name.isdigit() or names.count(name) > 1 else name for path, name in last.items()}


STUDY_FILE: Final = "study.json"
RUNS: Final = "runs"
"""The folder of the runs in a study's directory."""
STATUS: Final = "status"
"""The folder of what the trials say of themselves in a study's directory."""


def directory_of(study: Study, out: Path | str | None) -> Path:
    """Return the directory of a study, by default `studies/<name>`; refuse a file and the directory of a
    run.

    Raises:
        ValueError: for a file, or the directory of a run.
    """
    directory = Path("studies") / study.name if out is None else Path(out)
    allowed = "a new directory, or the directory of an earlier study"
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"out is {directory}, a file; allowed: {allowed}")
    if (directory / RECIPE_FILE).exists():
        raise ValueError(f"out is {directory}, the directory of a run; allowed: {allowed}")
    return directory


def read_study(out: Path | str) -> Study:
    """Read the study that is stored in a directory.

    Raises:
        ValueError: if there is no such file, or it is not that of a study.
    """
    path = Path(out) / STUDY_FILE
    try:
        table = read_json(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is not the file of a study: {error!r}") from error
    return Study.from_config(table, directory=out)
