"""Tables of any runs at hand, grouped by the values that fields of their experiments have."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate, combinations
from pathlib import Path
from typing import Any, Final

from cprl.experiment import Experiment
from cprl.runs.recipe import read_recipe, runs_in
from cprl.runs.states import state_of
from cprl.studies.factors import ALL, normalised, values_at
from cprl.studies.study import UNNAMED, Condition, named, short_names, unlike
from cprl.studies.tables.sources import Source, clocks_of, plain_level, reason_of, table_of
from cprl.studies.tables.table import WINDOW, Design, StudyTable, some
from cprl.values import differences, refusal, to_config

_MOST_NAMED: Final = 5
_NOT_COMPARED: Final = (*UNNAMED, "evaluation_episodes")

Experiments = Mapping[Path, Experiment]


def pooled_table(
    runs: Sequence[Path | str],
    *,
    by: Sequence[str],
    window: int = WINDOW,
    reference: str | None = None,
) -> StudyTable:
    """Return the table of any runs. Runs with the same values are pooled: their replicas count together.

    Replicas are numbered by the seeds of their runs, so that the same number in two conditions has the same
    seed; where all conditions have the same seeds, they are paired.

    Args:
        runs: directories of runs, or of directories that hold them; results that `cprl export` made too.
        by: paths of fields of an experiment, see `cprl.studies.factors`, e.g. "game.rules.freeze_steps"; a
            path with `*` stands for all values there, "name" for what the run's recipe is called.
    """
    fields = [normalised(path) for path in by]
    for path in fields:
        if path in ("seed", "replicas") or fields.count(path) > 1:
            raise refusal("by", path, "other fields than seed and replicas, each once")
    paths = runs_in(runs)
    experiments = {run: Experiment.from_recipe(read_recipe(run), directory=run) for run in paths}
    conditions, groups = _groups(experiments, fields)
    for name, members in groups.items():
        _refuse_seeds_twice(name, members)
    if reference is not None and reference not in groups:
        raise refusal("reference", reference, f"the name of a condition: {', '.join(list(groups)[:10])}")
    firsts = _firsts(experiments.values())
    sources = [
        Source(
            run=run,
            name=str(run),
            condition=name,
            checksum=Condition(experiment).checksum_in(run.parent),
            first=firsts[experiment.seed],
            experiment=experiment,
            reason=reason_of(state_of(run)),
        )
        for name, members in groups.items()
        for run, experiment in members.items()
    ]
    seeds = {frozenset(experiment.seed for experiment in members.values()) for members in groups.values()}
    design = Design(
        name=f"{len(paths)} runs by {', '.join(fields)}",
        conditions=conditions,
        reference=next(iter(groups)) if reference is None else reference,
        is_paired=len(seeds) == 1,
        notes=tuple(_notes(groups, fields)),
        clocks=clocks_of({name: members.values() for name, members in groups.items()}),
    )
    return table_of(design, sources, window=window)


def _groups(
    experiments: Experiments, fields: Sequence[str]
) -> tuple[dict[str, dict[str, Any]], dict[str, dict[Path, Experiment]]]:
    """Return the levels and the runs of each condition by its name; in the order of numbers, else of the
    runs."""
    by_values: dict[str, tuple[list[Any], dict[Path, Experiment]]] = {}
    for run, experiment in experiments.items():
        values = [_value_at(experiment, path, run) for path in fields]
        key = json.dumps([to_config(value, path) for value, path in zip(values, fields, strict=True)])
        by_values.setdefault(key, (values, {}))[1][run] = experiment
    short = short_names(fields)
    conditions: dict[str, Any] = {}
    groups: dict[str, Any] = {}
    for values, members in sorted(by_values.values(), key=lambda group: list(map(_rank, group[0]))):
        levels = {path: plain_level(value) for path, value in zip(fields, values, strict=True)}
        name = unlike(named({short[path]: level for path, level in levels.items()}), groups)
        conditions[name] = levels
        groups[name] = members
    return conditions, groups


def _value_at(experiment: Experiment, path: str, run: Path) -> Any:
    try:
        values = values_at(experiment, path)
    except ValueError as error:
        raise ValueError(f"{run}: {error}") from error
    return values[0] if all(value == values[0] for value in values) else tuple(values)


def _rank(value: Any) -> tuple[int, float]:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return (0, float(value)) if is_number else (1, 0.0)


def _refuse_seeds_twice(name: str, experiments: Experiments) -> None:
    for (one, first), (other, second) in combinations(experiments.items(), 2):
        if first.seed == second.seed:
            places = _places(first, second)
            why = f"they differ in {some(places, _MOST_NAMED)}" if places else "they are the same experiment"
            raise ValueError(
                f"{one} and {other} have the same seed, {first.seed}, and both {name}, which would count "
                f"replicas twice; {why}; allowed: each seed once in a condition, or another field in by"
            )


def _firsts(experiments: Iterable[Experiment]) -> dict[int, int]:
    most: dict[int, int] = {}
    for experiment in experiments:
        most[experiment.seed] = max(most.get(experiment.seed, 0), experiment.replicas)
    seeds = sorted(most)
    return dict(zip(seeds, accumulate((most[seed] for seed in seeds), initial=0), strict=False))


def _notes(groups: Mapping[str, Experiments], fields: Sequence[str]) -> Iterator[str]:
    """Return what runs of one condition, and the conditions themselves, differ in beside the fields asked
    for."""
    firsts = []
    for name, members in groups.items():
        first, *others = members.values()
        firsts.append(first)
        places = sorted({place for other in others for place in _places(first, other)})
        if places:
            yield f"The runs pooled as {name} also differ in {some(places, _MOST_NAMED)}."
    more = {place for other in firsts[1:] for place in _places(firsts[0], other)}
    places = sorted(place for place in more if not any(_is_within(place, path) for path in fields))
    if places:
        yield f"The conditions also differ in {some(places, _MOST_NAMED)}."


def _places(one: Experiment, other: Experiment) -> list[str]:
    """Return the places in which two experiments differ, as paths, without what is no condition."""
    before = one.to_config()
    now = other.to_config()
    for name in _NOT_COMPARED:
        before[name] = now[name]
    lines = differences(before, now, "")
    return [line.partition(" was ")[0].lstrip(".").replace("[", ".").replace("]", "") for line in lines]


def _is_within(place: str, path: str) -> bool:
    parts = place.split(".")
    wanted = path.split(".")
    matches = [part in (ALL, at) for part, at in zip(wanted, parts, strict=False)]
    return len(matches) == len(wanted) and all(matches)
