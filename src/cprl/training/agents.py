"""Population: the agents of an experiment that learn, follow a script, or were trained by an earlier run."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cprl import keys
from cprl.algorithms.base import Algorithm, TeamAlgorithm, TrainingEngine
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.make_env import spaces_of
from cprl.envs.unwrap import agent_names, commons_game_of
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.measuring.registry import OPTIONAL_ENTRIES, reported_by
from cprl.networks.agent import acting_network
from cprl.networks.recurrent import state_shape_of
from cprl.objectives.rewards import reward_name
from cprl.policies.asking import Calls
from cprl.policies.decisions import Bandit, BanditDecider, ballot_sizes
from cprl.policies.governors import GovernorActor, governor_spaces
from cprl.policies.joint_policy import ActorAgents, JointPolicy
from cprl.policies.language import LanguageActor
from cprl.policies.rng import Purpose, lane_name, lane_names, lane_seeds
from cprl.policies.scripted import RULES_READ, ScriptedActor
from cprl.population import (
    AgentSpec,
    Frozen,
    GovernorSpec,
    Language,
    Learning,
    OwnPast,
    Pool,
    Scripted,
    Team,
    algorithm_name,
    grouped,
    refuse_people,
    refuse_sharing,
    refuse_undecided,
    specs_by_agent,
    stored_in,
)
from cprl.training.governing import Governing
from cprl.training.pools import PoolActor
from cprl.training.stored import (
    LoadedRun,
    StoredAgent,
    decision_values,
    load,
    stored_actors,
    stored_agent,
    stored_governor,
    stored_policies,
)
from cprl.values import checked, instantiate


def _refuse_only_in_play(learner: Learner, env: EnvBase) -> None:
    """Raise a ValueError for `only_in_play` in a game without the entry "in_play"."""
    has_in_play = keys.IN_PLAY in env.observation_spec.keys(True, True)
    if getattr(learner.settings, "only_in_play", False) and not has_in_play:
        raise ValueError(
            'settings.only_in_play is True; allowed in a game without the entry ("agents", "in_play"): False'
        )


class Population:
    """The agents of R replicas of an environment, specified in any mix.

    Args:
        env: the worlds, with their transforms; agents are made for its observations.
        specs: the specification of each agent, see `cprl.population`.
        seed: the seed of the run; each agent of each replica has its own random numbers.
        worlds: the worlds W of each replica; world b of `env` belongs to replica b // W.
        first_replica: the number of the first replica, so that replica r can be trained alone.
        engine: "compiled", "eager" or "torchrl", see `Experiment.engine`; "auto" is for an experiment, which
            says how long it trains.
        starts: whether agents with `start_from` get the stored weights; False if a checkpoint with later
            weights is loaded next.
        weights: the names of the weights of `Frozen` agents by run, see `cprl.load`; runs not in it have
            their final ones.
        governor: the specification of the governor; None leaves its first option in force.
        governor_from_turn: the turns of the training before it decides.
    """

    def __init__(
        self,
        env: EnvBase,
        specs: Sequence[AgentSpec],
        *,
        seed: int = 0,
        worlds: int = 1,
        first_replica: int = 0,
        engine: TrainingEngine = "compiled",
        starts: bool = True,
        weights: Mapping[str, str] | None = None,
        governor: GovernorSpec | None = None,
        governor_from_turn: int = 0,
    ) -> None:
        checked("engine", engine, TrainingEngine)
        refuse_people(specs)
        self.spaces = spaces_of(env)
        self.specs = tuple(specs)
        self.seed = seed
        self.worlds = worlds
        self.replicas = env.batch_size.numel() // worlds
        self._game = commons_game_of(env)
        self.device = env.device or torch.device("cpu")
        groups = grouped(specs, self.spaces.agents)
        self._specs_by_agent: list[AgentSpec | GovernorSpec] = [*specs_by_agent(specs, self.spaces.agents)]
        if governor is not None:
            self._specs_by_agent.append(governor)
        check_scripted(groups, self.spaces, self._game)
        self._replica_numbers = range(first_replica, first_replica + self.replicas)
        self.calls = Calls()
        """The calls of the agents' language models."""
        self.learners: dict[tuple[int, ...], Learner] = {}
        for spec, agents in groups:
            if isinstance(spec, Learning | Team):
                self.learners[agents] = self._make_learner(spec, agents, engine, self.spaces, starts=starts)
                _refuse_only_in_play(self.learners[agents], env)
        self._stored_agents = self._load_stored_agents(weights or {})
        self._pools = {
            agent: PoolActor(
                stored,
                partial(stored_actors, playing=self.playing, worlds=worlds),
                seeds=self._seeds(Purpose.EXPLORATION)(agents=[agent]),
                worlds=worlds,
                present=self._present,
            )
            for agent, stored in self._stored_agents.items()
            if isinstance(self._specs_by_agent[agent], Pool)
        }
        self.governor = self._make_governor(governor, governor_from_turn)
        """The governor, which counts as the agent after the last one, and how it learns; None without one."""
        self.others: dict[ActorAgents, nn.Module] = self.other_actors(Purpose.EXPLORATION, worlds=worlds)
        self.others |= {(agent,): pool for agent, pool in self._pools.items()}
        self.decisions: BanditDecider | None = self._make_decider()
        """The decisions of the agents on the game's ballots, and how they learn them; None without
        ballots."""

    @property
    def playing(self) -> Game | Spaces:
        """Return the game or spaces that policies are made for, see `LoadedRun.playing`."""
        return self._game or self.spaces

    def policy(self, worlds: int) -> JointPolicy:
        """Return the current policies of all agents, for several worlds of each replica; agents that learn
        values explore with `epsilon_evaluation`."""
        actors: dict[ActorAgents, nn.Module] = {
            agents: learner.evaluation_actor(worlds) for agents, learner in self.learners.items()
        }
        actors |= self.other_actors(Purpose.EVALUATION, worlds=worlds)
        decisions = None
        if self.decisions is not None:
            decisions = self.decisions.without_exploration(
                Purpose.EVALUATED_DECISIONS, replicas=self.replicas, worlds=worlds
            )
        return JointPolicy(actors, decisions=decisions, governor=self.governor_actor(worlds))

    def random_policy(self, worlds: int) -> JointPolicy:
        """Return policies that take every action, and every choice of a decision, with equal probability."""
        agents = [[StoredAgent(spec=Scripted("random"))] * self.replicas] * len(self._specs_by_agent)
        return stored_policies(
            agents,
            self.playing,
            replicas=range(self.replicas),
            worlds=worlds,
            seed=self.seed,
            purpose=Purpose.RANDOM_PLAY,
            decides=Purpose.RANDOM_PLAY,
        )

    def governor_actor(self, worlds: int) -> GovernorActor | None:
        """Return an actor of the current governor for several worlds of each replica; None without one."""
        if self.governor is None or self.governor.learner is None:
            return self._stored_governor(Purpose.EVALUATION, worlds)
        return GovernorActor(self.governor.actor.governor, self.governor.learner.evaluation_actor(worlds))

    def _stored_governor(self, purpose: Purpose, worlds: int) -> GovernorActor | None:
        """Return the actor of a governor that does not learn, with random numbers for a purpose."""
        stored = self._stored_agents.get(self.spaces.agents, ())
        return stored_governor(stored, self.playing, seeds=self._seeds(purpose), worlds=worlds)

    def networks(self) -> dict[str, nn.Module]:
        """Return copies of the learners' current acting networks, by "replica_0/agent_0" and so on, and the
        networks of past selves, see `PoolActor.networks`."""
        networks: dict[str, nn.Module] = {}
        governors = [] if self.governor is None else [self.governor.learner]
        for learner in filter(None, [*self.learners.values(), *governors]):
            networks |= learner.networks()
        for pool in self._pools.values():
            networks |= pool.networks()
        return networks

    def _make_governor(self, spec: GovernorSpec | None, from_turn: int) -> Governing | None:
        if spec is None:
            return None
        assert self._game is not None
        assert self._game.governor is not None
        actor = self._stored_governor(Purpose.EXPLORATION, self.worlds)
        learner = None
        if isinstance(spec, Learning):
            spaces = governor_spaces(self._game)
            learner = self._make_learner(spec, (self.spaces.agents,), "eager", spaces)
            actor = GovernorActor(self._game.governor, learner.actor)
        assert actor is not None
        actor.from_turn = from_turn
        return Governing(self._game, actor, learner)

    def as_stored(self, replicas: Sequence[int]) -> list[list[StoredAgent]]:
        """Return copies of the current agents of some replicas, by agent and replica; the governor, if there
        is one, comes last."""
        networks = self.networks()
        decisions = {} if self.decisions is None else self.decisions.learned()
        others = self._others_as_stored()
        agents: list[list[StoredAgent]] = []
        for agent, spec in enumerate(self._specs_by_agent):
            if isinstance(spec, Learning | Team):
                lanes = [lane_name(replica, agent) for replica in replicas]
                agents.append(
                    [
                        StoredAgent(spec=spec, network=networks[lane], decisions=decisions.get(lane))
                        for lane in lanes
                    ]
                )
            else:
                agents.append([others[agent][self._replica_numbers.index(replica)] for replica in replicas])
        return agents

    def _load_stored_agents(self, weights: Mapping[str, str]) -> dict[int, list[StoredAgent]]:
        """Return the agents of each replica that do not learn by index, pools without past selves. Each
        stored run is read once."""
        earlier = cache(lambda run: load(run, weights=weights.get(run)))
        agents: dict[int, list[StoredAgent]] = {}
        for agent, spec in enumerate(self._specs_by_agent):
            if isinstance(spec, Learning | Team):
                continue
            for frozen in stored_in(spec).values():
                if agent == self.spaces.agents:
                    _refuse_other_governor(earlier(frozen.run), frozen, self._game)
                else:
                    _refuse_other_game(earlier(frozen.run), self.spaces, self._game, is_to_decide=True)
            agents[agent] = [
                stored_agent(spec, replica, calls=self.calls, load=earlier)
                for replica in self._replica_numbers
            ]
        return agents

    def _present(self, own_past: OwnPast) -> list[StoredAgent]:
        """Return copies of the agent of an `OwnPast` as it is now, of each replica."""
        agent = own_past.agent
        spec = self._specs_by_agent[agent]
        (learner,) = (learner for agents, learner in self.learners.items() if agent in agents)
        networks = learner.networks()
        names = lane_names(replicas=self._replica_numbers, agents=[agent])
        return [StoredAgent(spec=spec, network=networks[name]) for name in names]

    def _others_as_stored(self) -> dict[int, list[StoredAgent]]:
        """Return the agents of each replica that do not learn by index, pools as they are now."""
        return self._stored_agents | {agent: pool.as_stored() for agent, pool in self._pools.items()}

    def other_actors(
        self, purpose: Purpose, *, worlds: int, replicas: int | None = None
    ) -> dict[ActorAgents, nn.Module]:
        """Return the actors of the agents that do not learn, with random numbers for a purpose.

        Scripted agents of one policy act as lanes of one actor, as do agents of one kind from one stored run.

        Args:
            replicas: the number of replicas; by default all.
        """
        numbers = self._replica_numbers[:replicas]
        others = self._others_as_stored()
        agents = {
            agent: stored[: len(numbers)] for agent, stored in others.items() if agent < self.spaces.agents
        }
        kinds = {
            agent: (getattr(self._specs_by_agent[agent], "run", None), stored[0].kind)
            for agent, stored in agents.items()
        }
        return stored_actors(
            agents,
            self.playing,
            kinds=kinds,
            seeds=self._seeds(purpose, replicas),
            worlds=worlds,
            asks=purpose is not Purpose.EXHIBITION,  # viewers cost no calls
        )

    def _seeds(self, purpose: Purpose, replicas: int | None = None) -> Callable[..., list[tuple[int, ...]]]:
        """Return a function of some `agents` that returns the seeds of their lanes for one purpose."""
        numbers = self._replica_numbers[:replicas]
        return partial(lane_seeds, self.seed, replicas=numbers, purpose=purpose)

    def _make_decider(self) -> BanditDecider | None:
        sizes = ballot_sizes(self._game)
        refuse_undecided(self.specs, len(sizes))
        if not sizes:
            return None
        bandits = [
            (spec.decisions or Bandit()) if isinstance(spec, Learning | Team) else None
            for spec in self._specs_by_agent[: self.spaces.agents]
        ]
        return BanditDecider(
            sizes,
            bandits=bandits,
            stored=decision_values(self._stored_agents),
            replicas=self.replicas,
            worlds=self.worlds,
            seed=self.seed,
            first_replica=self._replica_numbers.start,
        )

    def _make_learner(
        self,
        spec: Learning | Team,
        agents: tuple[int, ...],
        engine: Any,
        spaces: Spaces,
        *,
        starts: bool = False,
    ) -> Learner:
        start_from = self._start_weights(spec, agents) if starts else {}
        lanes = Lanes(
            spaces,
            agents=agents,
            replicas=self.replicas,
            worlds=self.worlds,
            seed=self.seed,
            first_replica=self._replica_numbers.start,
            reward=spec.reward,
            start_from=start_from,
            share_parameters=isinstance(spec, Team) and spec.share_parameters,
            device=self.device,
        )
        learner = _algorithm_of(spec).make_learner(lanes, engine)
        if learner.rewards.reward != spec.reward and not isinstance(spec.reward, str):
            raise ValueError(
                f"reward is {reward_name(spec.reward)}, which the learner of {algorithm_name(spec)} does "
                "not have as its `rewards`; allowed for it: 'individual', 'team'"
            )
        return learner

    def _start_weights(self, spec: Learning | Team, agents: tuple[int, ...]) -> dict[str, dict[str, Tensor]]:
        """Return the weights with which the acting network of each agent of each replica starts, by the
        lane's name; empty without `start_from`."""
        source = spec.start_from
        if source is None:
            return {}
        run = load(source.run)
        algorithm = _algorithm_of(spec)
        _refuse_other_game(run, self.spaces, self._game)
        is_team = isinstance(spec, Team)
        sources = _team_of(run, source, len(agents)) if is_team else (source.agent,) * len(agents)
        weights = {}
        for replica in self._replica_numbers:
            stored_replica = source.replica_for(replica)
            for agent, source_agent in zip(agents, sources, strict=True):
                where = f"{lane_name(stored_replica, source_agent)} of {source.run}"
                stored = run.agent(source_agent, replica=stored_replica)
                weights[lane_name(replica, agent)] = _loadable_weights(stored, algorithm, self.spaces, where)
        return weights


