"""load: a run as its directory keeps it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa
import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cprl.checks import shown
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.custom import made
from cprl.envs.make_env import make_env, spaces_of
from cprl.envs.state import load_transforms_state
from cprl.experiment import Experiment
from cprl.learners.decisions import stored_decisions
from cprl.learners.lanes import EVALUATION, lane_name, lane_seeds
from cprl.networks.agent import acting_part
from cprl.networks.finite import all_finite
from cprl.networks.recurrent import state_cells_of
from cprl.networks.stacked import stack_lanes
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.decisions import ballot_sizes
from cprl.policies.lanes import LaneActor
from cprl.policies.scripted import scripted_lanes
from cprl.population import AgentSpec, Frozen, Learning, Scripted, Team, specs_by_agent
from cprl.runs.checkpoints import FOLDER
from cprl.runs.episodes import read_episodes
from cprl.runs.recipe import RECIPE_FILE, changed_code, read_recipe, say_changes
from cprl.runs.weights import kept_of, weights_of


@dataclass(frozen=True, eq=False)
class StoredAgent:
    """An agent of a stored run: how it acts, and its network if it has one."""

    kind: tuple[Any, ...]
    """("scripted", policy), or ("trained", stochastic, epsilon, algorithm); agents of one kind can be lanes
    of one actor."""
    network: nn.Module | None = None
    decisions: Tensor | None = None
    """The values of its choices on all ballots, float64 [C]; None if it decides by chance, or nothing."""

    def __repr__(self) -> str:
        acts = ", ".join(str(value) for value in self.kind[:3])
        return f"StoredAgent({acts}, network={type(self.network).__name__})"


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
    allow: tuple[str, ...] = ()
    _earlier: dict[str, "LoadedRun"] = field(default_factory=dict, repr=False)
    """Runs whose agents are frozen in this one, read once."""

    def __repr__(self) -> str:
        run = self.experiment
        return (
            f"LoadedRun({str(self.path)!r}, {run.name!r}, {run.episodes} episodes, {run.replicas} replicas, "
            f"{self.game.agents} agents)"
        )

    @cached_property
    def game(self) -> Any:
        """What was played."""
        return made(self.experiment.game)

    @property
    def specs(self) -> list[AgentSpec]:
        """The specification of each agent."""
        return specs_by_agent(self.experiment.agents, self.game.agents)

    @cached_property
    def spaces(self) -> Spaces:
        """What its agents observe and may do, transforms included."""
        return spaces_of(self.env())

    @property
    def replicas(self) -> list[int]:
        """The numbers of its replicas."""
        kept = sorted({int(lane.split("/")[0].removeprefix("replica_")) for lane in self.networks})
        return kept or list(range(self.experiment.replicas))

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
            return StoredAgent(("scripted", spec.policy))
        if isinstance(spec, Frozen):
            if spec.run not in self._earlier:
                weights = weights_of(self.recipe, self.path, spec.run)
                self._earlier[spec.run] = load(spec.run, weights=weights, allow=self.allow)
            return self._earlier[spec.run].agent(spec.agent, replica=spec.replica_for(replica))
        lane = lane_name(replica, agent)
        if lane not in self.networks:
            raise ValueError(f"{self.path} keeps no network of {lane}; kept are {sorted(self.networks)}")
        if not _is_finite(self.networks[lane]):
            raise ValueError(
                f"{self.weights_from}: the weights of {lane} are NaN or infinite; leave that replica out"
            )
        algorithm = made(spec.algorithm)
        stochastic = bool(algorithm.stochastic)
        epsilon = 0.0 if stochastic else float(getattr(algorithm.settings, "epsilon_evaluation", 0.0))
        kind = ("trained", stochastic, epsilon, repr(spec.algorithm))
        return StoredAgent(kind, self.networks[lane], self._decisions_of(lane))

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
        found = [[self.agent(agent, replica=replica)] for agent in range(self.game.agents)]
        return stored_policies(found, self._playing, replicas=[replica], worlds=worlds, seed=seed)

    @property
    def _playing(self) -> Game | Spaces:
        return self.game if isinstance(self.game, Game) else self.spaces

    def episodes(self) -> pa.Table:
        """The table of episodes; see `cprl.runs.episodes.read_episodes`."""
        return read_episodes(self.path)


def load(run: str | Path, *, weights: str | None = None, allow: Sequence[str] = ()) -> LoadedRun:
    """Builds a run again from its directory; runs no code that it holds.

    Warns on standard error where the user's own code is no longer what the run was made with.

    Files outside the directory are read for `Frozen` agents alone: the recipe names their runs by paths,
    which may lead anywhere, e.g. "../other". They are read when such an agent is asked for, without code.

    Args:
        weights: which of those in its `checkpoints/`: "final", "best" where the recipe keeps them, or
            "final-4800" of a run that was extended from so many episodes; by default the final ones, or those
            of the newest readable checkpoint where the run has not ended.
        allow: the targets, "module:Class", of the user's own code that the run may import.
    """
    run = Path(run)
    if weights is not None and (
        not isinstance(weights, str) or Path(weights).name != weights or weights in ("", "..")
    ):
        raise ValueError(f'weights is {weights!r}; allowed: a name in {run / FOLDER}, such as "final"')
    recipe = read_recipe(run)
    try:
        experiment = Experiment.from_recipe(recipe, directory=run, allow=allow)
    except ValueError as error:
        raise ValueError(f"{run / RECIPE_FILE}: {error}") from error
    say_changes(run, [f"the text of {module}, which its recipe keeps" for module in changed_code(recipe)])
    kept = kept_of(run, weights)
    loaded = LoadedRun(
        path=run,
        experiment=experiment,
        recipe=recipe,
        networks={},
        weights_from=kept.path,
        transforms_state=kept.transforms,
        decisions=kept.decisions,
        allow=tuple(allow),
    )
    with torch.random.fork_rng(devices=[]):  # networks draw weights at first, which the kept ones replace
        object.__setattr__(loaded, "networks", _networks(kept.path, kept.networks, loaded))
    return loaded


def _networks(path: Path, weights: Any, run: LoadedRun) -> dict[str, nn.Module]:
    networks = {}
    recipe, lacking = (
        f"{run.path / RECIPE_FILE}: a network cannot be made",
        f"{path} holds no weights of this run",
    )
    reason = lacking
    try:
        for name, state in weights.items():
            lane = name if "/" in name else f"replica_0/{name}"
            spec = run.specs[int(lane.rpartition("_")[2])]
            if not isinstance(spec, Learning | Team):
                raise ValueError(f"{lane} is the network of an agent that does not learn")
            reason = recipe
            network = acting_part(made(spec.algorithm).make_network(run.spaces))
            reason = lacking
            network.load_state_dict(state)
            networks[lane] = network
    except Exception as error:
        raise ValueError(f"{reason}: {error}") from error
    if not networks and any(isinstance(spec, Learning | Team) for spec in run.specs):
        raise ValueError(f"{lacking}: it is empty")
    if networks and not any(map(_is_finite, networks.values())):
        raise ValueError(f"{lacking}: all are NaN or infinite")
    return networks


def _is_finite(network: nn.Module) -> bool:
    return all_finite(network.state_dict().values())


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
    alike: dict[Any, list[int]] = {}
    for agent, of_replicas in enumerate(agents):
        alike.setdefault(of_replicas[0].kind, []).append(agent)
    actors: dict[AgentIndices, nn.Module] = {}
    for same in alike.values():
        seeds = lane_seeds(seed, replicas=replicas, agents=same, purpose=EVALUATION)
        lanes = [agents[agent][place] for place in range(len(replicas)) for agent in same]
        how: dict[str, Any] = {"seeds": seeds, "agents": len(same), "worlds": worlds}
        actors[tuple(same)] = stored_actor(lanes, playing, stacks=True, **how)
    values = [[own.decisions for own in of_replicas] for of_replicas in agents]
    decisions = (
        stored_decisions(values, playing, replicas=replicas, worlds=worlds, seed=seed)
        if isinstance(playing, Game)
        else None
    )
    return AgentPolicies(actors, decisions=decisions)


def stored_actor(
    lanes: Sequence[StoredAgent],
    playing: Game | Spaces,
    *,
    seeds: Sequence[Sequence[int]],
    agents: int,
    worlds: int,
    stacks: bool = False,
) -> nn.Module:
    """One actor for stored agents of one kind; the one place where an actor is made of a stored agent.

    Args:
        lanes: an agent for each lane, lane = replica x agents + agent.
        agents: how many agents of a replica it controls.
        stacks: whether lanes of one and the same network are stacked too, so that its values are, to the last
            bit, those that it has among others.
    """
    kind = lanes[0].kind
    if kind[0] == "scripted":
        return scripted_lanes(kind[1], playing, seeds=seeds, agents=agents, worlds=worlds)
    _, stochastic, epsilon, _ = kind
    spaces = playing.spaces if isinstance(playing, Game) else playing
    networks: list[Any] = [lane.network for lane in lanes]
    actor = LaneActor(
        _side_by_side(networks, stacks=stacks),
        spaces.actions,
        seeds=seeds,
        agents=agents,
        worlds=worlds,
        stochastic=stochastic,
        state_cells=state_cells_of(networks[0]),
    )
    actor.epsilon = epsilon
    return actor


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
        return lambda seen: torch.stack([network(own) for network, own in zip(networks, seen, strict=True)])
    return lambda *seen: stack(*seen)
