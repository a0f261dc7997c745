"""Each algorithm learns a small problem whose optimum is known."""

from dataclasses import replace
from statistics import fmean

import pytest
from c51 import C51
from cql import CQL
from iql import IQL
from team_learners import TEAMS

from cprl import CommonsEnv, Game, Rules, maps
from cprl.algorithms import A2C, DQN, PPO, SAC, Reinforce
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.measuring.playing import evaluate
from cprl.population import Learning, Team
from cprl.training import Schedule, train
from cprl.training.agents import Population

STEPS = 24
GAME = Game(
    map=maps.parse(">AA"),
    rules=Rules(regrow_prob=(1.0,), may_fire=False, window_rows=2, window_columns=3, episode_steps=STEPS),
)
"""An apple hangs again in the turn after it was bitten, unless the agent stands there: going to and fro
between the two sites pays one apple a step, and nothing pays more."""

REPLAY = DQNSettings(
    buffer_size=2000,
    batch_size=16,
    gamma=0.8,
    learning_rate=3e-3,
    hidden_cells=(16,),
    epsilon_hold_steps=50,
    epsilon_decay_steps=800,
    epsilon_evaluation=0.0,
    target_every_episodes=2,
)
ROLLOUTS = RolloutSettings(
    rollout_steps=24, minibatch_size=12, gamma=0.8, gae_lambda=0.9, learning_rate=5e-3, hidden_cells=(16,)
)
ONCE = RolloutSettings(
    rollout_steps=24,
    minibatch_size=24,
    epochs=1,
    gamma=0.8,
    gae_lambda=0.9,
    learning_rate=5e-3,
    hidden_cells=(16,),
)
ALGORITHMS = {
    "DQN": DQN(settings=REPLAY),
    "double DQN": DQN(settings=REPLAY, double=True),
    "C51": C51(settings=REPLAY, atoms=21, highest_return=6.0),
    "CQL": CQL(settings=REPLAY),
    "SAC": SAC(settings=REPLAY, target_entropy_weight=0.1),
    "IQL": IQL(settings=REPLAY),
    "PPO": PPO(settings=ROLLOUTS),
    "A2C": A2C(settings=ONCE, entropy_coeff=0.05),
    "REINFORCE": Reinforce(settings=ONCE),
}
REPLICAS = 6


def share_of_the_optimum(population):
    """Apples of a fresh episode of each replica, as a share of the most that there are."""
    played = evaluate(CommonsEnv(GAME, REPLICAS, seed=99), population.policy(1))
    return [float(episode.return_.sum()) / STEPS for episode in played]


@pytest.mark.slow
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_lone_agent_comes_close_to_the_optimum(name):
    env = CommonsEnv(GAME, REPLICAS)
    population = Population(env, [Learning(ALGORITHMS[name])], seed=1, engine="eager")
    untrained = share_of_the_optimum(population)
    episodes = 125 if isinstance(ALGORITHMS[name].settings, DQNSettings) else 400
    train(CommonsEnv(GAME, REPLICAS, seed=1), population.learners, Schedule(episodes=episodes))
    shares = share_of_the_optimum(population)
    assert fmean(untrained) < 0.5
    assert fmean(shares) > 0.9, shares
    assert sum(share == 1.0 for share in shares) >= REPLICAS - 2, shares


ROWS = Game(
    map=maps.parse(
        """
        >AA#
        ####
        #AA<
        """
    ),
    rules=Rules(regrow_prob=(1.0,), may_fire=False, window_rows=2, window_columns=3, episode_steps=24),
)
"""Two boards like that of `GAME`, an agent on each: 24 apples an episode for each, and no more."""


@pytest.mark.slow
@pytest.mark.parametrize("name", TEAMS)
def test_a_team_comes_close_to_the_optimum(name):
    settings = ROLLOUTS if name.endswith("PPO") else REPLAY
    algorithm = replace(TEAMS[name], settings=settings)
    # With the reward of the group, one of four replicas of IPPO ended at half of the apples.
    spec = Team(algorithm, (0, 1), reward="individual" if name == "IPPO" else "team")
    team = Population(CommonsEnv(ROWS, 4, seed=1), [spec], seed=1, engine="eager")

    def share():
        played = evaluate(CommonsEnv(ROWS, 4, seed=99), team.policy(1))
        return [float(episode.return_.sum()) / 48 for episode in played]

    untrained = share()
    train(CommonsEnv(ROWS, 4, seed=1), team.learners, Schedule(episodes=400 if name.endswith("PPO") else 125))
    assert fmean(untrained) < 0.5
    shares = share()
    assert fmean(shares) > 0.9, shares