def check_scripted(groups: Sequence[tuple[AgentSpec, Any]], spaces: Spaces, game: Game | None) -> None:
    """Refuse transforms that change the windows which scripted policies read.

    Args:
        groups: specifications, each with its agent indices.
        spaces: what agents observe, transforms included.
        game: the game; None for one that is not a `Game`.
    """
    if game is None or spaces == game.spaces:
        return
    for spec, agents in groups:
        if isinstance(spec, Language) or (isinstance(spec, Scripted) and spec.policy != "random"):
            raise ValueError(
                f"agents {list(agents)} follow {spec}, which reads the window of the game; transforms make "
                f"it {spaces.observation_dtype} {list(spaces.observation_shape)}: leave those transforms "
                'out, or use Scripted("random")'
            )


def refuse_other_worlds(earlier: EnvBase, env: EnvBase, name: str, others: Iterable[nn.Module]) -> None:
    """Refuse the worlds of an earlier game, called `name`, in which the agents of `env` could not play.

    Args:
        others: the actors of the agents that do not learn; scripted ones go by rules of `env`.
    """
    games = commons_game_of(earlier), commons_game_of(env)
    pairs: dict[str, tuple[Any, Any]] = {"agents": (agent_names(earlier), agent_names(env))}
    pairs["a board of cprl:"] = games[0] is not None, games[1] is not None
    reported = [reported_by(worlds) for worlds in (earlier, env)]
    for entry in OPTIONAL_ENTRIES:
        pairs[f"the entry {entry}:"] = entry in reported[0], entry in reported[1]
    pairs |= _pairs(games[0], spaces_of(earlier), games[1], spaces_of(env))
    if games[0] is not None and games[1] is not None:
        pairs["ballots"] = _ballot_choices(games[0]), _ballot_choices(games[1])
        pairs["a governor:"] = games[0].governor, games[1].governor
        for actor in others:
            if isinstance(actor, LanguageActor):
                pairs["for a language model the game"] = games[0], games[1]
            if isinstance(actor, ScriptedActor):
                for rule in RULES_READ[actor.policy]:
                    values = getattr(games[0].rules, rule), getattr(games[1].rules, rule)
                    pairs[f"for {actor.policy} agents a {rule} of"] = values
    _refuse_unequal(name, "has", pairs)


