"""Which engine trains an experiment whose engine is "auto": a short training eagerly, a long one compiled.

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
"""Updates from which on a training is compiled; see docs/performance.md ("The first start")."""
TURNS_PER_UPDATE: Final = 10
"""Turns that count as an update, since what agents act by is compiled too."""
EPISODE_STEPS: Final = 100
"""Of an episode, where a game has no clock that says it."""


def steps_of(experiment: "Experiment") -> int:
    """Return how many steps each replica takes, if no episode ends early."""
    length = experiment.length
    return length.number if length.is_of_steps else length.number * (length.clock or EPISODE_STEPS)


def turns_of(experiment: "Experiment") -> int:
    """Return how many turns each world has, likewise."""
    return steps_of(experiment) // experiment.worlds


def updates_of(experiment: "Experiment") -> int:
    """Return how many updates each replica has, of the agents with the most, if no episode ends early."""
    steps = steps_of(experiment)
    learning = [spec.algorithm for spec in experiment.agents if isinstance(spec, Learning | Team)]
    return max((_updates_by(algorithm, steps, experiment.worlds) for algorithm in learning), default=0)


def _updates_by(algorithm: Any, steps: int, worlds: int) -> int:
    """Return the updates in so many steps of a replica; without settings that tell, the turns of a world."""
    settings = _settings_of(algorithm)
    if not hasattr(settings, "updates_in"):
        return steps // worlds
    updates: int = settings.updates_in(steps, worlds=worlds)
    return updates


def _settings_of(algorithm: Any) -> Any:
    """Return the settings that a recipe holds of an algorithm, so that one of the user's own has the same as
    a value and as the `Custom` that is read back; None without settings of cprl's."""
    table = to_config(algorithm)
    settings = table["arguments"] if table["kind"] == "Custom" else table
    settings = settings.get("settings")
    if not is_value(settings):
        return None
    try:
        with trusting(custom_targets(settings)):
            return from_config(settings)
    except ValueError:  # which making the algorithm refuses
        return None


def engine_of(experiment: "Experiment") -> TrainingEngine:
    """Return the engine that trains an experiment: its own, or of "auto" the one that is sooner done."""
    if experiment.engine != "auto":
        return experiment.engine
    updates = updates_of(experiment)
    is_long = updates > 0 and updates + turns_of(experiment) // TURNS_PER_UPDATE >= FEWEST_COMPILED
    return "compiled" if is_long else "eager"


def about_engine(experiment: "Experiment") -> str:
    """Return in a sentence which engine "auto" stands for in a training that begins, and why; "" where nobody
    learns."""
    updates = updates_of(experiment)
    if not updates:
        return ""
    length = experiment.length
    has_no_clock = length.clock is None and not length.is_of_steps
    if_so_long = f", if each episode has {EPISODE_STEPS} turns," if has_no_clock else ""
    to_come = (
        f"about {updates:,} updates of each replica in {turns_of(experiment):,} turns{if_so_long} are to come"
    )
    if engine_of(experiment) == "compiled":
        return f"Compiles what agents act and learn by: {to_come}."
    return (
        f'Trains uncompiled: {to_come}, which take less time than compiling does. engine="compiled" compiles.'
    )


def begun_with(run: Path) -> TrainingEngine | None:
    """Return the engine with which a run was begun; None where there is none."""
    if not (run / RECIPE_FILE).exists():
        return None
    engine: TrainingEngine = recipe_config(read_recipe(run))["engine"]
    return engine
