"""Networks that output a distribution of returns."""

import numpy as np
import torch
from torch import Tensor, nn


class AtomNetwork(nn.Module):
    """The distribution of each action's return over fixed values, called atoms, as in C51.

    Source: Bellemare, Dabney and Munos, "A Distributional Perspective on Reinforcement Learning" (2017).

    Args:
        network: a network with A x atoms outputs.
        actions: the number of actions A.
        lowest: the lowest atom, a return.
        highest: the highest atom; where float32 needs it, see `_support`, it is some float32 steps lower.
        atoms: the number of atoms.
    """

    support: Tensor

    def __init__(
        self, network: nn.Module, *, actions: int, lowest: float, highest: float, atoms: int
    ) -> None:
        super().__init__()
        self.network, self.actions, self.atoms = network, actions, atoms
        self.register_buffer("support", _support(lowest, highest, atoms))

    def atom_logits(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to [..., atoms, A], before the softmax over atoms."""
        return self.network(observation).unflatten(-1, (self.atoms, self.actions))  # type: ignore[no-any-return]

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to the expected values [..., A]."""
        return (self.atom_logits(observation).softmax(-2) * self.support[:, None]).sum(-2)


def _support(lowest: float, highest: float, atoms: int) -> Tensor:
    """The atoms, float32 [atoms], such that none is projected beyond the last one.

    `DistributionalDQNLoss` finds the place of a return by dividing its distance to the lowest atom by that
    between atoms. From -5 to 100 the quotient of the highest of 51 is rounded to 50.000004, whose neighbour
    above, 51, is no atom: the loss would write beyond its memory. Quotients of smaller returns are no larger,
    and that of the lowest atom is 0.
    """
    support = torch.linspace(lowest, highest, atoms)
    finest = float(np.spacing(np.float32(max(abs(lowest), abs(highest)))))
    for lower in range(1, atoms):  # where atoms - 1 divides the range, in units of `finest`, all is exact
        if _last_place(support) <= atoms - 1:
            break
        support = torch.linspace(lowest, float(np.float32(highest)) - lower * finest, atoms)
    return support


def _last_place(support: Tensor) -> float:
    """Where `DistributionalDQNLoss` places the highest atom, in its arithmetic."""
    low, high = support.min().item(), support.max().item()
    return float((support.max() - low) / ((high - low) / (len(support) - 1)))
