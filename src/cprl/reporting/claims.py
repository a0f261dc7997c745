"""Measures for the study's claims: of training curves, and of trained agents in new worlds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.evaluation.evaluate import SEED
from cprl.evaluation.lanes import Source, fresh_worlds, policies_of, random_policies
from cprl.measuring.movement import Trace, overlap, rounds, shooting_distance, trace
from cprl.measuring.statistics import Estimate, estimate
from cprl.policies.assignment import AgentPolicies
from cprl.runs.curves import curves_of, running_mean
from cprl.stored import LoadedRun, load

Values = NDArray[np.float64]

WORLDS: Final = 64
"""The number of new worlds per replica in which trained agents play one episode each, as in evaluation."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A measure for a claim of the study."""

    name: str
    trained: Estimate
    """The value of the run, over its replicas."""
    random: float | None
    """The mean if all agents follow the random policy, in the same worlds; None for measures of training."""


def measures(run: Path) -> list[Measure]:
    """All measures of a run: of its training curves, and of its trained agents in new worlds.

    Args:
        run: The directory of the run, or of its exported results.
    """
    curves = curves_of(run)
    found = [
        Measure(name=name, trained=estimate(values), random=None)
        for name, values in of_training(curves).items()
    ]
    loaded = load(run)
    replicas = tuple(loaded.replicas)
    trained = _at_play(loaded, replicas, partial(policies_of, [Source(loaded)] * loaded.game.agents))
    by_chance = _by_chance(loaded, replicas)
    for name, values in trained.items():
        if np.isfinite(values).all():
            found.append(Measure(name=name, trained=estimate(values), random=float(by_chance[name].mean())))
    return found


_PLAYED_BY_CHANCE: Final[dict[Any, dict[str, Values]]] = {}


def _by_chance(run: LoadedRun, replicas: tuple[int, ...]) -> dict[str, Values]:
    """`of_play` of the random policy; the same for all runs of a game, so played once."""
    key = run.game, run.experiment.transforms, replicas
    if key not in _PLAYED_BY_CHANCE:
        _PLAYED_BY_CHANCE[key] = _at_play(run, replicas, partial(random_policies, run))
    return _PLAYED_BY_CHANCE[key]


def _at_play(run: LoadedRun, replicas: Sequence[int], who: Callable[..., AgentPolicies]) -> dict[str, Values]:
    """`of_play` of a game in the same fresh worlds, whoever plays."""
    found: dict[str, list[Values]] = {}
    for group, env in fresh_worlds(run, replicas, worlds=WORLDS, seed=SEED):
        played = trace(env, who(group, worlds=WORLDS, seed=SEED))
        for name, values in of_play(played, len(group)).items():
            found.setdefault(name, []).append(values)
    return {name: np.concatenate(values) for name, values in found.items()}


def of_training(curves: dict[str, Values]) -> dict[str, Values]:
    """Measures of training curves, float64 [R] each.

    Args:
        curves: The curves of a run, as `curves_of` returns them.
    """
    returns = running_mean(curves["collective_return"])
    early = returns[:, : min(600, returns.shape[1])]
    found = {
        "mean collective return over training": curves["collective_return"].mean(1),
        "collective return of the last 500 episodes": curves["collective_return"][:, -500:].mean(1),
        "depth of the deepest dip before episode 600, share of the peak before it": dip_depth(early),
        "episode of the highest collective return": returns.argmax(1).astype(np.float64),
    }
    agents = [curves[f"return_{agent}"] for agent in range(_agents(curves))]
    if len(agents) > 1:
        late = np.stack([of_agent[:, -500:].mean(1) for of_agent in agents])
        found["return of the poorest agent over that of the richest, last 500 episodes"] = late.min(
            0
        ) / late.max(0)
    return found


def dip_depth(curves: Values) -> Values:
    """The largest fall of each curve below its highest value so far, as a share of it, [R, E] to [R]."""
    peaks = np.maximum.accumulate(curves, axis=1)
    falls = np.divide(peaks - curves, peaks, out=np.zeros_like(peaks), where=peaks > 0)
    deepest: Values = falls.max(1)
    return deepest


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
    found = {
        f"rounds about the centre per 1000 steps, agent {agent}": mean(around[:, agent])
        for agent in range(agents)
    }
    if agents > 1:
        fired, always = shooting_distance(played)
        shots, steps = played.fired.sum((0, 2)), played.played.sum(0)
        found |= {
            "overlap of the cells that two agents visit": mean(overlap(played)),
            "steps to the nearest other when firing, over that in all steps": mean(fired) / mean(always),
            "shots per 1000 steps, all agents": 1000 * by_replica(shots).sum(1) / by_replica(steps).sum(1),
        }
    return found


def _agents(curves: dict[str, Values]) -> int:
    return sum(name.startswith("return_") for name in curves)