def _refuse_other_game(
    run: LoadedRun, spaces: Spaces, game: Game | None, *, is_to_decide: bool = False
) -> None:
    """Refuse a run that was trained for other observations or actions, or for other ballots if
    `is_to_decide`."""
    pairs = _pairs(run.game, run.spaces, game, spaces)
    if game is not None and isinstance(run.game, Game) and is_to_decide and game.ballots:
        pairs["ballots"] = _ballot_choices(run.game), _ballot_choices(game)
    _refuse_unequal(f"the agents of {run.path}", "have", pairs)


def _refuse_other_governor(run: LoadedRun, spec: Frozen, game: Any) -> None:
    """Refuse a stored agent that is no governor, or sees or chooses from something else than that of the
    game."""
    if not spec.agent == run.game.agents < len(run.all_specs):
        raise ValueError(
            f"governor is {spec}; allowed: the governor of a run, as the agent after the last one"
        )
    stored = run.game.governor
    pairs = {
        "a governor that sees": (stored.sees, game.governor.sees),
        "a governor with the options": (stored.options, game.governor.options),
    }
    _refuse_unequal(f"the game of {run.path}", "has", pairs)


def _pairs(
    game_there: Any, spaces_there: Spaces, game: Game | None, spaces: Spaces
) -> dict[str, tuple[Any, Any]]:
    """Return in words, there and here, what two games must share for the same agents to play both."""
    pairs: dict[str, tuple[Any, Any]] = {
        "observations": (spaces_there.observation_shape, spaces.observation_shape),
        "observations of the dtype": (spaces_there.observation_dtype, spaces.observation_dtype),
        "a number of actions of": (spaces_there.actions, spaces.actions),
    }
    if game is not None and isinstance(game_there, Game):
        pairs |= {
            "a form of observation": (game_there.observation, game.observation),
            "actions": (game_there.actions, game.actions),
            "channels": (game_there.channels, game.channels),
            "institutions that show": (game_there.entries_shown, game.entries_shown),
        }
        if "scoreboard" in game.score_channels:
            pairs["a scoreboard of so many agents:"] = game_there.agents, game.agents
    return pairs


