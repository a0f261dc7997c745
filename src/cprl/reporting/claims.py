"""The study's claims as measures of ours: of curves of episodes, and of trained agents at play."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.game import Game
from cprl.evaluation.evaluate import SEED, kept_replicas
from cprl.evaluation.lanes import Sitter, fresh_worlds, random_agents, seated
from cprl.measuring.movement import Trace, overlap, rounds, shooting_distance, trace
from cprl.measuring.statistics import Estimate, estimate
from cprl.policies.assignment import AgentPolicies
from cprl.runs.curves import curves_of, running_mean
from cprl.stored import load

Values = NDArray[np.float64]

WORLDS: Final = 64
"""Fresh worlds that the trained agents of each replica play, one episode in each, as in evaluation."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A number that says something about a claim."""

    name: str
    trained: Estimate
    """Over replicas."""
    random: float | None
    """Of the random policy at all seats, in the same worlds; None for measures of training."""


def measures(run: Path) -> list[Measure]:
    """What can be measured of a run's claims: of its training, and of its trained agents at play.

    Args:
        run: its directory, or its results.
    """
    curves = curves_of(run)
    found = [
        Measure(name=name, trained=estimate(values), random=None)
        for name, values in of_training(curves).items()
    ]
    loaded = load(run)
    game, replicas = loaded.game, tuple(kept_replicas(loaded))
    trained = _at_play(game, replicas, partial(seated, [Sitter(loaded)] * game.agents))
    by_chance = _by_chance(game, replicas)
    for name, values in trained.items():
        if np.isfinite(values).all():
            found.append(Measure(name=name, trained=estimate(values), random=float(by_chance[name].mean())))
    return found


@cache
def _by_chance(game: Game, replicas: tuple[int, ...]) -> dict[str, Values]:
    """`of_play` of the random policy; the same for all runs of a game."""
    return _at_play(game, replicas, partial(random_agents, game))


def _at_play(game: Game, replicas: Sequence[int], who: Callable[..., AgentPolicies]) -> dict[str, Values]:
    """`of_play` of a game in the same fresh worlds, whoever plays."""
    found: dict[str, list[Values]] = {}
    for group, env in fresh_worlds(game, replicas, worlds=WORLDS, seed=SEED):
        played = trace(env, who(group, worlds=WORLDS, seed=SEED))
        for name, values in of_play(played, len(group)).items():
            found.setdefault(name, []).append(values)
    return {name: np.concatenate(values) for name, values in found.items()}


def of_training(curves: dict[str, Values]) -> dict[str, Values]:
    """Measures of the course of training, [R] each.

    Args:
        curves: as `curves_of` gives them.
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
    """How far each curve falls below its highest point so far, at most, as a share of it, [R, E] to [R]."""
    peaks = np.maximum.accumulate(curves, axis=1)
    falls = np.divide(peaks - curves, peaks, out=np.zeros_like(peaks), where=peaks > 0)
    deepest: Values = falls.max(1)
    return deepest


def of_play(played: Trace, replicas: int) -> dict[str, Values]:
    """Measures of agents at play, [R] each; NaN where nobody fired with another one in play.

    Args:
        played: an episode of each world, those of a replica side by side.
        replicas: how many replicas R.
    """

    def by_replica(of_worlds: Values) -> Values:
        return of_worlds.reshape(replicas, -1)

    def mean(of_worlds: Values) -> Values:
        """Of each replica, over those of its worlds that have the number."""
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
