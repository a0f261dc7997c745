"""StepCollector: a TorchRL collector of one step per batch, without the overhead of the stock one."""

from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl.envs.stepping import begin_states


class StepCollector(BaseCollector):
    """Yields steps of all worlds one by one, batch size [B].

    Equivalent to `Collector(env, policy, frames_per_batch=B)` without its time axis of length 1, as a test
    checks, and several times faster. It does not stack, copy or track anything: batches contain the
    environment's own tensors. Environment and policy have states of their own, so that it has none.

    Args:
        env: B worlds, whose steps return new tensors.
    """

    def __init__(self, env: EnvBase, policy: nn.Module) -> None:
        super().__init__()
        self.env, self.policy = env, policy
        self.frames_per_batch = env.batch_size.numel()
        self.carried: TensorDictBase | None = None
        """The input of the environment's next step; None before the first step."""

    def iterator(self) -> Iterator[TensorDictBase]:
        if self.carried is None:
            self.carried = self.env.reset()
        while True:
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                now, self.carried = self.env.step_and_maybe_reset(self.policy(self.carried))
                begin_states(self.carried, self.carried, now)
            yield now

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        return int(self.env.set_seed(seed, static_seed=static_seed))

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        if close_env and not self.env.is_closed:
            self.env.close(raise_if_closed=raise_on_error)

    def state_dict(self) -> "OrderedDict[str, Any]":
        return OrderedDict()

    def load_state_dict(self, state_dict: "OrderedDict[str, Any]") -> None:
        pass
