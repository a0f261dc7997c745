"""Study: one experiment under several conditions, each repeated by the same replicas; a value."""

import json
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from itertools import chain, count
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from cprl.experiment.engine import engine_of
from cprl.experiment.experiment import MOST_SEED, Experiment
from cprl.runs.files import STUDY_FORMAT, digest_of, read_json, refuse_newer
from cprl.runs.recipe import RECIPE_FILE, stored_experiment, with_runs_moved
from cprl.studies.factors import (
    MOST_CONDITIONS,
    Design,
    Factor,
    Level,
    changed,
    changes_from_config,
    changes_to_config,
    checked_factors,
    drawn,
    factor_from_config,
    factor_to_config,
    grid,
)
from cprl.system.defaults import BLOCK
from cprl.values import (
    DirectoryName,
    Range,
    Value,
    meant,
    refusal,
    refuse_live,
    shown,
    without_defaults,
    without_departed,
)

CONDITION_FORMAT: Final = 1
"""Of checksums: counted up when a default of any value of `cprl.values.KINDS`, or of `Experiment`, changes,
so that the same checksum never means two things."""
UNNAMED: Final = ("name", "seed", "replicas", "on_nan")
"""Fields of an experiment that its checksum leaves out: what it is called, which repetitions of it a run
holds, and what happens where a number is not finite."""
SEEDS_APART: Final = 1000
"""Between the seeds of two blocks of replicas; evaluation plays worlds of the next seed."""
CONDITION: Final = "condition"
"""The column of named conditions."""
UNCHANGED: Final = "unchanged"
"""The one condition of a study without factors."""


@dataclass(frozen=True, eq=False)
class Condition:
    """One experiment of a study.

    Args:
        experiment: what is trained; its seed and replicas are those of the study.
        levels: the level of each factor, by factor: a value, or the name of a level.
        name: what it is called, unique in its study.
    """

    experiment: Experiment
    levels: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""

    @cached_property
    def checksum(self) -> str:
        """Of all that decides its numbers but the seed: 12 hexadecimal digits.

        Fields that have their default are left out, so that a later version, which has further ones, gives
        the same.
        """
        return self.checksum_in(".")

    def checksum_in(self, runs: Path | str) -> str:
        """Return the checksum in the names of its runs in a directory: what runs of `Frozen` agents are
        called from there, so that it is the same wherever the study is run from."""
        config = with_runs_moved(self.experiment.to_config(), ".", runs)
        config["engine"] = engine_of(self.experiment)
        table = {name: value for name, value in config.items() if name not in UNNAMED}
        named = without_defaults(table, Experiment)
        if named["engine"] == "compiled":  # the default when the format began
            del named["engine"]
        content = {"format": CONDITION_FORMAT, "experiment": named}
        return digest_of(json.dumps(content, sort_keys=True), size=6)


@dataclass(frozen=True, kw_only=True)
class Block:
    """Replicas of a condition that one run trains side by side."""

    first: int
    """The number of the first one in the study."""
    replicas: int
    seed: int
    """Of the run."""


Replicas: TypeAlias = Annotated[int, Range(1, 2**20)]


