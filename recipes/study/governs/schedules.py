"""How do the agents of a condition explore and learn, in steps and updates, when their training ends?

Functions take the smallest and the largest number of steps of a replica, and of its episodes.
"""

from collections.abc import Callable, Iterable
from typing import Any

from cprl.experiment import Experiment
from cprl.population import Learning, Team
from cprl.values import instantiate

Range = tuple[int, int]


def joined(texts: Iterable[str]) -> str:
    """Return different texts, each once."""
    return ", ".join(dict.fromkeys(texts))


def range_text(numbers: Iterable[float], form: str = ",.0f") -> str:
    """Return a number, or the smallest and the largest one."""
    return " to ".join(dict.fromkeys(f"{number:{form}}" for number in sorted(numbers)))


def each_kind(experiment: Experiment, text: Callable[[Any], str]) -> str:
    """Return texts about the algorithms of an experiment; of agents that do not learn, their kind."""
    texts = []
    for spec in experiment.agents:
        if isinstance(spec, Learning | Team):
            texts.append(text(instantiate(spec.algorithm)))
        else:
            texts.append(type(spec).__name__.lower())
    return joined(texts)


def exploration_at_end(experiment: Experiment, steps: Range) -> str:
    """Return the probability of a random action at the end of a training."""

    def text(algorithm: Any) -> str:
        schedule = getattr(algorithm.settings, "epsilon", None)
        if schedule is None or algorithm.stochastic:
            return "policy drawn"
        return range_text(map(schedule, steps), ".2f")

    return each_kind(experiment, text)


def updates_by(algorithm: Any, steps: int, worlds: int) -> int:
    """Return the updates of an agent in a number of steps; one in each turn if the settings do not say."""
    settings = algorithm.settings
    if not hasattr(settings, "updates_in"):
        return steps // worlds
    before = getattr(settings, "learning_starts", 0)
    return int(settings.updates_in(max(0, steps - before + 1), worlds=worlds))


def updates(experiment: Experiment, steps: Range) -> str:
    """Return the updates of each agent in a training."""

    def text(algorithm: Any) -> str:
        return range_text(updates_by(algorithm, number, experiment.worlds) for number in steps)

    return each_kind(experiment, text)


def target_period(experiment: Experiment, steps: Range, episodes: Range) -> str:
    """Return the updates from one copy of a network to its target to the next; the mean where copies count
    episodes."""

    def text(algorithm: Any) -> str:
        settings = algorithm.settings
        if not hasattr(settings, "target_every_episodes"):
            return f"none: {type(algorithm).__name__} has no target"
        if settings.tau is not None:
            return f"none: moves by {settings.tau:g} with each"
        if settings.target_every_updates is not None:
            return f"{settings.target_every_updates:,}"
        ends = zip(steps, reversed(episodes), strict=True)
        counts = [
            updates_by(algorithm, number, experiment.worlds) * settings.target_every_episodes / ended
            for number, ended in ends
        ]
        return f"{range_text(counts)} (mean; every {settings.target_every_episodes} episodes)"

    return each_kind(experiment, text)
