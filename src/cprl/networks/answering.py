"""Networks of continuous actions of several agents: values of joint actions, and the answers of peers."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class _OfParts(nn.Module):
    """A network that reads an observation and further numbers side by side.

    Args:
        network: reads them flat, [..., inputs], not scaled.
        observation_dims: the number of axes of an observation.
        scales: by which the observation and each further part are divided.
    """

    def __init__(self, network: nn.Module, *, observation_dims: int, scales: Sequence[float]) -> None:
        super().__init__()
        self.network, self._dims, self._scales = network, observation_dims, tuple(scales)

    def _read(self, observation: Tensor, *others: Tensor) -> Tensor:
        parts = observation.flatten(-self._dims), *others
        kind = others[-1].dtype
        scaled = [part.to(kind) / scale for part, scale in zip(parts, self._scales, strict=True)]
        return self.network(torch.cat(scaled, -1))  # type: ignore[no-any-return]


class JointCritic(_OfParts):
    """The value of a joint action, the critic of PR2's actor-critic.

    Args:
        network: a network with one output, of inputs for the observation and the actions of all agents.
        observation_dims: the number of axes of an observation.
        observation_scale: by which observations are divided.
        action_scale: by which actions are divided, e.g. the largest.
        value_scale: by which the output is multiplied, in units of reward.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        observation_dims: int,
        observation_scale: float = 1.0,
        action_scale: float = 1.0,
        value_scale: float = 1.0,
    ) -> None:
        scales = observation_scale, action_scale, action_scale
        super().__init__(network, observation_dims=observation_dims, scales=scales)
        self.value_scale = value_scale

    def forward(self, observation: Tensor, action: Tensor, peers_action: Tensor) -> Tensor:
        """[..., *shape], [..., D] and [..., (N - 1) x D] to [..., 1]."""
        return self._read(observation, action, peers_action) * self.value_scale


class AnswerSampler(_OfParts):
    """How peers answer an action, the conditional policy of PR2's actor-critic, as a sampler.

    Args:
        network: a network with (N - 1) x D outputs, of inputs for the observation, the agent's own action and
            the noise.
        observation_dims: the number of axes of an observation.
        observation_scale: by which observations are divided.
        action_scale: the largest action; by it own actions are divided, and answers are its tanh share.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        observation_dims: int,
        observation_scale: float = 1.0,
        action_scale: float = 1.0,
    ) -> None:
        scales = observation_scale, action_scale, 1.0
        super().__init__(network, observation_dims=observation_dims, scales=scales)
        self.action_scale = action_scale

    def forward(self, observation: Tensor, action: Tensor, noise: Tensor) -> Tensor:
        """[..., *shape], [..., D] and noise [..., Z] to the peers' actions [..., (N - 1) x D]."""
        return self._read(observation, action, noise).tanh() * self.action_scale
