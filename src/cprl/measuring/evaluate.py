"""How well a population plays, without learning: one fresh episode in every world of an environment."""

from collections.abc import Callable
from statistics import fmean, stdev

import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode, EpisodeTracker


def evaluate(
    env: CommonsEnv, policy: Callable[[TensorDictBase], TensorDictBase], *, explore: bool = False
) -> list[Episode]:
    """Plays the next episode of each world to its end.

    Args:
        env: B worlds; all are reset.
        policy: writes the actions of all agents, e.g. `cprl.acting.AgentPolicies`.
        explore: whether actors explore with their epsilon, else they play greedily.

    Returns:
        B episodes, by the number of the world.
    """
    worlds = env.batch_size.numel()
    tracker = EpisodeTracker(worlds, env.game.agents, env.game.rules.episode_steps)
    exploration = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
    episodes: dict[int, Episode] = {}
    with torch.no_grad(), set_exploration_type(exploration):
        moment = env.reset()
        while len(episodes) < worlds:
            batch = env.step(policy(moment))
            # A world that has ended stays as it is until all have.
            episodes.update({episode.world: episode for episode in tracker.add(batch)})
            moment = batch.get("next").exclude(("agents", "reward"))
    return [episodes[world] for world in range(worlds)]


def mean_return(episodes: list[Episode]) -> tuple[float, float]:
    """The mean over episodes of the return of all agents together, and its standard error."""
    returns = [float(episode.return_.sum()) for episode in episodes]
    error = stdev(returns) / len(returns) ** 0.5 if len(returns) > 1 else float("nan")
    return fmean(returns), error
