"""Population: who sits at each seat of a game, in every replica: learners, scripted and frozen agents."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, get_args

import torch
from torch import Tensor, nn

from cprl.algorithms.registry import Algorithm, told
from cprl.algorithms.tabular import Tabular
from cprl.algorithms.teams import TeamAlgorithm, check_team
from cprl.commons.game import Game
from cprl.learners.lanes import EVALUATION, EXPLORATION, lane_seeds
from cprl.learners.replay import ReplayLearner
from cprl.learners.rollouts import RolloutLearner
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.learners.tabular import TabularLearner
from cprl.learners.transitions import RewardKind
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.lanes import LaneActor, random_agents
from cprl.policies.scripted import ScriptedPolicy, scripted_lanes
from cprl.stored import load

AnyLearner: TypeAlias = ReplayLearner | RolloutLearner | TabularLearner


@dataclass(frozen=True)
class Learner:
    """A seat whose agent learns. Equal ones are lanes of one step.

    Args:
        algorithm: e.g. `cprl.learning.DQN(settings=...)`.
        reward_kind: "own", the agent's own reward, or "group", the sum of all agents' rewards.
    """

    algorithm: Algorithm
    reward_kind: RewardKind = "own"

    def __post_init__(self) -> None:
        if self.reward_kind not in get_args(RewardKind):
            raise ValueError(f"paid is {self.reward_kind!r}; allowed: {', '.join(get_args(RewardKind))}")


@dataclass(frozen=True)
class Scripted:
    """A seat whose agent follows a rule; see `cprl.policies.scripted`.

    Args:
        policy: which.
    """

    policy: ScriptedPolicy = "random"


@dataclass(frozen=True)
class Frozen:
    """A seat whose agent plays what an earlier run learned, and learns no more; the same in every replica.

    Args:
        run: the run's directory, or its results.
        agent: which of its agents.
        replica: of which replica.
    """

    run: str | Path
    agent: int
    replica: int = 0


Member: TypeAlias = Learner | Scripted | Frozen


class Population:
    """The agents of R replicas, one for each seat of the game, in any mix.

    Args:
        game: what is played.
        members: who sits at seat 0, 1 and so on.
        replicas: how many replicas R, the worlds of a training.
        seed: of the run; each agent of each replica has random numbers of its own.
        first_replica: the number of the first replica, so that replica r can be trained alone.
        compile: whether acting and learning are compiled by torch.
        device: where agents learn.

    Raises:
        ValueError: for more or fewer members than seats, and for members that do not fit the game or each
            other; says what fits.
    """

    def __init__(
        self,
        game: Game,
        members: Sequence[Member],
        *,
        replicas: int = 1,
        seed: int = 0,
        first_replica: int = 0,
        compile: bool = True,
        device: str | torch.device = "cpu",
    ) -> None:
        if len(members) != game.agents:
            raise ValueError(
                f"{len(members)} members for a game of {game.agents} seats; one for each is wanted"
            )
        self.game, self.members = game, tuple(members)
        self.replicas, self.seed, self._first = replicas, seed, first_replica
        self.learners: dict[AgentIndices, AnyLearner] = {
            agents: _learner(
                member,
                game,
                agents=agents,
                replicas=replicas,
                seed=seed,
                first_replica=first_replica,
                compile=compile,
                device=device,
            )
            for member, agents in self._seats_of(Learner)
        }
        self.others: dict[AgentIndices, nn.Module] = self._others(EXPLORATION)

    def _seats_of(self, kind: type[Any]) -> Iterable[tuple[Any, tuple[int, ...]]]:
        """Each different member of a kind, and where its like sit."""
        of_kind = [member for member in self.members if isinstance(member, kind)]
        for number, member in enumerate(of_kind):
            if member not in of_kind[:number]:
                yield member, tuple(agent for agent, other in enumerate(self.members) if other == member)

    def _others(self, purpose: int, *, worlds: int = 1) -> dict[AgentIndices, nn.Module]:
        """The actors of the members that do not learn, with random numbers for a purpose."""
        actors: dict[AgentIndices, nn.Module] = {}
        for kind, make in ((Scripted, _scripted), (Frozen, _frozen)):
            for member, agents in self._seats_of(kind):
                replicas = range(self._first, self._first + self.replicas)
                seeds = lane_seeds(self.seed, replicas=replicas, agents=agents, purpose=purpose)
                actors[agents] = make(member, self.game, seeds=seeds, agents=len(agents), worlds=worlds)
        return actors

    def policy(self, worlds: int) -> AgentPolicies:
        """Everybody as they are now, in so many worlds of each replica side by side; the learners of values
        with `epsilon_evaluation`."""
        learned: dict[AgentIndices, nn.Module] = {
            agents: learner.evaluation_actor(worlds) for agents, learner in self.learners.items()
        }
        return AgentPolicies({**learned, **self._others(EVALUATION, worlds=worlds)})

    def random_policy(self, worlds: int) -> AgentPolicies:
        """Everybody's seats taken by agents to whom every action is equally likely."""
        everyone = tuple(range(self.game.agents))
        return AgentPolicies(
            random_agents(self.game, everyone, replicas=self.replicas, seed=self.seed, worlds=worlds)
        )

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each learner's acting network as it is now, by "replica_0/agent_0" and so on."""
        return {
            name: network
            for learner in self.learners.values()
            for name, network in learner.networks().items()
        }

    def told(self) -> list[dict[str, Any]]:
        """What `cprl.load` builds it from again; a recipe keeps it as "population"."""
        return [_told(member) for member in self.members]


