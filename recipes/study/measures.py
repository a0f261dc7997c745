"""What did agents learn to do? Measures of their training, and of how they move and shoot in new worlds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from cprl.evaluation.populations import AgentOfReplica, agents_of, fresh_worlds, policies_of, scripted_agent
from cprl.experimental.movement import Trace, overlap, trace
from cprl.measuring.statistics import estimate
from cprl.measuring.windows import SMOOTHED_EPISODES, running_mean
from cprl.system.defaults import SEED, Fresh
from cprl.training.stored import LoadedRun, load
from cprl.values.array_types import Float64

WORLDS: Final = 64
"""The new worlds of each replica in which trained agents play one episode each, as in evaluation."""
NEARNESS: Final = "steps to the nearest other when firing, over that in all steps"
OVERLAP: Final = "overlap of the cells that two agents visit"
ROUNDS: Final = "rounds about the centre per 1000 steps, agent {agent}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Measures:
    """Measures of runs, float64 [R] each by name, for R replicas."""

    training: Mapping[str, Float64]
    """Measures of the training curves."""
    trained: Mapping[str, Float64]
    """Measures of trained agents in new worlds, those defined in all replicas; empty where the results were
    exported without weights."""
    random: Mapping[str, Float64]
    """The same of the random policy in the same worlds, empty likewise."""


def training_measures(
    curves: Mapping[str, Float64], *, window: int = SMOOTHED_EPISODES
) -> dict[str, Float64]:
    """Return measures of training curves, float64 [R] each; without those of more episodes than there were.

    Args:
        curves: of a run, as `curves_of` returns them.
        window: of the running means, in episodes.
    """
    harvest = curves["collective_return"]
    returns = running_mean(harvest, window)
    episodes = harvest.shape[1]
    parts = {"last 500 episodes": -500, "whole training": 0}
    if episodes < 500:
        del parts["last 500 episodes"]
    measures = {"mean collective return over training": harvest.mean(1)}
    if episodes >= 500:
        measures["collective return of the last 500 episodes"] = harvest[:, -500:].mean(1)
        survival = curves["survival_steps"][:, -500:].mean(1)
        measures["survival in the last 500 episodes, steps"] = survival
    if episodes >= 600:
        dip = "depth of the deepest dip before episode 600, share of the peak before it"
        measures[dip] = deepest_dip(returns[:, :600]).depth
    if episodes > window:
        measures["episode of the highest collective return"] = returns.argmax(1).astype(np.float64)
    agents = [curves[name] for name in curves if name.startswith("return_")]
    if len(agents) > 1:
        for part, first in parts.items():
            means = np.stack([agent[:, first:].mean(1) for agent in agents])
            name = f"return of the poorest agent over that of the richest, {part}"
            measures[name] = ratio(means.min(0), means.max(0))
    return measures


def measures_at_play(run: Path, *, seed: int = SEED) -> tuple[dict[str, Float64], dict[str, Float64]]:
    """Return measures of a run's trained agents in new worlds, without those undefined in some replica, and
    of random agents in the same worlds."""
    loaded = load(run)
    fresh = Fresh(replicas=tuple(loaded.replicas), episodes=WORLDS, seed=seed, greedy=True)
    trained = _played(loaded, fresh, agents_of(loaded))
    key = (loaded.game, loaded.experiment.transforms, fresh)
    if key not in _RANDOM_PLAY:
        _RANDOM_PLAY[key] = _played(loaded, fresh, [scripted_agent("random")] * loaded.game.agents)
    defined = {name: values for name, values in trained.items() if np.isfinite(values).all()}
    return defined, _RANDOM_PLAY[key]


_RANDOM_PLAY: Final[dict[Any, dict[str, Float64]]] = {}
"""Measures of random play by game, transforms and worlds, each played once."""


def _played(run: LoadedRun, fresh: Fresh, agents: Sequence[AgentOfReplica]) -> dict[str, Float64]:
    """Return the `play_measures` of a population in the fresh worlds of a run."""
    parts: dict[str, list[Float64]] = {}
    for group, env in fresh_worlds(fresh, run):
        played = trace(env, policies_of(fresh, run, agents, group))
        for name, values in play_measures(played, len(group)).items():
            parts.setdefault(name, []).append(values)
    return {name: np.concatenate(values) for name, values in parts.items()}


def play_measures(played: Trace, replicas: int) -> dict[str, Float64]:
    """Return measures of played episodes, float64 [R] each; NaN where no agent fired while another was in
    play.

    Args:
        played: one episode of each world; the worlds of a replica are adjacent.
        replicas: R.
    """

    def mean(values: Float64) -> Float64:
        """Return the mean of each replica over those of its worlds in which the value is finite."""
        values = values.reshape(replicas, -1)
        is_defined = np.isfinite(values)
        with np.errstate(invalid="ignore"):
            return np.where(is_defined, values, 0.0).sum(1) / is_defined.sum(1)

    rounds = np.abs(rounds_of(played))
    agents = range(rounds.shape[1])
    measures = {ROUNDS.format(agent=agent): mean(rounds[:, agent]) for agent in agents}
    if len(agents) > 1:
        shots = played.fired.reshape(len(played.fired), replicas, -1).sum((0, 2))
        steps = played.played.reshape(len(played.played), replicas, -1).sum((0, 2))
        measures[OVERLAP] = mean(overlap(played))
        measures[NEARNESS] = nearness(played, agents, mean)
        measures["shots per 1000 steps, all agents"] = 1000 * shots / steps
        for agent in agents:
            measures[f"{NEARNESS}, agent {agent}"] = nearness(played, [agent], mean)
    return measures


def rounds_of(trace: Trace) -> Float64:
    """Return the rounds of each agent about the centre of the board per 1000 steps, clockwise positive,
    float64 [B, N].

    They are the changes of the agent's angle, as seen from the centre, summed over its steps.
    """
    height, width = trace.board
    angle = np.arctan2(trace.row - (height - 1) / 2, trace.col - (width - 1) / 2)
    turned = (np.diff(angle, axis=0) + np.pi) % (2 * np.pi) - np.pi
    is_counted = trace.played[1:, :, None] & trace.in_play[1:] & trace.in_play[:-1]
    steps = np.maximum(is_counted.sum(0), 1)
    rounds: Float64 = (turned * is_counted).sum(0) / (2 * np.pi) / steps * 1000
    return rounds


def nearness(trace: Trace, agents: Sequence[int], mean: Callable[[Float64], Float64]) -> Float64:
    """Return the mean distance of some agents to the nearest other when they fire, over that in all steps."""
    distance = distance_to_nearest(trace)[..., agents]
    is_counted = np.isfinite(distance) & trace.played[..., None]
    with np.errstate(invalid="ignore"):
        when_firing, always = (
            np.where(which, distance, 0.0).sum((0, 2)) / which.sum((0, 2))
            for which in (is_counted & trace.fired[..., agents], is_counted)
        )
    return mean(when_firing) / mean(always)


def distance_to_nearest(trace: Trace) -> Float64:
    """Return the distance from each agent to the nearest other in play, in steps, float64 [T, B, N]: rows
    plus columns; infinite where the agent, or every other, is out of play."""
    rows = np.abs(trace.row[..., :, None] - trace.row[..., None, :])
    columns = np.abs(trace.col[..., :, None] - trace.col[..., None, :])
    are_both = trace.in_play[..., :, None] & trace.in_play[..., None, :]
    are_both &= ~np.eye(trace.row.shape[-1], dtype=bool)
    nearest: Float64 = np.where(are_both, rows + columns, np.inf).min(-1)
    return nearest


@dataclass(frozen=True, kw_only=True, eq=False)
class Dip:
    """The largest fall of each of R curves below its highest value so far, [R] each."""

    depth: Float64
    """A share of the highest value so far."""
    episode: Float64
    bottom: Float64


def deepest_dip(curves: Float64) -> Dip:
    """Return the largest fall of each curve, [R, E], below its highest value so far."""
    peaks = np.maximum.accumulate(curves, axis=1)
    falls = ratio(peaks - curves, peaks)
    at = falls.argmax(1)
    row = np.arange(len(curves))
    return Dip(depth=falls[row, at], episode=at.astype(np.float64), bottom=curves[row, at])


def ratio(part: Float64, whole: Float64, *, undefined: float = 0.0) -> Float64:
    """Return part / whole; `undefined` where the whole is not above 0."""
    ratios: Float64 = np.divide(part, whole, out=np.full(np.shape(part), undefined), where=whole > 0)
    return ratios


def with_interval(values: Float64) -> str:
    """Return the mean of replicas, [R], with its 95 % interval by Student's t."""
    return f"{estimate(values):.4g}"
