"""The choice of an engine for "auto": a short training runs eagerly, a long one compiled.

What agents act and learn by compiles for about as long as some thousand uncompiled updates take. The
experiment alone decides, so that it has the same numbers on every machine, whatever its caches hold; and
neither its seed nor its number of replicas, so that a replica has the numbers that it has beside others.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from cprl.algorithms.base import TrainingEngine
from cprl.population import Learning, Team
from cprl.runs.recipe import RECIPE_FILE, read_recipe, recipe_config
from cprl.values import custom_targets, from_config, is_value, to_config, trusting

if TYPE_CHECKING:
    from cprl.experiment.experiment import Experiment

Engine = Literal["auto", "compiled", "eager", "torchrl"]
FEWEST_COMPILED: Final = 5_000
"""The fewest updates of a training that is compiled; see docs/performance.md ("The first start")."""
TURNS_PER_UPDATE: Final = 10
"""Turns that count as one update, since acting is compiled too."""
EPISODE_STEPS: Final = 100
"""The assumed steps of an episode in a game without a clock."""


def planned_steps(experiment: "Experiment") -> int:
    """Return the steps of each replica, if no episode ends early."""
    length = experiment.length
    return length.number if length.is_of_steps else length.number * (length.clock or EPISODE_STEPS)


def planned_turns(experiment: "Experiment") -> int:
    """Return the turns of each world, if no episode ends early."""
    return planned_steps(experiment) // experiment.worlds


def planned_updates(experiment: "Experiment") -> int:
    """Return the updates of each replica, for the agents with the most, if no episode ends early."""
    steps = planned_steps(experiment)
    algorithms: list[Any] = []
    for spec in experiment.agents:
        if isinstance(spec, Learning | Team) and spec.algorithm not in algorithms:
            algorithms.append(spec.algorithm)
    return max((_updates_by(algorithm, steps, experiment.worlds) for algorithm in algorithms), default=0)


def _updates_by(algorithm: Any, steps: int, worlds: int) -> int:
    """Return the updates in `steps` steps of a replica; one in each turn if the settings do not say."""
    settings = _settings_of(algorithm)
    if not hasattr(settings, "updates_in"):
        return steps // worlds
    updates: int = settings.updates_in(steps, worlds=worlds)
    return updates


def _settings_of(algorithm: Any) -> Any:
    """Return the settings of an algorithm as its recipe holds them, so that a custom one has the same before
    and after it is stored; None without settings of cprl."""
    table = to_config(algorithm)
    if table["kind"] != "Custom":
        return getattr(algorithm, "settings", None)
    settings = table["arguments"].get("settings")
    if not is_value(settings):
        return None
    try:
        with trusting(custom_targets(settings)):
            return from_config(settings)
    except ValueError:  # refused when the algorithm is made
        return None


def engine_of(experiment: "Experiment") -> TrainingEngine:
    """Return the engine that trains an experiment; for "auto" the one that finishes sooner."""
    if experiment.engine != "auto":
        return experiment.engine
    updates = planned_updates(experiment)
    is_long = updates > 0 and updates + planned_turns(experiment) // TURNS_PER_UPDATE >= FEWEST_COMPILED
    return "compiled" if is_long else "eager"


def about_engine(experiment: "Experiment") -> str:
    """Return a sentence about the engine that "auto" chose for agents that learn, and why."""
    updates = planned_updates(experiment)
    length = experiment.length
    has_no_clock = length.clock is None and not length.is_of_steps
    if_so_long = f", if each episode has {EPISODE_STEPS} turns," if has_no_clock else ""
    turns = f"{planned_turns(experiment):,} turns{if_so_long}"
    to_come = f"about {updates:,} updates of each replica in {turns} are to come"
    if engine_of(experiment) == "compiled":
        return f"Compiles what agents act and learn by: {to_come}."
    return (
        f'Trains uncompiled: {to_come}, which take less time than compiling does. engine="compiled" compiles.'
    )


def begun_with(run: Path) -> TrainingEngine | None:
    """Return the engine with which a run was begun; None without a run."""
    if not (run / RECIPE_FILE).exists():
        return None
    return recipe_config(read_recipe(run)).get("engine")
