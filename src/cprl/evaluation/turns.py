"""One episode of one world, a turn at a time: films and people who play look at each turn."""

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from cprl.process import one_thread

Policy = Callable[[TensorDictBase], TensorDictBase]


class Turns:
    """An episode that is played turn by turn, with the exploration of training and evaluation.

    Unlike a collector it does not reset an environment that has ended, so that the last board can be seen.

    Args:
        env: one world, batch size [1], with its transforms; it is reset.
        policy: writes the actions of all agents, e.g. `cprl.policies.assignment.AgentPolicies`.
    """

    def __init__(self, env: EnvBase, policy: Policy) -> None:
        self.env, self.policy = env, policy
        self._moment: TensorDictBase = env.reset()
        self.has_ended = False

    def play(self) -> TensorDictBase:
        """Plays the next turn; returns its entries, batch size [1], see `cprl.keys`.

        Raises:
            ValueError: if the episode has ended.
        """
        if self.has_ended:
            raise ValueError("the episode has ended; allowed: turns up to its end")
        env = self.env
        with torch.no_grad(), one_thread(), set_exploration_type(ExplorationType.RANDOM):
            batch: TensorDictBase = env.step(self.policy(self._moment))
        self._moment = step_mdp(
            batch, reward_keys=env.reward_keys, action_keys=env.action_keys, done_keys=env.done_keys
        )
        self.has_ended = bool(batch["next", "done"].any())
        return batch
