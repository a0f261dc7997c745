"""Stored agents of earlier runs, read by `load`, their policies, and checks that runs have the same game."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.env_state import load_transforms_state
from cprl.envs.make_env import make_env, spaces_of, stored_game
from cprl.experiment import Experiment
from cprl.networks.agent import acting_network
from cprl.networks.finite import all_finite
from cprl.networks.recurrent import state_cells_of
from cprl.networks.stacked import stack_lanes
from cprl.policies.actors import LaneActor
from cprl.policies.asking import CALLS, Calls
from cprl.policies.decisions import Decider, ballot_sizes
from cprl.policies.governors import GovernorActor, ScriptedGovernor, governor_spaces
from cprl.policies.joint_policy import ActorAgents, JointPolicy
from cprl.policies.language import LanguageActor
from cprl.policies.rng import Purpose, lane_name, lane_seeds
from cprl.policies.scripted import scripted_lanes
from cprl.population import (
    AgentSpec,
    Frozen,
    GovernorSpec,
    Language,
    Learning,
    Person,
    Pool,
    Scripted,
    Team,
    specs_by_agent,
)
from cprl.runs.checkpoints import CHECKPOINTS
from cprl.runs.episodes import read_episodes
from cprl.runs.recipe import RECIPE_FILE, changed_code, read_recipe, warn_of_changes
from cprl.runs.weights import frozen_weights_name, weights_in
from cprl.training.pools import PoolActor
from cprl.values import Custom, describe_changes, instantiate, short_repr, to_config

_MOST_DIFFERENCES: Final = 3
"""The largest number of differences between two games that a message lists."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredAgent:
    """An agent that does not learn, or learns no longer: how it is specified, and what it has learned."""

    spec: AgentSpec | GovernorSpec
    network: nn.Module | None = field(default=None, repr=False)
    """The network by which it acts; None for an agent that did not learn."""
    decisions: Tensor | None = field(default=None, repr=False)
    """The values of its choices on all ballots, float64 [C]; None if it decides at random, or has no
    ballots."""
    calls: Calls = field(default_factory=Calls, repr=False)
    """What keeps the calls of its language model."""
    pool: tuple["StoredAgent", ...] = ()
    """The opponents of a `Pool`, oldest first, one of which plays each episode."""

    @property
    def kind(self) -> str:
        """Return the kind of the agent; agents of one kind can be lanes of one actor."""
        return repr(getattr(self.spec, "algorithm", self.spec))

    @cached_property
    def algorithm(self) -> Any:
        """Return the algorithm by which an agent with a network learned."""
        spec: Any = self.spec
        return instantiate(spec.algorithm)

    @property
    def epsilon(self) -> float | None:
        """Return the probability of a random action in evaluation; None for an agent without values of
        actions."""
        if self.network is None or self.algorithm.stochastic:
            return None
        return getattr(self.algorithm.settings, "epsilon_evaluation", 0.0)


