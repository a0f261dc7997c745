"""The game and the agents that all recipes of this folder share: twelve on a commons, after Perolat et al.

J. Perolat et al., "A multi-agent reinforcement learning model of common-pool resource appropriation" (2017).
docs/results.md says which numbers are the paper's, which it leaves open, how these recipes depart from it,
and how the cost was measured: with 4 replicas a step takes 6.3 ms of a core, so a condition of 1,000
episodes takes 1.8 core hours at most, and its process 3.1 GB of memory.
"""

from typing import Final

import cprl
from cprl import presets
from cprl.algorithms import DQN, DQNSettings
from cprl.population import Learning

BEAMS: Final = (10, 20)
"""The two lengths of the beam in cells; the first one is the reference."""
GAME: Final = presets.game("perolat/open-v1")
"""Its map has the size and number of sites of the paper's, at places of our own."""
SETTINGS: Final = DQNSettings(
    gamma=0.99,
    hidden_cells=(32, 32),
    epsilon_start=1.0,
    epsilon_end=0.1,
    epsilon_decay_steps=250_000,  # ours, as all below
    learning_rate=1e-4,
    buffer_size=20_000,
    batch_size=32,
    steps_per_update=4,
    target_every_episodes=3,
)

EXPERIMENT: Final = cprl.Experiment(
    name="perolat",
    game=GAME,
    agents=(Learning(DQN(settings=SETTINGS)),) * 12,
    episodes=1000,
    replicas=4,
    evaluation_episodes=20,
)
