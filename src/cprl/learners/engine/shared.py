"""SharedEngine: an engine whose networks each serve several agents, as one with a lane for each agent."""

from collections.abc import Callable, Mapping
from functools import partial
from math import prod
from typing import Any

from tensordict import TensorDict
from torch import Tensor

from cprl.learners.buffer.sampler import LaneBuffer
from cprl.learners.engine.base import Engine, ListEngine
from cprl.learners.engine.functional import Weights


class SharedEngine:
    """Presents an engine of R networks, each shared by S agents, as an engine of L = R x S lanes.

    A network learns from the transitions of all its agents in one batch, S x b of them. The loss of a lane is
    that of its network.

    Args:
        engine: the engine of the R networks.
        agents: the number of agents S that share a network.
    """

    def __init__(self, engine: Engine, agents: int) -> None:
        self.engine, self._agents = engine, agents

    def update(self, buffer: LaneBuffer) -> Tensor:
        """See `Engine`."""
        return self.update_from(buffer.sample())

    def update_from(self, batch: TensorDict) -> Tensor:
        """See `Engine`."""
        lanes, *sizes = batch.batch_size
        if "is_init" in batch:  # each sequence stays one
            *sequences, steps = sizes
            sizes = [prod(sequences), steps]
        together = batch.reshape(lanes // self._agents, self._agents * sizes[0], *sizes[1:])
        return self.engine.update_from(together).repeat_interleave(self._agents)

    def copy_to_targets(self, which: Tensor) -> None:
        """See `Engine`; agents that share a network are marked together."""
        self.engine.copy_to_targets(which.view(-1, self._agents)[:, 0])

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """See `Engine`."""
        return self._by_network(partial(self.engine.outputs, part=part), observation, *recurrent)

    def first(self, lanes: int) -> Callable[..., Any]:
        """See `Engine`."""
        return partial(self._by_network, self.engine.first(lanes // self._agents))

    def network_state(self, lane: int) -> Weights:
        """See `Engine`."""
        return self.engine.network_state(lane // self._agents)

    def weights(self, lane: int) -> Weights:
        """See `Engine`."""
        return self.engine.weights(lane // self._agents)

    def finite(self) -> Tensor:
        """See `Engine`."""
        return self.engine.finite().repeat_interleave(self._agents)

    def state_dict(self) -> dict[str, Any]:
        """See `Engine`."""
        return self.engine.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Engine`."""
        self.engine.load_state_dict(state)

    def _by_network(self, outputs: Callable[..., Any], observation: Tensor, *recurrent: Tensor) -> Any:
        """[L, k, ...] to [L, k, ...], through a function of [R, S x k, ...], or of recurrent networks of
        [R, S, k, ...]."""
        if recurrent:
            inputs = [own.reshape(-1, self._agents, *own.shape[1:]) for own in (observation, *recurrent)]
            return tuple(own.flatten(0, 1) for own in outputs(*inputs))
        lanes, size = observation.shape[:2]
        by_network = observation.reshape(lanes // self._agents, self._agents * size, *observation.shape[2:])
        given: Tensor = outputs(by_network)
        return given.reshape(lanes, size, *given.shape[2:])


def is_list(engine: object) -> bool:
    """Whether an engine updates one loss after the other, uncompiled."""
    return isinstance(engine.engine if isinstance(engine, SharedEngine) else engine, ListEngine)