def stored_agent(
    spec: AgentSpec | GovernorSpec, replica: int, *, calls: Calls, load: Callable[[str], "LoadedRun"]
) -> StoredAgent:
    """Return an agent of a replica that does not learn there; a pool is without past selves.

    Args:
        calls: what keeps the calls of a language model.
        load: loads the run of an agent of an earlier run.
    """
    if isinstance(spec, Frozen):
        agent = load(spec.run).agent(spec.agent, replica=spec.replica_for(replica))
        return replace(agent, calls=calls)
    runs = spec.runs if isinstance(spec, Pool) else ()
    opponents = [stored_agent(run, replica, calls=calls, load=load) for run in runs]
    if any(isinstance(opponent.spec, Language) for opponent in opponents):
        raise ValueError(
            "an opponent of a Pool plays by a language model, which would be asked in episodes of others "
            "too; allowed: agents that learned, or follow a script"
        )
    return StoredAgent(spec=spec, calls=calls, pool=tuple(opponents))


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedRun:
    """A run, loaded from its directory alone; see `load`."""

    path: Path
    experiment: Experiment
    recipe: Mapping[str, Any]
    """The content of `recipe.json`."""
    networks: Mapping[str, nn.Module]
    """The trained acting network of each lane, by "replica_0/agent_0" and so on."""
    weights_from: Path
    """The file of the weights: for a run that has not ended, its newest checkpoint."""
    transforms_state: Mapping[str, Any]
    """The states of the environment's transforms."""
    decisions: Mapping[str, Tensor] = field(default_factory=dict)
    """The values of each lane's decisions, see `cprl.policies.decisions`; empty without ballots."""

    def __repr__(self) -> str:
        return f"LoadedRun({str(self.path)!r}, {self.experiment!r})"

    @cached_property
    def game(self) -> Any:
        """Return the game that was played."""
        return instantiate(self.experiment.game)

    @property
    def metrics(self) -> tuple[Custom, ...]:
        """Return the custom metrics of the experiment."""
        return self.experiment.metrics

    @property
    def specs(self) -> list[AgentSpec]:
        return specs_by_agent(self.experiment.agents, self.game.agents)

    @property
    def all_specs(self) -> Sequence[AgentSpec | GovernorSpec]:
        """Return the specification of each agent, and last that of the governor, if it has one."""
        governor = self.experiment.governor
        return self.specs if governor is None else [*self.specs, governor]

    def governor(self, replicas: Sequence[int]) -> list[list[StoredAgent]]:
        """Return a list of the governor of each of some replicas; [] without one."""
        if self.experiment.governor is None:
            return []
        return [[self.agent(self.game.agents, replica=replica) for replica in replicas]]

    @cached_property
    def spaces(self) -> Spaces:
        """Return the observations and actions of its agents, transforms included."""
        return spaces_of(self.env())

    @cached_property
    def calls(self) -> Calls:
        """Return what keeps the calls of its language models, in its directory."""
        calls = Calls()
        calls.keep_in(self.path / CALLS)
        return calls

    @property
    def playing(self) -> Game | Spaces:
        """Return what policies are made for: the game, or its spaces if it is not a game of cprl."""
        return self.game if isinstance(self.game, Game) else self.spaces

    @property
    def replicas(self) -> list[int]:
        """Return the numbers of its replicas."""
        numbers = sorted({int(lane.split("/")[0].removeprefix("replica_")) for lane in self.networks})
        return numbers or list(range(self.experiment.replicas))

    def env(self, worlds: int = 1, *, seed: int = 0, first_world: int = 0) -> EnvBase:
        """Return fresh worlds of the run's game, with its transforms as they were at the end."""
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
        """Return an agent of a replica; its governor counts as the agent after the last one."""
        specs = self.all_specs
        if not 0 <= agent < len(specs):
            raise ValueError(f"agent is {agent}; {self.path} has the agents 0 to {len(specs) - 1}")
        spec = specs[agent]
        lane = lane_name(replica, agent)
        if isinstance(spec, Person):
            raise ValueError(
                f"agent {agent} of {self.path} is a person: people cannot be played again; allowed: cprl "
                "table, report, show and film, which read what they played"
            )
        if not isinstance(spec, Learning | Team):
            stored = stored_agent(spec, replica, calls=self.calls, load=self._load_earlier)
            return replace(stored, pool=(*stored.pool, *self._past_selves(spec, lane)))
        if lane not in self.networks:
            raise ValueError(f"{self.path} keeps no network of {lane}; kept are {sorted(self.networks)}")
        if not all_finite(self.networks[lane].state_dict().values()):
            raise ValueError(
                f"{self.weights_from}: the weights of {lane} are NaN or infinite; leave that replica out"
            )
        return StoredAgent(spec=spec, network=self.networks[lane], decisions=self._decisions_of(lane))

    @cached_property
    def _load_earlier(self) -> Callable[[str], "LoadedRun"]:
        """Return a function that loads a run whose agents are frozen in this one, each once."""
        return cache(lambda run: load(run, weights=frozen_weights_name(self.recipe, self.path, run)))

    def _past_selves(self, spec: AgentSpec | GovernorSpec, lane: str) -> list[StoredAgent]:
        """Return the past selves in the pool of a lane, oldest first; [] for other agents."""
        if not isinstance(spec, Pool) or spec.own_past is None:
            return []
        learner = self.specs[spec.own_past.agent]
        networks = [network for name, network in self.networks.items() if name.startswith(f"{lane}/")]
        return [StoredAgent(spec=learner, network=network) for network in networks[-spec.own_past.kept :]]

    def _decisions_of(self, lane: str) -> Tensor | None:
        sizes = ballot_sizes(self.game)
        values = self.decisions.get(lane)
        if not sizes:
            return None
        if not isinstance(values, Tensor) or values.shape != (sum(sizes),) or values.isnan().any():
            raise ValueError(
                f"{self.path} keeps {short_repr(values)} of what {lane} decides; allowed: {sum(sizes)} values"
            )
        return values

    def policy(self, replica: int = 0, *, worlds: int = 1, seed: int = 0) -> JointPolicy:
        """Return the policies of a replica's agents for several worlds; trained agents explore as in
        evaluation if asked to, with random numbers from the seed."""
        agents = [[self.agent(agent, replica=replica)] for agent in range(len(self.all_specs))]
        return stored_policies(agents, self.playing, replicas=[replica], worlds=worlds, seed=seed)

    def episodes(self) -> pa.Table:
        """Return the table of episodes; see `cprl.runs.episodes.read_episodes`."""
        return read_episodes(self.path)


