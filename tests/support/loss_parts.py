"""Losses of TorchRL, networks for them, and their weights."""

from functools import partial

import dqn_parts as parts
import torch
from dqn_parts import dqn_loss
from ring_parts import ACTIONS, SHAPE

from cprl.networks.mlp import MLPNetwork

MAKE_LOSS = partial(dqn_loss, gamma=0.9)


def networks(lanes, dtype=torch.float32, **options):
    """The network of each lane, by the lane's number alone."""
    made = []
    for lane in lanes:
        torch.manual_seed(lane)
        made.append(MLPNetwork(SHAPE, ACTIONS, hidden_cells=(16, 16), **options).to(dtype))
    return made


def in_order(tensors):
    """All numbers, whatever the order and form of layers."""
    return torch.cat([tensor.detach().flatten() for tensor in tensors]).sort().values


def weights_of(together, lane):
    """The weights of a lane and its targets."""
    named = parts.weights_at(together, lane)
    groups = ("value_network_params:", "target_value_network_params:")
    return [in_order([named[name] for name in named if name.startswith(group)]) for group in groups]
