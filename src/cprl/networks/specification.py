"""`Network`, the architecture that an algorithm names, and `new_network`, which makes networks of it."""

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
"""An architecture that cprl has. For a network of your own say `Custom`: cprl calls its target with (spaces,
outputs) and the arguments of the `Custom`."""


def new_network(
    network: Network | Custom,
    spaces: Spaces,
    outputs: int,
    *,
    shape: Sequence[int] | None = None,
    **options: Unpack[Options],
) -> nn.Module:
    """Return a new network that maps observations [..., *shape] to [..., outputs].

    Its weights are drawn from torch's global generator. It has the attributes `outputs` and
    `observation_dims`, the number of axes of one input. The network of a `GRU` or an `LSTM` also reads and
    returns a state, see `cprl.networks.recurrent`.

    Args:
        network: the architecture.
        outputs: the number of outputs.
        shape: the shape of one input, if it is not one observation: (S, *observation_shape) for the central
            critic of S agents. A network of your own gets it as `spaces.observation_shape`.

    Raises:
        ValueError: if a network of your own cannot be made or called, or has other outputs.
    """
    if shape is not None:
        spaces = replace(spaces, observation_shape=tuple(shape))
    if not isinstance(network, Custom):
        return network.make(spaces, outputs, **options)
    for name, value in options.items():
        if value:
            raise ValueError(
                f"settings.{name} is True; allowed with a network of your own, {network.target}: False; "
                "implement it in the network"
            )
    name = f"the network {network.target}"
    if shape is not None:
        name += " of a critic, whose observation has the members first,"
    return _custom_network(network, name, spaces, outputs)


def _custom_network(network: Custom, name: str, spaces: Spaces, outputs: int) -> nn.Module:
    """Return a network that a user's own code makes, after one call of it with two observations of zeros.

    Args:
        name: names the network in messages.
    """
    shape = spaces.observation_shape
    network.resolve()
    try:
        module = network.make(spaces, outputs)
    except Exception as error:  # a user's network may raise anything
        raise ValueError(f"{name} cannot be made for observations of {shape}: {error}") from error
    if not isinstance(module, nn.Module):
        raise ValueError(f"{name} is a {type(module).__name__}; allowed: a torch.nn.Module")
    _check_outputs(module, name, spaces, outputs)
    for attribute, value in {"outputs": outputs, "observation_dims": len(shape)}.items():
        if not hasattr(module, attribute):
            setattr(module, attribute, value)
    return module


def _check_outputs(module: nn.Module, name: str, spaces: Spaces, outputs: int) -> None:
    """Raise a ValueError unless a network maps two observations to [2, outputs]."""
    shape = spaces.observation_shape
    dtype = spaces.observation_dtype
    observations = torch.zeros(2, *shape, dtype=getattr(torch, dtype))
    was_training = module.training
    try:
        with torch.no_grad():
            output = module.eval()(observations)
    except Exception as error:  # its forward may raise anything, too
        raise ValueError(
            f"{name} cannot read observations [2, {', '.join(map(str, shape))}] of {dtype}: {error}"
        ) from error
    if tuple(output.shape) != (2, outputs):
        raise ValueError(f"{name} outputs {list(output.shape)} for two observations; allowed: [2, {outputs}]")
    module.train(was_training)
