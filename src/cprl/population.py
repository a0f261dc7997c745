"""Specifications of agents: `Learning`, `Team`, `Scripted`, `Language`, `Frozen`, `Pool` and `Person`, the
values that an experiment's `agents` holds.

A population is a sequence of specifications. A `Team` stands once and names its agents; the other
specifications stand for one agent each and take the remaining agent indices in order.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from posixpath import normpath
from typing import Annotated, Any, Final, Literal, TypeAlias

from cprl.algorithms.base import Algorithm, TeamAlgorithm
from cprl.learners.settings import EpsilonGreedy
from cprl.objectives.rewards import Reward
from cprl.policies.decisions import Bandit
from cprl.policies.governors import ScriptedGovernor
from cprl.policies.language import Language as Language
from cprl.policies.scripted import ScriptedPolicy
from cprl.values import AgentIndices, Custom, Natural, Positive, Steps, Value, Where, checked

_LONGEST_PATH_BYTES: Final = 4095
"""The longest path that Linux takes."""


def _is_path(value: Any) -> bool:
    """Return whether a value is a string that the operating system can take for a path."""
    try:
        return (
            isinstance(value, str)
            and "\0" not in value
            and 0 < len(os.fsencode(value)) <= _LONGEST_PATH_BYTES
        )
    except UnicodeEncodeError:
        return False


RunPath = Annotated[str, Where(_is_path, f"the path of a run's directory, up to {_LONGEST_PATH_BYTES} bytes")]


@dataclass(frozen=True)
class Frozen(Value):
    """An agent of an earlier run. It plays as it has learned there and learns nothing more; or, as
    `start_from` of another agent, gives that agent its initial weights.

    Args:
        run: the directory of the run, or of its results.
        agent: the index of the agent in that run.
        replica: the replica of that run whose agent plays in all replicas here; None for the replica of the
            same index as here; or one replica of that run for each replica here, e.g. (0, 1, 0, 1) if four
            replicas play with agents of two.
    """

    run: RunPath
    agent: Natural
    replica: Natural | Annotated[tuple[Natural, ...], Where(len, "one or more integers >= 0")] | None = 0

    def __post_init__(self) -> None:
        if isinstance(self.run, os.PathLike):
            object.__setattr__(self, "run", os.fspath(self.run))
        super().__post_init__()
        # "runs/x/" and "runs/x" are equal values, so recipes that differ in nothing else are equal too.
        object.__setattr__(self, "run", normpath(self.run))

    def replica_for(self, replica: int) -> int:
        """Return the index of the earlier run's replica whose agent plays in a replica here."""
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
    """An agent that learns independently of the others. Agents with equal specifications are computed
    together, which changes no result.

    Args:
        algorithm: the algorithm with its settings, e.g. `cprl.algorithms.DQN(settings=...)`.
        reward: the reward that it learns from: "individual", its own; "team", the sum of the rewards of all
            agents of the game; or a value of `cprl.objectives.rewards`, e.g. `Exchange(0.5)`.
        start_from: the agent with whose weights its acting network and that network's target start; None for
            new weights. The optimiser, critics, exploration and decisions always begin anew.
        decisions: how it learns to vote, in a game with votes or elections; None for `Bandit()`.
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
    """Agents that learn together, as a team in each replica.

    Args:
        algorithm: an algorithm of teams, e.g. `cprl.algorithms.QMIX(settings=...)`; with `share_parameters`
            also an algorithm of independent agents, e.g. `DQN(settings=...)`.
        agents: the indices of the members, ascending.
        reward: "team", the sum of the rewards of all agents of the game. IPPO, LOLA, MADDPG and algorithms of
            independent agents also take any other reward of `Learning`, for each member.
        start_from: a member of a team of the same size, in an earlier run; each member starts with the
            weights of the member at the same position in that team, see `Learning`. Mixers and central
            critics begin anew.
        decisions: how each member learns to vote, independently of the others, see `Learning`.
        share_parameters: whether the members share their acting network, and their critic if the algorithm
            has one for each member. The shared networks learn from the transitions of all members.
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
    """Raise a ValueError if parameters are to be shared, and the algorithm does not support that."""
    if share_parameters and not algorithm.can_share_parameters:
        raise ValueError(
            f"Team.share_parameters is True; allowed for {type(algorithm).__name__}, whose agents each have "
            "parameters of their own: False"
        )


@dataclass(frozen=True)
class Scripted(Value):
    """An agent that follows a rule and does not learn; see `cprl.policies.scripted`."""

    policy: ScriptedPolicy = "random"


