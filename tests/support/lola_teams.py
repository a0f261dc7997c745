"""Teams that learn by LOLA in small."""

from dataclasses import replace

from cprl.algorithms import LOLA, LOLASettings
from cprl.population import Team

SETTINGS = LOLASettings(
    rollout_steps=12, look_ahead_rate=1.0, hidden_cells=(8,), learning_rate=0.01, gae_lambda=0.95
)
ESTIMATORS = ("policy_gradient", "dice")
PAIR, FOUR = (0, 1), (0, 1, 2, 3)


def lola(estimator="policy_gradient", **changes):
    return LOLA(settings=replace(SETTINGS, **changes), estimator=estimator)


def team(estimator="policy_gradient", agents=FOUR, **changes):
    return Team(lola(estimator, **changes), agents, reward="individual")
