"""What the experiments of `test_own_parts.py` name as `Custom`: a transform, a callback and a game."""

import os
import shutil
import signal
from dataclasses import asdict, dataclass
from typing import Any

import torch
from matrix_game import MatrixGame
from torchrl.envs import Transform

from cprl import keys


class Fatigue(Transform):
    """Takes from every reward a share that grows with the steps that have been played in all worlds."""

    def __init__(self, per_step: float) -> None:
        super().__init__(in_keys=[keys.REWARD], out_keys=[keys.REWARD])
        self.per_step = per_step
        self.register_buffer("steps", torch.zeros(()))

    def _step(self, tensordict, next_tensordict):
        self.steps += 1
        reward = next_tensordict.get(keys.REWARD)
        next_tensordict.set(keys.REWARD, reward / (1 + self.per_step * self.steps))
        return next_tensordict


class Gift(Transform):
    """Adds a part of an apple to every reward."""

    def __init__(self, apples: float) -> None:
        super().__init__(in_keys=[keys.REWARD], out_keys=[keys.REWARD])
        self.apples = apples

    def _apply_transform(self, reward):
        return reward + self.apples


def largest_share(episode):
    """Of all apples that were harvested, those of the agent with most."""
    return episode.harvest.max() / episode.harvest.sum()


def gap(episode):
    """How many apples the agent with most harvested more than the agent with least."""
    return episode.harvest.max() - episode.harvest.min()


gap.title = "most minus least"
gap.unit = "apples"


def nameless(episode):
    return 1.0


nameless.unit = 3


def rewrites_harvest(episode):
    episode.harvest[:] = 99
    return 1.0


def rewrites_metrics(episode):
    episode.metrics["collective_return"] = 99.0
    return 1.0


def no_number(episode):
    return episode.harvest


def fails(episode):
    return int(episode.harvest.sum() / episode.harvest.sum())


def of_another_game(episode):
    return episode.fines.sum()


class Bored:
    """Explores less from some episode on, and counts episodes; stops at the step in STOP_AT_STEP."""

    def __init__(self, from_episode: int, epsilon: float) -> None:
        self.from_episode, self.epsilon, self.episodes = from_episode, epsilon, 0
        self.training: Any = None

    def on_start(self, training) -> None:
        self.training = training

    def on_step(self, batch) -> None:
        if self.training.steps == int(os.environ.get("STOP_AT_STEP", "-1")):
            os.kill(os.getpid(), signal.SIGTERM)

    def on_episode(self, episode, learning) -> None:
        self.episodes += 1
        learning["bored/episodes"] = torch.tensor(self.episodes)
        if self.episodes >= self.from_episode:
            for learner in self.training.learners.values():
                learner.actor.epsilon = min(learner.actor.epsilon, self.epsilon)

    def state_dict(self) -> dict[str, int]:
        return {"episodes": self.episodes}

    def load_state_dict(self, state) -> None:
        self.episodes = state["episodes"]


class Stopping:
    """Stops the process at the step in STOP_AT_STEP."""

    def __init__(self) -> None:
        self.steps = 0

    def on_step(self, batch) -> None:
        self.steps += 1
        if self.steps == int(os.environ.get("STOP_AT_STEP", "-1")):
            os.kill(os.getpid(), signal.SIGTERM)


class Deleting:
    """Deletes the directory in DELETE at step 30, and makes it again where a 1 follows."""

    def __init__(self) -> None:
        self.steps = 0

    def on_step(self, batch) -> None:
        self.steps += 1
        run, again = os.environ["DELETE"].split()
        if self.steps == 30:
            shutil.rmtree(run)
            if again == "1":
                os.mkdir(run)


class NoLogger:
    """Lacks the methods of a logger."""


@dataclass(frozen=True)
class Dilemma:
    """A repeated prisoner's dilemma as a game of the user's own."""

    steps: int = 5
    agents: int = 2

    def to_config(self) -> dict[str, Any]:
        return asdict(self)

    def make(self, worlds, seed, device):
        return MatrixGame(worlds, steps=self.steps)