@dataclass(frozen=True)
class OwnPast(Value):
    """The past selves of an agent that learns: copies of its network. The first is the one it starts with.

    Args:
        agent: the index of the agent in the game.
        every_steps: steps of a replica from one copy to the next.
        kept: the newest copies that are in the pool. Memory and the time to act grow with them.
    """

    agent: Natural
    every_steps: Steps = 20_000
    kept: Positive = 8


Draw: TypeAlias = Literal["uniform", "newest"]


@dataclass(frozen=True)
class Pool(Value):
    """An opponent that is drawn anew for each episode, from agents of earlier runs and past selves of an
    agent that learns here. It learns nothing.

    Each world draws for itself when its episode begins, independently of other worlds, replicas and pools.
    A past self plays in its own replica. It is deleted `every_steps` steps after it has left the pool; an
    episode that it still plays then draws again. In games with ballots a pool votes at random.

    Args:
        runs: the agents of earlier runs.
        own_past: the agent whose past selves are drawn; None for no agent.
        draw: "uniform": all are equally likely; "newest": the newest past self, or without past selves the
            last of `runs`.
    """

    runs: tuple[Frozen, ...] = ()
    own_past: OwnPast | None = None
    draw: Draw = "uniform"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs and self.own_past is None:
            raise ValueError("Pool.runs is (); allowed without own_past: at least one Frozen")


@dataclass(frozen=True)
class Person(Value):
    """A person, who decides in a hosted game, see `cprl.web`. A run with people has the episodes that they
    played; it cannot be trained, nor its people played again."""


AgentSpec: TypeAlias = Learning | Team | Scripted | Language | Frozen | Pool | Person
"""The specification of an agent, or of a team."""
GovernorSpec: TypeAlias = Learning | Frozen | ScriptedGovernor
"""The specification of a governor. A `Frozen` one counts as the agent after the last of its run."""


def any_learns(specs: Sequence[AgentSpec]) -> bool:
    """Return whether any agent of a population learns."""
    return any(isinstance(spec, Learning | Team) for spec in specs)


def has_people(specs: Sequence[AgentSpec]) -> bool:
    """Return whether a person is among the agents of a population."""
    return Person() in specs


def refuse_people(specs: Sequence[AgentSpec]) -> None:
    """Raise a ValueError if a person is among the agents of a population that is to be trained or played."""
    if has_people(specs):
        raise ValueError(
            f"agents[{specs.index(Person())}] is a Person, and people play in hosted games: cprl host; "
            "allowed: Learning, Team, Scripted, Language, Frozen, Pool"
        )


def learned(by_agent: Sequence[AgentSpec]) -> str:
    """Return how the agents of a population learned, in words: "4 agents by DQN, 1 agent by the script
    'greedy'", "4 people".

    Args:
        by_agent: the specification of each agent, see `specs_by_agent`.
    """
    counts = Counter(map(_describe, by_agent))
    return ", ".join(_count(description, count) for description, count in counts.items())


def _count(description: str, count: int) -> str:
    """Return how many agents have a description of `_describe`, in words; "" is that of people."""
    if not description:
        return f"{count} people" if count > 1 else "1 person"
    return f"{count} agent{'s' * (count > 1)} {description}"


def algorithm_name(spec: Learning | Team) -> str:
    """Return the name of the algorithm by which an agent learns, e.g. "QMIX"."""
    algorithm = spec.algorithm
    return algorithm.target if isinstance(algorithm, Custom) else type(algorithm).__name__


def _describe(spec: AgentSpec) -> str:
    """Return how an agent learned, in words that follow "agent", e.g. "by QMIX as a team"; "" of a person."""
    match spec:
        case Learning() | Team():
            team = " as a team" if isinstance(spec, Team) else ""
            return f"by {algorithm_name(spec)}{team}"
        case Scripted():
            return f"by the script {spec.policy!r}"
        case Language():
            return f"by the language model {spec.model}"
        case Frozen():
            return "of an earlier run"
        case Pool():
            return "of a pool"
        case Person():
            return ""
    return f"by {type(spec).__name__}"


