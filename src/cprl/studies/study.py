"""Study: one experiment under several conditions, each repeated by the same replicas; a value."""

import hashlib
import json
import os
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property, partial
from itertools import chain, count
from pathlib import Path
from typing import Any, Final

from cprl.arguments import BLOCK, integer, refusal
from cprl.checks import DIRECTORY_NAME, TEXT, checked, instance, shown
from cprl.experiment import MOST_SEED, Experiment, frozen_from, frozen_relative_to
from cprl.population import stored_of
from cprl.runs.files import STUDY_FORMAT, read_json, refuse_newer, write_json
from cprl.runs.recipe import RECIPE_FILE
from cprl.studies.factors import (
    MOST_CONDITIONS,
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
from cprl.values import without_defaults

_TRIES: Final = 20
"""Draws for each one that is kept, at most."""
SEEDS_APART: Final = 1000
"""Between the seeds of two blocks of replicas; evaluation plays worlds of the next seed."""


CONDITION_FORMAT: Final = 1
"""Of checksums: counted up when a default of any value of `cprl.values.KINDS`, or of `Experiment`, changes,
so that the same checksum never means two things."""


UNNAMED: Final = ("name", "seed", "replicas", "on_nan")
"""Fields of an experiment that its checksum leaves out: what it is called, which repetitions of it a run
holds, and what happens where a number is not finite."""


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
        table = {name: own for name, own in self.experiment.to_config().items() if name not in UNNAMED}
        kept = {"format": CONDITION_FORMAT, "experiment": without_defaults(table, Experiment)}
        return hashlib.blake2b(json.dumps(kept, sort_keys=True).encode(), digest_size=6).hexdigest()


def experiment_at(experiment: Experiment, levels: Mapping[str, Level]) -> Experiment:
    """An experiment with what a level of each factor changes."""
    changes = {path: value for own in levels.values() for path, value in own.changes.items()}
    twice = sum(len(own.changes) for own in levels.values()) - len(changes)
    if twice:
        raise ValueError(f"two factors change the same field, of {', '.join(changes)}; allowed: one each")
    refused = [path for path in changes if path in ("seed", "replicas", "name")]
    if refused:
        raise ValueError(f"a factor is {refused[0]}, which the study itself decides; allowed: other fields")
    return changed(experiment, changes) if changes else experiment


def apart(conditions: Iterable[Condition]) -> tuple[Condition, ...]:
    """Conditions with a number after their name where others have the same, e.g. of unlike agents."""
    conditions = tuple(conditions)
    taken = {own.name for own in conditions}
    found: dict[str, Condition] = {}
    for own in conditions:
        name = unlike(own.name, taken) if own.name in found else own.name
        taken.add(name)
        found[name] = own if name == own.name else replace(own, name=name)
    return tuple(found.values())


@dataclass(frozen=True, eq=False)
class Study:
    """One experiment under several conditions: a grid, random draws, or named conditions.

    Args:
        experiment: what every condition is, but for what it changes.
        factors: by the path of a field (see `cprl.studies.factors`), its values; or by a name of your own, a
            table of levels, each a table of values by path; or a distribution, with `draws`.
        conditions: named ones instead of factors, each a table of values by path; `{}` changes nothing.
        draws: so many random combinations of the factors' levels instead of their grid.
        replicas: of each condition; by default those of the experiment.
        block: replicas that one run trains side by side; fewer can be spread over more processes.
        reference: the name of the condition that others are compared with; by default the first one that
            changes nothing, else the first.
        name: by default that of the experiment.
        question: what the study asks, for its report.
        expectation: what was expected before it was run, for its report.
    """

    experiment: Experiment
    factors: Mapping[str, Factor] = field(default_factory=dict)
    conditions: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, kw_only=True)
    draws: int | None = field(default=None, kw_only=True)
    replicas: int | None = field(default=None, kw_only=True)
    block: int = field(default=BLOCK, kw_only=True)
    reference: str | None = field(default=None, kw_only=True)
    name: str = field(default="", kw_only=True)
    question: str = field(default="", kw_only=True)
    expectation: str = field(default="", kw_only=True)

    def __repr__(self) -> str:
        return (
            f"Study({self.name!r}, {len(self.all_conditions)} conditions, {self.replicas} replicas of each)"
        )

    def __post_init__(self) -> None:
        checked("experiment", self.experiment, instance(Experiment, "an Experiment"))
        keep = object.__setattr__
        keep(self, "factors", checked_factors(self.factors))
        keep(self, "conditions", _checked_conditions(self.conditions))
        keep(self, "replicas", self.experiment.replicas if self.replicas is None else self.replicas)
        keep(self, "name", self.name or self.experiment.name)
        checked("name", self.name, DIRECTORY_NAME)
        integer("replicas", self.replicas, 1, 2**20)
        integer("block", self.block, 1, 2**20)
        for own in ("question", "expectation"):
            checked(own, getattr(self, own), TEXT)
        if self.factors and self.conditions:
            raise ValueError("a study has factors and conditions; allowed: one of them")
        if self.draws is not None:
            integer("draws", self.draws, 1, MOST_CONDITIONS)
            if not self.factors:
                raise ValueError("draws is given without factors; allowed: factors to draw from")
        if self.blocks[-1].seed > MOST_SEED:
            raise ValueError(f"the experiment's seed is {self.experiment.seed}; allowed: a lower one")
        if self.reference_name not in [own.name for own in self.all_conditions]:
            names = ", ".join(own.name for own in self.all_conditions[:10])
            raise refusal("reference", self.reference, f"the name of a condition: {names}")
        for condition in self.all_conditions:
            self._check_stored(condition)
        self.to_config()  # refuses what `study.json` could not hold

    def _check_stored(self, condition: Condition) -> None:
        """Refuses stored agents that are named for another number of replicas than the study's."""
        for place, spec in enumerate(condition.experiment.agents):
            stored = stored_of(spec)
            theirs = None if stored is None else stored.replica
            if isinstance(theirs, tuple) and len(theirs) != self.replicas:
                where = f"agents.{place}" if stored is spec else f"agents.{place}.start_from"
                raise ValueError(
                    f"{where}.replica of condition {condition.name!r} is {shown(theirs)}, of {len(theirs)} "
                    f"numbers; allowed: {self.replicas} of them, one for each replica of the study; one "
                    "number for all; or None"
                )

    @cached_property
    def all_conditions(self) -> tuple[Condition, ...]:
        """Every condition, in order, each once."""
        by_sum: dict[str, Condition] = {}
        for name, levels in self._levels():
            changed_to = experiment_at(self.experiment, levels)
            own = Condition(changed_to, {factor: at.value for factor, at in levels.items()}, name)
            if (other := by_sum.setdefault(own.checksum, own)) is not own and self.draws is None:
                raise ValueError(f"conditions {other.name!r} and {name!r} are equal; allowed: each once")
            if len(by_sum) == self.draws:
                break
        if self.draws is not None and len(by_sum) < self.draws:
            raise ValueError(
                f"draws is {self.draws}; the factors have no more than {len(by_sum)} combinations that differ"
            )
        return apart(by_sum.values())

    @cached_property
    def blocks(self) -> tuple["Block", ...]:
        """The blocks of replicas of each condition, in order."""
        assert self.replicas is not None
        firsts = range(0, self.replicas, self.block)
        return tuple(
            Block(
                first=first,
                replicas=min(self.block, self.replicas - first),
                seed=self.experiment.seed + SEEDS_APART * nth,
            )
            for nth, first in enumerate(firsts)
        )

    @property
    def reference_name(self) -> str:
        """The name of the condition that others are compared with."""
        if self.reference is not None:
            return self.reference
        same = Condition(self.experiment).checksum
        unchanged = [own.name for own in self.all_conditions if own.checksum == same]
        return unchanged[0] if unchanged else self.all_conditions[0].name

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the factors; of named conditions "condition" alone."""
        return tuple(self.factors) if self.factors else (CONDITION,)

    def _levels(self) -> Iterator[tuple[str, dict[str, Level]]]:
        """The name and levels of each condition; of draws more than are asked for, as some may be equal."""
        if self.conditions:
            yield from ((name, {CONDITION: Level(name, own)}) for name, own in self.conditions.items())
        elif not self.factors:
            yield UNCHANGED, {CONDITION: Level(UNCHANGED, {})}
        else:
            short = short_names(self.factors)
            for levels in self._combinations():
                yield named({short[own]: at.value for own, at in levels.items()}), levels

    def _combinations(self) -> Iterable[dict[str, Level]]:
        if self.draws is not None:
            seed = self.experiment.seed
            return (drawn(self.factors, seed=seed, nth=nth) for nth in range(_TRIES * self.draws))
        every = list(grid(self.factors))
        if len(every) > MOST_CONDITIONS:
            raise ValueError(f"a study has {len(every):,} conditions; allowed: up to {MOST_CONDITIONS:,}")
        return every

    def to_config(self, directory: str | Path | None = None) -> dict[str, Any]:
        """The study as JSON can hold it.

        Args:
            directory: where it is kept: runs of `Frozen` agents are then given relative to it.
        """
        place = _no_change if directory is None else partial(os.path.relpath, start=directory)
        stored = self.experiment if directory is None else frozen_relative_to(self.experiment, directory)
        return {
            "format": STUDY_FORMAT,
            "experiment": stored.to_config(),
            "factors": [[name, factor_to_config(name, own, place)] for name, own in self.factors.items()],
            "conditions": [[name, changes_to_config(own, place)] for name, own in self.conditions.items()],
            **{own: getattr(self, own) for own in _PLAIN},
        }

    @classmethod
    def from_config(
        cls, table: Mapping[str, Any], *, allow: Iterable[str] = (), directory: str | Path | None = None
    ) -> "Study":
        """The study that `to_config` gave.

        Args:
            allow: the targets of `Custom` that it may hold, "module:Class" each.
            directory: where it is kept; runs of `Frozen` agents are then relative to where we stand.
        """
        refuse_newer("the study", table, STUDY_FORMAT)
        lacks = [name for name in ("experiment", "factors", "conditions", *_PLAIN) if name not in table]
        if table.get("format") != STUDY_FORMAT or lacks:
            raise ValueError(
                f"the study has the format {shown(table.get('format'))}"
                f"{' and lacks ' + ', '.join(lacks) if lacks else ''}; allowed: {STUDY_FORMAT}, complete"
            )
        if table.get("pairing") is False:
            raise ValueError("the study has pairing false; allowed: true")
        allow = tuple(allow)
        place = _no_change if directory is None else partial(_joined, str(directory))
        experiment = Experiment.from_config(table["experiment"], allow=allow)
        try:
            factors = {name: factor_from_config(name, own, allow, place) for name, own in table["factors"]}
            named = {name: changes_from_config(own, allow, place) for name, own in table["conditions"]}
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"the study has no factors and conditions that it could have: {error!r}"
            ) from error
        return cls(
            experiment if directory is None else frozen_from(experiment, directory),
            factors,
            conditions=named,
            **{own: table[own] for own in _PLAIN},
        )

    def __eq__(self, other: object) -> bool:
        return self.to_config() == other.to_config() if isinstance(other, Study) else NotImplemented

    def __hash__(self) -> int:
        return hash((self.name, self.replicas, self.block))


@dataclass(frozen=True, kw_only=True)
class Block:
    """Replicas of a condition that one run trains side by side."""

    first: int
    """The number of the first one in the study."""
    replicas: int
    seed: int
    """Of the run."""


_PLAIN: Final = (*("name", "question", "expectation"), *("draws", "replicas", "block", "reference"))
"""Fields that JSON can hold as they are."""
CONDITION: Final = "condition"
"""The column of named conditions."""
UNCHANGED: Final = "unchanged"
"""The one condition of a study without factors."""


def _no_change(run: str) -> str:
    return run


def _joined(directory: str, run: str) -> str:
    return os.path.relpath(os.path.join(directory, run))


def _checked_conditions(conditions: object) -> dict[str, dict[str, Any]]:
    allowed = "a table of conditions by name, each a table of values by path"
    if not isinstance(conditions, Mapping):
        raise refusal("conditions", conditions, allowed)
    for name, own in conditions.items():
        if not isinstance(name, str) or not name or not isinstance(own, Mapping):
            raise refusal(f"conditions[{name!r}]", own, allowed)
    return {name: dict(own) for name, own in conditions.items()}


BETWEEN = ", "
"""Between the levels in the name of a condition."""


def named(levels: Mapping[str, Any]) -> str:
    """The name of a condition, e.g. "freeze_steps=5, gamma=0.9"."""
    return BETWEEN.join(f"{name}={level_text(value)}" for name, value in levels.items())


def unlike(name: str, taken: Container[str]) -> str:
    """A name; with the lowest number from 2 on that is free where it is taken."""
    numbered = (f"{name} #{nth}" for nth in count(2))
    return next(own for own in chain([name], numbered) if own not in taken)


def levels_in(name: str) -> list[str]:
    """The levels in the name of a condition; those of a tuple or an agent, in brackets, are not apart."""
    found: list[str] = []
    depth = 0
    for part in name.split(BETWEEN):
        if depth:
            found[-1] += BETWEEN + part
        else:
            found.append(part)
        depth = max(0, depth + sum((own in "([{") - (own in ")]}") for own in part))
    return found


def level_text(value: Any) -> str:
    """A level in a few words, for names and figures."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple):
        return f"({', '.join(map(level_text, value))})"
    if is_dataclass(value) and not isinstance(value, type):
        return _value_text(value)
    return value if isinstance(value, str) else shown(value)


