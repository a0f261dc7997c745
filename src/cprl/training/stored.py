"""Stored agents of earlier runs, read by `load`, their policies, and checks that runs have the same game."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.env_state import load_transforms_state
from cprl.envs.make_env import make_env, spaces_of, stored_game
from cprl.experiment import Experiment
from cprl.keys import recurrent_state
from cprl.networks.agent import acting_network
from cprl.networks.finite import all_finite
from cprl.networks.recurrent import state_cells_of
from cprl.networks.stacked import stack_lanes
from cprl.policies.actors import LaneActor
from cprl.policies.asking import CALLS, Calls
from cprl.policies.decisions import ballot_sizes, stored_decisions
from cprl.policies.governors import GovernorActor, Script, governor_spaces
from cprl.policies.joint_policy import ActorAgents, JointPolicy
from cprl.policies.language import LanguageActor
from cprl.policies.rng import LaneRng, Purpose, lane_name, lane_seeds
from cprl.policies.scripted import ScriptedPolicy, scripted_lanes
from cprl.population import (
    AgentSpec,
    Draw,
    Frozen,
    GovernorSpec,
    Language,
    Learning,
    OwnPast,
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
from cprl.system.compat.tensordicts import unchecked_tensordict
from cprl.values import Custom, describe_changes, instantiate, short_repr, to_config

_MOST_DIFFERENCES: Final = 3
"""The largest number of differences between two games that a message lists."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredAgent:
    """An agent that no longer learns: a scripted policy, a network and how it acts by it, or a pool."""

    scripted: ScriptedPolicy | Script | None = None
    """The policy that it follows; None for an agent that acts by a network, or a pool."""
    language: Language | None = None
    """How a language model makes its plans, where it falls back to `scripted`; None without one."""
    calls: Calls = field(default_factory=Calls, repr=False)
    """What keeps the calls of its model."""
    network: nn.Module | None = field(default=None, repr=False)
    stochastic: bool = False
    """True if the network outputs the logits of a policy; else it outputs action values."""
    epsilon: float = 0.0
    """The probability of a random action in evaluation."""
    algorithm: str = field(default="", repr=False)
    """The algorithm that it learned by, as text."""
    decisions: Tensor | None = field(default=None, repr=False)
    """The values of its choices on all ballots, float64 [C]; None if it decides at random, or has no
    ballots."""
    pool: tuple["StoredAgent", ...] = ()
    """The opponents, oldest first, one of which plays each episode; empty for a single agent."""
    draw: Draw = "uniform"
    """How it is drawn which of them plays, see `Pool`."""

    @property
    def kind(self) -> tuple[Any, ...]:
        """Return the kind of the agent; agents of one kind can be lanes of one actor."""
        return self.scripted, self.language, self.stochastic, self.epsilon, self.algorithm


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
    _earlier: dict[str, "LoadedRun"] = field(default_factory=dict, repr=False)
    """Other runs whose agents are frozen in this one, read once."""

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
        if isinstance(spec, Script | Scripted | Language):
            return rule_follower(spec, self.calls)
        if isinstance(spec, Person):
            raise ValueError(
                f"agent {agent} of {self.path} is a person: people cannot be played again; allowed: cprl "
                "table, report, show and film, which read what they played"
            )
        if isinstance(spec, Frozen):
            return self._frozen(replica, spec)
        lane = lane_name(replica, agent)
        if isinstance(spec, Pool):
            opponents = list(map(partial(self._frozen, replica), spec.runs))
            if spec.own_past is not None:
                learner: Any = self.specs[spec.own_past.agent]
                past = [network for name, network in self.networks.items() if name.startswith(f"{lane}/")]
                newest = past[-spec.own_past.kept :]
                opponents += [trained_agent(learner, network, None) for network in newest]
            return StoredAgent(pool=tuple(opponents), draw=spec.draw)
        if lane not in self.networks:
            raise ValueError(f"{self.path} keeps no network of {lane}; kept are {sorted(self.networks)}")
        if not all_finite(self.networks[lane].state_dict().values()):
            raise ValueError(
                f"{self.weights_from}: the weights of {lane} are NaN or infinite; leave that replica out"
            )
        return trained_agent(spec, self.networks[lane], self._decisions_of(lane))

    def _frozen(self, replica: int, spec: Frozen) -> StoredAgent:
        """Return the agent of an earlier run that plays in a replica here."""
        if spec.run not in self._earlier:
            weights = frozen_weights_name(self.recipe, self.path, spec.run)
            self._earlier[spec.run] = load(spec.run, weights=weights)
        return self._earlier[spec.run].agent(spec.agent, replica=spec.replica_for(replica))

    def _decisions_of(self, lane: str) -> Tensor | None:
        sizes = ballot_sizes(self.game) if isinstance(self.game, Game) else ()
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


