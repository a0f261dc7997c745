"""Networks that output a distribution of returns."""

import torch
from torch import Tensor, nn


class AtomNetwork(nn.Module):
    """The distribution of each action's return over fixed values, called atoms, as in C51.

    Source: Bellemare, Dabney and Munos, "A Distributional Perspective on Reinforcement Learning" (2017).

    Args:
        network: a network with A x atoms outputs.
        actions: the number of actions A.
        lowest: the lowest atom, a return.
        highest: the highest atom.
        atoms: the number of atoms.
    """

    support: Tensor

    def __init__(
        self, network: nn.Module, *, actions: int, lowest: float, highest: float, atoms: int
    ) -> None:
        super().__init__()
        self.network, self.actions, self.atoms = network, actions, atoms
        self.register_buffer("support", torch.linspace(lowest, highest, atoms))

    def atom_logits(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to [..., atoms, A], before the softmax over atoms."""
        return self.network(observation).unflatten(-1, (self.atoms, self.actions))  # type: ignore[no-any-return]

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to the expected values [..., A]."""
        return (self.atom_logits(observation).softmax(-2) * self.support[:, None]).sum(-2)