def _refuse_unequal(subject: str, verb: str, pairs: Mapping[str, tuple[Any, Any]]) -> None:
    for name, (there, here) in pairs.items():
        if there != here:
            raise ValueError(f"{subject} {verb} {name} {there}; this game has {here}")


def _ballot_choices(game: Game) -> list[tuple[str, tuple[float, ...]]]:
    return [(ballot.title, ballot.choices) for ballot in game.ballots]


def _team_of(run: LoadedRun, source: Frozen, size: int) -> tuple[int, ...]:
    """Return the agents of the team of a stored agent."""
    spec = run.specs[source.agent] if source.agent < len(run.specs) else None
    if not isinstance(spec, Team) or len(spec.agents) != size:
        where = f"in a team of {len(spec.agents)}" if isinstance(spec, Team) else "in no team"
        raise ValueError(
            f"agent {source.agent} of {source.run} is {where}; allowed for a team of {size} to start from: a "
            f"member of a team of {size}"
        )
    return spec.agents


def _loadable_weights(
    stored: StoredAgent, algorithm: Algorithm, spaces: Spaces, where: str
) -> dict[str, Tensor]:
    """Return the weights of a stored agent's network; refuse them if the algorithm's network computes
    something else with them."""
    name = type(algorithm).__name__
    if stored.network is None:
        raise ValueError(f"{where} is scripted, without weights; allowed: an agent that learned")
    is_stochastic = stored.algorithm.stochastic
    if is_stochastic != algorithm.stochastic:
        meanings = {True: "the logits of a policy", False: "action values"}
        raise ValueError(
            f"the network of {where} outputs {meanings[is_stochastic]}; {name} learns "
            f"{meanings[algorithm.stochastic]}"
        )
    weights = stored.network.state_dict()
    with torch.random.fork_rng(devices=[]):
        network = acting_network(algorithm.make_network(spaces))
        try:
            network.load_state_dict(weights)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{where} has another network than {name} here: {reason}") from error
        if not _compute_the_same(network, stored.network, spaces):
            raise ValueError(
                f"{where} has another network than {name} here: with the same weights the outputs differ"
            )
    return weights


