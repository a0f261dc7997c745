"""Trials: which way of updating fits a loss of a user's own, and which losses learners refuse.

The algorithms of cprl name theirs (`cprl.algorithms.base.Algorithm.batching`); tests show that trials agree.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import A2CLoss, LossModule, PPOLoss, ReinforceLoss, ValueEstimators
from torchrl.objectives.value import GAE, TD0Estimator, ValueEstimatorBase

from cprl.learners.engine import WAYS, Batching, MakeLoss, UpdateRule, make_engine
from cprl.learners.ring import Ring, TransitionForm
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.objectives.functional import groups_of, own_targets, targets_of, total
from cprl.system.compiling import TOLERANCE

TRIAL_LANES: Final = 2
"""Enough to show whether lanes influence each other."""
TRIAL_TRANSITIONS: Final = 16
TRIAL_UPDATES: Final = 3  # enough to show stale weights or targets
TRIAL_RULE: Final = UpdateRule(learning_rate=0.1, adam_eps=1.0)
"""With these values Adam's first step changes a weight by 0.1 g / (abs(g) + 1), where g is its gradient."""


def fitting_engine(
    networks: Sequence[nn.Module],
    make_loss: MakeLoss,
    trial: TensorDict,
    ways: Sequence[Batching] = WAYS,
) -> Batching:
    """The first of some ways that agrees with the plain list on a trial; "list" with a warning if none does.

    Raises:
        ValueError: if the loss reads entries that batches do not have, or returns no loss.
    """
    try:
        _tried("list", networks, make_loss, trial)
    except KeyError as error:
        entries = ", ".join(sorted(trial.flatten_keys("/").keys()))
        raise ValueError(
            f"the loss reads an entry that its batches do not have: {error}; they have {entries}"
        ) from error
    changed = _changed_buffers(networks[0], make_loss, trial)
    reasons = []
    for batching in ways:
        try:
            if changed:
                raise ValueError(f"agents would share buffers that the loss changes: {', '.join(changed)}")
            if agrees(batching, networks, make_loss, trial):
                return batching
        except Exception as error:  # a user's loss or network may raise anything
            reasons.append(f"{batching}: {(str(error) or repr(error)).splitlines()[0]}")
            continue
        reasons.append(f"{batching}: the updates differ from those of agents that learn alone")
    if reasons:
        warnings.warn(
            f"agents are updated one after the other, which is many times slower; {'; '.join(reasons)}",
            RuntimeWarning,
            stacklevel=5,
        )
    return "list"


def agrees(batching: Batching, networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict) -> bool:
    """Whether a way of updating agrees with the list, in single or else in double precision: a trial takes
    large steps, so for losses with many inputs rounding in single precision can exceed the tolerance."""
    if _same(*(_tried(each, networks, make_loss, trial) for each in (batching, "list"))):
        return True
    with suppress(Exception):  # a user's network may not support double precision
        doubles = [deepcopy(network).double() for network in networks]
        batch = trial.apply(lambda entry: entry.double() if entry.is_floating_point() else entry)
        return _same(*(_tried(each, doubles, make_loss, batch) for each in (batching, "list")))
    return False


def _same(results: Sequence[Tensor], reference: Sequence[Tensor]) -> bool:
    return all(torch.allclose(*pair, TOLERANCE, TOLERANCE) for pair in zip(results, reference, strict=True))


def _tried(
    batching: Batching, networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict
) -> list[Tensor]:
    """Runs some updates of copies of the networks, with a copy to targets after all but the last.

    Returns:
        The losses of the updates; then for each lane its acting weights afterwards, the sum of all its
        weights and the sum of their squares.
    """
    engine = make_engine(deepcopy(list(networks)), make_loss, TRIAL_RULE, batching=batching, compile=False)
    results = []
    for _ in range(TRIAL_UPDATES):
        results.append(engine.update_from(trial.clone()))
        if len(results) < TRIAL_UPDATES:
            engine.copy_to_targets(torch.ones(len(networks), dtype=torch.bool))
    for lane in range(len(networks)):
        everything = torch.cat([weight.flatten() for weight in engine.weights(lane).values()])
        acting = [value for _, value in sorted(engine.network_state(lane).items())]
        results += [*acting, everything.sum(), everything.square().sum()]
    return results


