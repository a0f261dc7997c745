"""JointPolicy: the policy of all agents of a game, made of one actor for each agent or group of agents."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from cprl import keys
from cprl.keys import recurrent_state
from cprl.policies.actors import LaneActor
from cprl.policies.decisions import Decider
from cprl.policies.governors import GovernorActor
from cprl.system.compat.tensordicts import unchecked_tensordict

ActorAgents: TypeAlias = int | tuple[int, ...]
"""The agents that one actor or learner controls: the index of an agent, or the indices of several."""


def agent_indices(agents: ActorAgents) -> tuple[int, ...]:
    """Return the indices of the agents that an actor or learner controls, e.g. (3,) for 3."""
    return agents if isinstance(agents, tuple) else (agents,)


@dataclass(frozen=True)
class _Assignment:
    """An actor with the agents that it controls, and what it asks of the policy."""

    actor: nn.Module
    agents: int | list[int]
    """The agents, as the axis of agents is indexed: an index removes the axis, a list keeps it."""
    in_keys: tuple[str, ...]
    """The entries of "agents", and "done", that the actor reads, in the order of its arguments."""
    state_cells: int
    """The numbers in an agent's recurrent state; 0 for an actor without one."""
    worlds: int
    """The worlds that the actor plays, of all replicas together; 0 if it plays any number."""

    @classmethod
    def from_actor(cls, actor: nn.Module, agents: ActorAgents) -> "_Assignment":
        """Read what an actor asks. Any module can be an actor, so each attribute has a default."""
        return cls(
            actor=actor,
            agents=list(agents) if isinstance(agents, tuple) else agents,
            in_keys=tuple(getattr(actor, "in_keys", ("observation",))),
            state_cells=int(getattr(actor, "state_cells", 0)),
            worlds=int(getattr(actor, "replicas", 0)) * int(getattr(actor, "worlds", 0)),
        )


