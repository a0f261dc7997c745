"""The experiments that the studies of the game as run vary: the tragedy of the commons, on three schedules.

Four independent DQN agents on `commons`, by the rules of the study as run: `EXPERIMENT`, 200 episodes of 8
replicas in one world each on a schedule twenty times shorter than the published one; `TRAGEDY`, which learns
from sixteen worlds, as recipes/tragedy.py does by the published rules; and `PUBLISHED`, experiment 5 as run.
"""

from dataclasses import replace
from typing import Final

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning

SETTINGS: Final = replace(
    presets.dqn_settings("commons", variant="as_run"),
    learning_rate=1e-4,
    epsilon_decay_steps=100_000,
    gamma=0.95,
)
AGENT: Final = Learning(DQN(settings=SETTINGS))

EXPERIMENT: Final = cprl.Experiment(
    name="short_commons",
    game=presets.game("commons", variant="as_run"),
    agents=(AGENT,) * 4,
    episodes=200,
    replicas=8,
    evaluation_episodes=50,
)

WORLDS: Final = 16
FASTER: Final = replace(SETTINGS, learning_rate=1e-3, gamma=0.97, steps_per_update=WORLDS, batch_size=64)
TRAGEDY: Final = replace(
    EXPERIMENT,
    name="tragedy",
    agents=(Learning(DQN(settings=FASTER)),) * 4,
    episodes=300,
    replicas=4,
    worlds=WORLDS,
)

PUBLISHED: Final = replace(
    EXPERIMENT,
    name="commons",
    agents=(Learning(DQN(settings=presets.dqn_settings("commons", variant="as_run"))),) * 4,
    episodes=4800,
    evaluation_episodes=20,
)
