"""Tables of any runs at hand, grouped by the values that fields of their experiments have."""

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, Final

from cprl.arguments import refusal
from cprl.experiment import Experiment
from cprl.runs.recipe import read_recipe, runs_in
from cprl.studies.factors import ALL, normalised, values_at
from cprl.studies.study import UNNAMED, Condition, named, short_names
from cprl.studies.tables.sources import REASONS, Design, Lacking, Source, plain_level
from cprl.studies.tables.table import WINDOW, StudyTable, table_of
from cprl.studies.trials import state_of
from cprl.values import differences, to_config

_MOST_NAMED: Final = 5
_NOT_COMPARED: Final = (*UNNAMED, "evaluation_episodes")


def pooled_table(
    runs: Sequence[Path | str],
    *,
    by: Sequence[str],
    window: int = WINDOW,
    reference: str | None = None,
    allow: Sequence[str] = (),
) -> StudyTable:
    """The table of any runs. Runs with the same values are pooled: their replicas count together.

    Replicas are numbered by the seeds of their runs, so that the same number in two conditions has the same
    seed; where all conditions have the same seeds, they are paired.

    Args:
        runs: directories of runs, or of directories that hold them; results that `cprl export` made too.
        by: paths of fields of an experiment, see `cprl.studies.factors`, e.g. "game.rules.freeze_steps"; a
            path with `*` stands for all values there, "name" for what the run's recipe is called.
        allow: the user's own code, "module:Class", that a run's recipe may name.
    """
    fields = [normalised(own) for own in by]
    for own in fields:
        if own in ("seed", "replicas") or fields.count(own) > 1:
            raise refusal("by", own, "other fields than seed and replicas, each once")
    paths = runs_in(runs)
    experiments = {run: Experiment.from_recipe(read_recipe(run), allow=allow, directory=run) for run in paths}
    groups = _groups(experiments, fields)
    for name, (_, members) in groups.items():
        _refuse_seeds_twice(name, {run: experiments[run] for run in members})
    if reference is not None and reference not in groups:
        raise refusal("reference", reference, f"the name of a condition: {', '.join(list(groups)[:10])}")
    firsts = _numbers(experiments.values())
    sources, lacking = [], []
    for name, (_, members) in groups.items():
        for run in members:
            experiment, state = experiments[run], state_of(run)
            if state != "finished":
                replicas = experiment.replicas
                lacking.append(
                    Lacking(name=str(run), condition=name, replicas=replicas, reason=REASONS[state])
                )
                continue
            sources.append(
                Source(
                    run=run,
                    name=str(run),
                    condition=name,
                    checksum=Condition(experiment).checksum,
                    first=firsts[experiment.seed],
                    replicas=experiment.replicas,
                    episodes=experiment.episodes,
                )
            )
    design = Design(
        name=f"{len(paths)} runs by {', '.join(fields)}",
        conditions={name: levels for name, (levels, _) in groups.items()},
        reference=next(iter(groups)) if reference is None else reference,
        is_paired=len({frozenset(experiments[run].seed for run in members) for _, members in groups.values()})
        == 1,
        notes=tuple(
            _notes(
                {name: [experiments[run] for run in members] for name, (_, members) in groups.items()}, fields
            )
        ),
    )
    return table_of(design, sources, lacking, window=window)


def _groups(
    experiments: Mapping[Path, Experiment], fields: Sequence[str]
) -> dict[str, tuple[dict[str, Any], list[Path]]]:
    """The levels and runs of each condition by its name; in the order of numbers, else of the runs."""
    found: dict[str, tuple[list[Any], list[Path]]] = {}
    for run, experiment in experiments.items():
        values = [_value_at(experiment, own, run) for own in fields]
        key = json.dumps([to_config(own, name) for own, name in zip(values, fields, strict=True)])
        found.setdefault(key, (values, []))[1].append(run)
    short = short_names(fields)
    groups: dict[str, tuple[dict[str, Any], list[Path]]] = {}
    for values, runs in sorted(found.values(), key=lambda own: [_rank(value) for value in own[0]]):
        levels = {name: plain_level(own) for name, own in zip(fields, values, strict=True)}
        name = named({short[own]: level for own, level in levels.items()})
        alike = sum(own == name or own.startswith(f"{name} (") for own in groups)
        groups[f"{name} ({alike + 1})" if alike else name] = levels, runs
    return groups


def _value_at(experiment: Experiment, path: str, run: Path) -> Any:
    """The value of a field of a run; of several places all of them, if they differ."""
    try:
        values = values_at(experiment, path)
    except ValueError as error:
        raise ValueError(f"{run}: {error}") from error
    return values[0] if all(own == values[0] for own in values) else tuple(values)


def _rank(value: Any) -> tuple[int, float]:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return (0, float(value)) if is_number else (1, 0.0)


def _refuse_seeds_twice(name: str, experiments: Mapping[Path, Experiment]) -> None:
    """Raises a ValueError where a condition would count a replica twice."""
    for (one, first), (other, second) in combinations(experiments.items(), 2):
        if first.seed == second.seed:
            places = _differ(first, second)
            why = f"they differ in {_some(places)}" if places else "they are the same experiment"
            raise ValueError(
                f"{one} and {other} have the same seed, {first.seed}, and both {name}, which would count "
                f"replicas twice; {why}; allowed: each seed once in a condition, or another field in by"
            )


def _numbers(experiments: Iterable[Experiment]) -> dict[int, int]:
    """The number of the first replica of each seed."""
    most: dict[int, int] = {}
    for own in experiments:
        most[own.seed] = max(most.get(own.seed, 0), own.replicas)
    firsts, total = {}, 0
    for seed in sorted(most):
        firsts[seed] = total
        total += most[seed]
    return firsts


def _notes(groups: Mapping[str, list[Experiment]], fields: Sequence[str]) -> Iterable[str]:
    """What runs of one condition, and the conditions themselves, differ in beside the fields asked for."""
    for name, own in groups.items():
        places = sorted({place for other in own[1:] for place in _differ(own[0], other)})
        if places:
            yield f"The runs pooled as {name} also differ in {_some(places)}."
    firsts = [own[0] for own in groups.values()]
    more = {place for other in firsts[1:] for place in _differ(firsts[0], other)}
    places = sorted(place for place in more if not any(_is_within(place, own) for own in fields))
    if places:
        yield f"The conditions also differ in {_some(places)}."


def _differ(one: Experiment, other: Experiment) -> list[str]:
    """The places in which two experiments differ, as paths, without what is no condition."""
    before, now = (
        {name: own for name, own in each.to_config().items() if name not in _NOT_COMPARED}
        for each in (one, other)
    )
    lines = differences(before, now, "")
    return [line.partition(" was ")[0].lstrip(".").replace("[", ".").replace("]", "") for line in lines]


def _is_within(place: str, field: str) -> bool:
    """Whether a place is that of a field, or within its value."""
    parts, wanted = place.split("."), field.split(".")
    return len(parts) >= len(wanted) and all(
        own in (ALL, part) for own, part in zip(wanted, parts, strict=False)
    )


def _some(places: Sequence[str]) -> str:
    more = f" and {len(places) - _MOST_NAMED} more" if len(places) > _MOST_NAMED else ""
    return f"{', '.join(places[:_MOST_NAMED])}{more}"