def _changed_buffers(network: nn.Module, make_loss: MakeLoss, trial: TensorDict) -> list[str]:
    """The names of a loss's buffers, other than its weights, that change when it is called."""
    loss = make_loss(deepcopy(network))
    own_targets(loss)
    weights = tuple(f"{name}." for name in groups_of(loss))
    numbers = {name: buffer for name, buffer in loss.named_buffers() if not name.startswith(weights)}
    before = {name: buffer.clone() for name, buffer in numbers.items()}
    with torch.random.fork_rng():
        loss(trial[0].clone())
    return [name for name, buffer in numbers.items() if not torch.equal(buffer, before[name])]


def trial_batch(
    lanes: int, form: TransitionForm, actions: int, *, device: str | torch.device = "cpu"
) -> TensorDict:
    """Synthetic transitions [lanes, 8], or sequences, always the same; one in eight ends an episode."""
    ring = Ring(
        form,
        seeds=[(lane,) for lane in range(lanes)],
        transitions=TRIAL_TRANSITIONS + form.steps_ahead,
        batch_size=8,
        device=device,
    )
    ring.fill(actions, torch.Generator().manual_seed(0))
    return ring.sample()


def trial_rollout(
    transitions: TensorDict,
    *,
    actions: int | None = None,
    states: Mapping[str, Sequence[int]] | None = None,
) -> TensorDict:
    """A synthetic batch of a rollout, from synthetic transitions: with the logits of so many actions, and the
    states of recurrent networks, of these shapes, whose every third step is an init."""
    chance, device = torch.Generator().manual_seed(1), transitions["action"].device
    batch = transitions.select("observation", "action")

    def uniform(*shape: int) -> Tensor:
        return torch.rand((*transitions["action"].shape, *shape), generator=chance).to(device)

    for name in ("advantage", "value_target", "state_value"):
        batch[name] = uniform(1)
    batch["action_log_prob"] = batch["advantage"].squeeze(-1) - 2.5
    if actions is not None:
        batch["logits"] = uniform(actions)
    for name, shape in (states or {}).items():
        batch[name] = torch.rand((*batch.batch_size, *shape), generator=chance).to(device)
        thirds = torch.arange(batch.batch_size[1], device=device) % 3 == 0
        batch["is_init"] = thirds.expand(batch.batch_size)
    return batch


def refuse_for_replay(loss: LossModule, settings: DQNSettings, make_batch: Callable[[], TensorDict]) -> None:
    """Raises a ValueError if the loss of a lane cannot learn from a replay buffer with these settings; with
    `n_steps` above 1 it is tried with synthetic transitions, [b]."""
    name = type(loss).__name__
    if isinstance(loss, A2CLoss | PPOLoss | ReinforceLoss):
        raise ValueError(
            f"{name} is on-policy and cannot learn from a replay buffer; use RolloutLearner, or "
            "cprl.algorithms.PPO, A2C or Reinforce in a population"
        )
    if loss.value_type not in (None, ValueEstimators.TD0, TD0Estimator):
        raise ValueError(
            f"{name} has the value estimator {loss.value_type}, which reads consecutive steps; a "
            "replay buffer samples single transitions; allowed: ValueEstimators.TD0, with n_steps for longer "
            "returns"
        )
    for field, default in (("tau", None), ("own_target_weights", False)):
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
    """Raises a ValueError if a loss needs other advantages than those of `RolloutLearner`."""
    kind = loss.value_type
    is_gae = isinstance(kind, type) and issubclass(kind, GAE)
    if not is_gae and kind not in (None, ValueEstimators.GAE, ValueEstimators.MAGAE):
        raise ValueError(
            f"{type(loss).__name__} has the value estimator {kind}; allowed: GAE, which "
            "RolloutLearner computes: leave make_value_estimator out, and set gamma and gae_lambda in the "
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
