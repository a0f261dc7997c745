"""Agents of stored runs as policies, those that act alike side by side."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.learners.decisions import stored_decisions
from cprl.learners.lanes import EVALUATION, lane_seeds
from cprl.networks.recurrent import state_cells_of
from cprl.networks.stacked import stack_lanes
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.recurrent import actor_of_lanes
from cprl.policies.scripted import scripted_lanes


@dataclass(frozen=True, eq=False)
class StoredAgent:
    """An agent of a stored run: how it acts, and its network if it has one."""

    kind: tuple[Any, ...]
    """("scripted", policy), or ("trained", stochastic, epsilon, algorithm); agents of one kind can be lanes
    of one actor."""
    network: nn.Module | None = None
    decisions: Tensor | None = None
    """The values of its choices on all ballots, float64 [C]; None if it decides by chance, or nothing."""

    def __repr__(self) -> str:
        acts = ", ".join(str(value) for value in self.kind[:3])
        return f"StoredAgent({acts}, network={type(self.network).__name__})"


def stored_policies(
    agents: Sequence[Sequence[StoredAgent]],
    playing: Game | Spaces,
    *,
    replicas: Sequence[int],
    worlds: int,
    seed: int,
) -> AgentPolicies:
    """Stored agents as the policies of all agents of some replicas, agents of one kind as lanes of one actor.

    Args:
        agents: by agent and replica.
        playing: the game; its spaces where it is not one of cprl's.
        replicas: their numbers.
        worlds: how many worlds of each replica are played side by side.
        seed: what random numbers follow from, with the replica and the agent.
    """
    alike: dict[Any, list[int]] = {}
    for agent, of_replicas in enumerate(agents):
        alike.setdefault(of_replicas[0].kind, []).append(agent)
    actors: dict[AgentIndices, nn.Module] = {}
    for same in alike.values():
        seeds = lane_seeds(seed, replicas=replicas, agents=same, purpose=EVALUATION)
        lanes = [agents[agent][place] for place in range(len(replicas)) for agent in same]
        how: dict[str, Any] = {"seeds": seeds, "agents": len(same), "worlds": worlds}
        actors[tuple(same)] = stored_actor(lanes, playing, stacks=True, **how)
    values = [[own.decisions for own in of_replicas] for of_replicas in agents]
    decisions = (
        stored_decisions(values, playing, replicas=replicas, worlds=worlds, seed=seed)
        if isinstance(playing, Game)
        else None
    )
    return AgentPolicies(actors, decisions=decisions)


def stored_actor(
    lanes: Sequence[StoredAgent],
    playing: Game | Spaces,
    *,
    seeds: Sequence[Sequence[int]],
    agents: int,
    worlds: int,
    stacks: bool = False,
) -> nn.Module:
    """One actor for stored agents of one kind; the one place where an actor is made of a stored agent.

    Args:
        lanes: an agent for each lane, lane = replica x agents + agent.
        playing: the game; its spaces where it is not one of cprl's.
        seeds: of each lane's random numbers.
        agents: how many agents of a replica it controls.
        worlds: how many worlds of each replica are played side by side.
        stacks: whether lanes of one and the same network are stacked too, so that its values are, to the last
            bit, those that it has among others.
    """
    kind = lanes[0].kind
    if kind[0] == "scripted":
        return scripted_lanes(kind[1], playing, seeds=seeds, agents=agents, worlds=worlds)
    _, stochastic, epsilon, _ = kind
    spaces = playing.spaces if isinstance(playing, Game) else playing
    networks: list[Any] = [lane.network for lane in lanes]
    actor = actor_of_lanes(
        _side_by_side(networks, stacks=stacks),
        spaces,
        seeds=seeds,
        agents=agents,
        worlds=worlds,
        stochastic=stochastic,
        state_cells=state_cells_of(networks[0]),
    )
    actor.epsilon = epsilon
    return actor


def _side_by_side(networks: Sequence[nn.Module], *, stacks: bool) -> Callable[..., Any]:
    """What all networks give for what their lanes see, [L, k, ...] to [L, k, A]; of recurrent ones also their
    states."""
    first = networks[0]
    if not stacks and all(network is first for network in networks):
        first.requires_grad_(False)
        return lambda *seen: first(*seen)
    try:
        stack = stack_lanes(networks)
    except ValueError:  # of a form that does not stack, e.g. a network of the user's own
        return lambda seen: torch.stack([network(own) for network, own in zip(networks, seen, strict=True)])
    return lambda *seen: stack(*seen)