def rule_follower(spec: Script | Scripted | Language, calls: Calls) -> StoredAgent:
    """Return an agent that follows a script, or plans by a language model whose calls `calls` keeps."""
    if isinstance(spec, Language):
        return StoredAgent(scripted=spec.fallback, language=spec, calls=calls)
    return StoredAgent(scripted=spec.policy if isinstance(spec, Scripted) else spec)


def trained_agent(spec: Learning | Team, network: nn.Module, decisions: Tensor | None) -> StoredAgent:
    """Return an agent that has learned, with its network and the values of its decisions."""
    algorithm = instantiate(spec.algorithm)
    epsilon = 0.0
    if not algorithm.stochastic:
        epsilon = getattr(algorithm.settings, "epsilon_evaluation", 0.0)
    return StoredAgent(
        network=network,
        stochastic=algorithm.stochastic,
        epsilon=epsilon,
        algorithm=repr(spec.algorithm),
        decisions=decisions,
    )


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
    if isinstance(playing, Game):
        stored = decision_values(by_index)
        decisions = stored_decisions(
            playing, stored, replicas=replicas, worlds=worlds, seed=seed, purpose=decides
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
    by: Any = stored[0].scripted
    if not isinstance(by, Script):
        lanes = {playing.agents: stored}
        actors = stored_actors(lanes, governor_spaces(playing), seeds=seeds, worlds=worlds, stacks=True)
        (by,) = actors.values()
    return GovernorActor(playing.governor, by)


def decision_values(agents: Mapping[int, Sequence[StoredAgent]]) -> dict[int, list[Tensor]]:
    """Return the values of the decisions of agents that have any, in each replica."""
    values = {}
    for agent, replicas in agents.items():
        decisions = [stored.decisions for stored in replicas if stored.decisions is not None]
        if decisions:
            values[agent] = decisions
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
    spaces = playing.spaces if isinstance(playing, Game) else playing
    actors: dict[ActorAgents, nn.Module] = {}
    said: dict[Any, Any] = {}
    for agent in sorted(agents):
        replicas = agents[agent]
        if replicas[0].pool:
            actors[agent,] = PoolActor(
                list(zip(*[stored.pool for stored in replicas], strict=True)),
                playing,
                seeds=seeds(agents=[agent]),
                worlds=worlds,
                draw=replicas[0].draw,
            )
        else:
            kind = replicas[0].kind if kinds is None else kinds[agent]
            indices_by_kind.setdefault(kind, []).append(agent)
    for indices in indices_by_kind.values():
        by_replica = zip(*[agents[agent] for agent in indices], strict=True)
        lanes = list(chain.from_iterable(by_replica))
        size: dict[str, Any] = {"seeds": seeds(agents=indices), "agents": len(indices), "worlds": worlds}
        stored = lanes[0]
        if stored.language is not None and asks:
            actors[tuple(indices)] = LanguageActor(
                stored.language, playing, calls=stored.calls, said=said, **size
            )
            continue
        if stored.scripted is not None:
            actors[tuple(indices)] = scripted_lanes(stored.scripted, playing, **size)
            continue
        networks: list[Any] = [lane.network for lane in lanes]
        actor = LaneActor(
            _apply_together(networks, stacks=stacks),
            spaces.actions,
            stochastic=stored.stochastic,
            state_cells=state_cells_of(networks[0]),
            **size,
        )
        actor.epsilon = stored.epsilon
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


class PoolActor(nn.Module):
    """Plays one agent of every replica by opponents, one of which each world draws for each episode.

    In each turn all opponents choose, by random numbers of their own, and the action of the drawn one counts.
    The agent's recurrent state is the index of the drawn one plus 1, thus 0 when an episode begins, and then
    the states of all opponents.

    Args:
        opponents: the opponents besides past selves, oldest first, each a `StoredAgent` of each replica.
        seeds: the seed of each replica, see `lane_seeds`; opponents have continuations of it.
        worlds: the worlds k of each replica.
        draw: see `Pool`.
        own_past: the past selves; None for none.
        present: returns copies of the agent of `own_past` as it is now, a `StoredAgent` of each replica.
    """

    def __init__(
        self,
        opponents: Sequence[Sequence[StoredAgent]],
        playing: Game | Spaces,
        *,
        seeds: Sequence[Sequence[int]],
        worlds: int,
        draw: Draw,
        own_past: OwnPast | None = None,
        present: Callable[[], Sequence[StoredAgent]] = list,
    ) -> None:
        super().__init__()
        if any(stored.language for replicas in opponents for stored in replicas):
            raise ValueError(
                "an opponent of a Pool plays by a language model, which would be asked in episodes of others "
                "too; allowed: agents that learned, or follow a script"
            )
        self.rng = LaneRng(seeds, worlds)
        self._playing = playing
        self._seeds = seeds
        self._worlds = worlds
        self._draw = draw
        self._own_past = own_past
        self._present = present
        self._first_past = len(opponents)
        # One more than can be drawn, so that the last one to leave ends its episodes.
        self._held = own_past.kept + 1 if own_past else 0
        self._all = [*opponents, *(present() for _ in range(self._held))]
        self._copies = min(self._held, 1)
        """The past selves so far; number n has the index `_first_past` + n % `_held`."""
        self._steps = 0
        self.policy = self._make_policy()
        self.state_cells = 1 + len(self._all) * self.policy.state_cells
        actors: Any = self.policy.actors
        read = {name for actor in actors for name in actor.in_keys}
        self.in_keys = (*read - {recurrent_state.AFTER}, recurrent_state.AFTER)

    def _make_policy(self) -> JointPolicy:
        """Return the policy that plays all opponents as the agents of one game."""

        def seeds(agents: Sequence[int]) -> list[tuple[int, ...]]:
            return [(*seed, self._copies, opponent + 1) for seed in self._seeds for opponent in agents]

        opponents = dict(enumerate(self._all))
        return JointPolicy(stored_actors(opponents, self._playing, seeds=seeds, worlds=self._worlds))

    def _newest(self, count: int) -> dict[int, int]:
        """Return the indices of the newest past selves by their numbers, oldest first."""
        numbers = range(max(0, self._copies - count), self._copies)
        return {number: self._first_past + number % self._held for number in numbers}

    @property
    def _drawable(self) -> list[int]:
        return [*range(self._first_past), *self._newest(self._held - 1).values()]

    def as_stored(self) -> list[StoredAgent]:
        """Return the pool of each replica as it is now."""
        opponents = [self._all[index] for index in self._drawable]
        return [StoredAgent(pool=pool, draw=self._draw) for pool in zip(*opponents, strict=True)]

    def networks(self) -> dict[str, nn.Module]:
        """Return the networks of past selves, oldest first, by "replica_0/agent_1/past_0" and so on."""
        return {
            f"{lane_name(*seed[1:3])}/past_{number}": stored.network
            for number, index in self._newest(self._held).items()
            for seed, stored in zip(self._seeds, self._all[index], strict=True)
            if stored.network is not None
        }

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        left = self._copy_if_due()
        batch_size = tensordict.batch_size
        entries = {name: tensordict.get(name) for name in self.in_keys}
        states = entries.pop(recurrent_state.AFTER)[:, 0]
        index = self._draw_if_due(states[:, 0].long() - 1, left)[:, None]
        size = *batch_size, len(self._all)
        seen = {name: entry.expand(*size, *entry.shape[2:]) for name, entry in entries.items()}
        seen[recurrent_state.AFTER] = states[:, 1:].reshape(*size, self.policy.state_cells)
        agents = unchecked_tensordict(seen, batch_size)
        self.policy(unchecked_tensordict({"agents": agents}, batch_size))
        states_after = torch.cat([index + 1.0, agents.get(recurrent_state.AFTER).flatten(1)], 1)
        tensordict.set("action", agents.get("action").gather(1, index))
        return tensordict.set(recurrent_state.AFTER, states_after[:, None])

    def _draw_if_due(self, index: Tensor, left: int) -> Tensor:
        """Return the index of each world's opponent, int64 [B], drawn anew where it is -1 or has left."""
        drawable = torch.tensor(self._drawable, device=index.device)
        position = (self.rng.next().flatten() * len(drawable)).long().to(index.device)
        drawn = drawable[position] if self._draw == "uniform" else drawable[-1]
        return torch.where((index < 0) | (index == left), drawn, index)

    def _copy_if_due(self) -> int:
        """Copy the agent as it is now; return the index of what left for it, -1 for nothing."""
        left = -1
        if self._own_past and self._steps >= self._copies * self._own_past.every_steps:
            left = self._first_past + self._copies % self._held
            self._all[left] = self._present()
            self._copies += 1
            self.policy = self._make_policy()
        self._steps += self._worlds
        return left

    def get_extra_state(self) -> dict[str, Any]:
        networks = {name: network.state_dict() for name, network in self.networks().items()}
        counts = {"steps": self._steps, "copies": self._copies}
        return {"rng": self.rng.state_dict(), **counts, "networks": networks}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        self.rng.load_state_dict(state["rng"])
        self._steps = state["steps"]
        self._copies = state["copies"]
        for name, network in self.networks().items():
            network.load_state_dict(state["networks"][name])
        self.policy = self._make_policy()
