"""Play episodes without learning: turn by turn, or whole episodes for their numbers."""

from collections.abc import Callable, Iterator, Sequence
from statistics import fmean, stdev

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl import keys
from cprl.envs.commons_env import CommonsEnv
from cprl.envs.unwrap import clock_of
from cprl.measuring.tracker import Episode, tracker_of
from cprl.system.process import one_thread
from cprl.system.working import note_progress, working
from cprl.values import Custom

Policy = Callable[[TensorDictBase], TensorDictBase]


def turns(env: EnvBase, policy: Policy, *, explore: bool = True) -> Iterator[TensorDictBase]:
    """Play the next episode of each world, turn by turn; torch computes in one thread.

    All worlds are reset at once, before the first turn is asked for. A world of a `CommonsEnv` that has ended
    does not change until all have ended. In any other environment, including one with transforms, it is reset
    when the next turn is asked for, and plays on.

    Args:
        env: B worlds, batch size [B].
        policy: writes the actions of all agents, e.g. `cprl.policies.joint_policy.JointPolicy`.
        explore: True: agents draw their actions as they do in training, at random with probability epsilon
            or from their policy. False: they take their best actions.

    Returns:
        The entries of each turn, batch size [B], see `cprl.keys`, up to the one in which the last world ends.
    """
    with torch.no_grad(), one_thread():
        moment = env.reset()
    return _turns(env, policy, moment, explore)


def _turns(env: EnvBase, policy: Policy, moment: TensorDictBase, explore: bool) -> Iterator[TensorDictBase]:
    exploration = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
    clock = clock_of(env)
    has_ended = np.zeros((*env.batch_size, 1), np.bool_)
    count = 0
    while not has_ended.all():
        with torch.no_grad(), one_thread(), set_exploration_type(exploration):
            acted = policy(moment)
            if isinstance(env, CommonsEnv):
                batch, moment = env.lean_step(acted, resets=False)
            else:
                batch = env.step(acted)
        count += 1
        note_progress(count, clock, "turns")
        has_ended |= batch["next", keys.DONE].numpy(force=True)
        yield batch
        if not isinstance(env, CommonsEnv):
            moment = env.maybe_reset(env.step_mdp(batch))


def evaluate(
    env: EnvBase, policy: Policy, *, explore: bool = False, metrics: Sequence[Custom] = ()
) -> list[Episode]:
    """Play the next episode of each world to its end, see `turns`.

    Args:
        env: B worlds, batch size [B]. If a world is reset and plays on, only its first episode counts.
        policy: writes the actions of all agents.
        explore: as in `turns`; by default agents take their best actions.
        metrics: custom metrics, see `EpisodeTracker`.

    Returns:
        B episodes, in the order of worlds.
    """
    tracker = tracker_of(env, metrics)
    episodes: dict[int, Episode] = {}
    what = "playing an episode" if tracker.worlds == 1 else f"playing {tracker.worlds:,} episodes"
    with working(what):
        for batch in turns(env, policy, explore=explore):
            for episode in tracker.add(batch):
                episodes.setdefault(episode.world, episode)
    return [episodes[world] for world in range(tracker.worlds)]


def mean_return(episodes: list[Episode]) -> tuple[float, float]:
    """Return the mean over episodes of the summed return, and its standard error; NaN for one episode."""
    returns = [float(episode.return_.sum()) for episode in episodes]
    error = stdev(returns) / len(returns) ** 0.5 if len(returns) > 1 else float("nan")
    return fmean(returns), error
