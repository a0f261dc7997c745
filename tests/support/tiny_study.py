"""A study that takes a second: two agents, one replica, episodes of some turns, nothing compiled."""

from dataclasses import replace

from cprl import Custom, Experiment, Game, Rules, Study, maps
from cprl.algorithms import DQN
from cprl.learners.settings import DQNSettings
from cprl.population import Learning, Scripted

BOARD = """
.>A.A
A.A..
..A<A
"""
GAME = Game(map=maps.parse(BOARD), rules=Rules(episode_steps=20, window_rows=2, window_columns=3))
SETTINGS = DQNSettings(buffer_size=100, hidden_cells=(4,), learning_starts=4, batch_size=2)
LEARNING = Learning(DQN(settings=SETTINGS))

TINY = Experiment(
    name="tiny",
    game=GAME,
    agents=(LEARNING, LEARNING),
    episodes=2,
    replicas=1,
    evaluation_episodes=1,
    engine="eager",
)
MIXED = replace(TINY, agents=(LEARNING, Scripted("greedy")))
OFTEN_SAVED = replace(TINY, episodes=24, callbacks=(Custom("often_saved:OftenSaved"),))

FREEZE = "game.rules.freeze_steps"
GAMMA = "agents.*.algorithm.settings.gamma"


def study_of(factors, episodes=24):
    """2 x 2 conditions of 4 replicas, in two blocks each."""
    return Study(replace(OFTEN_SAVED, episodes=episodes), factors, replicas=4, block=2)
