"""The network architecture of an algorithm, and the networks made from it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias, Unpack

import torch
from torch import nn

from cprl.commons.spaces import Spaces
from cprl.networks.convolutional import Conv
from cprl.networks.mlp import MLP, Options
from cprl.networks.recurrent import GRU, LSTM
from cprl.values import Custom

Network: TypeAlias = MLP | Conv | GRU | LSTM
"""A network of cprl. A network of your own is a `Custom`, called with (spaces, outputs) and its arguments."""


def new_network(
    network: Network | Custom,
    spaces: Spaces,
    outputs: int,
    *,
    shape: Sequence[int] | None = None,
    **options: Unpack[Options],
) -> nn.Module:
    """A new network from observations [..., *shape] to [..., outputs], initialised from torch's generator.

    That of a `GRU` or an `LSTM` also reads and returns a state, see `cprl.networks.recurrent`.

    Args:
        outputs: the number of outputs. The network gets the attributes `outputs` and `observation_dims`.
        shape: the shape of its input if that is not one observation: (S, *observation_shape) for the central
            critic of S agents. A network of your own gets it as `spaces.observation_shape`.
    """
    if not isinstance(network, Custom):
        return network.make(spaces, outputs, shape=shape, **options)
    for name, value in options.items():
        if value:
            raise ValueError(
                f"settings.{name} is True; allowed with a network of your own, {network.target}: False; "
                "implement it in the network"
            )
    name = f"the network {network.target}"
    if shape is not None:
        spaces = replace(spaces, observation_shape=tuple(shape))
        name += " of a critic, whose observation has the members first,"
    return _users_network(network, name, spaces, outputs)


def _users_network(network: Custom, name: str, spaces: Spaces, outputs: int) -> nn.Module:
    """A network that a user's own code makes, after a check that it reads observations."""
    shape, dtype = spaces.observation_shape, spaces.observation_dtype
    network.resolve()
    try:
        made = network.make(spaces, outputs)
    except Exception as error:  # a user's network may raise anything
        raise ValueError(f"{name} cannot be made for observations of {shape}: {error}") from error
    if not isinstance(made, nn.Module):
        raise ValueError(f"{name} is a {type(made).__name__}; allowed: a torch.nn.Module")
    was_training = made.training
    try:
        with torch.no_grad():
            given = made.eval()(torch.zeros(2, *shape, dtype=getattr(torch, dtype)))
    except Exception as error:  # likewise
        raise ValueError(
            f"{name} cannot read observations [2, {', '.join(map(str, shape))}] of {dtype}: {error}"
        ) from error
    if tuple(given.shape) != (2, outputs):
        raise ValueError(f"{name} outputs {list(given.shape)} for two observations; allowed: [2, {outputs}]")
    made.train(was_training)
    for name, value in {"outputs": outputs, "observation_dims": len(shape)}.items():
        if not hasattr(made, name):
            setattr(made, name, value)
    return made
