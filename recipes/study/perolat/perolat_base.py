"""The game and the agents that all recipes of this folder share: twelve on a commons, after Perolat et al.

J. Perolat et al., "A multi-agent reinforcement learning model of common-pool resource appropriation" (2017).
docs/results/details.md says which numbers others report of the paper, whose text we did not find, how these
recipes depart from them, and how the cost was measured: with 4 replicas a step takes 3.5 ms of a core, so a
condition of 1,000 episodes takes one core hour at most, and its process 3.1 GB of memory with full buffers.
"""

from typing import Final

import cprl
from cprl import presets
from cprl.algorithms import DQN, DQNSettings
from cprl.population import Learning

BEAMS: Final = (10, 20)
"""The two lengths of the beam in cells; the first one is the reference. The paper is said to have 10 in its
figure 3 and 20 in its appendix A."""
GAME: Final = presets.game("perolat/open-v1")
"""Its rules are those reported of the paper, but that episodes also end when no apple is left. Its map has
the size and number of sites of a public redrawing of the paper's, at places of our own."""
SETTINGS: Final = DQNSettings(
    gamma=0.99,
    hidden_cells=(32, 32),
    epsilon_start=1.0,
    epsilon_end=0.1,
    epsilon_decay_steps=250_000,
    learning_rate=1e-4,
    buffer_size=20_000,
    batch_size=32,
    steps_per_update=4,
    target_every_episodes=3,
)
"""DQN of dense layers is reported of the paper. No number of its learner is, so these are all ours."""

EXPERIMENT: Final = cprl.Experiment(
    name="perolat",
    game=GAME,
    agents=(Learning(DQN(settings=SETTINGS)),) * 12,
    episodes=1000,
    replicas=4,
    evaluation_episodes=20,
)
