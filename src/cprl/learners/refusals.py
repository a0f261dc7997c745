"""Checks of a user's losses and networks: those that do not fit the memory or the settings are refused before
a training writes anything."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import A2CLoss, LossModule, PPOLoss, ReinforceLoss, ValueEstimators
from torchrl.objectives.value import GAE, TD0Estimator, ValueEstimatorBase

from cprl.learners.loss_state import changed_state
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.networks.agent import AgentNetworks, networks_by_name
from cprl.objectives.functional import make_lazy_parts, mark_targets_updated, targets_of, total


def refuse_for_replay(loss: LossModule, settings: DQNSettings, make_batch: Callable[[], TensorDict]) -> None:
    """Raise a ValueError if the loss of a lane cannot learn from a replay buffer with these settings.

    Args:
        make_batch: makes synthetic transitions, [b]; with `n_steps` above 1 the loss is tried with them.
    """
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
    for holder in (loss, *_estimators(loss)):
        _refuse_other_number(loss, holder, "gamma", "gamma", settings)
    mark_targets_updated(loss)
    if _ignores_steps(loss, make_batch()):
        raise ValueError(
            f'n_steps is {settings.n_steps}; allowed: 1, because {name} does not read "steps_to_next_obs" '
            "and would discount the bootstrap value by one step"
        )


def refuse_other_advantages(loss: LossModule, settings: RolloutSettings) -> None:
    """Raise a ValueError if a loss needs other advantages than `Rollouts` computes."""
    estimator = loss.value_type
    is_gae = isinstance(estimator, type) and issubclass(estimator, GAE)
    if not is_gae and estimator not in (None, ValueEstimators.GAE, ValueEstimators.MAGAE):
        raise ValueError(
            f"{type(loss).__name__} has the value estimator {estimator}; allowed: GAE, which "
            "Rollouts computes: leave make_value_estimator out, and set gamma and gae_lambda in the "
            "settings"
        )
    for estimator_module in _estimators(loss):
        _refuse_other_number(loss, estimator_module, "gamma", "gamma", settings)
        _refuse_other_number(loss, estimator_module, "lmbda", "gae_lambda", settings)


def _refuse_other_number(
    loss: LossModule, holder: Any, name: str, field: str, settings: DQNSettings | RolloutSettings
) -> None:
    """Raise a ValueError if a loss, or its value estimator, has another number than the settings.

    Args:
        holder: the loss or the estimator.
        name: the attribute of the holder, if it has one.
        field: the field of the settings that must be equal.
    """
    expected = getattr(settings, field)
    value = float(getattr(holder, name, expected))
    if abs(value - expected) > 1e-6:
        raise ValueError(
            f"{type(loss).__name__} has {name} {value:g} and the settings have {field} {expected:g}, "
            "by which the learner sums rewards; they must be equal, or leave make_value_estimator out"
        )


def check_loss(loss: LossModule, batch: TensorDict) -> list[str]:
    """Call a loss twice with a batch, [b]; return the names of the state that it keeps between calls.

    Raises:
        ValueError: if it reads entries that the batch does not have, returns no loss, draws from torch's
            global generator, or keeps state that no checkpoint has, see `changed_state`.
    """
    mark_targets_updated(loss)
    make_lazy_parts(loss)
    return changed_state(loss, lambda: _check_call(loss, batch.clone()))


def _check_call(loss: LossModule, batch: TensorDict) -> None:
    """Call a loss; raise a ValueError if it lacks entries of the batch or draws from torch's generator."""
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
    """Return whether a loss says that it reads an entry."""
    try:
        return key in (getattr(loss, "in_keys", None) or ())
    except NotImplementedError:
        return False


def _estimators(loss: LossModule) -> list[ValueEstimatorBase]:
    """Return the value estimators of a loss."""
    return [child for child in loss.children() if isinstance(child, ValueEstimatorBase)]


def _ignores_steps(loss: LossModule, batch: TensorDict) -> bool:
    """Return whether a loss bootstraps with a discount that does not depend on the steps of a return.

    It bootstraps if its value depends on whether episodes terminate.
    """

    def loss_with(steps: int, *, terminated: bool) -> Tensor:
        trial = batch.clone()
        trial["steps_to_next_obs"] = torch.full_like(trial["steps_to_next_obs"], steps)
        trial["next", "terminated"] = torch.full_like(trial["next", "terminated"], terminated)
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            value: Tensor = total(loss(trial), loss).mean()
        return value

    one_step = loss_with(1, terminated=False)
    bootstraps = not torch.equal(one_step, loss_with(1, terminated=True))
    return bootstraps and torch.equal(one_step, loss_with(99, terminated=False))


def refuse_other_networks(network: nn.Module) -> None:
    """Raise a ValueError unless the networks of an agent are an "actor" and a "critic"."""
    names = list(networks_by_name(network))
    if not isinstance(network, AgentNetworks) or names[:2] != ["actor", "critic"]:
        raise ValueError(f'an agent has the networks {names}; allowed: "actor" and "critic"')
