"""Networks that read observations."""

from collections.abc import Sequence
from math import prod

from torch import Tensor, nn
from torchrl.modules import MLP


class MLPNetwork(nn.Module):
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


def _glorot_uniform(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.xavier_uniform_(module.weight)
        nn.init.zeros_(module.bias)
