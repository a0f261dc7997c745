"""What networks are made for: windows and vectors, and settings of their learners."""

from dqn_parts import MEADOW as GAME

from cprl.algorithms import DQNSettings, RolloutSettings
from cprl.commons.spaces import Spaces

SPACES = GAME.spaces
VECTORS = Spaces(
    agents=2, observation_shape=(6,), observation_dtype="float32", observation_scale=1.0, actions=3
)
REPLAY = DQNSettings(buffer_size=100, batch_size=4, learning_rate=1e-3)
ROLLOUTS = RolloutSettings(rollout_steps=20, minibatch_size=10, epochs=1)
