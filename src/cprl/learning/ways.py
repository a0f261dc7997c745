"""Which way many lanes are updated: the fastest whose gradients are those of the plain list.

"lane axis": the networks' parameters carry a lane axis, under one ordinary loss; wants `QNetwork`s.
"vmap": the loss is vmapped over stacked parameters; takes any network.
"list": a loss module for each lane, one after the other; takes any loss.
"""

import warnings
from collections.abc import Sequence
from copy import deepcopy
from typing import Any, Final, Literal, get_args

import torch
from torch import Tensor, nn
from torchrl.data.replay_buffers import ReplayBuffer

from cprl.acting.networks import QNetwork
from cprl.learning.functional import MakeLoss
from cprl.learning.fused import FunctionalUpdate
from cprl.learning.replay import lane_buffer
from cprl.learning.transitions import LaneTurn, array_of
from cprl.learning.updates import ListUpdate, Update

Way = Literal["lane axis", "vmap", "list"]

TRIAL_LANES: Final = 2
"""Lanes of a trial: enough to show what one lane would take from another."""
TRIAL_TRANSITIONS: Final = 16
TRIAL_STEP: Final = {"learning_rate": 1.0, "adam_eps": 1.0}
"""By Adam's first step of this size a weight changes by g / (abs(g) + 1), g its gradient."""
TOLERANCE: Final = 1e-4
"""How far losses and changes of weights, in float32, may be from those of the list."""


def make_update(
    way: Way | None,
    networks: Sequence[nn.Module],
    make_loss: MakeLoss,
    *,
    compile: bool,
    trial: ReplayBuffer,
    **how: Any,
) -> Update:
    """An update of all lanes; see `FunctionalUpdate` for the arguments that are not said here.

    Args:
        way: how; None for the first that passes a trial, of "lane axis", "vmap" and "list".
        networks: of the lanes.
        make_loss: a lane's loss out of its network.
        compile: whether it is compiled, but for the list.
        trial: made-up transitions for the first `TRIAL_LANES` lanes, see `trial_buffer`.

    Raises:
        ValueError: for an unknown way.
    """
    if way is None:
        way = fitting_way(networks[:TRIAL_LANES], make_loss, trial)
    if way not in get_args(Way):
        raise ValueError(f"way is {way!r}; allowed: {', '.join(get_args(Way))}")
    return _update(way, networks, make_loss, compile=compile, **how)


def fitting_way(networks: Sequence[nn.Module], make_loss: MakeLoss, trial: ReplayBuffer) -> Way:
    """The first way that does on a trial what the plain list does; warns where that is the list itself.

    Args:
        networks: of some lanes; copies of them are tried.
        make_loss: a lane's loss out of its network.
        trial: made-up transitions of these lanes.
    """
    wanted = _tried("list", networks, make_loss, trial)
    reasons = []
    for way in get_args(Way)[:-1]:
        try:
            came = _tried(way, networks, make_loss, trial)
        except Exception as error:  # whatever a loss or network of the user's own does not bear
            reasons.append(f"{way}: {str(error).splitlines()[0]}")
            continue
        if all(torch.allclose(*pair, TOLERANCE, TOLERANCE) for pair in zip(came, wanted, strict=True)):
            fitting: Way = way
            return fitting
        reasons.append(f"{way}: agents would not learn what each learns alone")
    warnings.warn(
        f"agents learn one after the other, many times slower; {'; '.join(reasons)}",
        RuntimeWarning,
        stacklevel=4,
    )
    return "list"


def trial_buffer(
    lanes: int, observation_shape: Sequence[int], actions: int, *, device: str | torch.device = "cpu"
) -> ReplayBuffer:
    """Made-up transitions of a few lanes, the same every time; one in eight ends an episode."""
    buffer = lane_buffer(
        seeds=[(lane,) for lane in range(lanes)],
        transitions=TRIAL_TRANSITIONS,
        batch_size=8,
        observation_shape=observation_shape,
        device=device,
    )
    chance = torch.Generator().manual_seed(0)
    for step in range(TRIAL_TRANSITIONS):
        seen = torch.randint(256, (2, lanes, *observation_shape), generator=chance).to(torch.uint8)
        action = torch.randint(actions, (lanes,), generator=chance)
        ends = torch.full((lanes,), step % 8 == 7)
        turn = seen[0], action, seen[1], torch.rand(lanes, generator=chance), ends, ends
        buffer.storage.write(LaneTurn(*(array_of(entry.to(device)) for entry in turn)))
    return buffer


def _update(
    way: Way, networks: Sequence[nn.Module], make_loss: MakeLoss, *, compile: bool, **how: Any
) -> Update:
    if way == "list":
        return ListUpdate(networks, make_loss, **how)
    if way == "lane axis" and not all(isinstance(network, QNetwork) for network in networks):
        raise ValueError("networks are not QNetworks")
    return FunctionalUpdate(networks, make_loss, lane_axis=way == "lane axis", compile=compile, **how)


def _tried(way: Way, networks: Sequence[nn.Module], make_loss: MakeLoss, trial: ReplayBuffer) -> list[Tensor]:
    """The losses of an update of copies of the networks, and their weights after it."""
    sampling = deepcopy(trial.sampler.state_dict())
    update = _update(way, deepcopy(list(networks)), make_loss, compile=False, **TRIAL_STEP)
    losses = update.learn(trial)
    trial.sampler.load_state_dict(sampling)
    return [
        losses,
        *(weight for lane in range(len(networks)) for weight in update.network_state(lane).values()),
    ]
