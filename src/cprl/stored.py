"""load: a run as its directory keeps it: game, population, trained networks, episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from cprl.algorithms.actor_critic import policy
from cprl.algorithms.registry import Algorithm, built
from cprl.commons.game import Game
from cprl.commons.maps import Map
from cprl.commons.observation import Observation
from cprl.commons.rules import Rules
from cprl.envs.commons_env import CommonsEnv
from cprl.learners.lanes import lane_name
from cprl.networks.agent import acting_part
from cprl.policies.assignment import AgentPolicies
from cprl.policies.scripted import ScriptedActor
from cprl.policies.single import QActor, RandomActor
from cprl.runs.checkpoints import FOLDER, checkpoints_in, read_checkpoint
from cprl.runs.directory import read_recipe
from cprl.runs.episodes import read_episodes
from cprl.runs.weights import load_weights


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedRun:
    """A run, built again from its directory alone; see `load`."""

    path: Path
    game: Game
    members: Sequence[Mapping[str, Any]]
    """Who sat at each seat, as `cprl.population.Population.told` tells it."""
    algorithms: Mapping[int, Algorithm]
    """What the agents that learned were made of, by their number."""
    recipe: Mapping[str, Any]
    """What `recipe.json` holds."""
    networks: Mapping[str, nn.Module]
    """The trained acting network of each lane, by "replica_0/agent_0" and so on."""
    weights_from: Path
    """The file that held them: of a run that has not ended, its newest checkpoint."""

    @property
    def replicas(self) -> list[int]:
        """The numbers of the replicas whose networks were kept."""
        return sorted({int(lane.split("/")[0].removeprefix("replica_")) for lane in self.networks})

    def env(self, worlds: int = 1, *, seed: int = 0) -> CommonsEnv:
        """So many fresh worlds of the run's game."""
        return CommonsEnv(self.game, worlds, seed=seed)

    def agent(self, agent: int, *, replica: int = 0) -> tuple[nn.Module, bool, float]:
        """An agent that learned: its acting network, whether that gives the logits of a policy from which it
        draws its actions, and else the chance of a random one with which it is evaluated.

        Raises:
            ValueError: where no such network was kept; says which were.
        """
        lane = lane_name(replica, agent)
        if lane not in self.networks:
            raise ValueError(f"{self.path} keeps no network of {lane}; kept are {sorted(self.networks)}")
        algorithm = self.algorithms[agent]
        stochastic = bool(getattr(algorithm, "stochastic", True))
        return self.networks[lane], stochastic, float(getattr(algorithm.settings, "epsilon_evaluation", 0.0))

    def policy(self, replica: int = 0, *, others: Mapping[int, nn.Module] | None = None) -> AgentPolicies:
        """The agents of a replica; those that learned explore as in evaluation where asked to.

        Args:
            replica: its number.
            others: actors by the agent's number, instead of those of the run.

        Raises:
            ValueError: where a seat stays empty; says which.
        """
        actors, empty = dict(others or {}), []
        for agent, member in enumerate(self.members):
            if agent in actors:
                continue
            if member["member"] == "Frozen":
                earlier = load(member["run"])
                actors[agent] = _actor(earlier, member["agent"], member["replica"])
            elif member["member"] == "Scripted":
                actors[agent] = self._scripted(member["manner"], agent)
            elif lane_name(replica, agent) in self.networks:
                actors[agent] = _actor(self, agent, replica)
            else:
                empty.append(agent)
        if empty:
            raise ValueError(
                f"agents {empty} of replica {replica} have no network in {self.path}; kept are "
                f"{sorted(self.networks)}: give actors for them as others"
            )
        return AgentPolicies({agent: actors[agent] for agent in range(self.game.agents)})

    def _scripted(self, policy: Any, agent: int) -> nn.Module:
        if policy == "random":
            return RandomActor(len(self.game.actions), seed=agent)
        return _OneScripted(policy, self.game, agent)

    def episodes(self) -> pa.Table:
        """The table of episodes; see `cprl.recording.read_episodes`."""
        return read_episodes(self.path)


def _actor(run: LoadedRun, agent: int, replica: int) -> nn.Module:
    """An agent that learned, as TorchRL's actor for one agent."""
    network, stochastic, epsilon = run.agent(agent, replica=replica)
    if stochastic:
        drawing: nn.Module = policy(network)
        return drawing
    actor = QActor(network, len(run.game.actions))
    actor.epsilon = epsilon
    return actor