@dataclass(frozen=True, eq=False)
class Study(Value, stored=False):
    """One experiment under several conditions: a grid, random draws, or named conditions.

    Args:
        experiment: what every condition is, but for what it changes.
        factors: by the path of a field (see `cprl.studies.factors`), its values; or by a name of your own, a
            table of levels, each a table of values by path; or a distribution, with `draws`.
        conditions: named ones instead of factors, each a table of values by path; `{}` changes nothing.
        draws: so many random combinations of the factors' levels instead of their grid.
        design: how they are drawn: "random", each by itself; "latin_hypercube", the range of each factor
            evenly; or "sobol", all ranges together evenly, however many are drawn.
        replicas: of each condition; by default as many as in the experiment.
        block: replicas that one run trains side by side; fewer can be spread over more processes.
        reference: the name of the condition that others are compared with; by default the first one that
            changes nothing, else the first.
        name: by default the experiment's.
        question: what the study asks, for its report.
        expectation: what was expected before it was run, for its report.
    """

    experiment: Experiment
    factors: Mapping[str, Factor] = field(default_factory=dict)
    conditions: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, kw_only=True)
    draws: Annotated[int, Range(1, MOST_CONDITIONS)] | None = field(default=None, kw_only=True)
    design: Design = field(default="random", kw_only=True)
    replicas: Replicas | None = field(default=None, kw_only=True)
    block: Replicas = field(default=BLOCK, kw_only=True)
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
        names = [condition.name for condition in self.all_conditions]
        if self.reference_name not in names:
            raise refusal("reference", self.reference, f"the name of a condition: {', '.join(names[:10])}")
        refuse_live(self.to_config(), where=f"the study {self.name!r}")

    @cached_property
    def all_conditions(self) -> tuple[Condition, ...]:
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
        return apart(by_checksum.values())

    def _levels(self) -> Iterator[tuple[str, dict[str, Level]]]:
        """Yield the name and levels of each condition; of draws more than are asked for, as some may be
        equal."""
        if self.conditions:
            yield from ((name, {CONDITION: Level(name, levels)}) for name, levels in self.conditions.items())
        elif not self.factors:
            yield UNCHANGED, {CONDITION: Level(UNCHANGED, {})}
        else:
            short = short_names(self.factors)
            seed = self.experiment.seed
            draws = self.draws
            combinations = (
                grid(self.factors)
                if draws is None
                else drawn(self.factors, draws, seed=seed, design=self.design)
            )
            for levels in combinations:
                yield named({short[factor]: level.value for factor, level in levels.items()}), levels

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        assert self.replicas is not None
        return tuple(
            Block(
                first=first,
                replicas=min(self.block, self.replicas - first),
                seed=self.experiment.seed + SEEDS_APART * (first // self.block),
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
        """Return the names of the factors; of named conditions "condition" alone."""
        return tuple(self.factors) if self.factors else (CONDITION,)

    def to_config(self, directory: str | Path | None = None) -> dict[str, Any]:
        """Return the study as JSON can hold it; in a directory, runs of `Frozen` agents are given relative to
        it."""
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
        """Return the study that `to_config` gave in a directory."""
        refuse_newer("the study", table, STUDY_FORMAT)
        if table.get("format") != STUDY_FORMAT:
            raise refusal("the study's format", table.get("format"), str(STUDY_FORMAT))
        known = ("format", "experiment", "factors", "conditions", *_PLAIN)
        if unknown := [name for name in table if name not in known]:
            close = meant(unknown[0], known)
            raise ValueError(f"the study has no {shown(unknown[0])}{close}; allowed: {', '.join(known)}")
        try:
            values = {"experiment": stored_experiment(table["experiment"])}
            values |= {name: without_departed(dict(table[name])) for name in ("factors", "conditions")}
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
"""Fields that JSON can hold as they are."""


def experiment_at(experiment: Experiment, levels: Mapping[str, Level]) -> Experiment:
    """Return an experiment with what a level of each factor changes."""
    paths = [path for level in levels.values() for path in level.changes]
    if len(set(paths)) < len(paths):
        raise ValueError(f"two factors change the same field, of {', '.join(paths)}; allowed: one each")
    refused = [path for path in paths if path in ("seed", "replicas", "name")]
    if refused:
        raise ValueError(f"a factor is {refused[0]}, which the study itself decides; allowed: other fields")
    changes = {path: value for level in levels.values() for path, value in level.changes.items()}
    return changed(experiment, changes) if changes else experiment


BETWEEN: Final = ", "
"""Between the levels in the name of a condition."""


def named(levels: Mapping[str, Any]) -> str:
    """Return the name of a condition, e.g. "freeze_steps=5, gamma=0.9"."""
    return BETWEEN.join(f"{name}={level_text(value)}" for name, value in levels.items())


def apart(conditions: Iterable[Condition]) -> tuple[Condition, ...]:
    """Return conditions with a number after their name where others have the same, e.g. of unlike agents."""
    conditions = tuple(conditions)
    taken = {condition.name for condition in conditions}
    by_name: dict[str, Condition] = {}
    for condition in conditions:
        name = unlike(condition.name, taken) if condition.name in by_name else condition.name
        taken.add(name)
        by_name[name] = condition if name == condition.name else replace(condition, name=name)
    return tuple(by_name.values())


def unlike(name: str, taken: Container[str]) -> str:
    """Return a name that is not taken: itself, or with the lowest number from 2 on that is free."""
    numbered = (f"{name} #{number}" for number in count(2))
    return next(free for free in chain([name], numbered) if free not in taken)


def levels_in(name: str) -> list[str]:
    """Return the levels in the name of a condition; brackets, of a tuple or an agent, hold one together."""
    levels: list[str] = []
    depth = 0
    for part in name.split(BETWEEN):
        if depth:
            levels[-1] += BETWEEN + part
        else:
            levels.append(part)
        depth = max(0, depth + sum((sign in "([{") - (sign in ")]}") for sign in part))
    return levels


def level_text(value: Any) -> str:
    """Return a level in a few words, for names and figures: a dataclass by its class and its first field that
    is no switch, if that says more, e.g. "Learning(DQN)", "MLP((8, 8))"."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple):
        return f"({', '.join(map(level_text, value))})"
    if not is_dataclass(value) or isinstance(value, type):
        return value if isinstance(value, str) else shown(value)
    kind = type(value).__name__
    values = (getattr(value, part.name) for part in fields(value))
    first = next((part for part in values if not isinstance(part, bool)), "")
    inner = type(first).__name__ if is_dataclass(first) else level_text(first)
    says_no_more = first is None or not inner or inner.startswith(kind)  # as DQNSettings of DQN
    return kind if says_no_more else f"{kind}({inner})"


def short_names(factors: Iterable[str]) -> dict[str, str]:
    """Return the last word of each path, or the whole path where it is a number or several share it."""
    last = {path: path.rpartition(".")[2] for path in factors}
    words = list(last.values())
    return {path: path if word.isdigit() or words.count(word) > 1 else word for path, word in last.items()}


FILE_NAME: Final = "study.json"
RUNS, STATUS = "runs", "status"
"""Folders of a study's directory."""


def directory_of(study: Study, out: Path | str | None) -> Path:
    """Return the directory of a study, by default `studies/<name>`."""
    directory = Path("studies") / study.name if out is None else Path(out)
    allowed = "a new directory, or the directory of an earlier study"
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"out is {directory}, a file; allowed: {allowed}")
    if (directory / RECIPE_FILE).exists():
        raise ValueError(f"out is {directory}, the directory of a run; allowed: {allowed}")
    return directory


def read_study(out: Path | str) -> Study:
    """Return the study of a directory."""
    path = Path(out) / FILE_NAME
    try:
        table = read_json(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is not the file of a study: {error!r}") from error
    return Study.from_config(table, directory=out)
