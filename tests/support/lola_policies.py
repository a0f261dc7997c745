"""Networks for matrix games as in the papers of LOLA: a number for each thing that an agent can have seen."""

from copy import deepcopy

import torch
from torch import nn


class Table(nn.Module):
    """The output of each observation, one-hot [.., X] to [.., outputs]; with two outputs, logits, the second
    is 0, so that X numbers are a policy of two actions.

    Args:
        spaces: of the game.
        outputs: 2 for a policy, 1 for values.
        spread: the standard deviation of the first numbers of a policy; values begin at 0.
    """

    def __init__(self, spaces, outputs, *, spread=1.0):
        super().__init__()
        self.observation_dims, self.outputs = 1, outputs
        self.numbers = nn.Parameter(torch.randn(*spaces.observation_shape) * (spread if outputs > 1 else 0))

    def make_stack(self, tables):
        """One network with the numbers of L tables, [L, X]: [L, .., X] to [L, .., outputs]."""
        stack = deepcopy(self)
        stack.numbers = nn.Parameter(torch.stack([own.numbers.detach() for own in tables]))
        return stack

    def lane_state(self, lane):
        """The state dict of one table of a stack."""
        return {"numbers": self.numbers[lane].detach().clone()}

    def forward(self, observation):
        *lanes, size = self.numbers.shape
        numbers = self.numbers.reshape(*lanes, *[1] * (observation.ndim - 1 - len(lanes)), size)
        first = (observation * numbers).sum(-1)
        return torch.stack([first, *[torch.zeros_like(first)] * (self.outputs - 1)], -1)
