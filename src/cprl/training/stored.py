"""Agents that earlier runs learned, read by `load`, and how they play."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.make_env import make_env, spaces_of
from cprl.envs.state import load_transforms_state
from cprl.experiment import Experiment
from cprl.networks.agent import acting_part
from cprl.networks.finite import all_finite
from cprl.networks.recurrent import state_cells_of
from cprl.networks.stacked import stack_lanes
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.decisions import (
    ballot_sizes,
    stored_decisions,
)
from cprl.policies.lanes import LaneActor
from cprl.policies.rng import Purpose, lane_name, lane_seeds
from cprl.policies.scripted import ScriptedPolicy, scripted_lanes
from cprl.population import (
    AgentSpec,
    Frozen,
    Learning,
    Scripted,
    Team,
    specs_by_agent,
)
from cprl.runs.checkpoints import FOLDER
from cprl.runs.episodes import read_episodes
from cprl.runs.recipe import RECIPE_FILE, changed_code, read_recipe, say_changes
from cprl.runs.weights import weights_in, weights_of
from cprl.values import Custom, made, shown


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredAgent:
    """An agent that does not learn any more: how it acts, and its network if it has one."""

    scripted: ScriptedPolicy | None = None
    """The policy that it follows; None for an agent that acts by a network."""
    network: nn.Module | None = field(default=None, repr=False)
    stochastic: bool = False
    """Whether the network outputs the logits of a policy; else it outputs action values."""
    epsilon: float = 0.0
    """The probability of a random action in evaluation."""
    algorithm: str = field(default="", repr=False)
    """What it learned by."""
    decisions: Tensor | None = field(default=None, repr=False)
    """The values of its choices on all ballots, float64 [C]; None if it decides by chance, or nothing."""

    @property
    def kind(self) -> tuple[Any, ...]:
        """What agents have in common that can be lanes of one actor."""
        return self.scripted, self.stochastic, self.epsilon, self.algorithm


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedRun:
    """A run, built again from its directory alone; see `load`."""

    path: Path
    experiment: Experiment
    recipe: Mapping[str, Any]
    """What `recipe.json` holds."""
    networks: Mapping[str, nn.Module]
    """The trained acting network of each lane, by "replica_0/agent_0" and so on."""
    weights_from: Path
    """The file that held them: of a run that has not ended, its newest checkpoint."""
    transforms_state: Mapping[str, Any]
    """What the transforms of the environment had learned."""
    decisions: Mapping[str, Tensor] = field(default_factory=dict)
    """The values of what each lane decides, see `cprl.policies.decisions`; empty where it decides nothing."""
    _earlier: dict[str, "LoadedRun"] = field(default_factory=dict, repr=False)
    """Runs whose agents are frozen in this one, read once."""

    def __repr__(self) -> str:
        return f"LoadedRun({str(self.path)!r}, {self.experiment!r})"

    @cached_property
    def game(self) -> Any:
        """What was played."""
        return made(self.experiment.game)

    @property
    def metrics(self) -> tuple[Custom, ...]:
        """The user's own."""
        return self.experiment.metrics

    @property
    def specs(self) -> list[AgentSpec]:
        return specs_by_agent(self.experiment.agents, self.game.agents)

    @cached_property
    def spaces(self) -> Spaces:
        """What its agents observe and may do, transforms included."""
        return spaces_of(self.env())

    @property
    def playing(self) -> Game | Spaces:
        """What policies are made for: the game, or its spaces alone where it is none of cprl's."""
        return self.game if isinstance(self.game, Game) else self.spaces

    @property
    def replicas(self) -> list[int]:
        """The numbers of its replicas."""
        numbers = sorted({int(lane.split("/")[0].removeprefix("replica_")) for lane in self.networks})
        return numbers or list(range(self.experiment.replicas))

    def env(self, worlds: int = 1, *, seed: int = 0, first_world: int = 0) -> EnvBase:
        """So many fresh worlds of the run's game, with its transforms as they were at the end."""
        env = make_env(
            self.game,
            worlds=worlds,
            seed=seed,
            first_world=first_world,
            transforms=self.experiment.transforms,
        )
        load_transforms_state(env, self.transforms_state)
        return env

    def agent(self, agent: int, *, replica: int = 0) -> StoredAgent:
        """An agent of a replica."""
        if not 0 <= agent < self.game.agents:
            raise ValueError(f"agent is {agent}; {self.path} has the agents 0 to {self.game.agents - 1}")
        spec = self.specs[agent]
        if isinstance(spec, Scripted):
            return StoredAgent(scripted=spec.policy)
        if isinstance(spec, Frozen):
            if spec.run not in self._earlier:
                weights = weights_of(self.recipe, self.path, spec.run)
                self._earlier[spec.run] = load(spec.run, weights=weights)
            return self._earlier[spec.run].agent(spec.agent, replica=spec.replica_for(replica))
        lane = lane_name(replica, agent)
        if lane not in self.networks:
            raise ValueError(f"{self.path} keeps no network of {lane}; kept are {sorted(self.networks)}")
        if not all_finite(self.networks[lane].state_dict().values()):
            raise ValueError(
                f"{self.weights_from}: the weights of {lane} are NaN or infinite; leave that replica out"
            )
        return trained_agent(spec, self.networks[lane], self._decisions_of(lane))

    def _decisions_of(self, lane: str) -> Tensor | None:
        sizes = ballot_sizes(self.game) if isinstance(self.game, Game) else ()
        values = self.decisions.get(lane)
        if not sizes:
            return None
        if not isinstance(values, Tensor) or values.shape != (sum(sizes),) or values.isnan().any():
            raise ValueError(
                f"{self.path} keeps {shown(values)} of what {lane} decides; allowed: {sum(sizes)} values"
            )
        return values

    def policy(self, replica: int = 0, *, worlds: int = 1, seed: int = 0) -> AgentPolicies:
        """The agents of a replica in so many worlds side by side; those that learned explore as in evaluation
        where asked to, by random numbers that follow from the seed.
        """
        agents = [[self.agent(agent, replica=replica)] for agent in range(self.game.agents)]
        return stored_policies(agents, self.playing, replicas=[replica], worlds=worlds, seed=seed)

    def episodes(self) -> pa.Table:
        """The table of episodes; see `cprl.runs.episodes.read_episodes`."""
        return read_episodes(self.path)


