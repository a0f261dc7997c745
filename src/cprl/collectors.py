"""StepCollector: TorchRL's collector interface for one step a batch, without what the stock one spends."""

from collections import OrderedDict
from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type


class StepCollector(BaseCollector):
    """Yields one step of all worlds after the other, batch size [B].

    The same as `Collector(env, policy, frames_per_batch=B)` but for its axis of one time step, which a test
    holds equal; it stacks, copies and tracks nothing, so what it yields are the environment's own tensors.

    Args:
        env: B worlds, whose steps return fresh tensors.
        policy: writes the actions.
    """

    def __init__(self, env: EnvBase, policy: nn.Module) -> None:
        super().__init__()
        self.env, self.policy = env, policy
        self.frames_per_batch = env.batch_size.numel()
        self._carrier: TensorDictBase | None = None
        self._iterator: Iterator[TensorDictBase] | None = None

    def iterator(self) -> Iterator[TensorDictBase]:
        """Endless; the environment is reset when it begins."""
        if self._carrier is None:
            self._carrier = self.env.reset()
        while True:
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                now, self._carrier = self.env.step_and_maybe_reset(self.policy(self._carrier))
            yield now

    def resume_from(self, moment: TensorDictBase) -> None:
        """Steps on from a moment that the environment was put in, e.g. by `CommonsEnv.load`."""
        self._carrier = moment

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seeds the environment; returns the next seed."""
        return int(self.env.set_seed(seed, static_seed=static_seed))

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        """Closes the environment, if wanted."""
        if close_env and not self.env.is_closed:
            self.env.close(raise_if_closed=raise_on_error)

    def state_dict(self) -> "OrderedDict[str, Any]":
        """Nothing: environment and policy have states of their own."""
        return OrderedDict()

    def load_state_dict(self, state_dict: "OrderedDict[str, Any]") -> None:
        """Nothing; see `state_dict`."""

    def __del__(self) -> None:
        """Nothing is left behind."""


def stock_collector(env: EnvBase, policy: nn.Module, *, steps: int = 1) -> Collector:
    """TorchRL's own `Collector`, which yields [B, steps]; several times as slow at one step a batch.

    Args:
        env: B worlds.
        policy: writes the actions.
        steps: in a batch; agents explore in all of them with the epsilon of the first.
    """
    before = deepcopy(policy.state_dict())
    collector = Collector(
        env,
        policy,
        frames_per_batch=env.batch_size.numel() * steps,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    policy.load_state_dict(before)  # it was tried once, which took random numbers
    return collector