def _value_text(value: Any) -> str:
    """A dataclass by its class and its first field that is no switch, if that says more: "Learning(DQN)",
    "MLP((8, 8))"."""
    kind = type(value).__name__
    each = (getattr(value, own.name) for own in fields(value))
    first = next((own for own in each if not isinstance(own, bool)), "")
    inner = type(first).__name__ if is_dataclass(first) else level_text(first)
    says_no_more = first is None or not inner or inner.startswith(kind)  # as DQNSettings of DQN
    return kind if says_no_more else f"{kind}({inner})"


def short_names(factors: Iterable[str]) -> dict[str, str]:
    """The last word of each path, or the whole path where it is a number or several factors share it."""
    last = {own: own.rpartition(".")[2] for own in factors}
    shared = {word for word in last.values() if word.isdigit() or list(last.values()).count(word) > 1}
    return {own: own if word in shared else word for own, word in last.items()}


FILE_NAME: Final = "study.json"
RUNS, STATUS = "runs", "status"
"""Folders of a study's directory."""


def directory_of(study: Study, out: Path | str | None) -> Path:
    """The directory of a study, by default `studies/<name>`."""
    found = Path("studies") / study.name if out is None else Path(out)
    allowed = "a new directory, or that of an earlier study"
    if found.exists() and not found.is_dir():
        raise ValueError(f"out is {found}, a file; allowed: {allowed}")
    if (found / RECIPE_FILE).exists():
        raise ValueError(f"out is {found}, the directory of a run; allowed: {allowed}")
    return found


def write_study(study: Study, out: Path) -> None:
    """Writes what a study is into its directory."""
    write_json(out / FILE_NAME, study.to_config(out))


def read_study(out: Path | str, *, allow: Sequence[str] = ()) -> Study:
    """The study of a directory.

    Args:
        allow: the user's own code, "module:Class", that it may import.
    """
    out = Path(out)
    try:
        table = read_json(out / FILE_NAME)
    except (OSError, ValueError) as error:
        raise ValueError(f"{out / FILE_NAME} is not the file of a study: {error!r}") from error
    return Study.from_config(table, allow=allow, directory=out)