def load(run: str | Path, *, weights: str | None = None) -> LoadedRun:
    """Builds a run again from its directory; runs no code that it holds.

    Warns on standard error where the user's own code is no longer what the run was made with.

    Files outside the directory are read for `Frozen` agents alone: the recipe names their runs by paths,
    which may lead anywhere, e.g. "../other". They are read when such an agent is asked for, without code.

    Args:
        weights: which of those in its `checkpoints/`: "final", "best" where the recipe keeps them, or
            "final-4800" of a run that was extended from so many episodes; by default the final ones, or those
            of the newest readable checkpoint where the run has not ended.
    """
    run = Path(run)
    if weights is not None and (Path(weights).name != weights or weights in ("", "..")):
        raise ValueError(f'weights is {weights!r}; allowed: a name in {run / FOLDER}, such as "final"')
    recipe = read_recipe(run)
    try:
        experiment = Experiment.from_recipe(recipe, directory=run)
    except ValueError as error:
        raise ValueError(f"{run / RECIPE_FILE}: {error}") from error
    say_changes(run, [f"the text of {module}, which its recipe keeps" for module in changed_code(recipe)])
    kept_weights = weights_in(run, weights)
    networks: dict[str, nn.Module] = {}
    loaded = LoadedRun(
        path=run,
        experiment=experiment,
        recipe=recipe,
        networks=networks,
        weights_from=kept_weights.path,
        transforms_state=kept_weights.transforms,
        decisions=kept_weights.decisions,
    )
    with torch.random.fork_rng(devices=[]):  # networks draw weights at first, which the stored ones replace
        networks |= _networks(loaded, kept_weights.networks)
    return loaded


