"""Which way many lanes are updated: the fastest whose gradients are those of the plain list.

"lane axis": the networks' parameters carry a lane axis, under one ordinary loss; wants `MLPNetwork`s.
"lane axis, flat": the same, for losses that want transitions in a row.
"vmap": the loss is vmapped over stacked parameters; takes any network.
"list": a loss module for each lane, one after the other; takes any loss.
"""

import warnings
from collections.abc import Sequence
from copy import deepcopy
from typing import Any, Final, Literal, get_args

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from cprl.learners.buffer.sampler import lane_buffer
from cprl.learners.engine.base import Engine, ListEngine
from cprl.learners.engine.compiled import FunctionalEngine
from cprl.learners.engine.functional import MakeLoss
from cprl.learners.transitions import LaneTurn, array_of

EngineName = Literal["lane axis", "lane axis, flat", "vmap", "list"]

TRIAL_LANES: Final = 2
"""Lanes of a trial: enough to show what one lane would take from another."""
TRIAL_TRANSITIONS: Final = 16
TRIAL_UPDATES: Final = 3
"""Enough to show weights or targets that are not those of the last update."""
TRIAL_STEP: Final = {"learning_rate": 0.1, "adam_eps": 1.0}
"""By Adam's first step of this size a weight changes by 0.1 g / (abs(g) + 1), g its gradient."""
TOLERANCE: Final = 1e-4
"""How far losses and changes of weights, in float32, may be from those of the list."""


def make_engine(
    name: EngineName | None,
    networks: Sequence[nn.Module],
    make_loss: MakeLoss,
    *,
    compile: bool,
    trial: TensorDict,
    **how: Any,
) -> Engine:
    """An update of all lanes; see `FunctionalEngine` for the arguments that are not said here.

    Args:
        name: how; None for the first that passes a trial, in the order of `EngineName`.
        networks: of the lanes.
        make_loss: a lane's loss out of its network.
        compile: whether it is compiled, but for the list.
        trial: a made-up batch for the first `TRIAL_LANES` lanes, see `trial_batch`.

    Raises:
        ValueError: for an unknown way.
    """
    if name is None:
        name = fitting_engine(networks[:TRIAL_LANES], make_loss, trial)
    if name not in get_args(EngineName):
        raise ValueError(f"way is {name!r}; allowed: {', '.join(get_args(EngineName))}")
    return _make(name, networks, make_loss, compile=compile, **how)


def fitting_engine(networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict) -> EngineName:
    """The first way that does on a trial what the plain list does; warns where that is the list itself.

    Args:
        networks: of some lanes; copies of them are tried.
        make_loss: a lane's loss out of its network.
        trial: a made-up batch of these lanes.
    """
    wanted = _tried("list", networks, make_loss, trial)
    reasons = []
    for name in get_args(EngineName)[:-1]:
        try:
            came = _tried(name, networks, make_loss, trial)
            if _agree(came, wanted) or _agree_in_double(name, networks, make_loss, trial):
                fitting: EngineName = name
                return fitting
        except Exception as error:  # whatever a loss or network of the user's own does not bear
            reasons.append(f"{name}: {(str(error) or repr(error)).splitlines()[0]}")
            continue
        reasons.append(f"{name}: agents would not learn what each learns alone")
    warnings.warn(
        f"agents learn one after the other, many times slower; {'; '.join(reasons)}",
        RuntimeWarning,
        stacklevel=4,
    )
    return "list"


def _agree(came: Sequence[Tensor], wanted: Sequence[Tensor]) -> bool:
    return all(torch.allclose(*pair, TOLERANCE, TOLERANCE) for pair in zip(came, wanted, strict=True))


def _agree_in_double(
    name: EngineName, networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict
) -> bool:
    """Whether a way agrees with the list in double precision: the steps of a trial are so large that a loss
    like that of QMIX, with many inputs, makes more of what single precision rounds than is tolerated."""
    doubles = [deepcopy(network).double() for network in networks]
    batch = trial.apply(lambda entry: entry.double() if entry.is_floating_point() else entry)
    try:
        came, wanted = (_tried(each, doubles, make_loss, batch) for each in (name, "list"))
    except Exception:  # a network of the user's own may not bear double precision
        return False
    return _agree(came, wanted)


def trial_batch(
    lanes: int,
    observation_shape: Sequence[int],
    actions: int,
    *,
    action_shape: Sequence[int] = (),
    device: str | torch.device = "cpu",
) -> TensorDict:
    """Made-up transitions [lanes, 8], the same every time; one in eight ends an episode."""
    buffer = lane_buffer(
        seeds=[(lane,) for lane in range(lanes)],
        transitions=TRIAL_TRANSITIONS,
        batch_size=8,
        observation_shape=observation_shape,
        action_shape=action_shape,
        device=device,
    )
    chance = torch.Generator().manual_seed(0)
    for step in range(TRIAL_TRANSITIONS):
        seen = torch.randint(256, (2, lanes, *observation_shape), generator=chance).to(torch.uint8)
        action = torch.randint(actions, (lanes, *action_shape), generator=chance)
        ends = torch.full((lanes,), step % 8 == 7)
        turn = seen[0], action, seen[1], torch.rand(lanes, generator=chance), ends, ends
        buffer.storage.write(LaneTurn(*(array_of(entry.to(device)) for entry in turn)))
    batch: TensorDict = buffer.sample()
    return batch


def _make(
    name: EngineName, networks: Sequence[nn.Module], make_loss: MakeLoss, *, compile: bool, **how: Any
) -> Engine:
    if name == "list":
        return ListEngine(networks, make_loss, **how)
    axis, flat = name.startswith("lane axis"), name == "lane axis, flat"
    return FunctionalEngine(networks, make_loss, lane_axis=axis, flat=flat, compile=compile, **how)


def _tried(
    name: EngineName, networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict
) -> list[Tensor]:
    """The losses of some updates of copies of the networks, targets replaced after all but the last, the
    weights that act after them, and for each lane the sums of all its weights and of their squares."""
    engine = _make(name, deepcopy(list(networks)), make_loss, compile=False, **TRIAL_STEP)
    came = []
    for _ in range(TRIAL_UPDATES):
        came.append(engine.update_from(trial.clone()))
        if len(came) < TRIAL_UPDATES:
            engine.copy_to_targets(torch.ones(len(networks), dtype=torch.bool))
    for lane in range(len(networks)):
        everything = torch.cat([weight.flatten() for weight in engine.weights(lane).values()])
        came += [*engine.network_state(lane).values(), everything.sum(), everything.square().sum()]
    return came
