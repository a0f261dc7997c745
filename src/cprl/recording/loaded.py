"""load: a run as its directory keeps it: game, settings, population, trained networks, episodes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from torch import nn

from cprl.acting import QActor, QNetwork, RandomActor, Seats
from cprl.commons.game import Game
from cprl.commons.maps import Map
from cprl.commons.observation import Observation
from cprl.commons.rules import Rules
from cprl.envs.torchrl_env import CommonsEnv
from cprl.learning.dqn import q_network
from cprl.learning.settings import DQNSettings
from cprl.recording.checkpoints import FOLDER, checkpoints_in, read_checkpoint
from cprl.recording.results import read_episodes
from cprl.recording.run import read_recipe
from cprl.recording.weights import load_weights


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedRun:
    """A run, built again from its directory alone; see `load`."""

    path: Path
    game: Game
    settings: DQNSettings
    recipe: Mapping[str, Any]
    """What `recipe.json` holds."""
    networks: Mapping[str, QNetwork]
    """The trained network of each lane, by "replica_0/agent_0" and so on."""
    weights_from: Path
    """The file that held them: of a run that has not ended, its newest checkpoint."""

    @property
    def replicas(self) -> list[int]:
        """The numbers of the replicas whose networks were kept."""
        return sorted({int(lane.split("/")[0].removeprefix("replica_")) for lane in self.networks})

    def env(self, worlds: int = 1, *, seed: int = 0) -> CommonsEnv:
        """So many fresh worlds of the run's game."""
        return CommonsEnv(self.game, worlds, seed=seed)

    def policy(self, replica: int = 0, *, others: Mapping[int, nn.Module] | None = None) -> Seats:
        """The trained agents of a replica, who explore with `epsilon_evaluation` where asked to.

        Args:
            replica: its number.
            others: actors by the agent's number, instead of those of the run; where it says that an agent
                acted at random, one that does so is there without being given.

        Raises:
            ValueError: where a seat stays empty; says which.
        """
        actions = len(self.game.actions)
        at_random = self.recipe["arguments"].get("population", {}).get("random", ())
        actors: dict[int, nn.Module] = {agent: RandomActor(actions, seed=agent) for agent in at_random}
        actors |= others or {}
        for agent in range(self.game.agents):
            network = self.networks.get(f"replica_{replica}/agent_{agent}")
            if network is not None:
                actor = QActor(network, actions)
                actor.epsilon = self.settings.epsilon_evaluation
                actors.setdefault(agent, actor)
        empty = sorted(set(range(self.game.agents)) - set(actors))
        if empty:
            raise ValueError(
                f"agents {empty} of replica {replica} have no network in {self.path}; kept are "
                f"{sorted(self.networks)}: give actors for them as others"
            )
        return Seats({agent: actors[agent] for agent in range(self.game.agents)})

    def episodes(self) -> pa.Table:
        """The table of episodes; see `cprl.recording.read_episodes`."""
        return read_episodes(self.path)


def load(run: str | Path, *, weights: str | None = None) -> LoadedRun:
    """Builds a run's game, settings, population and networks again; runs no code of its files.

    Args:
        run: its directory.
        weights: which were kept: "final", or "best" where the recipe keeps them; by default the final ones,
            or those of the newest readable checkpoint where the run has not ended.

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
        learner = recipe["arguments"]["learner"]
        settings = DQNSettings(**{**learner, "hidden_cells": tuple(learner["hidden_cells"])})
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{run / 'recipe.json'} holds no game and learner of cprl: {error!r}") from error
    path, kept_weights = _weights(run, weights)
    return LoadedRun(
        path=run,
        game=game,
        settings=settings,
        recipe=recipe,
        networks=_networks(path, kept_weights, game, settings),
        weights_from=path,
    )


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


def _networks(path: Path, weights: Any, game: Game, settings: DQNSettings) -> dict[str, QNetwork]:
    networks = {}
    try:
        for lane, state in weights.items():
            network = q_network(
                game.observation_shape,
                len(game.actions),
                settings=settings,
                highest=game.observation.highest,
            )
            network.load_state_dict(state)
            networks[lane if "/" in lane else f"replica_0/{lane}"] = network
    except Exception as error:
        raise ValueError(f"{path} holds no weights of this run: {error}") from error
    return networks
