"""Evaluates a policy without learning: one fresh episode in every world of an environment."""

from collections.abc import Callable, Sequence
from statistics import fmean, stdev

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl.envs.commons_env import CommonsEnv
from cprl.envs.unwrap import clock_of
from cprl.measuring.episodes import Episode, tracker_of
from cprl.system.process import one_thread
from cprl.system.working import say_how_far, working
from cprl.values import Custom

Policy = Callable[[TensorDictBase], TensorDictBase]


def evaluate(
    env: EnvBase, policy: Policy, *, explore: bool = False, metrics: Sequence[Custom] = ()
) -> list[Episode]:
    """Plays the next episode of each world to its end; torch computes in one thread.

    Args:
        env: B worlds, batch size [B]; all are reset. A world of a `CommonsEnv` that has ended does not change
            until all have ended. In any other environment, including one with transforms, it is reset and
            plays on, and only its first episode counts.
        metrics: the user's own, see `EpisodeTracker`.

    Returns:
        B episodes, in the order of worlds.
    """
    tracker, episodes = tracker_of(env, metrics), dict[int, Episode]()
    exploration = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
    clock = clock_of(env)
    turns = 0
    what = "playing an episode" if tracker.worlds == 1 else f"playing {tracker.worlds:,} episodes"
    with torch.no_grad(), one_thread(), set_exploration_type(exploration), working(what):
        moment = env.reset()
        while len(episodes) < tracker.worlds:
            say_how_far(turns, clock, "turns")
            turns += 1
            acted = policy(moment)
            if isinstance(env, CommonsEnv):
                batch, moment = env.lean_step(acted, resets=False)
            else:
                batch, moment = env.step_and_maybe_reset(acted)
            for episode in tracker.add(batch):
                episodes.setdefault(episode.world, episode)
    return [episodes[world] for world in range(tracker.worlds)]


def mean_return(episodes: list[Episode]) -> tuple[float, float]:
    """The mean over episodes of the agents' summed return, and its standard error; NaN for one episode."""
    returns = [float(episode.return_.sum()) for episode in episodes]
    error = stdev(returns) / len(returns) ** 0.5 if len(returns) > 1 else float("nan")
    return fmean(returns), error
