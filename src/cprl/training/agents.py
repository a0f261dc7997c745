"""The agents of a population, of whatever kind; those that earlier runs learned are read by `load`."""

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

from cprl.algorithms.base import Algorithm, TeamAlgorithm
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.make_env import make_env, spaces_of
from cprl.envs.state import load_transforms_state
from cprl.envs.unwrap import commons_of
from cprl.experiment import Experiment
from cprl.learners.base import Learner, LearningAgents
from cprl.networks.agent import acting_part
from cprl.networks.finite import all_finite
from cprl.networks.recurrent import state_cells_of, state_shape_of
from cprl.networks.stacked import stack_lanes
from cprl.objectives.preferences import named
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.decisions import (
    Bandit,
    BanditDecider,
    ballot_sizes,
    decider_by_chance,
    stored_decisions,
)
from cprl.policies.lanes import LaneActor, random_agents
from cprl.policies.present import PresentPolicy
from cprl.policies.rng import EVALUATION, EXHIBITION, EXPLORATION, lane_name, lane_seeds
from cprl.policies.scripted import ScriptedPolicy, scripted_lanes
from cprl.population import (
    AgentSpec,
    Frozen,
    Learning,
    Scripted,
    Team,
    grouped,
    refuse_sharing,
    refuse_undecided,
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
        return _trained(spec, self.networks[lane], self._decisions_of(lane))

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


def _trained(spec: Learning | Team, network: nn.Module, decisions: Tensor | None) -> StoredAgent:
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
    seeds = partial(lane_seeds, seed, replicas=replicas, purpose=EVALUATION)
    decisions = None
    if isinstance(playing, Game):
        stored = _stored_values(by_index)
        decisions = stored_decisions(playing, stored, replicas=replicas, worlds=worlds, seed=seed)
    actors = _actors(by_index, playing, kinds=kinds, seeds=seeds, worlds=worlds, stacks=True)
    return AgentPolicies(actors, decisions=decisions)


def _stored_values(agents: Mapping[int, Sequence[StoredAgent]]) -> dict[int, list[Tensor]]:
    """The values of the decisions of each replica, of agents that have any; scripted ones have none."""
    values = {agent: [stored.decisions for stored in of_replicas] for agent, of_replicas in agents.items()}
    known = {agent: [value for value in each if value is not None] for agent, each in values.items()}
    return {agent: each for agent, each in known.items() if each}


def _actors(
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


class Population:
    """The agents of R replicas of an environment, specified in any mix.

    Args:
        env: a world for each replica, with its transforms: agents are made for what it shows them.
        specs: the specification of each agent, see `cprl.population`.
        seed: of the run; each agent of each replica has random numbers of its own.
        worlds: the worlds W of each replica; world b of `env` belongs to replica b // W.
        first_replica: the number of the first replica, so that replica r can be trained alone.
        engine: "compiled", "eager" or "torchrl", see `Experiment.engine`.
        starts: whether agents that start from stored weights get them; False where a checkpoint follows,
            which has later ones.
        weights: the names of the weights that `Frozen` agents play with, see `cprl.load`, by their run; of
            runs that are not in it the final ones.
    """

    def __init__(
        self,
        env: EnvBase,
        specs: Sequence[AgentSpec],
        *,
        seed: int = 0,
        worlds: int = 1,
        first_replica: int = 0,
        engine: str = "compiled",
        starts: bool = True,
        weights: Mapping[str, str] | None = None,
    ) -> None:
        self.spaces, self.specs, self.seed = spaces_of(env), tuple(specs), seed
        self.replicas, self.worlds = env.batch_size.numel() // worlds, worlds
        commons = commons_of(env)
        self._game = None if commons is None else commons.game
        self._device = env.device or torch.device("cpu")
        groups = grouped(specs, self.spaces.agents)
        self._by_agent = specs_by_agent(specs, self.spaces.agents)
        check_scripted(groups, self.spaces, self._game)
        self._numbers = range(first_replica, first_replica + self.replicas)
        self._stored = self._agents_that_do_not_learn(weights or {})
        self.learners: dict[tuple[int, ...], Learner] = {}
        for spec, agents in groups:
            if isinstance(spec, Learning | Team):
                self.learners[agents] = self._learner(spec, agents, engine, starts)
        self.others: dict[AgentIndices, nn.Module] = self._others(EXPLORATION, worlds=worlds)
        self.decisions: BanditDecider | None = self._decisions()
        """What the agents decide, and learn to, where the game asks them."""

    @property
    def playing(self) -> Game | Spaces:
        """What policies are made for, see `LoadedRun.playing`."""
        return self._game or self.spaces

    def policy(self, worlds: int) -> AgentPolicies:
        """All agents as they are now, in so many worlds of each replica side by side; those that learn values
        explore with `epsilon_evaluation`."""
        learned: dict[AgentIndices, nn.Module] = {
            agents: learner.evaluation_actor(worlds) for agents, learner in self.learners.items()
        }
        decisions = None if self.decisions is None else self.decisions.evaluation(worlds)
        return AgentPolicies({**learned, **self._others(EVALUATION, worlds=worlds)}, decisions=decisions)

    def present_policy(self) -> PresentPolicy:
        """All agents of the first replica as they are now, whenever it is called, in one world."""
        with torch.random.fork_rng(devices=[]):
            actors: dict[AgentIndices, Any] = {
                agents: (learner.evaluation_actor(1), learner.actor)
                for agents, learner in self.learners.items()
            }
            decisions = self.decisions
            return PresentPolicy(
                actors,
                self._others(EXHIBITION, worlds=1, replicas=1),
                decisions=None if decisions is None else (decisions.first_replica(), decisions),
                replicas=self.replicas,
                device=self._device,
            )

    def random_policy(self, worlds: int) -> AgentPolicies:
        """Every agent takes every action with equal probability, and every choice where it decides."""
        everyone = tuple(range(self.spaces.agents))
        seeds = [(self.seed, replica, agent) for replica in range(self.replicas) for agent in everyone]
        return AgentPolicies(
            random_agents(self.spaces, everyone, replicas=self.replicas, seed=self.seed, worlds=worlds),
            decisions=None if self._game is None else decider_by_chance(self._game, seeds, worlds=worlds),
        )

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each learner's acting network as it is now, by "replica_0/agent_0" and so on."""
        return {
            name: network
            for learner in self.learners.values()
            for name, network in learner.networks().items()
        }

    def as_stored(self, replicas: Sequence[int]) -> list[list[StoredAgent]]:
        """Copies of the agents as they are now, by agent and replica, of these replicas."""
        networks = self.networks()
        decisions = {} if self.decisions is None else self.decisions.learned()
        agents: list[list[StoredAgent]] = []
        for agent, spec in enumerate(self._by_agent):
            if isinstance(spec, Learning | Team):
                lanes = [lane_name(replica, agent) for replica in replicas]
                agents.append([_trained(spec, networks[lane], decisions.get(lane)) for lane in lanes])
            else:
                agents.append([self._stored[agent][self._numbers.index(replica)] for replica in replicas])
        return agents

    def _agents_that_do_not_learn(self, weights: Mapping[str, str]) -> dict[int, list[StoredAgent]]:
        """The agents of each replica, by their index; each stored run is read once."""
        runs: dict[str, LoadedRun] = {}
        agents: dict[int, list[StoredAgent]] = {}
        for agent, spec in enumerate(self._by_agent):
            if isinstance(spec, Scripted):
                agents[agent] = [StoredAgent(scripted=spec.policy)] * self.replicas
            elif isinstance(spec, Frozen):
                if spec.run not in runs:
                    runs[spec.run] = load(spec.run, weights=weights.get(spec.run))
                    _refuse_unfitting(runs[spec.run], self.spaces, self._game, is_to_decide=True)
                replicas = map(spec.replica_for, self._numbers)
                agents[agent] = [runs[spec.run].agent(spec.agent, replica=replica) for replica in replicas]
        return agents

    def _others(
        self, purpose: int, *, worlds: int, replicas: int | None = None
    ) -> dict[AgentIndices, nn.Module]:
        """The actors of the agents that do not learn, with random numbers for a purpose; for so many
        replicas, all by default. Scripted agents of one policy act as lanes of one actor, and agents of one
        kind from one stored run."""
        numbers = self._numbers[:replicas]
        agents = {agent: of_replicas[: len(numbers)] for agent, of_replicas in self._stored.items()}
        kinds = {
            agent: (getattr(self._by_agent[agent], "run", None), of_replicas[0].kind)
            for agent, of_replicas in agents.items()
        }
        seeds = partial(lane_seeds, self.seed, replicas=numbers, purpose=purpose)
        return _actors(agents, self.playing, kinds=kinds, seeds=seeds, worlds=worlds)

    def _decisions(self) -> BanditDecider | None:
        sizes = () if self._game is None else ballot_sizes(self._game)
        refuse_undecided(self.specs, len(sizes))
        if not sizes:
            return None
        bandits = [
            (spec.decisions or Bandit()) if isinstance(spec, Learning | Team) else None
            for spec in self._by_agent
        ]
        return BanditDecider(
            sizes,
            bandits=bandits,
            stored=_stored_values(self._stored),
            replicas=self.replicas,
            worlds=self.worlds,
            seed=self.seed,
            first_replica=self._numbers.start,
        )

    def _learner(self, spec: Learning | Team, agents: tuple[int, ...], engine: Any, starts: bool) -> Learner:
        who = LearningAgents(
            self.spaces,
            agents=agents,
            replicas=self.replicas,
            worlds=self.worlds,
            seed=self.seed,
            first_replica=self._numbers.start,
            reward_kind=spec.reward,
            start_from=self._start_weights(spec, agents) if starts else {},
            share_parameters=isinstance(spec, Team) and spec.share_parameters,
            device=self._device,
        )
        learner = _algorithm_of(spec).make_learner(who, engine)
        wants = getattr(learner, "wants", None)
        if not isinstance(spec.reward, str) and getattr(wants, "preferences", None) != spec.reward:
            raise ValueError(
                f"reward is {named(spec.reward)}, which the learner of {_name(spec)} does not have as its "
                "`wants`; allowed for it: 'individual', 'team'"
            )
        return learner

    def _start_weights(self, spec: Learning | Team, agents: tuple[int, ...]) -> dict[str, dict[str, Tensor]]:
        """The state dict of the acting network with which each agent of each replica starts, by the lane's
        name; empty where they start anew."""
        source = spec.start_from
        if source is None:
            return {}
        run, algorithm = load(source.run), _algorithm_of(spec)
        _refuse_unfitting(run, self.spaces, self._game)
        is_team = isinstance(spec, Team)
        sources = _members(run, source, len(agents)) if is_team else (source.agent,) * len(agents)
        weights = {}
        for replica in self._numbers:
            there = source.replica_for(replica)
            for agent, stored_agent in zip(agents, sources, strict=True):
                where = f"{lane_name(there, stored_agent)} of {source.run}"
                stored = run.agent(stored_agent, replica=there)
                weights[lane_name(replica, agent)] = _weights(stored, algorithm, self.spaces, where)
        return weights


def check_scripted(groups: Sequence[tuple[AgentSpec, Any]], spaces: Spaces, game: Game | None) -> None:
    """Checks that no transform changed the windows that scripted policies read.

    Args:
        groups: specifications, and the agent indices of each.
        spaces: what agents observe, transforms included.
        game: what is played; None for a game that is not a `Game`.
    """
    if game is None or spaces == game.spaces:
        return
    for spec, agents in groups:
        if isinstance(spec, Scripted) and spec.policy != "random":
            raise ValueError(
                f"agents {list(agents)} follow {spec}, which reads the window of the game; transforms make "
                f"it {spaces.observation_dtype} {list(spaces.observation_shape)}: leave those transforms "
                'out, or use Scripted("random")'
            )


def _refuse_unfitting(
    run: LoadedRun, spaces: Spaces, game: Game | None, *, is_to_decide: bool = False
) -> None:
    """Refuses a run that was trained for other observations or actions, or other ballots if its agents are to
    decide here."""
    pairs: dict[str, tuple[Any, Any]] = {
        "observations": (run.spaces.observation_shape, spaces.observation_shape),
        "observations of the dtype": (run.spaces.observation_dtype, spaces.observation_dtype),
        "a number of actions of": (run.spaces.actions, spaces.actions),
    }
    if game is not None and isinstance(run.game, Game):
        if is_to_decide and game.ballots:
            pairs["ballots"] = _ballots(run.game), _ballots(game)
        pairs |= {
            "a form of observation": (run.game.observation, game.observation),
            "actions": (run.game.actions, game.actions),
            "channels": (run.game.channels, game.channels),
            "institutions that show": (run.game.entries_shown, game.entries_shown),
        }
        if "scoreboard" in game.score_channels:
            pairs["a scoreboard of so many agents:"] = run.game.agents, game.agents
    for name, (there, here) in pairs.items():
        if there != here:
            raise ValueError(f"the agents of {run.path} have {name} {there}; this game has {here}")


def _ballots(game: Game) -> list[tuple[str, tuple[float, ...]]]:
    return [(ballot.title, ballot.choices) for ballot in game.ballots]


def _members(run: LoadedRun, source: Frozen, size: int) -> tuple[int, ...]:
    """The agents of the team that the stored agent is in."""
    spec = run.specs[source.agent] if source.agent < len(run.specs) else None
    if not isinstance(spec, Team) or len(spec.agents) != size:
        where = f"in a team of {len(spec.agents)}" if isinstance(spec, Team) else "in no team"
        raise ValueError(
            f"agent {source.agent} of {source.run} is {where}; allowed for a team of {size} to start from: a "
            f"member of a team of {size}"
        )
    return spec.agents


def _weights(stored: StoredAgent, algorithm: Algorithm, spaces: Spaces, where: str) -> dict[str, Tensor]:
    """The weights of a stored agent's network, if the algorithm's network computes the same with them."""
    name = type(algorithm).__name__
    if stored.network is None:
        raise ValueError(f"{where} is scripted, without weights; allowed: an agent that learned")
    if stored.stochastic != algorithm.stochastic:
        outputs = {True: "the logits of a policy", False: "action values"}
        raise ValueError(
            f"the network of {where} outputs {outputs[stored.stochastic]}; {name} learns "
            f"{outputs[algorithm.stochastic]}"
        )
    weights = stored.network.state_dict()
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        network = acting_part(algorithm.make_network(spaces))
        try:
            network.load_state_dict(weights)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{where} has another network than {name} here: {reason}") from error
        torch.manual_seed(0)
        seen = torch.rand(8, *spaces.observation_shape) * spaces.observation_scale
        seen = seen.to(getattr(torch, spaces.observation_dtype))
        shape = state_shape_of(network)
        state = () if shape is None else (torch.zeros(8, *shape),)
        outputs_here, outputs_there = network(seen, *state), stored.network(seen, *state)
        pairs = zip(outputs_here, outputs_there, strict=True) if state else [(outputs_here, outputs_there)]
        if not all(torch.equal(*pair) for pair in pairs):
            raise ValueError(
                f"{where} has another network than {name} here: with the same weights the outputs differ"
            )
    return weights


def _algorithm_of(spec: Learning | Team) -> Algorithm:
    """The algorithm of a specification; refuses code of the user's own that is none."""
    is_sharing = isinstance(spec, Team) and spec.share_parameters
    kind = TeamAlgorithm if isinstance(spec, Team) and not is_sharing else Algorithm
    algorithm = made(spec.algorithm)
    if not isinstance(algorithm, kind):
        raise ValueError(
            f"the algorithm of {_name(spec)} is a {type(algorithm).__name__}; allowed: a subclass of "
            f"cprl.algorithms.{kind.__name__}"
        )
    refuse_sharing(algorithm, is_sharing)
    return algorithm


def _name(spec: Learning | Team) -> str:
    return spec.algorithm.target if isinstance(spec.algorithm, Custom) else type(spec.algorithm).__name__
