"""Chooses the engine that updates many lanes: the fastest one with the gradients of the plain list.

"lane_axis": the networks' parameters have a lane axis, under one ordinary loss; needs networks that stack,
    see `cprl.networks.stacked.stack_lanes`.
"lane_axis_flat": the same, for losses that need a flat batch of transitions, [L x b].
"vmapped": `torch.vmap` of the loss over stacked parameters; works with any network.
"list": a loss module for each lane, one after the other; works with any loss.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from typing import Final, Literal, get_args

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import A2CLoss, LossModule, PPOLoss, ReinforceLoss, ValueEstimators
from torchrl.objectives.value import GAE, TD0Estimator, ValueEstimatorBase

from cprl.learners.engine import (
    Engine,
    FunctionalEngine,
    ListEngine,
    MakeLoss,
    UpdateRule,
    groups_of,
    own_targets,
    targets_of,
    total,
)
from cprl.learners.ring import STATE, Ring, TransitionForm
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.learners.transitions import LaneTurn, array_of
from cprl.system.compat import promise_targets
from cprl.system.compiling import TOLERANCE

EngineName = Literal["lane_axis", "lane_axis_flat", "vmapped", "list"]

TRIAL_LANES: Final = 2
"""Lanes of a trial: enough to show whether lanes influence each other."""
TRIAL_TRANSITIONS: Final = 16
TRIAL_UPDATES: Final = 3
"""Enough to show stale weights or targets."""
TRIAL_RULE: Final = UpdateRule(learning_rate=0.1, adam_eps=1.0)
"""With these values Adam's first step changes a weight by 0.1 g / (abs(g) + 1), where g is its gradient."""


def fitting_engine(networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict) -> EngineName:
    """The first engine, in the order of `EngineName`, that agrees with the plain list on a trial; warns if
    only the list itself is left.
    """
    try:
        reference = _tried("list", networks, make_loss, trial)
    except KeyError as error:
        entries = ", ".join(
            sorted("/".join(key) if isinstance(key, tuple) else key for key in trial.keys(True, True))
        )
        raise ValueError(
            f"the loss reads an entry that its batches do not have: {error}; they have {entries}"
        ) from error
    changed = _changed_buffers(networks[0], make_loss, trial)
    reasons = []
    for name in get_args(EngineName)[:-1]:
        try:
            if changed:
                raise ValueError(f"agents would share buffers that the loss changes: {', '.join(changed)}")
            results = _tried(name, networks, make_loss, trial)
            if _agree(results, reference) or _agree_in_double(name, networks, make_loss, trial):
                fitting: EngineName = name
                return fitting
        except Exception as error:  # a user's loss or network may raise anything
            reasons.append(f"{name}: {(str(error) or repr(error)).splitlines()[0]}")
            continue
        reasons.append(f"{name}: the updates differ from those of agents that learn alone")
    warnings.warn(
        f"agents are updated one after the other, which is many times slower; {'; '.join(reasons)}",
        RuntimeWarning,
        stacklevel=4,
    )
    return "list"


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


def _agree(results: Sequence[Tensor], reference: Sequence[Tensor]) -> bool:
    return all(torch.allclose(*pair, TOLERANCE, TOLERANCE) for pair in zip(results, reference, strict=True))


def _agree_in_double(
    name: EngineName, networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict
) -> bool:
    """Whether an engine agrees with the list in double precision. A trial takes large steps, so for losses
    with many inputs, such as that of QMIX, rounding in single precision can exceed the tolerance."""
    doubles = [deepcopy(network).double() for network in networks]
    batch = trial.apply(lambda entry: entry.double() if entry.is_floating_point() else entry)
    try:
        results, reference = (_tried(each, doubles, make_loss, batch) for each in (name, "list"))
    except Exception:  # a user's network may not support double precision
        return False
    return _agree(results, reference)


