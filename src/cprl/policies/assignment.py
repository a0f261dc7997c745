"""AgentPolicies: one actor for each agent of a game, as one policy for the environment."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from cprl import keys, recurrent_state
from cprl.policies.decisions import Decider
from cprl.policies.lanes import LaneActor
from cprl.system.compat import unchecked_tensordict

AgentIndices: TypeAlias = int | tuple[int, ...]
"""The agents that an actor or learner controls: one index, or several."""


def agent_indices(indices: AgentIndices) -> tuple[int, ...]:
    return indices if isinstance(indices, tuple) else (indices,)


class AgentPolicies(TensorDictModuleBase):
    """Passes each actor the observations of its agents, and combines the actions.

    Args:
        actors: one for each agent, agent 0 first, e.g. a `RandomActor`; or a mapping from the agents that
            each controls: an index for an actor of one agent, a tuple for an actor of several, e.g. a
            `LaneActor`.
        decisions: what the agents decide, where a game asks them (`Game.decisions`); None in other games.

    Reads ("agents", "observation"), uint8 [B, N, C, X, Y], and the other entries of "agents" that an actor's
    `in_keys` name, e.g. "apple_ahead"; writes ("agents", "action"), int64 [B, N].
    Where actors are recurrent it also reads "recurrent_state" and writes it and "recurrent_state_before".
    With decisions it also reads "ballots_due", and writes ("agents", "decision"), int64 [B, N].
    """

    in_keys: tuple[Any, ...] = (keys.OBSERVATION,)
    out_keys: tuple[Any, ...] = (keys.ACTION,)

    def __init__(
        self,
        actors: Sequence[nn.Module] | Mapping[AgentIndices, nn.Module],
        *,
        decisions: Decider | None = None,
    ) -> None:
        super().__init__()
        by_agents: dict[AgentIndices, nn.Module] = dict(
            actors if isinstance(actors, Mapping) else enumerate(actors)
        )
        taken = sorted(agent for indices in by_agents for agent in agent_indices(indices))
        if not taken or taken != list(range(len(taken))):
            raise ValueError(f"actors control the agents {taken}; allowed: 0, 1 and so on, each exactly once")
        self.agents = len(taken)
        self.indices = list(by_agents)
        self._one_takes_all = self.indices == [tuple(taken)]
        self.actors = nn.ModuleList(by_agents.values())
        self.decisions = decisions
        self._state_cells = max(int(getattr(actor, "state_cells", 0)) for actor in self.actors)
        """The largest state of an agent; 0 if no actor is recurrent."""
        self._worlds = max(
            int(getattr(actor, "replicas", 0)) * int(getattr(actor, "worlds", 0)) for actor in self.actors
        )
        """How many worlds all replicas play together; 0 if actors play any number."""
        if decisions is not None:
            if decisions.agents != self.agents:
                raise ValueError(
                    f"there are {self.agents} actors, and decisions of {decisions.agents} agents; allowed: "
                    "the same agents"
                )
            self.in_keys = (keys.OBSERVATION, keys.BALLOTS_DUE)
            self.out_keys = (keys.ACTION, keys.DECISION)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        agents = keys.entry(tensordict, keys.AGENTS)
        if self._worlds and tensordict.batch_size.numel() != self._worlds:
            there = tensordict.batch_size.numel()
            raise ValueError(
                f"the policy plays {self._worlds} world{'s' * (self._worlds > 1)} and the environment has "
                f"{there}; allowed: as many, e.g. run.policy(replica, worlds={there})"
            )
        if self.decisions is not None:
            due = keys.entry(tensordict, keys.BALLOTS_DUE)
            keys.put(agents, "decision", self.decisions.decide(due))
        observation = keys.entry(agents, "observation")
        dim = len(tensordict.batch_size)
        if observation.shape[dim] != self.agents:
            raise ValueError(
                f"there are {self.agents} actors for {observation.shape[dim]} agents; "
                "allowed: one actor for each agent"
            )
        if self._state_cells:
            size = *observation.shape[: dim + 1], self._state_cells
            recurrent_state.prepare(agents, size, observation.device)
        if self._one_takes_all:
            (actor,) = self.actors
            keys.put(agents, "action", self._choose(actor, agents, (), tensordict.batch_size))
            return tensordict
        chosen: Tensor | None = None
        for indices, actor in zip(self.indices, self.actors, strict=True):
            at = list(indices) if isinstance(indices, tuple) else indices
            index = (*[slice(None)] * dim, at)
            action = self._choose(actor, agents, index, tensordict.batch_size)
            if chosen is None:
                chosen = observation.new_empty(observation.shape[: dim + 1], dtype=torch.int64)
            chosen[index] = action
        agents.set("action", chosen)
        return tensordict

    def _choose(
        self, actor: nn.Module, agents: TensorDictBase, at: tuple[Any, ...], batch_size: torch.Size
    ) -> Tensor:
        """Return one actor's actions for the agents at an index, () for all; write the states of a recurrent
        one."""
        cells = getattr(actor, "state_cells", 0)
        names = getattr(actor, "in_keys", ("observation",))
        seen = [_seen(agents, name, at, cells) for name in names]
        if isinstance(actor, LaneActor):  # the same as its forward, without a TensorDict
            action, *after = actor.choose_with(*seen)
        else:
            chosen = actor(unchecked_tensordict(dict(zip(names, seen, strict=True)), batch_size))
            action = chosen.get("action")
            after = [chosen.get(recurrent_state.AFTER)] if cells else []
        for states in after:
            recurrent_state.write(agents, at, states)
        return action


def _seen(agents: TensorDictBase, name: str, at: tuple[Any, ...], cells: int) -> Tensor:
    """Return an entry of the agents at an index; of recurrent states, of so many cells, those before the
    turn."""
    if name == recurrent_state.AFTER:
        states: Tensor = recurrent_state.read(agents, at, cells)
        return states
    entry: Tensor = keys.entry(agents, name)
    return entry[at] if at else entry
