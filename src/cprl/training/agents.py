"""Population: the learners and policies of a population, in every replica; agents of earlier runs too."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cprl.algorithms.base import Algorithm, TeamAlgorithm
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.custom import Custom, made
from cprl.envs.make_env import spaces_of
from cprl.envs.unwrap import commons_of
from cprl.learners.base import Learner
from cprl.learners.decisions import Bandit, BanditDecider
from cprl.learners.lanes import EVALUATION, EXHIBITION, EXPLORATION, lane_name, lane_seeds
from cprl.learners.preferences import named
from cprl.networks.agent import acting_part
from cprl.networks.recurrent import state_shape_of
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.decisions import ballot_sizes, decider_by_chance
from cprl.policies.lanes import random_agents
from cprl.policies.present import PresentPolicy
from cprl.policies.scripted import scripted_lanes
from cprl.population import (
    AgentSpec,
    Frozen,
    Learning,
    Scripted,
    Team,
    grouped,
    refuse_sharing,
    refuse_undecided,
)
from cprl.training.stored import LoadedRun, StoredAgent, load, stored_actor


class Population:
    """The agents of R replicas of an environment, specified in any mix.

    Args:
        env: a world for each replica, with its transforms: agents are made for what it shows them.
        specs: the specification of each agent, see `cprl.population`.
        seed: of the run; each agent of each replica has random numbers of its own.
        first_replica: the number of the first replica, so that replica r can be trained alone.
        engine: "compiled", "eager" or "torchrl", see `Experiment.engine`.
        allow: what stored runs of `Frozen` agents may import, see `cprl.load`.
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
        first_replica: int = 0,
        engine: str = "compiled",
        allow: Sequence[str] = (),
        starts: bool = True,
        weights: Mapping[str, str] | None = None,
    ) -> None:
        self.spaces, self.specs = spaces_of(env), tuple(specs)
        self.replicas, self.seed, self._first = env.batch_size.numel(), seed, first_replica
        commons = commons_of(env)
        self._game = None if commons is None else commons.game
        self._device = env.device or torch.device("cpu")
        self._groups = grouped(specs, self.spaces.agents)
        check_scripted(self._groups, self.spaces, self._game)
        numbers = range(first_replica, first_replica + self.replicas)
        frozen = (spec for spec, _ in self._groups if isinstance(spec, Frozen))
        named_weights = {} if weights is None else weights
        self._frozen = frozen_agents(frozen, self.spaces, self._game, allow, numbers, named_weights)
        self._acting = _acting_together(self._groups, self._frozen)
        who = {
            "replicas": self.replicas,
            "seed": seed,
            "first_replica": first_replica,
            "engine": engine,
            "device": self._device,
        }
        self.learners: dict[tuple[int, ...], Learner] = {}
        for spec, agents in self._groups:
            if isinstance(spec, Learning | Team):
                start = start_weights(spec, agents, self.spaces, self._game, numbers, allow) if starts else {}
                self.learners[agents] = _learner(
                    spec, self.spaces, agents, {**who, "start_from": start} if start else who
                )
        self.others: dict[AgentIndices, nn.Module] = self._others(EXPLORATION, worlds=1)
        self.decisions: BanditDecider | None = self._decisions()
        """What the agents decide, and learn to, where the game asks them."""

    def _decisions(self) -> BanditDecider | None:
        sizes = () if self._game is None else ballot_sizes(self._game)
        refuse_undecided(self.specs, len(sizes))
        if not sizes:
            return None
        bandits: list[Bandit | None] = [None] * self.spaces.agents
        stored: dict[int, list[Tensor]] = {}
        for spec, agents in self._groups:
            for agent in agents:
                if isinstance(spec, Learning | Team):
                    bandits[agent] = spec.decisions or Bandit()
                elif isinstance(spec, Frozen):
                    values = [own.decisions for own in self._frozen[spec] if own.decisions is not None]
                    stored |= {agent: values} if values else {}  # a scripted agent of that run has none
        return BanditDecider(
            sizes,
            bandits=bandits,
            stored=stored,
            replicas=self.replicas,
            seed=self.seed,
            first_replica=self._first,
        )

    def _others(
        self, purpose: int, *, worlds: int, replicas: int | None = None
    ) -> dict[AgentIndices, nn.Module]:
        """The actors of the agents that do not learn, with random numbers for a purpose; for so many
        replicas, all by default."""
        actors: dict[AgentIndices, nn.Module] = {}
        numbers = range(self._first, self._first + (replicas or self.replicas))
        for agents, specs in self._acting.items():
            how: dict[str, Any] = {"agents": len(agents), "worlds": worlds}
            how["seeds"] = lane_seeds(self.seed, replicas=numbers, agents=agents, purpose=purpose)
            if isinstance(specs[0], Scripted):
                actors[agents] = scripted_lanes(specs[0].policy, self._game or self.spaces, **how)
            else:
                stored = [self._frozen[spec][place] for place in range(len(numbers)) for spec in specs]
                actors[agents] = stored_actor(stored, self._game or self.spaces, **how)
        return actors

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
            others = self._others(EXHIBITION, worlds=1, replicas=1)
            own = self.decisions
            decisions = None if own is None else (own.first_replica(), own)
            return PresentPolicy(
                actors, others, decisions=decisions, replicas=self.replicas, device=self._device
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


def _acting_together(
    groups: Sequence[tuple[AgentSpec, tuple[int, ...]]], stored: Mapping[Frozen, Sequence[StoredAgent]]
) -> dict[tuple[int, ...], tuple[Any, ...]]:
    """The specification of each agent that does not learn, by the agents that act as lanes of one actor:
    scripted ones that are specified alike, and agents of one kind from one stored run."""
    alike: dict[Any, dict[int, Scripted | Frozen]] = {}
    for spec, agents in groups:
        if isinstance(spec, Scripted | Frozen):
            key = spec if isinstance(spec, Scripted) else (spec.run, stored[spec][0].kind)
            alike.setdefault(key, {}).update(dict.fromkeys(agents, spec))
    together = [dict(sorted(specs.items())) for specs in alike.values()]
    return {tuple(specs): tuple(specs.values()) for specs in together}


def _learner(spec: Learning | Team, spaces: Spaces, agents: tuple[int, ...], who: dict[str, Any]) -> Learner:
    sharing: dict[str, Any] = (
        {"share_parameters": True} if isinstance(spec, Team) and spec.share_parameters else {}
    )
    learner = algorithm_of(spec).make_learner(
        spaces, agents=agents, reward_kind=spec.reward, **sharing, **who
    )
    wants = getattr(learner, "wants", None)
    if not isinstance(spec.reward, str) and getattr(wants, "preferences", None) != spec.reward:
        own = spec.algorithm
        name = own.target if isinstance(own, Custom) else type(own).__name__
        raise ValueError(
            f"reward is {named(spec.reward)}, which the learner of {name} does not have as its `wants`; "
            "allowed for it: 'individual', 'team'"
        )
    return learner


def check_scripted(groups: Sequence[tuple[AgentSpec, Any]], spaces: Spaces, game: Game | None) -> None:
    """Checks that no transform changed the windows that scripted policies read.

    Args:
        groups: specifications, and the agent indices of each.
        spaces: what agents observe, transforms included.
        game: what is played; None for a game that is not a `Game`.
    """
    for spec, agents in groups:
        is_reading = isinstance(spec, Scripted) and spec.policy != "random"
        if (
            is_reading
            and game is not None
            and replace(spaces, vectors=()) != replace(game.spaces, vectors=())
        ):
            raise ValueError(
                f"agents {list(agents)} follow {spec}, which reads the window of the game; transforms make "
                f"it {spaces.observation_dtype} {list(spaces.observation_shape)}: leave those transforms "
                'out, or use Scripted("random")'
            )


def frozen_agents(
    specs: Iterable[Frozen],
    spaces: Spaces,
    game: Game | None,
    allow: Sequence[str],
    replicas: Sequence[int],
    weights: Mapping[str, str],
) -> dict[Frozen, list[StoredAgent]]:
    """The stored agent of each replica, by specification; each run is read once.

    Args:
        spaces: what agents observe and may do here.
        weights: the names of the weights, by run; of others the final ones.
    """
    specs = tuple(specs)
    runs = {
        path: _fitting_run(path, spaces, game, allow, weights=weights.get(path), is_to_decide=True)
        for path in dict.fromkeys(spec.run for spec in specs)
    }
    return {
        spec: [runs[spec.run].agent(spec.agent, replica=spec.replica_for(replica)) for replica in replicas]
        for spec in specs
    }


def _fitting_run(
    path: str,
    spaces: Spaces,
    game: Game | None,
    allow: Sequence[str],
    *,
    weights: str | None = None,
    is_to_decide: bool = False,
) -> LoadedRun:
    """The stored run, refused where it was trained for other observations or actions, or other ballots if its
    agents are to decide here."""
    run = load(path, weights=weights, allow=allow)
    theirs = run.spaces
    differences: list[tuple[str, Any, Any]] = [
        ("observations", theirs.observation_shape, spaces.observation_shape),
        ("observations of the dtype", theirs.observation_dtype, spaces.observation_dtype),
        ("a number of actions of", theirs.actions, spaces.actions),
    ]
    if game is not None and isinstance(run.game, Game):
        if is_to_decide and game.ballots:
            differences.append(("ballots", _asked(run.game), _asked(game)))
        differences += [
            ("a form of observation", run.game.observation, game.observation),
            ("actions", run.game.actions, game.actions),
            ("channels", run.game.channels, game.channels),
            ("institutions that show", run.game.entries_shown, game.entries_shown),
        ]
    for name, came, here in differences:
        if came != here:
            raise ValueError(f"the agents of {path} have {name} {came}; this game has {here}")
    return run


def _asked(game: Game) -> list[tuple[str, tuple[float, ...]]]:
    """What agents of a game decide on, and the choices."""
    return [(ballot.title, ballot.choices) for ballot in game.ballots]


def start_weights(
    spec: Learning | Team,
    agents: tuple[int, ...],
    spaces: Spaces,
    game: Game | None,
    replicas: Sequence[int],
    allow: Sequence[str] = (),
) -> dict[str, dict[str, Tensor]]:
    """The state dict of the acting network with which each agent of each replica starts, by the lane's name;
    empty where they start anew.

    Args:
        spaces: what they observe and may do.
    """
    source = spec.start_from
    if source is None:
        return {}
    run, algorithm = _fitting_run(source.run, spaces, game, allow), algorithm_of(spec)
    theirs = _members(run, source, len(agents)) if isinstance(spec, Team) else (source.agent,) * len(agents)
    weights = {}
    for replica in replicas:
        for agent, stored_agent in zip(agents, theirs, strict=True):
            taken = source.replica_for(replica)
            where = f"{lane_name(taken, stored_agent)} of {source.run}"
            stored = run.agent(stored_agent, replica=taken)
            weights[lane_name(replica, agent)] = _weights(stored, algorithm, spaces, where)
    return weights


def _members(run: LoadedRun, source: Frozen, size: int) -> tuple[int, ...]:
    """The agents of the team that the stored agent is in."""
    theirs = run.specs[source.agent] if source.agent < len(run.specs) else None
    if not isinstance(theirs, Team) or len(theirs.agents) != size:
        what = f"in a team of {len(theirs.agents)}" if isinstance(theirs, Team) else "in no team"
        raise ValueError(
            f"agent {source.agent} of {source.run} is {what}; allowed for a team of {size} to start from: a "
            f"member of a team of {size}"
        )
    return theirs.agents


def _weights(stored: StoredAgent, algorithm: Algorithm, spaces: Spaces, where: str) -> dict[str, Tensor]:
    """The weights of a stored agent's network, if the algorithm's network computes the same with them."""
    name = type(algorithm).__name__
    if stored.network is None:
        raise ValueError(f"{where} is scripted, without weights; allowed: an agent that learned")
    if stored.kind[1] != algorithm.stochastic:
        kinds = {True: "the logits of a policy", False: "action values"}
        raise ValueError(
            f"the network of {where} outputs {kinds[stored.kind[1]]}; {name} learns "
            f"{kinds[algorithm.stochastic]}"
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
        ours, theirs = network(seen, *state), stored.network(seen, *state)
        if not all(
            torch.equal(*pair) for pair in (zip(ours, theirs, strict=True) if state else [(ours, theirs)])
        ):
            raise ValueError(
                f"{where} has another network than {name} here: with the same weights the outputs differ"
            )
    return weights


def algorithm_of(spec: Learning | Team) -> Algorithm:
    """The algorithm of a specification; refuses code of the user's own that is none."""
    is_sharing = isinstance(spec, Team) and spec.share_parameters
    wanted = TeamAlgorithm if isinstance(spec, Team) and not is_sharing else Algorithm
    algorithm = made(spec.algorithm)
    if not isinstance(algorithm, wanted):
        named = f" of {spec.algorithm.target}" if isinstance(spec.algorithm, Custom) else ""
        raise ValueError(
            f"the algorithm{named} is a {type(algorithm).__name__}; allowed: a subclass of "
            f"cprl.algorithms.{wanted.__name__}"
        )
    refuse_sharing(algorithm, is_sharing)
    return algorithm
