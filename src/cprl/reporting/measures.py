"""Measures for the study's claims: of training curves, and of trained agents in new worlds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl import arguments
from cprl.evaluation.evaluate import SEED
from cprl.evaluation.lanes import Source, fresh_worlds, policies_of, random_policies
from cprl.measuring.movement import Trace, overlap, rounds, shooting_distance, trace
from cprl.measuring.published import SMOOTHED_EPISODES
from cprl.policies.assignment import AgentPolicies
from cprl.runs.curves import curves_of, running_mean
from cprl.runs.weights import lacks_weights
from cprl.training.stored import LoadedRun, load

Values = NDArray[np.float64]

WORLDS: Final = 64
"""The number of new worlds per replica in which trained agents play one episode each, as in evaluation."""


NEARNESS: Final = "steps to the nearest other when firing, over that in all steps"
OVERLAP: Final = "overlap of the cells that two agents visit"
ROUNDS: Final = "rounds about the centre per 1000 steps, agent {agent}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Measures:
    """Measures of a run, float64 [R] each by name, for R replicas."""

    training: Mapping[str, Values]
    """Of its training curves."""
    trained: Mapping[str, Values]
    """Of its trained agents in new worlds; only those defined in all replicas; empty where the results were
    exported without weights."""
    random: Mapping[str, Values]
    """Of the random policy in the same worlds; likewise."""


def measures(
    run: Path, *, window: int = SMOOTHED_EPISODES, seed: int = SEED, allow: Sequence[str] = ()
) -> Measures:
    """All measures of a run: of its training curves, and of its trained agents in new worlds.

    Args:
        run: The directory of the run, or of its exported results.
        window: The window of the running means of which some measures are, in episodes.
        seed: The seed of the new worlds.
        allow: See `cprl.load`.
    """
    training = of_training(curves_of(run), window=window)
    if lacks_weights(run):
        return Measures(training=training, trained={}, random={})
    loaded = load(run, allow=allow)
    replicas = tuple(loaded.replicas)
    trained = _at_play(
        loaded, replicas, partial(policies_of, [Source(loaded)] * loaded.game.agents), seed=seed
    )
    return Measures(
        training=training,
        trained={name: values for name, values in trained.items() if np.isfinite(values).all()},
        random=_by_chance(loaded, replicas, seed=seed),
    )


_PLAYED_BY_CHANCE: Final[dict[Any, dict[str, Values]]] = {}


def _by_chance(run: LoadedRun, replicas: tuple[int, ...], *, seed: int) -> dict[str, Values]:
    """`of_play` of the random policy; the same for all runs of a game, so played once."""
    key = run.game, run.experiment.transforms, replicas, seed
    if key not in _PLAYED_BY_CHANCE:
        _PLAYED_BY_CHANCE[key] = _at_play(run, replicas, partial(random_policies, run), seed=seed)
    return _PLAYED_BY_CHANCE[key]


def _at_play(
    run: LoadedRun, replicas: Sequence[int], who: Callable[..., AgentPolicies], *, seed: int
) -> dict[str, Values]:
    """`of_play` of a game in the same fresh worlds, whoever plays."""
    found: dict[str, list[Values]] = {}
    for group, env in fresh_worlds(run, replicas, worlds=WORLDS, seed=seed):
        played = trace(env, who(group, worlds=WORLDS, seed=seed))
        for name, values in of_play(played, len(group)).items():
            found.setdefault(name, []).append(values)
    return {name: np.concatenate(values) for name, values in found.items()}


def of_training(curves: dict[str, Values], *, window: int = SMOOTHED_EPISODES) -> dict[str, Values]:
    """Measures of training curves, float64 [R] each; without those of more episodes than there were.

    Args:
        curves: The curves of a run, as `curves_of` returns them.
        window: The window of the running means in episodes.
    """
    returns = running_mean(curves["collective_return"], window)
    episodes = curves["collective_return"].shape[1]
    has_last = episodes >= 500
    found = {"mean collective return over training": curves["collective_return"].mean(1)}
    if has_last:
        found |= {
            "collective return of the last 500 episodes": curves["collective_return"][:, -500:].mean(1),
            "survival in the last 500 episodes, steps": curves["survival_steps"][:, -500:].mean(1),
        }
    if episodes >= 600:
        dip = "depth of the deepest dip before episode 600, share of the peak before it"
        found[dip] = dip_depth(returns[:, :600])
    if episodes > window:
        found["episode of the highest collective return"] = returns.argmax(1).astype(np.float64)
    agents = [curves[f"return_{agent}"] for agent in range(_agents(curves))]
    if len(agents) > 1:
        for when, first in (*[("last 500 episodes", -500)] * has_last, ("whole training", 0)):
            means = np.stack([of_agent[:, first:].mean(1) for of_agent in agents])
            name = f"return of the poorest agent over that of the richest, {when}"
            found[name] = _share(means.min(0), means.max(0))
    return found


def dip_depth(curves: Values) -> Values:
    """The largest fall of each curve below its highest value so far, as a share of it, [R, E] to [R]."""
    deepest: Values = falls(curves).max(1)
    return deepest


def falls(curves: Values) -> Values:
    """How far each curve lies below its highest value so far, as a share of it, [R, E].

    Raises:
        ValueError: if the curves are no array of numbers, [R, E].
    """
    curves = arguments.floats("curves", curves)
    if curves.ndim != 2:
        raise arguments.refusal("curves", list(curves.shape), "an array [R, E]")
    peaks = np.maximum.accumulate(curves, axis=1)
    return _share(peaks - curves, peaks)


def of_play(played: Trace, replicas: int) -> dict[str, Values]:
    """Measures of played episodes, float64 [R] each; NaN where no agent fired while another was in play.

    Args:
        played: One episode of each world; the worlds of a replica are adjacent.
        replicas: The number of replicas R.
    """

    def by_replica(of_worlds: Values) -> Values:
        return of_worlds.reshape(replicas, -1)

    def mean(of_worlds: Values) -> Values:
        """The mean of each replica over those of its worlds in which the value is finite."""
        values = by_replica(of_worlds)
        with np.errstate(invalid="ignore"):
            means: Values = np.nansum(values, 1) / np.isfinite(values).sum(1)
        return means

    around = np.abs(rounds(played))
    agents = around.shape[1]
    found = {ROUNDS.format(agent=agent): mean(around[:, agent]) for agent in range(agents)}
    if agents > 1:
        fired, always = shooting_distance(played)
        shots, steps = played.fired.sum((0, 2)), played.played.sum(0)
        found |= {
            OVERLAP: mean(overlap(played)),
            NEARNESS: mean(fired) / mean(always),
            "shots per 1000 steps, all agents": 1000 * by_replica(shots).sum(1) / by_replica(steps).sum(1),
        }
        for agent in range(agents):
            near, usual = shooting_distance(played, agent=agent)
            found[f"{NEARNESS}, agent {agent}"] = mean(near) / mean(usual)
    return found


def _share(part: Values, whole: Values) -> Values:
    shares: Values = np.divide(part, whole, out=np.zeros_like(whole), where=whole > 0)
    return shares


def _agents(curves: dict[str, Values]) -> int:
    return sum(name.startswith("return_") for name in curves)
