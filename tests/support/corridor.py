"""An environment of TorchRL that is no commons: a corridor; and how any environment is played."""

import gymnasium
import numpy as np

from cprl.measuring import EpisodeTracker
from cprl.measuring.series import Observer
from cprl.training.training import StepCollector


class Corridor(gymnasium.Env):
    """Five cells; a step to the right pays its cell's number. The camera shows one white pixel."""

    action_space = gymnasium.spaces.Discrete(2)
    observation_space = gymnasium.spaces.Dict(
        {
            "place": gymnasium.spaces.Box(0, 1, (5,), np.float32),
            "pixels": gymnasium.spaces.Box(0, 255, (2, 5, 3), np.uint8),
        }
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.steps = 0
        return self.seen(), {}

    def step(self, action):
        self.at, self.steps = int(np.clip(self.at + (1 if action else -1), 0, 4)), self.steps + 1
        return self.seen(), float(self.at), False, self.steps == 6, {}

    def seen(self):
        pixels = np.zeros((2, 5, 3), np.uint8)
        pixels[0, self.at] = 255
        return {"place": np.eye(5, dtype=np.float32)[self.at], "pixels": pixels}


def play(env, policy, turns, *, callbacks=(), tracker=None):
    """Steps an environment as a training does; returns the episodes that ended."""
    tracker = tracker or EpisodeTracker(env.batch_size[0], 2)
    observer = Observer(callbacks, env)
    ended = []
    for turn, batch in enumerate(StepCollector(env, policy), start=1):
        observer.on_step(batch)
        for episode in tracker.add(batch):
            ended.append(episode)
            observer.on_episode(episode, {"agent_0/loss": 0.5})
        if turn == turns:
            return ended
    raise AssertionError
