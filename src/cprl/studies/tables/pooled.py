"""Tables of any runs at hand, grouped by the values that fields of their experiments have."""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate, combinations
from pathlib import Path
from typing import Any, Final

from cprl.experiment import Experiment
from cprl.population import has_people, learned, specs_by_agent
from cprl.runs.played import absence
from cprl.runs.recipe import read_recipe, runs_in
from cprl.runs.states import SESSION, state_of
from cprl.studies.factors import ALL, normalised, values_at
from cprl.studies.study import NOT_IN_CHECKSUM, Condition, condition_name, unique_name
from cprl.studies.tables.sources import RunSource, clocks_of, plain_level, reason_missing, table_of_sources
from cprl.studies.tables.tidy_table import StudyDesign, StudyTable, abbreviated
from cprl.system.defaults import WINDOW_EPISODES
from cprl.values import describe_changes, is_number, refusal, to_config

_MOST_NAMED: Final = 5
_AGENTS: Final = "agents"
_NOT_COMPARED: Final = (*NOT_IN_CHECKSUM, "evaluation_episodes")

Experiments = Mapping[Path, Experiment]


def pooled_table(
    runs: Sequence[Path | str],
    *,
    by: Sequence[str],
    window: int = WINDOW_EPISODES,
    reference: str | None = None,
) -> StudyTable:
    """Return the table of any runs, grouped into conditions by some fields of their experiments.

    Runs with the same values of these fields form one condition, and their replicas are pooled. Replicas are
    numbered by the seeds of their runs, so that replicas with the same number have the same seed; groups of
    people by their session, whose rounds in a condition are episodes of the same group. They are paired if
    all conditions have the same seeds, or sessions. People and trained agents are never pooled: where some
    runs are of people and some not, their agents are a field too.

    Args:
        runs: directories of runs, or of directories that hold them; results that `cprl export` made too.
        by: paths of fields of an experiment, see `cprl.studies.factors`, e.g. "game.rules.freeze_steps"; a
            path with `*` stands for all values there, "name" for what the run's recipe is called.

    Raises:
        ValueError: for a field that is no part of a condition, a seed twice in a condition, or an unknown
            reference.
    """
    fields = [normalised(path) for path in by]
    for path in fields:
        if path in ("seed", "replicas") or fields.count(path) > 1:
            raise refusal("by", path, "other fields than seed and replicas, each once")
    paths = runs_in(runs)
    experiments = {run: Experiment.from_recipe(read_recipe(run), directory=run) for run in paths}
    kinds = {has_people(experiment.agents) for experiment in experiments.values()}
    if len(kinds) > 1 and _AGENTS not in fields:
        fields.append(_AGENTS)
    conditions, groups = _groups(experiments, fields)
    for name, members in groups.items():
        _refuse_seeds_twice(name, members)
    if reference is not None and reference not in groups:
        raise refusal("reference", reference, f"the name of a condition: {', '.join(list(groups)[:10])}")
    origins = {run: _origin(run, experiment) for run, experiment in experiments.items()}
    firsts = _firsts(experiments, origins)
    sources = []
    paired = set()
    for name, members in groups.items():
        paired.add(frozenset(origins[run] for run in members))
        for run, experiment in members.items():
            source = RunSource(
                run=run,
                name=str(run),
                condition=name,
                checksum=Condition(experiment).checksum_in(run.parent),
                first=firsts[origins[run]],
                experiment=experiment,
                reason=reason_missing(state_of(run)),
            )
            sources.append(source)
    design = StudyDesign(
        name=f"{len(paths)} runs by {', '.join(fields)}",
        conditions=conditions,
        reference=next(iter(groups)) if reference is None else reference,
        is_paired=len(paired) == 1,
        notes=(*_notes(groups, fields), *_absences(experiments)),
        clocks=clocks_of({name: members.values() for name, members in groups.items()}),
    )
    return table_of_sources(design, sources, window=window)