def specs_by_agent(specs: Sequence[AgentSpec], agents: int) -> list[AgentSpec]:
    """Return the specification of each of N agents; each member of a team has the team's.

    Raises:
        ValueError: if an agent has two specifications or none, or is not in the game.
    """
    by_agent: dict[int, AgentSpec] = {}
    for spec in specs:
        for agent in spec.agents if isinstance(spec, Team) else ():
            if agent in by_agent:
                raise ValueError(f"agent {agent} is in two teams; allowed: one specification for each agent")
            if agent >= agents:
                raise ValueError(f"a team has agent {agent}; the game has the agents 0 to {agents - 1}")
            by_agent[agent] = spec
    single_specs = [spec for spec in specs if not isinstance(spec, Team)]
    remaining_agents = [agent for agent in range(agents) if agent not in by_agent]
    if len(single_specs) != len(remaining_agents):
        raise ValueError(
            f"{len(single_specs) + len(by_agent)} agents are specified for a game of {agents} agents; "
            "allowed: one specification for each"
        )
    by_agent.update(zip(remaining_agents, single_specs, strict=True))
    for agent, spec in by_agent.items():
        own_past = getattr(spec, "own_past", None)
        if own_past and not isinstance(by_agent.get(own_past.agent), Learning | Team):
            raise ValueError(f"agent {agent} is a {spec}; allowed: own_past of an agent that learns")
    return [by_agent[agent] for agent in range(agents)]


def refuse_undecided(specs: Sequence[AgentSpec], ballots: int) -> None:
    """Raise a ValueError if an agent says how it learns to vote, in a game without ballots."""
    for index, spec in enumerate(specs):
        if isinstance(spec, Learning | Team) and spec.decisions is not None and not ballots:
            raise ValueError(
                f"agents[{index}].decisions is {spec.decisions}; allowed in a game without votes and "
                "elections: None"
            )


def grouped(specs: Sequence[AgentSpec], agents: int) -> list[tuple[AgentSpec, tuple[int, ...]]]:
    """Return each specification once, with the indices of all agents that have it, by their first agent.

    Each team is a group of its own, also beside an equal one.
    """
    by_agent = specs_by_agent(specs, agents)
    groups: list[tuple[AgentSpec, tuple[int, ...]]] = []
    for agent, spec in enumerate(by_agent):
        if any(agent in members for _, members in groups):
            continue
        if isinstance(spec, Team):
            groups.append((spec, spec.agents))
        else:
            equal_agents = tuple(index for index in range(agents) if by_agent[index] == spec)
            groups.append((spec, equal_agents))
    return groups


def exploration_steps(specs: Sequence[AgentSpec]) -> int | None:
    """Return the environment step of a replica from which on every agent's epsilon stays at its end.

    Return None if no agent has an epsilon that falls. A user's own algorithm does not count.
    """
    end_steps = [
        settings.epsilon_hold_steps + settings.epsilon_decay_steps
        for settings in exploring(specs)
        if settings.epsilon_end < settings.epsilon_start
    ]
    return max(end_steps, default=None)


def exploring(specs: Sequence[AgentSpec]) -> list[EpsilonGreedy]:
    """Return the settings of agents that explore epsilon-greedily; a user's own algorithms do not count."""
    algorithms = [spec.algorithm for spec in specs if isinstance(spec, Learning | Team)]
    greedy = [
        algorithm for algorithm in algorithms if isinstance(algorithm, Algorithm) and not algorithm.stochastic
    ]
    return [algorithm.settings for algorithm in greedy if isinstance(algorithm.settings, EpsilonGreedy)]


def partners_in(specs: Iterable[Any]) -> list[str]:
    """Return the directories of the earlier runs whose agents play in a population, sorted."""
    playing = (spec for spec in specs if isinstance(spec, Frozen | Pool))
    return sorted({stored.run for spec in playing for stored in stored_in(spec).values()})


def stored_in(spec: Any) -> dict[str, Frozen]:
    """Return the agents of earlier runs that a specification names, to play or to start from, each by its
    place in the specification: "", ".start_from" or ".runs[0]" and so on."""
    if isinstance(spec, Frozen):
        return {"": spec}
    if isinstance(spec, Pool):
        return {f".runs[{index}]": stored for index, stored in enumerate(spec.runs)}
    start = getattr(spec, "start_from", None)
    return {} if start is None else {".start_from": start}


def with_stored(spec: Any, change: Callable[[Frozen], Frozen]) -> Any:
    """Return a specification after a change of the agents of earlier runs that it names."""
    if isinstance(spec, Frozen):
        return change(spec)
    if isinstance(spec, Pool):
        return replace(spec, runs=tuple(map(change, spec.runs)))
    if isinstance(spec, Learning | Team) and spec.start_from is not None:
        return replace(spec, start_from=change(spec.start_from))
    return spec
