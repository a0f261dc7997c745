"""A small training in which numbers may go wrong."""

from cprl import Game, Rules, maps
from cprl.algorithms import DQNSettings, RolloutSettings

GAME = Game(
    map=maps.parse(".A>.A.A\nA.A...A\n..<.A.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=12),
)
REPLAY = DQNSettings(
    buffer_size=60,
    batch_size=4,
    learning_starts=4,
    hidden_cells=(8,),
    learning_rate=1e-3,
    epsilon_hold_steps=5,
    epsilon_decay_steps=20,
    target_every_episodes=1,
)
ROLLOUT = RolloutSettings(rollout_steps=6, minibatch_size=3, epochs=2, hidden_cells=(8,), learning_rate=1e-3)
