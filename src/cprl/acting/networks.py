"""Networks that read observations."""

from collections.abc import Sequence
from math import prod

import torch
from torch import Tensor, nn
from torchrl.modules import MLP


class QNetwork(nn.Module):
    """The value of each action, from what an agent sees, by fully connected layers with ReLU.

    Args:
        observation_shape: (C, X, Y) of an observation, `Game.observation_shape`.
        actions: how many actions A there are.
        hidden_cells: units of each hidden layer.
        highest: the largest value of an observation, `Observation.highest`; layers see 0..1.
        relu_on_outputs: ReLU on the values too, as in the study as run.
        glorot_uniform: Glorot-uniform weights and zero biases, as in the study as run; else torch's default.
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        actions: int,
        *,
        hidden_cells: Sequence[int] = (32, 32),
        highest: float = 255.0,
        relu_on_outputs: bool = False,
        glorot_uniform: bool = False,
    ) -> None:
        super().__init__()
        self.highest, self.relu_on_outputs = highest, relu_on_outputs
        self.observation_dims, self.outputs = len(observation_shape), actions
        self.layers = MLP(
            in_features=prod(observation_shape),
            out_features=actions,
            num_cells=list(hidden_cells),
            activation_class=nn.ReLU,
            activate_last_layer=relu_on_outputs,
        )
        if glorot_uniform:
            self.apply(_glorot_uniform)

    @property
    def linears(self) -> list[nn.Linear]:
        """The layers with weights, first to last."""
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to [..., A], in the parameters' type."""
        seen = observation.flatten(-self.observation_dims).to(self.linears[0].weight.dtype) / self.highest
        return self.layers(seen)  # type: ignore[no-any-return]


class AtomNetwork(nn.Module):
    """The distribution of each action's return over so many fixed values, atoms, as in C51.

    Source: Bellemare, Dabney and Munos, "A Distributional Perspective on Reinforcement Learning" (2017).

    Args:
        network: with A x atoms outputs.
        actions: A.
        lowest: the lowest return that it can tell.
        highest: the highest.
        atoms: how many there are.
    """

    support: Tensor

    def __init__(self, network: QNetwork, *, actions: int, lowest: float, highest: float, atoms: int) -> None:
        super().__init__()
        self.network, self.actions, self.atoms = network, actions, atoms
        self.register_buffer("support", torch.linspace(lowest, highest, atoms))

    def atom_logits(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to [..., atoms, A], before the softmax over atoms."""
        return self.network(observation).unflatten(-1, (self.atoms, self.actions))  # type: ignore[no-any-return]

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to the expected values [..., A]."""
        return (self.atom_logits(observation).softmax(-2) * self.support[:, None]).sum(-2)


class AgentNetworks(nn.ModuleDict):
    """Networks of one agent that learn together, by name; the first is the one that acts."""

    def forward(self, observation: Tensor) -> Tensor:
        """What the acting network gives."""
        given: Tensor = acting_part(self)(observation)
        return given


def parts_of(network: nn.Module) -> dict[str, nn.Module]:
    """The networks of one agent by name, the acting one first; a single one has the name ""."""
    return dict(network.items()) if isinstance(network, AgentNetworks) else {"": network}


def acting_part(network: nn.Module) -> nn.Module:
    """The network that acts."""
    return next(iter(parts_of(network).values()))


def _glorot_uniform(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.xavier_uniform_(module.weight)
        nn.init.zeros_(module.bias)
