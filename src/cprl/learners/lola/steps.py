"""Steps: an optimiser of the members' parameters in all replicas."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from cprl.learners.engine.optimizers import (
    BETA_1,
    BETA_2,
    WITH_MEAN,
    WITH_SQUARE,
    change_weights,
    shortened,
)
from cprl.learners.settings import Optimizer


class Steps:
    """An optimiser of the parameters of S members, [R, ...] each.

    Args:
        parameters: of each member.
        name: the optimiser.
        learning_rate: its step size.
        eps: its epsilon.
        max_grad_norm: the norm to which the gradient of each member of each replica is clipped, or None.
    """

    def __init__(
        self,
        parameters: Sequence[Sequence[nn.Parameter]],
        *,
        name: Optimizer,
        learning_rate: float,
        eps: float,
        max_grad_norm: float | None = None,
    ) -> None:
        self._parameters, self._name, self._rate, self._eps = parameters, name, learning_rate, eps
        self._longest, self.count = max_grad_norm, 0
        self.means = [[torch.zeros_like(value) for value in of] for of in parameters if name in WITH_MEAN]
        self.squares = [[torch.zeros_like(value) for value in of] for of in parameters if name in WITH_SQUARE]

    def descend(self, loss: Tensor) -> None:
        """One step along the gradient of a sum over members and replicas."""
        self.count += 1
        flat = [value for of in self._parameters for value in of]
        slopes = list(torch.autograd.grad(loss, flat))
        for member, of in enumerate(self._parameters):
            mine, slopes = slopes[: len(of)], slopes[len(of) :]
            change_weights(
                self._name,
                [value.data for value in of],
                mine if self._longest is None else shortened(mine, self._longest),
                self.means[member] if self.means else (),
                self.squares[member] if self.squares else (),
                step_size=mine[0].new_tensor(self._rate / (1 - BETA_1**self.count)),
                scale=mine[0].new_tensor((1 - BETA_2**self.count) ** -0.5),
                learning_rate=self._rate,
                eps=self._eps,
            )

    def kept(self, member: int) -> list[Tensor]:
        """What it keeps of a member, [R, ...] each."""
        return [value for of in (self.means, self.squares) if of for value in of[member]]

    def state_dict(self) -> dict[str, Any]:
        """Its running means and its count of steps; the tensors themselves."""
        return {"count": self.count, "means": self.means, "squares": self.squares}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self.count = int(state["count"])
        for name in ("means", "squares"):
            copy_all(getattr(self, name), state[name])


def copy_all(values: Sequence[Sequence[Tensor]], state: Sequence[Sequence[Tensor]]) -> None:
    """Copies the tensors of each member into its own, in place."""
    for of, others in zip(values, state, strict=True):
        for own, other in zip(of, others, strict=True):
            own.copy_(other)
