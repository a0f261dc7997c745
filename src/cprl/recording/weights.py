"""The weights of networks, kept and read."""

import os
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn


def save_weights(run: Path, networks: Mapping[str, nn.Module], *, name: str = "final") -> Path:
    """Writes the weights of each agent's network, all or nothing.

    Args:
        run: the run's directory.
        networks: by the agent's name.
        name: of the file.

    Returns:
        `checkpoints/<name>.pt` of the run, which `load_weights` reads.
    """
    path = run / "checkpoints" / f"{name}.pt"
    path.parent.mkdir(exist_ok=True)
    partial = path.with_suffix(".partial")
    torch.save({agent: network.state_dict() for agent, network in networks.items()}, partial)
    os.replace(partial, path)
    return path


def load_weights(path: Path) -> dict[str, dict[str, Tensor]]:
    """The state dict of each agent's network; reads tensors only, runs no code of the file."""
    return dict(torch.load(path, weights_only=True))
