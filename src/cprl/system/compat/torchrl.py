"""Environments, specs, losses, targets and estimators of TorchRL."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.modules.distributions.utils import has_analytic_entropy
from torchrl.objectives import LossModule, PPOLoss

from cprl.system.libraries import relying_on, require

require("torchrl", EnvBase, "_step_and_maybe_reset")
require("torchrl", LossModule, "_reduce_loss")
require("torchrl", PPOLoss, "_get_entropy")


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
    """Return the spec of bools with a shape [B, ...], or [B, N, ...] in a group of agents.

    `Binary` describes the same values but treats its last axis as one vector: a spec [B, N] cannot be indexed
    in a group of shape [B, N], so `EnvBase.observation_spec_unbatched` raises an IndexError.
    """
    return Categorical(2, shape=shape, dtype=torch.bool)


class LaneCategorical(torch.distributions.Categorical):
    """`Categorical` for the policies of several agents in one batch, of which one may be NaN.

    TorchRL's PPO losses replace the entropies of the whole batch by samples if one of them is not finite, and
    torch refuses to sample from NaN, on a GPU for the rest of the process. Here a policy of NaN has entropy 0
    and is sampled uniformly; the log-probabilities, and so that agent's loss, stay NaN. Nothing else differs.
    """

    def entropy(self) -> torch.Tensor:
        """Return the entropy, 0 for NaN."""
        entropy: torch.Tensor = super().entropy()  # type: ignore[no-untyped-call]
        # Compiled losses take a sample, and so the log-probability of one, where the entropy is NaN.
        return entropy if torch.compiler.is_compiling() else entropy.nan_to_num(nan=0.0)

    def sample(self, sample_shape: Any = ()) -> torch.Tensor:
        """Return samples, uniform for NaN; in compiled losses, which sample in every case and look at samples
        of NaN alone, always 0."""
        size = torch.Size(sample_shape)
        if torch.compiler.is_compiling():
            return self.probs.new_zeros(self._extended_shape(size), dtype=torch.int64)
        weights = self.probs.reshape(-1, self._num_events).nan_to_num(nan=1.0)
        return torch.multinomial(weights, size.numel(), True).T.reshape(self._extended_shape(size))


def entropy_by_formula(loss: LossModule) -> None:
    """Make a PPO loss take the entropy of its policy as the distribution computes it.

    TorchRL's asks whether the entropies of the whole batch are finite, to sample otherwise; a question that
    torch cannot vmap. A loss with another entropy, or a policy without a formula, stays as it is.
    """
    if getattr(type(loss), "_get_entropy", None) is not PPOLoss._get_entropy:
        return
    by_samples = loss._get_entropy

    def entropy_of(dist: torch.distributions.Distribution, **shape: Any) -> Any:
        if not has_analytic_entropy(dist):
            return by_samples(dist, **shape)
        return dist.entropy().unsqueeze(-1)

    loss._get_entropy = entropy_of


class ReshapedLoss:
    """A mixin for a `LossModule` that applies a function to the loss of each transition before weighting and
    reduction. List it before the loss among the base classes.

    TorchRL's losses know their distances by name, see `torchrl.objectives.utils.distance_loss`, and hand what
    those give to the private `LossModule._reduce_loss`, which this class overrides. The loss must call it
    once. This is no `LossModule` itself: the class of one has a `forward`, which would hide that of the loss.
    """

    def reshape_each(self, losses: torch.Tensor) -> torch.Tensor:
        """Apply the function to losses of any shape."""
        raise NotImplementedError

    def _reduce_loss(self, loss: torch.Tensor, **options: Any) -> Any:
        return super()._reduce_loss(self.reshape_each(loss), **options)  # type: ignore[misc]


def updated_weights(loss: LossModule) -> list[str]:
    """Return the names of the weights whose targets a TorchRL target updater updates."""
    return [name for name, is_updated in _targets_of(loss).items() if is_updated]


def refuse_updaters(loss: LossModule, message: str) -> None:
    """Make a loss refuse TorchRL's target updaters, which read the names of its targets first."""
    loss._has_update_associated = _Refusing(_targets_of(loss), message)


class _Refusing(dict[str, bool]):
    """One class for all losses: compiled code is shared only between learners of the same classes."""

    def __init__(self, names: Mapping[str, bool], message: str) -> None:
        super().__init__(names)
        self._message = message

    def keys(self) -> Any:
        raise ValueError(self._message)


def promise_targets(loss: LossModule) -> None:
    """Mark the targets of a loss as updated, so that it does not warn about a missing TorchRL updater;
    the networks that have the loss update them."""
    targets = _targets_of(loss)
    for name in targets:
        targets[name] = True


def _targets_of(loss: LossModule) -> dict[str, bool]:
    """Return whether a TorchRL updater updates the targets of weights, by the names of these weights."""
    with relying_on("torchrl", "LossModule._has_update_associated"):
        targets: dict[str, bool] = loss._has_update_associated
    return targets


def forget_cached_weights(loss: LossModule) -> None:
    """Clear the detached weights that some losses cache at a call, so that they can be replaced."""
    loss.__dict__.pop("_cache", None)
