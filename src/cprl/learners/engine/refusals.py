"""Checks before training that a learner can train a loss correctly; each error names the loss."""

from collections.abc import Iterable
from typing import Final

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import A2CLoss, LossModule, PPOLoss, ReinforceLoss, ValueEstimators
from torchrl.objectives.value import GAE, TD0Estimator, ValueEstimatorBase

from cprl.learners.engine.functional import own_targets, targets_of, total
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.system.compat import promise_targets

_OF_ONE_STEP: Final = (None, ValueEstimators.TD0, TD0Estimator)
_OF_ROLLOUTS: Final = (None, ValueEstimators.GAE, ValueEstimators.MAGAE)


def refuse_for_replay(loss: LossModule, settings: DQNSettings, batch: TensorDict) -> None:
    """Raises a ValueError if a loss cannot learn from a replay buffer with these settings.

    Args:
        loss: the loss of one lane; it is called if `n_steps` is above 1.
        settings: the hyperparameters.
        batch: synthetic transitions of one lane, [b].
    """
    refuse_on_policy(loss)
    _refuse_without_targets(loss, settings)
    name = type(loss).__name__
    if settings.n_steps == 1:
        return
    for owner in (loss, *_estimators(loss)):
        gamma = getattr(owner, "gamma", settings.gamma)
        if abs(float(gamma) - settings.gamma) > 1e-6:
            raise ValueError(
                f"{name} has gamma {float(gamma):g} and the settings have gamma {settings.gamma:g}; with "
                "n_steps above 1 they must be equal"
            )
    own_targets(loss)
    if _ignores_steps(loss, batch):
        raise ValueError(
            f'n_steps is {settings.n_steps}; allowed: 1, because {name} does not read "steps_to_next_obs" '
            "and would discount the bootstrap value by one step"
        )


def refuse_on_policy(loss: LossModule) -> None:
    """Raises a ValueError if a loss needs consecutive steps, or steps of the current policy."""
    name = type(loss).__name__
    if isinstance(loss, A2CLoss | PPOLoss | ReinforceLoss):
        raise ValueError(
            f"{name} is on-policy and cannot learn from a replay buffer; use RolloutLearner, or "
            "cprl.algorithms.PPO, A2C or Reinforce in a population"
        )
    if loss.value_type not in _OF_ONE_STEP:
        raise ValueError(
            f"{name} has the value estimator {_name(loss.value_type)}, which reads consecutive steps; a "
            "replay buffer samples single transitions; allowed: ValueEstimators.TD0, with n_steps for longer "
            "returns"
        )


def _refuse_without_targets(loss: LossModule, settings: DQNSettings) -> None:
    """Raises a ValueError for settings of targets, if a loss has none."""
    for name, default in (("tau", None), ("own_target_weights", False)):
        if getattr(settings, name) != default and not targets_of(loss):
            raise ValueError(
                f"{name} is {getattr(settings, name)}; allowed: {default}, because {type(loss).__name__} has "
                "no targets"
            )


def refuse_other_advantages(loss: LossModule, settings: RolloutSettings) -> None:
    """Raises a ValueError if a loss needs other advantages than those of `RolloutLearner`."""
    name = type(loss).__name__
    if loss.value_type not in _OF_ROLLOUTS and not _is_gae(loss.value_type):
        raise ValueError(
            f"{name} has the value estimator {_name(loss.value_type)}; allowed: GAE, which RolloutLearner "
            "computes: leave make_value_estimator out, and set gamma and gae_lambda in the settings"
        )
    for estimator in _estimators(loss):
        for of_loss, of_settings in (("gamma", "gamma"), ("lmbda", "gae_lambda")):
            theirs, ours = float(getattr(estimator, of_loss)), getattr(settings, of_settings)
            if abs(theirs - ours) > 1e-6:
                raise ValueError(
                    f"{name} has a value estimator with {of_loss}={theirs:g}; the settings have "
                    f"{of_settings}={ours:g}, which RolloutLearner uses: leave make_value_estimator out"
                )


def refuse_other_outputs(loss: LossModule, batch: TensorDict) -> None:
    """Raises a ValueError if a loss returns no entry that is a loss.

    Args:
        loss: the loss of one lane; it is called.
        batch: a synthetic batch of one lane, [b].
    """
    promise_targets(loss)
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        total(loss(batch.clone()), loss)


def reads(loss: LossModule, key: str) -> bool:
    """Whether an entry is among the keys that a loss reads."""
    try:
        listed: Iterable[object] = getattr(loss, "in_keys", None) or ()
    except NotImplementedError:
        return False
    return key in listed


def _estimators(loss: LossModule) -> list[ValueEstimatorBase]:
    """The value estimator that a loss was constructed with, if any."""
    return [child for child in loss.children() if isinstance(child, ValueEstimatorBase)]


def _is_gae(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, GAE)


def _name(kind: object) -> str:
    return kind.__name__ if isinstance(kind, type) else str(kind)


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
