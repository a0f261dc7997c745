"""Learners with recurrent networks in small, by their algorithm."""

from dataclasses import replace

from cprl import algorithms
from cprl.algorithms import (
    DQN,
    PPO,
    DQNSettings,
    RolloutSettings,
)
from cprl.networks import GRU, LSTM, MLP, Conv
from cprl.population import Learning, Team

SMALL = GRU(encoder=MLP(hidden_cells=(6,)), recurrent_cells=5)
LONG = LSTM(encoder=MLP(hidden_cells=(6,)), recurrent_cells=5)
CONV = GRU(encoder=Conv(channels=(3,), hidden_cells=(6,)), recurrent_cells=5)
ROLLOUTS = RolloutSettings(rollout_steps=20, minibatch_size=10, epochs=2)
ON_POLICY = {
    "PPO": PPO(settings=ROLLOUTS, network=SMALL),
    "PPO, LSTM": PPO(settings=ROLLOUTS, network=LONG),
    "PPO, convolutions": PPO(settings=ROLLOUTS, network=CONV),
    "A2C": algorithms.A2C(settings=replace(ROLLOUTS, epochs=1), network=SMALL),
    "REINFORCE": algorithms.Reinforce(settings=replace(ROLLOUTS, epochs=1), network=SMALL),
    "IPPO": algorithms.IPPO(settings=ROLLOUTS, network=SMALL),
    "MAPPO": algorithms.MAPPO(settings=ROLLOUTS, network=SMALL),
}
REPLAY = DQNSettings(buffer_size=60, batch_size=4)
SEQUENCES = replace(
    REPLAY,
    learning_starts=8,
    sequence_steps=6,
    learning_rate=1e-3,
    epsilon_hold_steps=0,
    epsilon_decay_steps=60,
    target_every_episodes=2,
)
DQNS = {
    "GRU": DQN(settings=SEQUENCES, network=SMALL),
    "LSTM, double, log-cosh": DQN(settings=SEQUENCES, network=LONG, double=True, loss_function="log_cosh"),
    "convolutions": DQN(settings=replace(SEQUENCES, tau=0.1), network=CONV),
}
FOUR = (0, 1, 2, 3)


def specs(name, *, shares=False):
    """Four agents of an algorithm, each by itself or as a team."""
    algorithm = ON_POLICY[name]
    if name in ("IPPO", "MAPPO") or shares:
        reward = "team" if name == "MAPPO" else "individual"
        return [Team(algorithm, FOUR, reward=reward, share_parameters=shares)]
    return [Learning(algorithm)] * 4