def _learner(
    member: Learner,
    game: Game,
    *,
    agents: tuple[int, ...],
    compile: bool,
    device: str | torch.device,
    **who: Any,
) -> AnyLearner:
    algorithm = member.algorithm
    who |= {"agents": agents, "reward_kind": member.reward_kind}
    if isinstance(algorithm, Tabular):
        algorithm.network(game)  # refuses a game of which it would not see all
        return TabularLearner(game, settings=algorithm.settings, **who)

    def make_network() -> nn.Module:
        return algorithm.network(game)

    common: dict[str, Any] = {
        "make_network": make_network,
        "make_loss": algorithm.loss,
        "compile": compile,
        "device": device,
        **who,
    }
    if isinstance(algorithm, TeamAlgorithm):
        team = algorithm
        check_team(team, reward_kind=member.reward_kind, members=len(agents))
        common["make_team"] = lambda networks: team.team(networks, game)
    settings = algorithm.settings
    if isinstance(settings, RolloutSettings):
        return RolloutLearner(game, settings=settings, **common)
    if isinstance(settings, DQNSettings):
        stochastic = algorithm.stochastic  # type: ignore[union-attr]
        return ReplayLearner(game, settings=settings, stochastic=stochastic, **common)
    raise ValueError(
        f"{type(algorithm).__name__} has settings of the type {type(settings).__name__}; "
        "DQNSettings (learns from replay) or RolloutSettings (on-policy) is wanted"
    )


def _scripted(member: Scripted, game: Game, **how: Any) -> nn.Module:
    return scripted_lanes(member.policy, game, **how)


def _frozen(
    member: Frozen, game: Game, *, seeds: Sequence[Sequence[int]], agents: int, worlds: int
) -> nn.Module:
    loaded = load(member.run)
    for name, theirs, ours in (
        ("observations", loaded.game.observation_shape, game.observation_shape),
        ("a form of observation", loaded.game.observation, game.observation),
        ("actions", loaded.game.actions, game.actions),
    ):
        if theirs != ours:
            raise ValueError(f"the agents of {member.run} have {name} {theirs}; this game has {ours}")
    network, stochastic, epsilon = loaded.agent(member.agent, replica=member.replica)
    actor = LaneActor(
        _for_all_lanes(network),
        len(game.actions),
        seeds=seeds,
        agents=agents,
        worlds=worlds,
        stochastic=stochastic,
    )
    actor.epsilon = epsilon
    return actor


def _for_all_lanes(network: nn.Module) -> Callable[[Tensor], Tensor]:
    network.requires_grad_(False)

    def values(observation: Tensor) -> Tensor:
        given: Tensor = network(observation)
        return given

    return values


def _told(member: Member) -> dict[str, Any]:
    if isinstance(member, Learner):
        return {"member": "Learner", "paid": member.reward_kind, **told(member.algorithm)}
    if isinstance(member, Scripted):
        return {"member": "Scripted", "manner": member.policy}
    run = str(Path(member.run).resolve())
    return {"member": "Frozen", "run": run, "agent": member.agent, "replica": member.replica}
