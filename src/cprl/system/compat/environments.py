"""Environments and specs of TorchRL."""

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from torchrl.data import Categorical
from torchrl.envs import EnvBase

from cprl.system.libraries import require

require("torchrl", EnvBase, "_step_and_maybe_reset")


class LeanStepEnv(EnvBase):
    """An `EnvBase` that steps and resets in its own method, `lean_step`.

    `EnvBase.step_and_maybe_reset`, rollouts and collectors call the private `_step_and_maybe_reset`, whose
    key handling takes seven times as long as a step of one world. This class overrides it.
    """

    @abstractmethod
    def lean_step(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Like `EnvBase.step_and_maybe_reset`, for all worlds."""

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        if not isinstance(tensordict, TensorDictBase):
            raise ValueError(f"tensordict is a {type(tensordict).__name__}; allowed: a TensorDict")
        if "next" in tensordict or "_step" in tensordict:  # a step of some worlds, or into given tensors
            return super()._step_and_maybe_reset(tensordict)  # type: ignore[no-any-return]
        return self.lean_step(tensordict)


def flag_spec(*shape: int) -> Categorical:
    """The spec of bools with a shape [B, ...], or [B, N, ...] in a group of agents.

    `Binary` describes the same values but treats its last axis as one vector: a spec [B, N] cannot be indexed
    in a group of shape [B, N], so `EnvBase.observation_spec_unbatched` raises an IndexError.
    """
    return Categorical(2, shape=shape, dtype=torch.bool)