def _networks(run: LoadedRun, weights: Mapping[str, Any]) -> dict[str, nn.Module]:
    networks = {}
    refusal = no_weights = f"{run.weights_from} holds no weights of this run"
    try:
        for name, state in weights.items():
            lane = name if "/" in name else f"replica_0/{name}"
            spec = run.specs[int(lane.rpartition("_")[2])]
            if not isinstance(spec, Learning | Team):
                raise ValueError(f"{lane} is the network of an agent that does not learn")
            refusal = f"{run.path / RECIPE_FILE}: a network cannot be made"
            networks[lane] = acting_part(made(spec.algorithm).make_network(run.spaces))
            refusal = no_weights
            networks[lane].load_state_dict(state)
    except Exception as error:
        raise ValueError(f"{refusal}: {error}") from error
    if not networks and any(isinstance(spec, Learning | Team) for spec in run.specs):
        raise ValueError(f"{no_weights}: it is empty")
    if networks and not any(all_finite(network.state_dict().values()) for network in networks.values()):
        raise ValueError(f"{no_weights}: all are NaN or infinite")
    return networks


def trained_agent(spec: Learning | Team, network: nn.Module, decisions: Tensor | None) -> StoredAgent:
    algorithm = made(spec.algorithm)
    return StoredAgent(
        network=network,
        stochastic=algorithm.stochastic,
        epsilon=0.0 if algorithm.stochastic else getattr(algorithm.settings, "epsilon_evaluation", 0.0),
        algorithm=repr(spec.algorithm),
        decisions=decisions,
    )


def in_a_row(replicas: Sequence[int]) -> list[list[int]]:
    """Ascending numbers in groups without gaps, as the worlds of an environment are."""
    breaks = np.flatnonzero(np.diff(replicas) > 1) + 1
    return [numbers.tolist() for numbers in np.split(np.array(replicas), breaks)]


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
        seed: what random numbers follow from, with the replica and the agent.
    """
    by_index = dict(enumerate(agents))
    kinds = {agent: of_replicas[0].kind for agent, of_replicas in by_index.items()}
    seeds = partial(lane_seeds, seed, replicas=replicas, purpose=Purpose.EVALUATION)
    decisions = None
    if isinstance(playing, Game):
        stored = decision_values(by_index)
        decisions = stored_decisions(playing, stored, replicas=replicas, worlds=worlds, seed=seed)
    actors = stored_actors(by_index, playing, kinds=kinds, seeds=seeds, worlds=worlds, stacks=True)
    return AgentPolicies(actors, decisions=decisions)


def decision_values(agents: Mapping[int, Sequence[StoredAgent]]) -> dict[int, list[Tensor]]:
    """The values of the decisions of each replica, of agents that have any; scripted ones have none."""
    values = {
        agent: [stored.decisions for stored in of_replicas if stored.decisions is not None]
        for agent, of_replicas in agents.items()
    }
    return {agent: of_replicas for agent, of_replicas in values.items() if of_replicas}


def stored_actors(
    agents: Mapping[int, Sequence[StoredAgent]],
    playing: Game | Spaces,
    *,
    kinds: Mapping[int, Any],
    seeds: Callable[..., Sequence[Sequence[int]]],
    worlds: int,
    stacks: bool = False,
) -> dict[AgentIndices, nn.Module]:
    """Actors for stored agents, those of a kind as lanes of one: lane = replica x agents + agent.

    Args:
        agents: of each replica, by index.
        seeds: those of the lanes of some `agents`.
        stacks: whether lanes of one and the same network are stacked too, so that its values are, to the last
            bit, those that it has among others.
    """
    alike: dict[Any, list[int]] = {}
    for agent in sorted(agents):
        alike.setdefault(kinds[agent], []).append(agent)
    spaces = playing.spaces if isinstance(playing, Game) else playing
    actors: dict[AgentIndices, nn.Module] = {}
    for together in alike.values():
        of_replicas = zip(*(agents[agent] for agent in together), strict=True)
        lanes = [lane for of_replica in of_replicas for lane in of_replica]
        first = lanes[0]
        common: dict[str, Any] = {"seeds": seeds(agents=together), "agents": len(together), "worlds": worlds}
        if first.scripted is not None:
            actors[tuple(together)] = scripted_lanes(first.scripted, playing, **common)
            continue
        networks: list[Any] = [lane.network for lane in lanes]
        actor = LaneActor(
            _side_by_side(networks, stacks=stacks),
            spaces.actions,
            stochastic=first.stochastic,
            state_cells=state_cells_of(networks[0]),
            **common,
        )
        actor.epsilon = first.epsilon
        actors[tuple(together)] = actor
    return actors


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
        return lambda seen: torch.stack([network(lane) for network, lane in zip(networks, seen, strict=True)])
    return lambda *seen: stack(*seen)
