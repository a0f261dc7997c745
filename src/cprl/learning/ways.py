"""Which way many lanes are updated: the fastest whose gradients are those of the plain list.

"lane axis": the networks' parameters carry a lane axis, under one ordinary loss; wants `QNetwork`s.
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

from cprl.learning.functional import MakeLoss
from cprl.learning.fused import FunctionalUpdate
from cprl.learning.replay import lane_buffer
from cprl.learning.transitions import LaneTurn, array_of
from cprl.learning.updates import ListUpdate, Update

Way = Literal["lane axis", "lane axis, flat", "vmap", "list"]

TRIAL_LANES: Final = 2
"""Lanes of a trial: enough to show what one lane would take from another."""
TRIAL_TRANSITIONS: Final = 16
TRIAL_UPDATES: Final = 3
"""Enough to show weights or targets that are not those of the last update."""
TRIAL_STEP: Final = {"learning_rate": 0.1, "adam_eps": 1.0}
"""By Adam's first step of this size a weight changes by 0.1 g / (abs(g) + 1), g its gradient."""
TOLERANCE: Final = 1e-4
"""How far losses and changes of weights, in float32, may be from those of the list."""


def make_update(
    way: Way | None,
    networks: Sequence[nn.Module],
    make_loss: MakeLoss,
    *,
    compile: bool,
    trial: TensorDict,
    **how: Any,
) -> Update:
    """An update of all lanes; see `FunctionalUpdate` for the arguments that are not said here.

    Args:
        way: how; None for the first that passes a trial, in the order of `Way`.
        networks: of the lanes.
        make_loss: a lane's loss out of its network.
        compile: whether it is compiled, but for the list.
        trial: a made-up batch for the first `TRIAL_LANES` lanes, see `trial_batch`.

    Raises:
        ValueError: for an unknown way.
    """
    if way is None:
        way = fitting_way(networks[:TRIAL_LANES], make_loss, trial)
    if way not in get_args(Way):
        raise ValueError(f"way is {way!r}; allowed: {', '.join(get_args(Way))}")
    return _update(way, networks, make_loss, compile=compile, **how)


def fitting_way(networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict) -> Way:
    """The first way that does on a trial what the plain list does; warns where that is the list itself.

    Args:
        networks: of some lanes; copies of them are tried.
        make_loss: a lane's loss out of its network.
        trial: a made-up batch of these lanes.
    """
    wanted = _tried("list", networks, make_loss, trial)
    reasons = []
    for way in get_args(Way)[:-1]:
        try:
            came = _tried(way, networks, make_loss, trial)
            if _agree(came, wanted) or _agree_in_double(way, networks, make_loss, trial):
                fitting: Way = way
                return fitting
        except Exception as error:  # whatever a loss or network of the user's own does not bear
            reasons.append(f"{way}: {(str(error) or repr(error)).splitlines()[0]}")
            continue
        reasons.append(f"{way}: agents would not learn what each learns alone")
    warnings.warn(
        f"agents learn one after the other, many times slower; {'; '.join(reasons)}",
        RuntimeWarning,
        stacklevel=4,
    )
    return "list"


def _agree(came: Sequence[Tensor], wanted: Sequence[Tensor]) -> bool:
    return all(torch.allclose(*pair, TOLERANCE, TOLERANCE) for pair in zip(came, wanted, strict=True))


def _agree_in_double(way: Way, networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict) -> bool:
    """Whether a way agrees with the list in double precision: the steps of a trial are so large that a loss
    like that of QMIX, with many inputs, makes more of what single precision rounds than is tolerated."""
    doubles = [deepcopy(network).double() for network in networks]
    batch = trial.apply(lambda entry: entry.double() if entry.is_floating_point() else entry)
    try:
        came, wanted = (_tried(each, doubles, make_loss, batch) for each in (way, "list"))
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


def _update(
    way: Way, networks: Sequence[nn.Module], make_loss: MakeLoss, *, compile: bool, **how: Any
) -> Update:
    if way == "list":
        return ListUpdate(networks, make_loss, **how)
    axis, flat = way.startswith("lane axis"), way == "lane axis, flat"
    return FunctionalUpdate(networks, make_loss, lane_axis=axis, flat=flat, compile=compile, **how)


def _tried(way: Way, networks: Sequence[nn.Module], make_loss: MakeLoss, trial: TensorDict) -> list[Tensor]:
    """The losses of some updates of copies of the networks, targets replaced after all but the last, the
    weights that act after them, and for each lane the sums of all its weights and of their squares."""
    update = _update(way, deepcopy(list(networks)), make_loss, compile=False, **TRIAL_STEP)
    came = []
    for _ in range(TRIAL_UPDATES):
        came.append(update.learn_from(trial.clone()))
        if len(came) < TRIAL_UPDATES:
            update.copy_to_targets(torch.ones(len(networks), dtype=torch.bool))
    for lane in range(len(networks)):
        everything = torch.cat([weight.flatten() for weight in update.weights(lane).values()])
        came += [*update.network_state(lane).values(), everything.sum(), everything.square().sum()]
    return came