def trial_batch(
    lanes: int, form: TransitionForm, actions: int, *, device: str | torch.device = "cpu"
) -> TensorDict:
    """Synthetic transitions [lanes, 8], or sequences, always the same; an episode ends with every eighth
    turn."""
    ahead = form.horizon.steps if form.horizon else form.sequence_steps
    ring = Ring(
        form,
        seeds=[(lane,) for lane in range(lanes)],
        transitions=TRIAL_TRANSITIONS + ahead - 1,
        batch_size=8,
        device=device,
    )
    fields, chance = ring.fields, torch.Generator().manual_seed(0)
    for step in range(ring.capacity):
        seen = torch.randint(256, (2, lanes, *form.observation_shape), generator=chance).to(torch.uint8)
        if fields["observation"].dtype != torch.uint8:
            seen = (seen > 127).to(fields["observation"].dtype)
        action = torch.randint(actions, fields["action"].shape[1:], generator=chance)
        ends = torch.full((lanes,), step % 8 == 7)
        reward = torch.rand(fields["reward"].shape[1:], generator=chance)
        states = torch.rand((2, lanes, fields[STATE].shape[-1]), generator=chance) if STATE in fields else ()
        turn = seen[0], action, seen[1], reward, ends, ends, *states
        ring.write(LaneTurn(*(array_of(entry.to(ring.device)) for entry in turn)))
    return ring.sample()


def trial_rollout(
    transitions: TensorDict,
    *,
    actions: int | None = None,
    states: Mapping[str, Sequence[int]] | None = None,
) -> TensorDict:
    """A synthetic batch of a rollout, from synthetic transitions.

    Args:
        actions: their number A, for a batch with logits.
        states: the shapes of the states of recurrent networks by their entries; every third step is an init.
    """
    chance = torch.Generator().manual_seed(1)
    batch = transitions.select("observation", "action")
    device = batch["action"].device
    for name in ("advantage", "value_target", "state_value"):
        batch[name] = torch.rand((*batch["action"].shape, 1), generator=chance).to(device)
    batch["action_log_prob"] = batch["advantage"].squeeze(-1) - 2.5
    if actions is not None:
        batch["logits"] = torch.rand((*batch["action"].shape, actions), generator=chance).to(device)
    for name, shape in (states or {}).items():
        batch[name] = torch.rand((*batch.batch_size, *shape), generator=chance).to(device)
        batch["is_init"] = (torch.arange(batch.batch_size[1], device=device) % 3 == 0).expand(
            batch.batch_size
        )
    return batch


def make_engine(
    name: EngineName,
    networks: Sequence[nn.Module],
    make_loss: MakeLoss,
    rule: UpdateRule,
    *,
    target_networks: Sequence[nn.Module] | None = None,
    compile: bool,
) -> Engine:
    """The engine of this name over the networks of all lanes; `compile` is ignored for "list"."""
    if name == "list":
        return ListEngine(networks, make_loss, rule, target_networks=target_networks)
    return FunctionalEngine(
        networks,
        make_loss,
        rule,
        target_networks=target_networks,
        lane_axis=name.startswith("lane_axis"),
        flat=name == "lane_axis_flat",
        compile=compile,
    )


def _tried(
    name: EngineName, networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict
) -> list[Tensor]:
    """Runs some updates of copies of the networks, with a copy to targets after all but the last.

    Returns:
        The losses of the updates; then for each lane its acting weights afterwards, the sum of all its
        weights and the sum of their squares.
    """
    engine = make_engine(name, deepcopy(list(networks)), make_loss, TRIAL_RULE, compile=False)
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


_OF_ONE_STEP: Final = (None, ValueEstimators.TD0, TD0Estimator)
_OF_ROLLOUTS: Final = (None, ValueEstimators.GAE, ValueEstimators.MAGAE)


def refuse_for_replay(loss: LossModule, settings: DQNSettings, batch: TensorDict) -> None:
    """Raises a ValueError if a loss cannot learn from a replay buffer with these settings.

    Args:
        loss: the loss of one lane; it is called if `n_steps` is above 1.
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
    for name, default in (("tau", None), ("own_target_weights", False)):
        if getattr(settings, name) != default and not targets_of(loss):
            raise ValueError(
                f"{name} is {getattr(settings, name)}; allowed: {default}, because {type(loss).__name__} has "
                "no targets"
            )


def refuse_other_advantages(loss: LossModule, settings: RolloutSettings) -> None:
    """Raises a ValueError if a loss needs other advantages than those of `RolloutLearner`."""
    name = type(loss).__name__
    kind = loss.value_type
    if kind not in _OF_ROLLOUTS and not (isinstance(kind, type) and issubclass(kind, GAE)):
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
    promise_targets(loss)
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        total(loss(batch.clone()), loss)


def reads(loss: LossModule, key: str) -> bool:
    try:
        listed: Iterable[object] = getattr(loss, "in_keys", None) or ()
    except NotImplementedError:
        return False
    return key in listed


def _estimators(loss: LossModule) -> list[ValueEstimatorBase]:
    return [child for child in loss.children() if isinstance(child, ValueEstimatorBase)]


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
