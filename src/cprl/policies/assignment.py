"""AgentPolicies: one actor for each agent of a game, as one policy for the environment."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from cprl import keys
from cprl.policies.lanes import LaneActor

AgentIndices: TypeAlias = int | tuple[int, ...]
"""Where an actor or learner sits: one agent's number, or several."""


def agent_indices(indices: AgentIndices) -> tuple[int, ...]:
    """The agents' numbers."""
    return indices if isinstance(indices, tuple) else (indices,)


class AgentPolicies(TensorDictModuleBase):
    """Lets each actor see what the agents at its seats see, and puts the actions together.

    Args:
        actors: one for each agent, agent 0 first, see `cprl.policies.single`; or by the agents
            that each controls: an index for an actor of one agent, a tuple for one of several, e.g. a
            `LaneActor`.

    Reads ("agents", "observation"), uint8 [B, N, C, X, Y], and of the group "agents" whatever else an actor's
    `in_keys` name, e.g. "stock_gauge"; writes ("agents", "action"), int64 [B, N].

    Raises:
        ValueError: for seats that are empty or taken twice.
    """

    in_keys = (keys.OBSERVATION,)
    out_keys = (keys.ACTION,)

    def __init__(self, actors: Sequence[nn.Module] | Mapping[AgentIndices, nn.Module]) -> None:
        super().__init__()
        of_seats = dict(actors) if isinstance(actors, Mapping) else dict(enumerate(actors))
        taken = sorted(agent for indices in of_seats for agent in agent_indices(indices))
        if taken != list(range(len(taken))):
            raise ValueError(f"actors sit at {taken}; wanted are 0, 1 and so on, each taken once")
        self.agents = len(taken)
        self.indices = list(of_seats)
        self._one_takes_all = self.indices == [tuple(taken)]
        self.actors = nn.ModuleList(of_seats.values())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Each actor chooses for its agents, in all worlds at once."""
        agents = keys.entry(tensordict, keys.AGENTS)
        observation = keys.entry(agents, "observation")
        dim = len(tensordict.batch_size)
        if observation.shape[dim] != self.agents:
            raise ValueError(
                f"{self.agents} actors for {observation.shape[dim]} agents; "
                "one actor for each agent is wanted"
            )
        if self._one_takes_all:
            (actor,) = self.actors
            keys.put(agents, "action", self._choose(actor, agents, None, tensordict.batch_size))
            return tensordict
        chosen = observation.new_empty(observation.shape[: dim + 1], dtype=torch.int64)
        for indices, actor in zip(self.indices, self.actors, strict=True):
            at = list(indices) if isinstance(indices, tuple) else indices
            index = (*[slice(None)] * dim, at)
            chosen[index] = self._choose(actor, agents, index, tensordict.batch_size)
        agents.set("action", chosen)
        return tensordict

    def _choose(self, actor: nn.Module, agents: TensorDictBase, index: Any, batch_size: torch.Size) -> Tensor:
        """What an actor chooses for the agents at an index, None for all, by the entries that it reads."""
        if isinstance(actor, LaneActor):  # what its forward does, without a TensorDict to and fro
            return actor.choose(_at(agents, "observation", index))
        names = getattr(actor, "in_keys", ("observation",))
        view = TensorDict._new_unsafe(
            {name: _at(agents, name, index) for name in names}, batch_size=batch_size
        )
        action: Tensor = actor(view).get("action")
        return action


def _at(agents: TensorDictBase, name: str, index: Any) -> Tensor:
    told: Tensor = keys.entry(agents, name)
    return told if index is None else told[index]
