"""How to give an agent a network of your own, beside one of the library.
Prints the network of each agent, and how many weights it has."""

from functools import partial

import torch
from torch import nn

import cprl
from cprl import Game, Rules, maps
from cprl.algorithms import DQN, DQNSettings
from cprl.networks import Conv
from cprl.population import Learning


class Tanh(nn.Module):
    """Maps observations [..., *shape] to [..., outputs], for any leading axes."""

    def __init__(self, spaces, outputs, cells=16):
        super().__init__()
        self.axes = len(spaces.observation_shape)  # channels, rows, columns
        self.highest = spaces.observation_scale  # 255 for windows
        pixels = torch.Size(spaces.observation_shape).numel()
        self.layers = nn.Sequential(nn.Linear(pixels, cells), nn.Tanh(), nn.Linear(cells, outputs))

    def forward(self, observation):
        return self.layers(observation.flatten(-self.axes).float() / self.highest)


game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
settings = DQNSettings(buffer_size=500)
experiment = cprl.Experiment(
    name="own_network",
    game=game,
    agents=(
        Learning(DQN(settings=settings, network=Conv(channels=(4, 4)))),
        Learning(DQN(settings=settings, network=partial(Tanh, cells=8))),
    ),
    episodes=4,
    evaluation_episodes=2,
)
run = cprl.run(experiment, watch="off")

for lane, network in cprl.load(run).networks.items():
    weights = sum(weight.numel() for weight in network.parameters())
    print(f"{lane}: {type(network).__name__}, {weights:,} weights")