class JointPolicy(TensorDictModuleBase):
    """A policy that passes each actor the observations of its agents, and joins the actions.

    Args:
        actors: one for each agent, agent 0 first, e.g. a `RandomActor`; or a mapping from the agents that
            each controls: an index for an actor of one agent, a tuple for an actor of several, e.g. a
            `LaneActor`.
        decisions: chooses on the ballots of games that have any (`Game.decisions`); None in other games.
        governor: decides in games with a `Governor`; None in other games, and where its first option stays in
            force.

    Reads ("agents", "observation"), uint8 [B, N, C, X, Y], and the other entries of "agents" that an actor's
    `in_keys` name, e.g. "apple_ahead"; writes ("agents", "action"), int64 [B, N].
    With recurrent actors it also reads "recurrent_state", and writes that and "recurrent_state_before".
    With decisions it also reads "ballots_due", and writes ("agents", "decision"), int64 [B, N]; with a
    governor "seen" and "rule".
    """

    in_keys: tuple[Any, ...] = (keys.OBSERVATION,)
    out_keys: tuple[Any, ...] = (keys.ACTION,)

    def __init__(
        self,
        actors: Sequence[nn.Module] | Mapping[ActorAgents, nn.Module],
        *,
        decisions: Decider | None = None,
        governor: GovernorActor | None = None,
    ) -> None:
        super().__init__()
        actors_by_agents = dict(actors.items() if isinstance(actors, Mapping) else enumerate(actors))
        controlled = sorted(agent for agents in actors_by_agents for agent in agent_indices(agents))
        if not controlled or controlled != list(range(len(controlled))):
            raise ValueError(
                f"actors control the agents {controlled}; allowed: 0, 1 and so on, each exactly once"
            )
        self.agents = len(controlled)
        self.indices = list(actors_by_agents)
        """The agents of each actor, in the order of `actors`."""
        self.actors = nn.ModuleList(actors_by_agents.values())
        self.decisions = decisions
        self.governor = governor
        self._assignments = [
            _Assignment.from_actor(actor, agents) for agents, actor in actors_by_agents.items()
        ]
        self._one_actor_plays_all = self.indices == [tuple(controlled)]
        self.state_cells = max(assignment.state_cells for assignment in self._assignments)
        """The numbers in the largest recurrent state of an agent; 0 if no actor is recurrent."""
        self._worlds = max(assignment.worlds for assignment in self._assignments)
        """The worlds that all replicas play together; 0 if actors play any number."""
        if decisions is not None:
            if decisions.agents != self.agents:
                raise ValueError(
                    f"there are {self.agents} actors, and decisions of {decisions.agents} agents; allowed: "
                    "the same agents"
                )
            self.in_keys = (keys.OBSERVATION, keys.BALLOTS_DUE)
            self.out_keys = (keys.ACTION, keys.DECISION)
        if governor is not None:
            self.in_keys = (*self.in_keys, keys.SEEN)
            self.out_keys = (*self.out_keys, keys.RULE)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        agents = keys.entry(tensordict, keys.AGENTS)
        batch_dims = tensordict.batch_dims
        self._refuse_other_worlds(tensordict.batch_size.numel())
        if self.decisions is not None:
            ballots_due = keys.entry(tensordict, keys.BALLOTS_DUE)
            keys.put(agents, "decision", self.decisions.decide(ballots_due))
        if self.governor is not None:
            keys.put(tensordict, keys.RULE, self.governor.decide(keys.entry(tensordict, keys.SEEN)))
        observation = keys.entry(agents, "observation")
        self.refuse_other_agents(observation.shape[batch_dims])
        shape = observation.shape[: batch_dims + 1]
        if self.state_cells:
            recurrent_state.prepare(agents, (*shape, self.state_cells), observation.device)
        if self._one_actor_plays_all:  # reads and writes whole entries, without indexing or copying them
            (assignment,) = self._assignments
            keys.put(agents, "action", _choose(assignment, agents, (), tensordict))
            return tensordict
        actions = observation.new_empty(shape, dtype=torch.int64)
        for assignment in self._assignments:
            index = (*[slice(None)] * batch_dims, assignment.agents)
            actions[index] = _choose(assignment, agents, index, tensordict)
        agents.set("action", actions)
        return tensordict

    def _refuse_other_worlds(self, worlds: int) -> None:
        """Raise a ValueError unless the environment has as many worlds as the actors play."""
        if self._worlds and worlds != self._worlds:
            raise ValueError(
                f"the policy plays {self._worlds} world{'s' * (self._worlds > 1)} and the environment has "
                f"{worlds}; allowed: as many, e.g. run.policy(replica, worlds={worlds})"
            )

    def refuse_other_agents(self, agents: int) -> None:
        """Raise a ValueError unless the environment has as many agents as the actors control."""
        if agents != self.agents:
            raise ValueError(
                f"there are {self.agents} actors for {agents} agents; allowed: one actor for each agent"
            )


def _choose(
    assignment: _Assignment, agents: TensorDictBase, index: tuple[Any, ...], worlds: TensorDictBase
) -> Tensor:
    """Return the actions that an actor chooses for its agents; write their recurrent states, if it has any.

    Args:
        agents: the entries of "agents", [B, N, ...].
        index: selects the actor's agents in these entries; () selects all.
        worlds: the entries of worlds, [B], of which an actor may read "done".
    """
    actor = assignment.actor
    names = assignment.in_keys
    inputs = [
        keys.entry(worlds, name)
        if name == keys.DONE
        else _read_entry(agents, name, index, assignment.state_cells)
        for name in names
    ]
    if isinstance(actor, LaneActor):  # the same as its forward, without the cost of a TensorDict
        action, *states_after = actor.choose_with(*inputs)
    else:
        output = actor(unchecked_tensordict(dict(zip(names, inputs, strict=True)), worlds.batch_size))
        action = output.get("action")
        states_after = [output.get(recurrent_state.AFTER)] if assignment.state_cells else []
    for states in states_after:
        recurrent_state.write_states(agents, index, states)
    return action


def _read_entry(agents: TensorDictBase, name: str, index: tuple[Any, ...], state_cells: int) -> Tensor:
    """Return an entry of "agents" for the agents that an index selects.

    An actor reads and writes its recurrent state under one name, that of the states after a turn. What it
    reads are the states before this turn, their first `state_cells` numbers.
    """
    if name == recurrent_state.AFTER:
        return recurrent_state.read_states(agents, index, state_cells)
    entry = keys.entry(agents, name)
    return entry[index] if index else entry