def _groups(
    experiments: Experiments, fields: Sequence[str]
) -> tuple[dict[str, dict[str, Any]], dict[str, dict[Path, Experiment]]]:
    """Return the levels and the runs of each condition, by its name; ordered by numeric levels."""
    by_values: dict[str, tuple[list[Any], dict[Path, Experiment]]] = {}
    for run, experiment in experiments.items():
        values = [_value_at(experiment, path, run) for path in fields]
        key = json.dumps([to_config(value, path) for value, path in zip(values, fields, strict=True)])
        by_values.setdefault(key, (values, {}))[1][run] = experiment
    conditions: dict[str, Any] = {}
    groups: dict[str, Any] = {}
    for values, members in sorted(by_values.values(), key=lambda group: list(map(_rank, group[0]))):
        levels = {path: plain_level(value) for path, value in zip(fields, values, strict=True)}
        if _AGENTS in levels:
            first: Any = next(iter(members.values()))
            levels[_AGENTS] = learned(specs_by_agent(first.agents, first.game.agents))
        name = unique_name(condition_name(levels), groups)
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
    return (0, float(value)) if is_number(value) else (1, 0.0)


def _refuse_seeds_twice(name: str, experiments: Experiments) -> None:
    """Refuse runs of one condition with the same seed, which would count replicas twice."""
    for (run, experiment), (other_run, other) in combinations(experiments.items(), 2):
        if experiment.seed == other.seed and not has_people(experiment.agents):
            places = _differing_fields(experiment, other)
            why = "they are the same experiment"
            if places:
                why = f"they differ in {abbreviated(places, _MOST_NAMED)}"
            raise ValueError(
                f"{run} and {other_run} have the same seed, {experiment.seed}, and both {name}, which would "
                f"count replicas twice; {why}; allowed: each seed once in a condition, or another field in by"
            )


def _origin(run: Path, experiment: Experiment) -> tuple[int, str]:
    """Return what runs share whose replicas of the same number belong together: the seed, or of people the
    session."""
    if not has_people(experiment.agents):
        return experiment.seed, ""
    return 0, str(read_recipe(run).get(SESSION, run.resolve()))


def _firsts(experiments: Experiments, origins: Mapping[Path, Any]) -> dict[Any, int]:
    """Return the number of the first replica of each origin."""
    most: dict[Any, int] = {}
    for run, experiment in experiments.items():
        most[origins[run]] = max(most.get(origins[run], 0), experiment.replicas)
    in_order = sorted(most)
    return dict(zip(in_order, accumulate((most[origin] for origin in in_order), initial=0), strict=False))


def _notes(groups: Mapping[str, Experiments], fields: Sequence[str]) -> Iterator[str]:
    """Yield warnings of other fields in which the runs of a condition, or the conditions, differ."""
    firsts = []
    for name, members in groups.items():
        first, *others = members.values()
        firsts.append(first)
        places = sorted({place for other in others for place in _differing_fields(first, other)})
        if places:
            yield f"The runs pooled as {name} also differ in {abbreviated(places, _MOST_NAMED)}."
    more = {place for other in firsts[1:] for place in _differing_fields(firsts[0], other)}
    places = sorted(place for place in more if not _is_within(place, fields))
    if places:
        yield f"The conditions also differ in {abbreviated(places, _MOST_NAMED)}."


def _absences(experiments: Experiments) -> Iterator[str]:
    """Yield a sentence for each run in which nobody was there to act for an agent of a person."""
    for run, experiment in experiments.items():
        sentence = absence(run) if has_people(experiment.agents) else ""
        if sentence:
            yield f"{run}: {sentence}"


def _differing_fields(first: Experiment, second: Experiment) -> list[str]:
    """Return the paths in which two experiments differ, without fields that are part of no condition."""
    before = first.to_config()
    now = second.to_config()
    for name in _NOT_COMPARED:
        before[name] = now[name]
    lines = describe_changes(before, now, "")
    return [line.partition(" was ")[0].lstrip(".").replace("[", ".").replace("]", "") for line in lines]


def _is_within(place: str, paths: Sequence[str]) -> bool:
    """Return whether a place lies at, or within, one of the paths."""
    names = place.split(".")
    for path in paths:
        parts = path.split(".")
        matches = [part in (ALL, name) for part, name in zip(parts, names, strict=False)]
        if len(matches) == len(parts) and all(matches):
            return True
    return False