class _OneScripted(TensorDictModuleBase):
    """A scripted agent as TorchRL's actor for one agent, in however many worlds it is asked.

    Args:
        policy: see `ScriptedActor`.
        game: what is played.
        agent: where it sits; its random numbers follow from that.
    """

    in_keys = ("observation",)
    out_keys = ("action",)

    def __init__(self, policy: Any, game: Game, agent: int) -> None:
        super().__init__()
        self._make = partial(ScriptedActor, policy, game, seeds=[(agent,)], agents=1)
        self._actor = self._make()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 [B]."""
        seen = tensordict.get("observation").unsqueeze(1)
        if self._actor.worlds != len(seen):
            self._actor = self._make(worlds=len(seen))
        return tensordict.set("action", self._actor.choose(seen)[:, 0])


def load(run: str | Path, *, weights: str | None = None, algorithms: Sequence[type[Any]] = ()) -> LoadedRun:
    """Builds a run's game, population and networks again; runs no code of its files.

    Args:
        run: its directory.
        weights: which were kept: "final", or "best" where the recipe keeps them; by default the final ones,
            or those of the newest readable checkpoint where the run has not ended.
        algorithms: classes of the user's own that the run's agents may be made of.

    Raises:
        ValueError: for a file that is missing, truncated, changed or foreign; names file and reason.
    """
    run = Path(run)
    recipe = read_recipe(run)
    try:
        kept = recipe["arguments"]["game"]
        game = Game(
            map=Map(**kept["map"]),
            rules=Rules(**kept["rules"]),
            observation=Observation(**kept.get("observation", {})),
        )
        members = _members(recipe["arguments"], game)
        made_of = {
            agent: built(
                {key: value for key, value in member.items() if key not in ("member", "paid")}, own=algorithms
            )
            for agent, member in enumerate(members)
            if member["member"] == "Learner"
        }
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{run / 'recipe.json'} holds no game and learner of cprl: {error!r}") from error
    path, kept_weights = _weights(run, weights)
    with torch.random.fork_rng(devices=[]):  # networks draw weights at first, which the kept ones replace
        networks = _networks(path, kept_weights, game, made_of)
    return LoadedRun(
        path=run,
        game=game,
        members=members,
        algorithms=made_of,
        recipe=recipe,
        networks=networks,
        weights_from=path,
    )


def _members(arguments: Mapping[str, Any], game: Game) -> list[dict[str, Any]]:
    """Who sat where; runs of before there were populations had DQN agents and random ones."""
    population = arguments.get("population", {})
    if isinstance(population, list):
        return population
    settings = {"kind": "DQNSettings", **arguments["learner"]}
    learner = {"member": "Learner", "algorithm": "DQN", "settings": settings}
    scripted = {"member": "Scripted", "manner": "random"}
    at_random = population.get("random", ())
    return [scripted if agent in at_random else learner for agent in range(game.agents)]


def _weights(run: Path, name: str | None) -> tuple[Path, Any]:
    """A file with weights, and the state dict of each network in it."""
    folder = run / FOLDER
    path = folder / f"{name or 'final'}.pt"
    if name is None and not path.exists():
        reasons = []
        for checkpoint in reversed(checkpoints_in(folder)):
            try:
                state = read_checkpoint(checkpoint)
                of_learners = [learner["networks"] for learner in state["learners"]]
            except (ValueError, KeyError) as error:
                reasons.append(str(error))
                continue
            return checkpoint, {lane: own for networks in of_learners for lane, own in networks.items()}
        raise ValueError(
            "; ".join([f"{path} is not there, nor a readable checkpoint: has {run} been trained?", *reasons])
        )
    try:
        return path, load_weights(path)
    except Exception as error:
        raise ValueError(f"{path} holds no weights of this run: {error}") from error


def _networks(path: Path, weights: Any, game: Game, made_of: Mapping[int, Algorithm]) -> dict[str, nn.Module]:
    networks = {}
    try:
        for name, state in weights.items():
            lane = name if "/" in name else f"replica_0/{name}"
            agent = int(lane.rpartition("_")[2])
            network = acting_part(made_of[agent].network(game))
            network.load_state_dict(state)
            networks[lane] = network
    except Exception as error:
        raise ValueError(f"{path} holds no weights of this run: {error}") from error
    return networks