@torch.no_grad()
def _compute_the_same(network: nn.Module, stored: nn.Module, spaces: Spaces) -> bool:
    """Return whether two networks have the same outputs, and states, for some random observations."""
    torch.manual_seed(0)
    observation = torch.rand(8, *spaces.observation_shape) * spaces.observation_scale
    observation = observation.to(getattr(torch, spaces.observation_dtype))
    shape = state_shape_of(network)
    if shape is None:
        return torch.equal(network(observation), stored(observation))
    state = torch.zeros(8, *shape)
    pairs = zip(network(observation, state), stored(observation, state), strict=True)
    return all(torch.equal(output, stored_output) for output, stored_output in pairs)


def _algorithm_of(spec: Learning | Team) -> Algorithm:
    """Return the algorithm of a specification; refuse user code that is no algorithm."""
    is_sharing = isinstance(spec, Team) and spec.share_parameters
    kind = TeamAlgorithm if isinstance(spec, Team) and not is_sharing else Algorithm
    algorithm = instantiate(spec.algorithm)
    if not isinstance(algorithm, kind):
        raise ValueError(
            f"the algorithm of {algorithm_name(spec)} is a {type(algorithm).__name__}; allowed: a subclass "
            f"of cprl.algorithms.{kind.__name__}"
        )
    refuse_sharing(algorithm, is_sharing)
    return algorithm