def load(run: str | Path, *, weights: str | None = None) -> LoadedRun:
    """Load a run from its directory, without running code that it holds.

    Warn on standard error if user code has changed since the run was made.

    Files outside the directory are read for `Frozen` agents only: the recipe names their runs by paths, which
    may lead anywhere, e.g. "../other". They are read, without running code, when such an agent is needed.

    Args:
        weights: the name of weights in its `checkpoints/`: "final", "best" if the recipe keeps them, or
            "final-4800" for a run that was extended from 4800 episodes; by default the final ones, or those
            of the newest readable checkpoint if the run has not ended.
    """
    run = Path(run)
    if weights is not None and (Path(weights).name != weights or weights in ("", "..")):
        raise ValueError(f'weights is {weights!r}; allowed: a name in {run / CHECKPOINTS}, such as "final"')
    recipe = read_recipe(run)
    try:
        experiment = Experiment.from_recipe(recipe, directory=run)
    except ValueError as error:
        raise ValueError(f"{run / RECIPE_FILE}: {error}") from error
    warn_of_changes(run, [f"the text of {module}, which its recipe keeps" for module in changed_code(recipe)])
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
    with torch.random.fork_rng(devices=[]):  # new networks draw initial weights, which are replaced
        networks |= _networks(loaded, kept_weights.networks)
    return loaded


def as_loaded(run: str | Path | LoadedRun) -> LoadedRun:
    """Return a run as it is, or load it from its directory."""
    return run if isinstance(run, LoadedRun) else load(run)


def refuse_other_games(runs: Mapping[str, LoadedRun]) -> None:
    """Raise a ValueError if a run has a different game or different transforms than the first run.

    Args:
        runs: the runs by the names that a refusal says.
    """
    first_name, *other_names = runs
    first_run = runs[first_name]
    for name in other_names:
        run = runs[name]
        both = f"{first_name} and {name}"
        refuse_unlike(both, first_run.experiment.game, run.experiment.game)
        refuse_unlike(both, first_run.experiment.transforms, run.experiment.transforms, "transforms")
        learned = differing_entries(first_run.transforms_state, run.transforms_state)
        if learned:
            raise ValueError(f"{both}: the learned state of transforms differs: {learned}")


def differing_entries(state: Mapping[str, Any], other_state: Mapping[str, Any]) -> list[str]:
    """Return the names of the entries of a transforms' state that another state lacks or has with another
    value."""
    return [
        name
        for name, value in state.items()
        if name not in other_state
        or not torch.equal(torch.as_tensor(value), torch.as_tensor(other_state[name]))
    ]


