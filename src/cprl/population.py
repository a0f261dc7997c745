"""How each agent of a population is specified: plain values.

A population is a sequence of specifications. A `Team` stands once and names its agents; the others take the
remaining agent indices in order.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from posixpath import normpath
from typing import Annotated, Any, Final, TypeAlias

from cprl.algorithms.base import Algorithm, TeamAlgorithm
from cprl.learners.settings import Exploring
from cprl.objectives.rewards import Reward
from cprl.policies.decisions import Bandit
from cprl.policies.scripted import ScriptedPolicy
from cprl.values import AgentIndices, Custom, Natural, Value, Where, checked


def _is_path(value: Any) -> bool:
    try:
        return isinstance(value, str) and "\0" not in value and 0 < len(os.fsencode(value)) <= _MOST_PATH
    except UnicodeEncodeError:
        return False


_MOST_PATH: Final = 4095
RunPath = Annotated[str, Where(_is_path, f"the path of a run's directory, up to {_MOST_PATH} bytes")]


@dataclass(frozen=True)
class Frozen(Value):
    """What an agent of an earlier run learned: an agent that plays it, or what another one starts from.

    Args:
        run: the directory of the run, or of its results.
        agent: the index of the agent in that run.
        replica: the replica of that run; None for the replica of the same number in each replica; or one for
            each replica here, e.g. (0, 1, 0, 1) where four play against two.
    """

    run: RunPath
    agent: Natural
    replica: Natural | Annotated[tuple[Natural, ...], Where(len, "one or more integers >= 0")] | None = 0

    def __post_init__(self) -> None:
        if isinstance(self.run, os.PathLike):
            object.__setattr__(self, "run", os.fspath(self.run))
        super().__post_init__()
        object.__setattr__(self, "run", normpath(self.run))  # of "runs/x/" and "runs/x", the same checksum

    def replica_for(self, replica: int) -> int:
        if not isinstance(self.replica, tuple):
            return replica if self.replica is None else self.replica
        if replica >= len(self.replica):
            raise ValueError(
                f"{self} names {len(self.replica)} replicas, and none for the replica of index {replica}; "
                "allowed: one for each replica that plays"
            )
        return self.replica[replica]


@dataclass(frozen=True)
class Learning(Value):
    """An agent that learns on its own. Equal ones are updated together, as lanes of one engine.

    Args:
        algorithm: e.g. `cprl.algorithms.DQN(settings=...)`.
        reward: what it wants: "individual", its own reward; "team", the sum of the rewards of all agents of
            the game; or a value of `cprl.objectives.rewards`, e.g. `Exchange(0.5)`.
        start_from: the agent whose weights its acting network, and the target of it, start with; None for
            new ones. The optimiser, critics, exploration and decisions begin anew.
        decisions: how it learns what it decides, in a game with votes or elections; None for `Bandit()`.
    """

    algorithm: Algorithm | Custom
    reward: Reward = "individual"
    start_from: Frozen | None = None
    decisions: Bandit | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.algorithm, TeamAlgorithm):
            name = type(self.algorithm).__name__
            raise ValueError(
                f"{name} is learned by a team: Team({name}(...), agents=(0, 1)) says which agents it has"
            )


@dataclass(frozen=True)
class Team(Value):
    """Agents that learn together; a team in every replica.

    Args:
        algorithm: e.g. `cprl.algorithms.QMIX(settings=...)`; with `share_parameters` also one of independent
            agents, e.g. `DQN(settings=...)`.
        agents: their indices, ascending.
        reward: "team", the sum of the rewards of all agents of the game; for IPPO, LOLA, MADDPG and those of
            independent agents also what each member wants by itself, see `Learning`.
        start_from: a member of a team of the same size; each member starts with the weights of the member
            at the same place in that team, see `Learning`. Mixers and central critics begin anew.
        decisions: how each member learns what it decides, by itself; see `Learning`.
        share_parameters: whether the members share one network, of actions and, where the algorithm has
            one for each member, of values; it learns from the transitions of all of them.
    """

    algorithm: Algorithm | Custom
    agents: AgentIndices
    reward: Reward = "team"
    start_from: Frozen | None = None
    decisions: Bandit | None = None
    share_parameters: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.share_parameters:
            checked("Team.algorithm", self.algorithm, TeamAlgorithm | Custom)
        if isinstance(self.algorithm, Algorithm):
            refuse_sharing(self.algorithm, self.share_parameters)


def refuse_sharing(algorithm: Algorithm, share_parameters: bool) -> None:
    if share_parameters and not algorithm.can_share_parameters:
        raise ValueError(
            f"Team.share_parameters is True; allowed for {type(algorithm).__name__}, whose agents each have "
            "parameters of their own: False"
        )


@dataclass(frozen=True)
class Scripted(Value):
    """An agent that follows a rule and does not learn; see `cprl.policies.scripted`."""

    policy: ScriptedPolicy = "random"


AgentSpec: TypeAlias = Learning | Team | Scripted | Frozen


def any_learns(specs: Sequence[AgentSpec]) -> bool:
    """Return whether an agent learns."""
    return any(isinstance(spec, Learning | Team) for spec in specs)


def learned(by_agent: Sequence[AgentSpec]) -> str:
    """Who plays and how they learned, of `specs_by_agent`, e.g. "4 agents by DQN"."""
    names = [_kind(spec) for spec in by_agent]
    counts = {name: names.count(name) for name in names}
    return ", ".join(f"{count} agent{'s' * (count > 1)} {name}" for name, count in counts.items())


def _kind(spec: AgentSpec) -> str:
    match spec:
        case Learning() | Team():
            team = " as a team" if isinstance(spec, Team) else ""
            algorithm = spec.algorithm
            name = algorithm.target if isinstance(algorithm, Custom) else type(algorithm).__name__
            return f"by {name}{team}"
        case Scripted():
            return f"by the script {spec.policy!r}"
        case Frozen():
            return "of an earlier run"
    return f"by {type(spec).__name__}"


def specs_by_agent(specs: Sequence[AgentSpec], agents: int) -> list[AgentSpec]:
    """The specification of each of N agents; that of a team for each of its members."""
    by_agent: dict[int, AgentSpec] = {}
    for spec in specs:
        for agent in spec.agents if isinstance(spec, Team) else ():
            if agent in by_agent:
                raise ValueError(f"agent {agent} is in two teams; allowed: one specification for each agent")
            if agent >= agents:
                raise ValueError(f"a team has agent {agent}; the game has the agents 0 to {agents - 1}")
            by_agent[agent] = spec
    alone = [spec for spec in specs if not isinstance(spec, Team)]
    left = [agent for agent in range(agents) if agent not in by_agent]
    if len(alone) != len(left):
        raise ValueError(
            f"{len(alone) + len(by_agent)} agents are specified for a game of {agents} agents; "
            "allowed: one specification for each"
        )
    by_agent.update(zip(left, alone, strict=True))
    return [by_agent[agent] for agent in range(agents)]


def refuse_undecided(specs: Sequence[AgentSpec], ballots: int) -> None:
    for place, spec in enumerate(specs):
        if isinstance(spec, Learning | Team) and spec.decisions is not None and not ballots:
            raise ValueError(
                f"agents[{place}].decisions is {spec.decisions}; allowed in a game without votes and "
                "elections: None"
            )


def grouped(specs: Sequence[AgentSpec], agents: int) -> list[tuple[AgentSpec, tuple[int, ...]]]:
    """Each specification with the indices of its agents: equal ones together, each team by itself, in the
    order of their first agents.
    """
    by_agent = specs_by_agent(specs, agents)
    groups: list[tuple[AgentSpec, tuple[int, ...]]] = []
    for agent, spec in enumerate(by_agent):
        if not any(agent in members for _, members in groups):
            members = (
                spec.agents
                if isinstance(spec, Team)
                else tuple(other for other, of_other in enumerate(by_agent) if of_other == spec)
            )
            groups.append((spec, members))
    return groups


def exploration_steps(specs: Sequence[AgentSpec]) -> int | None:
    """The environment step of a replica at which the last agent's epsilon has reached its end; None if no
    agent explores by epsilon, or only by an algorithm of the user's own."""
    ends = [
        settings.epsilon_hold_steps + settings.epsilon_decay_steps
        for settings in exploring(specs)
        if settings.epsilon_end < settings.epsilon_start
    ]
    return max(ends, default=None)


def exploring(specs: Sequence[AgentSpec]) -> list[Exploring]:
    """Return the settings of agents who explore by epsilon, but for those of the user's own algorithms."""
    learners = [spec.algorithm for spec in specs if isinstance(spec, Learning | Team)]
    settings = [one.settings for one in learners if isinstance(one, Algorithm) and not one.stochastic]
    return [one for one in settings if isinstance(one, Exploring)]


def partners_in(specs: Iterable[AgentSpec]) -> list[str]:
    """Return the runs whose agents play among some specifications."""
    return sorted({spec.run for spec in specs if isinstance(spec, Frozen)})


def stored_of(spec: Any) -> Frozen | None:
    """The stored agent that plays or that is started from; None where there is none."""
    return spec if isinstance(spec, Frozen) else getattr(spec, "start_from", None)


def with_stored(spec: Any, changed: Callable[[Frozen], Frozen]) -> Any:
    """A specification of an agent with another stored agent in place of its own, if it has one."""
    if isinstance(spec, Frozen):
        return changed(spec)
    if isinstance(spec, Learning | Team) and spec.start_from is not None:
        return replace(spec, start_from=changed(spec.start_from))
    return spec
