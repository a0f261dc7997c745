"""Population: the learners and policies of a population, in every replica of a training."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import nn
from torchrl.envs import EnvBase

from cprl.algorithms.base import Algorithm, TeamAlgorithm
from cprl.commons.game import Game
from cprl.custom import Custom, made
from cprl.envs.make_env import spaces_of
from cprl.envs.unwrap import commons_of
from cprl.learners.base import Learner
from cprl.learners.lanes import EVALUATION, EXPLORATION, lane_seeds
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.lanes import random_agents
from cprl.policies.scripted import scripted_lanes
from cprl.population import AgentSpec, Frozen, Learning, Scripted, Team, grouped
from cprl.spaces import Spaces
from cprl.stored import StoredAgent, load, stored_actor


class Population:
    """The agents of R replicas of an environment, specified in any mix.

    Args:
        env: a world for each replica, with its transforms: agents are made for what it shows them.
        specs: the specification of each agent, see `cprl.population`.
        seed: of the run; each agent of each replica has random numbers of its own.
        first_replica: the number of the first replica, so that replica r can be trained alone.
        engine: "compiled", "eager" or "torchrl", see `Experiment.engine`.
        allow: what stored runs of `Frozen` agents may import, see `cprl.load`.

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
    ) -> None:
        self.spaces, self.specs = spaces_of(env), tuple(specs)
        self.replicas, self.seed, self._first = env.batch_size.numel(), seed, first_replica
        commons = commons_of(env)
        self._game = None if commons is None else commons.game
        self._groups = grouped(specs, self.spaces.agents)
        _check_scripted(self._groups, self.spaces, self._game)
        self._frozen = {
            spec: _frozen(spec, self.spaces, self._game, allow)
            for spec, _ in self._groups
            if isinstance(spec, Frozen)
        }
        who = {
            "replicas": self.replicas,
            "seed": seed,
            "first_replica": first_replica,
            "engine": engine,
            "device": env.device or torch.device("cpu"),
        }
        self.learners: dict[tuple[int, ...], Learner] = {
            agents: _learner(spec, self.spaces, agents, who)
            for spec, agents in self._groups
            if isinstance(spec, Learning | Team)
        }
        self.others: dict[AgentIndices, nn.Module] = self._others(EXPLORATION, worlds=1)

    def _others(self, purpose: int, *, worlds: int) -> dict[AgentIndices, nn.Module]:
        """The actors of the agents that do not learn, with random numbers for a purpose."""
        actors: dict[AgentIndices, nn.Module] = {}
        replicas = range(self._first, self._first + self.replicas)
        for spec, agents in self._groups:
            how: dict[str, Any] = {"agents": len(agents), "worlds": worlds}
            how["seeds"] = lane_seeds(self.seed, replicas=replicas, agents=agents, purpose=purpose)
            if isinstance(spec, Scripted):
                actors[agents] = scripted_lanes(spec.policy, self._game or self.spaces, **how)
            elif isinstance(spec, Frozen):
                stored = [self._frozen[spec]] * len(how["seeds"])
                actors[agents] = stored_actor(stored, self._game or self.spaces, **how)
        return actors

    def policy(self, worlds: int) -> AgentPolicies:
        """All agents as they are now, in so many worlds of each replica side by side; those that learn values
        explore with `epsilon_evaluation`."""
        learned: dict[AgentIndices, nn.Module] = {
            agents: learner.evaluation_actor(worlds) for agents, learner in self.learners.items()
        }
        return AgentPolicies({**learned, **self._others(EVALUATION, worlds=worlds)})

    def random_policy(self, worlds: int) -> AgentPolicies:
        """Every agent takes every action with equal probability."""
        everyone = tuple(range(self.spaces.agents))
        return AgentPolicies(
            random_agents(self.spaces, everyone, replicas=self.replicas, seed=self.seed, worlds=worlds)
        )

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each learner's acting network as it is now, by "replica_0/agent_0" and so on."""
        return {
            name: network
            for learner in self.learners.values()
            for name, network in learner.networks().items()
        }


def _learner(spec: Learning | Team, spaces: Spaces, agents: tuple[int, ...], who: dict[str, Any]) -> Learner:
    wanted = TeamAlgorithm if isinstance(spec, Team) else Algorithm
    algorithm = made(spec.algorithm)
    if not isinstance(algorithm, wanted):
        named = f" of {spec.algorithm.target}" if isinstance(spec.algorithm, Custom) else ""
        raise ValueError(
            f"the algorithm{named} is a {type(algorithm).__name__}; allowed: a subclass of "
            f"cprl.algorithms.{wanted.__name__}"
        )
    return algorithm.make_learner(spaces, agents=agents, reward_kind=spec.reward, **who)


def _check_scripted(groups: Sequence[tuple[AgentSpec, Any]], spaces: Spaces, game: Game | None) -> None:
    """Refuses scripted policies where transforms changed the windows that they read."""
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


def _frozen(spec: Frozen, spaces: Spaces, game: Game | None, allow: Sequence[str]) -> StoredAgent:
    """The stored agent, refused where it was trained for other observations or actions."""
    run = load(spec.run, allow=allow)
    theirs = run.spaces
    differences: list[tuple[str, Any, Any]] = [
        ("observations", theirs.observation_shape, spaces.observation_shape),
        ("observations of the dtype", theirs.observation_dtype, spaces.observation_dtype),
        ("a number of actions of", theirs.actions, spaces.actions),
    ]
    if game is not None and isinstance(run.game, Game):
        differences += [
            ("a form of observation", run.game.observation, game.observation),
            ("actions", run.game.actions, game.actions),
        ]
    for name, came, here in differences:
        if came != here:
            raise ValueError(f"the agents of {spec.run} have {name} {came}; this game has {here}")
    return run.agent(spec.agent, replica=spec.replica)
