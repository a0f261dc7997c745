"""Population: the learners and policies of a population, in every replica of a training."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cprl.arguments import object_of, objects, texts
from cprl.checks import MOST_SEED, checked, count
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.custom import Custom
from cprl.envs.make_env import spaces_of
from cprl.envs.unwrap import commons_of
from cprl.learners.base import Learner
from cprl.learners.decisions import Bandit, BanditDecider
from cprl.learners.lanes import EVALUATION, EXHIBITION, EXPLORATION, lane_seeds
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.decisions import ballot_sizes, decider_by_chance
from cprl.policies.lanes import random_agents
from cprl.policies.present import PresentPolicy
from cprl.policies.scripted import scripted_lanes
from cprl.population import AgentSpec, Frozen, Learning, Scripted, Team, grouped, refuse_undecided
from cprl.preferences.values import named
from cprl.training.earlier import algorithm_of, frozen_agents, start_weights
from cprl.training.stored_agents import StoredAgent, stored_actor


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

    Raises:
        ValueError: for specifications that do not fit the environment or each other; says what does.
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
        specs = objects("specs", specs, AgentSpec, "Learning, Team, Scripted or Frozen")
        checked("seed", seed, count(0, MOST_SEED))
        checked("first_replica", first_replica, count(0))
        texts("allow", allow)
        self.spaces, self.specs = spaces_of(env), specs
        self.replicas, self.seed, self._first = env.batch_size.numel(), seed, first_replica
        commons = commons_of(env)
        self._game = None if commons is None else commons.game
        self._device = env.device or torch.device("cpu")
        self._groups = grouped(specs, self.spaces.agents)
        check_scripted(self._groups, self.spaces, self._game)
        numbers = range(first_replica, first_replica + self.replicas)
        frozen = (spec for spec, _ in self._groups if isinstance(spec, Frozen))
        named_weights = {} if weights is None else weights
        object_of("weights", named_weights, Mapping, "the names of weights by run")
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

    Raises:
        ValueError: names the agents and their policy.
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