def refuse_unlike(names: str, game: Any, other_game: Any, path: str = "") -> None:
    """Raise a ValueError that says where two games, or two lists of transforms, differ.

    Args:
        names: the names of the two runs, e.g. "a and b".
        path: where the differences are; by default the game's class.
    """
    config = to_config(stored_game(game))
    other_config = to_config(stored_game(other_game))
    lines = describe_changes(config, other_config, path or type(game).__name__)
    if lines:
        raise ValueError(
            f"{names} have different games: {'; '.join(lines[:_MOST_DIFFERENCES])}; allowed: the same game"
        )


def _networks(run: LoadedRun, weights: Mapping[str, Any]) -> dict[str, nn.Module]:
    networks = {}
    refusal = no_weights = f"{run.weights_from} holds no weights of this run"
    try:
        for name, state in weights.items():
            lane = name if "/" in name else f"replica_0/{name}"
            agent = int(lane.split("/")[1].removeprefix("agent_"))
            spec = run.all_specs[agent]
            if isinstance(spec, Pool) and spec.own_past is not None:
                spec = run.specs[spec.own_past.agent]
            if not isinstance(spec, Learning | Team):
                raise ValueError(f"{lane} is the network of an agent that does not learn")
            refusal = f"{run.path / RECIPE_FILE}: a network cannot be made"
            spaces = run.spaces if agent < run.game.agents else governor_spaces(run.game)
            networks[lane] = acting_network(instantiate(spec.algorithm).make_network(spaces))
            refusal = no_weights
            networks[lane].load_state_dict(state)
    except Exception as error:
        raise ValueError(f"{refusal}: {error}") from error
    if not networks and any(isinstance(spec, Learning | Team) for spec in run.specs):
        raise ValueError(f"{no_weights}: it is empty")
    if networks and not any(all_finite(network.state_dict().values()) for network in networks.values()):
        raise ValueError(f"{no_weights}: all are NaN or infinite")
    return networks


def consecutive_groups(replicas: Sequence[int]) -> list[list[int]]:
    """Return ascending numbers in groups without gaps, since the worlds of an environment have none."""
    breaks = np.flatnonzero(np.diff(replicas) > 1) + 1
    return [numbers.tolist() for numbers in np.split(np.array(replicas), breaks)]


def stored_policies(
    agents: Sequence[Sequence[StoredAgent]],
    playing: Game | Spaces,
    *,
    replicas: Sequence[int],
    worlds: int,
    seed: int,
    purpose: Purpose = Purpose.EVALUATION,
    decides: Purpose = Purpose.EVALUATED_DECISIONS,
) -> JointPolicy:
    """Return the policies of stored agents of some replicas; agents of one kind are lanes of one actor.

    Args:
        agents: the stored agents, by agent and replica; the governor, if one decides, comes last.
        seed: the seed of random numbers, with the replica, the agent and the purpose.
        purpose: the purpose of the random numbers of actions.
        decides: that of the random numbers of decisions on ballots.
    """
    by_index = dict(enumerate(agents))
    seeds = partial(lane_seeds, seed, replicas=replicas, purpose=purpose)
    governor = stored_governor(by_index.pop(playing.agents, ()), playing, seeds=seeds, worlds=worlds)
    decisions = None
    if sizes := ballot_sizes(playing):
        decisions = Decider(
            sizes,
            seeds=lane_seeds(seed, replicas=replicas, agents=range(playing.agents), purpose=decides),
            agents=playing.agents,
            worlds=worlds,
            stored=decision_values(by_index),
        )
    actors = stored_actors(by_index, playing, seeds=seeds, worlds=worlds, stacks=True)
    return JointPolicy(actors, decisions=decisions, governor=governor)


