"""Learners of every algorithm in small, and trainings of four of them on a small board."""

from dataclasses import replace

import torch
from c51 import C51
from cql import CQL
from iql import IQL

import cprl
from cprl import CommonsEnv, Experiment, Game, Rules, maps
from cprl.algorithms import A2C, DQN, PPO, PR2, SAC, Reinforce
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.training import Schedule, train
from cprl.training.agents import Population

GAME = Game(
    map=maps.parse(
        """
        .A>.A.
        A.A.v.
        ..<.A^
        """
    ),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=12, freeze_steps=2),
)
REPLAY = DQNSettings(
    buffer_size=60,
    batch_size=4,
    learning_rate=1e-3,
    hidden_cells=(8,),
    epsilon_hold_steps=5,
    epsilon_decay_steps=40,
    target_every_episodes=2,
)
ROLLOUTS = RolloutSettings(rollout_steps=20, minibatch_size=10, epochs=2, hidden_cells=(8,))
ALGORITHMS = {
    "DQN": DQN(settings=REPLAY),
    "double DQN": DQN(settings=REPLAY, double=True),
    "Huber DQN": DQN(settings=REPLAY, loss_function="smooth_l1"),
    "log-cosh DQN": DQN(settings=replace(REPLAY, optimizer="keras_rmsprop"), loss_function="log_cosh"),
    "C51": C51(settings=REPLAY, atoms=7),
    "CQL": CQL(settings=REPLAY),
    "SAC": SAC(settings=REPLAY),
    "IQL": IQL(settings=REPLAY),
    "PR2": PR2(settings=REPLAY, temperature=1.0),
    "PPO": PPO(settings=ROLLOUTS),
    "A2C": A2C(settings=replace(ROLLOUTS, epochs=1)),
    "REINFORCE": Reinforce(settings=replace(ROLLOUTS, epochs=1)),
}
FOUR = tuple(range(4))


def population(members, *, replicas=2, first_replica=0, game=GAME):
    env = CommonsEnv(game, replicas, seed=3)
    return Population(env, members, seed=3, first_replica=first_replica, engine="eager")


class Returns:
    """Keeps the returns of every episode, by replica."""

    def __init__(self):
        self.of = {}

    def on_episode(self, episode, learning):
        self.of.setdefault(episode.world, []).append(episode.return_.tolist())


def trained(agents, *, episodes=6, first=0, update_every=1):
    env = CommonsEnv(GAME, agents.replicas, seed=agents.seed, first_world=first)
    returns = Returns()
    schedule = Schedule(episodes=episodes, update_every=update_every)
    training = train(env, agents.learners, schedule, others=agents.others, callbacks=[returns])
    return training, returns.of


def weights(agents):
    return {
        f"{lane}/{name}": value
        for lane, network in agents.networks().items()
        for name, value in network.state_dict().items()
    }


def assert_all_weights_move_and_replicas_learn_apart(together, alone):
    """Three replicas, and the last of them alone: it learns the same."""
    before = weights(together)
    _, returns = trained(together)
    _, returns_alone = trained(alone, first=2)
    assert returns[2] == returns_alone[0]
    after, after_alone = weights(together), weights(alone)
    for key, value in after.items():
        if not key.endswith("support"):
            assert not torch.equal(value, before[key]), f"{key} has not moved"
    for key, value in after_alone.items():
        torch.testing.assert_close(value, after[key], rtol=1e-4, atol=1e-5)


def ran(tmp_path, members, name="run"):
    """A whole run of these agents, and its networks."""
    how = {"replicas": 2, "episodes": 4, "seed": 3, "evaluation_episodes": 2, "engine": "eager"}
    experiment = Experiment(name="mixed", game=GAME, agents=members, **how)
    run = cprl.run(experiment, tmp_path / name, watch="off")
    return run, cprl.load(run).networks
