"""What learners refuse before anything is written: losses and networks that do not fit their memory."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import A2CLoss, LossModule, PPOLoss, ReinforceLoss, ValueEstimators
from torchrl.objectives.value import GAE, TD0Estimator, ValueEstimatorBase

from cprl.learners.kept import kept_by
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.networks.agent import AgentNetworks, parts_of
from cprl.objectives.functional import make_lazy_parts, own_targets, targets_of, total


def refuse_for_replay(loss: LossModule, settings: DQNSettings, make_batch: Callable[[], TensorDict]) -> None:
    """Raises a ValueError if the loss of a lane cannot learn from a replay buffer with these settings; with
    `n_steps` above 1 it is tried with synthetic transitions, [b]."""
    name = type(loss).__name__
    if isinstance(loss, A2CLoss | PPOLoss | ReinforceLoss):
        raise ValueError(
            f"{name} is on-policy and cannot learn from a replay buffer; use "
            "cprl.algorithms.PPO, A2C or Reinforce"
        )
    if loss.value_type not in (None, ValueEstimators.TD0, TD0Estimator):
        raise ValueError(
            f"{name} has the value estimator {loss.value_type}, which reads consecutive steps; a "
            "replay buffer samples single transitions; allowed: ValueEstimators.TD0, with n_steps for longer "
            "returns"
        )
    for field, default in (("tau", None), ("target_every_updates", None), ("own_target_weights", False)):
        if getattr(settings, field) != default and not targets_of(loss):
            raise ValueError(
                f"{field} is {getattr(settings, field)}; allowed: {default}, because {name} has no targets"
            )
    if settings.n_steps == 1:
        return
    for owner in (loss, *_estimators(loss)):
        _refuse_another(loss, owner, "gamma", "gamma", settings)
    own_targets(loss)
    if _ignores_steps(loss, make_batch()):
        raise ValueError(
            f'n_steps is {settings.n_steps}; allowed: 1, because {name} does not read "steps_to_next_obs" '
            "and would discount the bootstrap value by one step"
        )


def refuse_other_advantages(loss: LossModule, settings: RolloutSettings) -> None:
    """Raises a ValueError if a loss needs other advantages than those of `Rollouts`."""
    kind = loss.value_type
    is_gae = isinstance(kind, type) and issubclass(kind, GAE)
    if not is_gae and kind not in (None, ValueEstimators.GAE, ValueEstimators.MAGAE):
        raise ValueError(
            f"{type(loss).__name__} has the value estimator {kind}; allowed: GAE, which "
            "Rollouts computes: leave make_value_estimator out, and set gamma and gae_lambda in the "
            "settings"
        )
    for owner in _estimators(loss):
        _refuse_another(loss, owner, "gamma", "gamma", settings)
        _refuse_another(loss, owner, "lmbda", "gae_lambda", settings)


def _refuse_another(
    loss: LossModule, owner: Any, name: str, field: str, settings: DQNSettings | RolloutSettings
) -> None:
    """Raises a ValueError if a loss or an estimator of it has another number than the settings."""
    expected = getattr(settings, field)
    value = float(getattr(owner, name, expected))
    if abs(value - expected) > 1e-6:
        raise ValueError(
            f"{type(loss).__name__} has {name} {value:g} and the settings have {field} {expected:g}, "
            "by which the learner sums rewards; they must be equal, or leave make_value_estimator out"
        )


def check_loss(loss: LossModule, batch: TensorDict) -> list[str]:
    """Return the names of what a loss keeps from call to call, of two calls with a batch, [b].

    Raises:
        ValueError: if it reads entries that the batch does not have, returns no loss, draws from torch's
            generator, or keeps what a checkpoint does not have, see `kept_by`.
    """
    own_targets(loss)
    make_lazy_parts(loss)
    return kept_by(loss, lambda: _check_call(loss, batch.clone()))


def _check_call(loss: LossModule, batch: TensorDict) -> None:
    entries = ", ".join(sorted(batch.flatten_keys("/").keys()))
    with torch.random.fork_rng(devices=[]):
        state = torch.get_rng_state()
        try:
            total(loss(batch), loss)
        except KeyError as error:
            raise ValueError(
                f"the loss reads an entry that its batches do not have: {error}; they have {entries}"
            ) from error
        if not torch.equal(torch.get_rng_state(), state):
            raise ValueError(
                f"the loss {type(loss).__name__}, or a network of it, draws from torch's random generator, "
                "by which agents would depend on each other; allowed: a loss that reads the entry "
                '"noise", see OffPolicy.noise_numbers, and networks without dropout'
            )


def reads(loss: LossModule, key: str) -> bool:
    """Whether a loss lists an entry among those that it reads."""
    try:
        return key in (getattr(loss, "in_keys", None) or ())
    except NotImplementedError:
        return False


def _estimators(loss: LossModule) -> list[ValueEstimatorBase]:
    return [child for child in loss.children() if isinstance(child, ValueEstimatorBase)]


def _ignores_steps(loss: LossModule, batch: TensorDict) -> bool:
    """Whether a loss bootstraps with a discount that does not depend on the steps of a return."""

    def of(steps: int, *, ends: bool) -> Tensor:
        tried = batch.clone()
        tried["steps_to_next_obs"] = torch.full_like(tried["steps_to_next_obs"], steps)
        tried["next", "terminated"] = torch.full_like(tried["next", "terminated"], ends)
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            value: Tensor = total(loss(tried), loss).mean()
        return value

    bootstraps = not torch.equal(of(1, ends=False), of(1, ends=True))
    return bootstraps and torch.equal(of(1, ends=False), of(99, ends=False))


def refuse_other_parts(network: nn.Module) -> None:
    """Raises a ValueError unless an agent has an "actor" and a "critic"."""
    parts = list(parts_of(network))
    if not isinstance(network, AgentNetworks) or parts[:2] != ["actor", "critic"]:
        raise ValueError(f'an agent has the networks {parts}; allowed: "actor" and "critic"')