def stored_governor(
    stored: Sequence[StoredAgent],
    playing: Game | Spaces,
    *,
    seeds: Callable[..., Sequence[Sequence[int]]],
    worlds: int,
) -> GovernorActor | None:
    """Return the actor of a governor that does not learn.

    Args:
        stored: the governor of each replica; () for None, with which the first option stays in force.
        seeds: see `stored_actors`.
    """
    if not stored:
        return None
    assert isinstance(playing, Game)
    assert playing.governor is not None
    decider: Any = stored[0].spec
    if not isinstance(decider, ScriptedGovernor):
        lanes = {playing.agents: stored}
        actors = stored_actors(lanes, governor_spaces(playing), seeds=seeds, worlds=worlds, stacks=True)
        (decider,) = actors.values()
    return GovernorActor(playing.governor, decider)


def decision_values(agents: Mapping[int, Sequence[StoredAgent]]) -> dict[int, list[Tensor]]:
    """Return the values of the decisions of agents that have any, in each replica."""
    values: dict[int, list[Any]] = {}
    for agent, replicas in agents.items():
        if replicas[0].decisions is not None:
            values[agent] = [stored.decisions for stored in replicas]
    return values


def stored_actors(
    agents: Mapping[int, Sequence[StoredAgent]],
    playing: Game | Spaces,
    *,
    kinds: Mapping[int, Any] | None = None,
    seeds: Callable[..., Sequence[Sequence[int]]],
    worlds: int,
    stacks: bool = False,
    asks: bool = True,
) -> dict[ActorAgents, nn.Module]:
    """Return actors for stored agents; agents of one kind are lanes of one actor: lane = replica x agents +
    agent. A pool has an actor of its own.

    Args:
        agents: the stored agents of each replica, by index.
        kinds: the kind of each agent by index; by default `StoredAgent.kind`.
        seeds: returns the seeds of the lanes of some `agents`.
        stacks: whether lanes with the very same network are stacked too, so that its values equal, to the
            last bit, those beside other networks.
        asks: whether language models are asked; without, their agents follow the fallback.
    """
    indices_by_kind: dict[Any, list[int]] = {}
    actors: dict[ActorAgents, nn.Module] = {}
    for agent in sorted(agents):
        replicas = agents[agent]
        if isinstance(replicas[0].spec, Pool):
            make_actors = partial(stored_actors, playing=playing, worlds=worlds)
            actors[agent,] = PoolActor(replicas, make_actors, seeds=seeds(agents=[agent]), worlds=worlds)
        else:
            kind = replicas[0].kind if kinds is None else kinds[agent]
            indices_by_kind.setdefault(kind, []).append(agent)
    said: dict[Any, Any] = {}
    for indices in indices_by_kind.values():
        by_replica = zip(*[agents[agent] for agent in indices], strict=True)
        lanes = list(chain.from_iterable(by_replica))
        size: dict[str, Any] = {"seeds": seeds(agents=indices), "agents": len(indices), "worlds": worlds}
        actor: Any
        match lanes[0].spec:
            case Language() as spec if asks:
                actor = LanguageActor(spec, playing, calls=lanes[0].calls, said=said, **size)
            case Language(fallback=policy) | Scripted(policy=policy):
                actor = scripted_lanes(policy, playing, **size)
            case _:
                networks: list[Any] = [lane.network for lane in lanes]
                actor = LaneActor(
                    _apply_together(networks, stacks=stacks),
                    (playing.spaces if isinstance(playing, Game) else playing).actions,
                    stochastic=lanes[0].algorithm.stochastic,
                    state_cells=state_cells_of(networks[0]),
                    **size,
                )
                actor.epsilon = lanes[0].epsilon or 0.0
        actors[tuple(indices)] = actor
    return actors


def _apply_together(networks: Sequence[nn.Module], *, stacks: bool) -> Callable[..., Any]:
    """Return a function that applies each network to the observations of its lane, [L, k, ...] to [L, k, A];
    recurrent networks also return their states."""
    first = networks[0]
    if not stacks and all(network is first for network in networks):
        first.requires_grad_(False)
        return lambda *seen: first(*seen)
    try:
        stack = stack_lanes(networks)
    except ValueError:  # these networks do not stack, e.g. custom ones
        return lambda seen: torch.stack([network(lane) for network, lane in zip(networks, seen, strict=True)])
    return lambda *seen: stack(*seen)
