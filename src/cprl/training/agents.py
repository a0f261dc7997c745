"""Population: the agents of an experiment, of whatever kind."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, get_args

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cprl import keys
from cprl.algorithms.base import Algorithm, TeamAlgorithm, TrainingEngine
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.make_env import spaces_of
from cprl.envs.unwrap import commons_of
from cprl.learners.base import AnyLearner
from cprl.learners.lanes import Lanes
from cprl.networks.agent import acting_part
from cprl.networks.recurrent import state_shape_of
from cprl.objectives.rewards import reward_name
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.decisions import (
    Bandit,
    BanditDecider,
    ballot_sizes,
    stored_decisions,
)
from cprl.policies.lanes import random_agents
from cprl.policies.present import PresentPolicy
from cprl.policies.rng import Purpose, lane_name, lane_seeds
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
from cprl.training.stored import LoadedRun, StoredAgent, decision_values, load, stored_actors, trained_agent
from cprl.values import Custom, made, shown


def _refuse_unmarked(spec: Learning | Team, env: EnvBase) -> None:
    """Raises a ValueError for learning from turns in play alone in a game that does not say who is."""
    settings = getattr(_algorithm_of(spec), "settings", None)
    if getattr(settings, "only_in_play", False) and keys.IN_PLAY not in env.observation_spec.keys(True, True):
        raise ValueError(
            'settings.only_in_play is True; allowed in a game without the entry ("agents", "in_play"): False'
        )


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
        known = get_args(TrainingEngine)
        if engine not in known:
            more = '; "auto" is for an Experiment, which says how long it trains' * (engine == "auto")
            raise ValueError(f"engine is {shown(engine)}; allowed: {', '.join(map(shown, known))}{more}")
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
        self.learners: dict[tuple[int, ...], AnyLearner] = {}
        for spec, agents in groups:
            if isinstance(spec, Learning | Team):
                _refuse_unmarked(spec, env)
                self.learners[agents] = self._learner(spec, agents, engine, starts)
        self.others: dict[AgentIndices, nn.Module] = self._others(Purpose.EXPLORATION, worlds=worlds)
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
        return AgentPolicies(
            {**learned, **self._others(Purpose.EVALUATION, worlds=worlds)}, decisions=decisions
        )

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
                self._others(Purpose.EXHIBITION, worlds=1, replicas=1),
                decisions=None if decisions is None else (decisions.first_replica(), decisions),
                replicas=self.replicas,
                device=self._device,
            )

    def random_policy(self, worlds: int) -> AgentPolicies:
        """Every agent takes every action with equal probability, and every choice where it decides."""
        everyone = tuple(range(self.spaces.agents))
        actors = random_agents(self.spaces, everyone, replicas=self.replicas, seed=self.seed, worlds=worlds)
        decisions = None
        if self._game is not None:
            replicas = range(self.replicas)
            purpose = Purpose.RANDOM_PLAY
            decisions = stored_decisions(
                self._game, {}, replicas=replicas, worlds=worlds, seed=self.seed, purpose=purpose
            )
        return AgentPolicies(actors, decisions=decisions)

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
                agents.append([trained_agent(spec, networks[lane], decisions.get(lane)) for lane in lanes])
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
        self, purpose: Purpose, *, worlds: int, replicas: int | None = None
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
        return stored_actors(agents, self.playing, kinds=kinds, seeds=seeds, worlds=worlds)

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
            stored=decision_values(self._stored),
            replicas=self.replicas,
            worlds=self.worlds,
            seed=self.seed,
            first_replica=self._numbers.start,
        )

    def _learner(
        self, spec: Learning | Team, agents: tuple[int, ...], engine: Any, starts: bool
    ) -> AnyLearner:
        lanes = Lanes(
            self.spaces,
            agents=agents,
            replicas=self.replicas,
            worlds=self.worlds,
            seed=self.seed,
            first_replica=self._numbers.start,
            reward=spec.reward,
            start_from=self._start_weights(spec, agents) if starts else {},
            share_parameters=isinstance(spec, Team) and spec.share_parameters,
            device=self._device,
        )
        learner = _algorithm_of(spec).make_learner(lanes, engine)
        if learner.rewards.reward != spec.reward and not isinstance(spec.reward, str):
            raise ValueError(
                f"reward is {reward_name(spec.reward)}, which the learner of {_name(spec)} does not have as "
                "its `rewards`; allowed for it: 'individual', 'team'"
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
