"""Experiments whose trainings are watched."""

import torch
from recordings import GAME
from torchrl.envs import Transform

import cprl
from cprl import Custom, Experiment, Game, Rules, maps
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.envs.make_env import make_env
from cprl.population import Learning, Scripted
from cprl.training.agents import Population

REPLAY = DQNSettings(buffer_size=300, batch_size=4, hidden_cells=(8,), epsilon_hold_steps=10)
ROLLOUT = RolloutSettings(rollout_steps=20, minibatch_size=10, hidden_cells=(8,))
DQN_AGENT = Learning(DQN(settings=REPLAY))
ALONE = Experiment(
    name="alone",
    game=Game(
        map=maps.parse(".A>.A.A\nA.A...A\n..<.A.A\n.>..A.<"),
        rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=20),
    ),
    agents=[DQN_AGENT, Learning(PPO(settings=ROLLOUT)), Scripted("greedy"), DQN_AGENT],
    replicas=2,
    episodes=3,
    transforms=[Custom("watched:Haze")],
    engine="eager",
)


def population_of(experiment):
    torch.manual_seed(experiment.seed)
    env = make_env(experiment.game, worlds=experiment.replicas, seed=0, transforms=experiment.transforms)
    return env, Population(env, experiment.agents, engine=experiment.engine)


SETTINGS = DQNSettings(buffer_size=200, learning_rate=1e-3, hidden_cells=(8,))
EXPERIMENT = cprl.Experiment(
    name="small",
    game=GAME,
    agents=(Learning(DQN(settings=SETTINGS)), Scripted("random")),
    episodes=3,
    replicas=2,
    evaluation_episodes=4,
    engine="eager",
)


class Haze(Transform):
    """Draws from torch's generator at every step, as a user's own code may."""

    def _step(self, tensordict, next_tensordict):
        torch.rand(3)
        return next_tensordict
