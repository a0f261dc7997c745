"""A policy that acts by what it sees, and a callback that keeps what it is shown."""

import torch
from tensordict.nn import TensorDictModuleBase

from cprl import keys


class ByWindow(TensorDictModuleBase):
    """A policy that follows from the window alone, and leaves entries of its own, as networks do."""

    in_keys = (keys.OBSERVATION,)
    out_keys = (keys.ACTION,)

    def forward(self, tensordict):
        window = tensordict[keys.OBSERVATION].long().flatten(-3)
        jumble = (window * torch.arange(1, window.shape[-1] + 1)).sum(-1)
        tensordict[keys.ACTION] = jumble // 7 % 8
        tensordict[keys.AGENTS, "value"] = jumble.float()
        tensordict["note"] = jumble.sum(-1)
        return tensordict


class Witness:
    def __init__(self):
        self.turns, self.episodes, self.learning = [], [], []

    def on_step(self, batch):
        self.turns.append(batch)

    def on_episode(self, episode, learning):
        self.episodes.append(episode)
        self.learning.append(dict(learning))
