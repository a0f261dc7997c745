"""The study's claims as measures of ours: of curves of episodes, and of trained agents at play."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from cprl.acting.actors import RandomActor
from cprl.acting.seats import Seats
from cprl.measuring.movement import overlap, rounds, shooting_distance, trace
from cprl.measuring.statistics import Estimate, estimate
from cprl.recording.curves import curves_of, running_mean
from cprl.recording.loaded import LoadedRun, load

Values = NDArray[np.float64]

WORLDS = 8
"""Fresh worlds that the trained agents of each replica play, one episode in each, with epsilon 0.05."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A number that says something about a claim."""

    name: str
    trained: Estimate
    """Over replicas."""
    random: float | None
    """Of the random policy at all seats, in 32 worlds; None for measures of training."""


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
    random = Seats([RandomActor(len(loaded.game.actions), seed=agent) for agent in range(loaded.game.agents)])
    by_chance = of_play(loaded, random, worlds=32)
    each = [of_play(loaded, loaded.policy(replica), worlds=WORLDS) for replica in loaded.replicas]
    for name, chance in by_chance.items():
        values = np.array([own[name] for own in each])
        if np.isfinite(values).all():
            found.append(Measure(name=name, trained=estimate(values), random=chance))
    return found


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


def of_play(loaded: LoadedRun, policy: Callable[..., object], *, worlds: int) -> dict[str, float]:
    """Measures of one episode in each of so many fresh worlds.

    Args:
        loaded: the run whose game is played.
        policy: of all agents; they explore as they do in evaluation.
        worlds: how many.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(_FRESH_SEED)  # TorchRL's exploration draws from torch's generator
        played = trace(loaded.env(worlds, seed=_FRESH_SEED), policy)
    around = np.abs(rounds(played)).mean(0)
    found = {
        f"rounds about the centre per 1000 steps, agent {agent}": float(around[agent])
        for agent in range(len(around))
    }
    if loaded.game.agents > 1:
        fired, always = shooting_distance(played)
        found["overlap of the cells that two agents visit"] = float(np.mean(overlap(played)))
        if np.isfinite(fired).any():
            found["steps to the nearest other when firing, over that in all steps"] = float(
                np.nanmean(fired) / np.nanmean(always)
            )
        shots = played.fired.sum() / played.played.sum() * 1000
        found["shots per 1000 steps, all agents"] = float(shots)
    return found


_FRESH_SEED = 10_007
"""No training of ours uses it."""


def _agents(curves: dict[str, Values]) -> int:
    return sum(name.startswith("return_") for name in curves)
