"""How to write an algorithm with a network of its own: C51, which learns the distribution of returns.
Prints what two agents learned the best action to be worth in the first turn."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import DistributionalQValueActor
from torchrl.objectives import DistributionalDQNLoss

import cprl
from cprl import Game, Rules, maps
from cprl.algorithms import DQNSettings, OffPolicy
from cprl.networks.agent import MethodModule
from cprl.population import Learning
from cprl.values import Range


@dataclass(frozen=True, kw_only=True)
class C51(OffPolicy):
    """TorchRL's `DistributionalDQNLoss` (Bellemare, Dabney and Munos 2017). The network itself chooses the
    action whose value bootstraps, as in double DQN; in the paper its target does."""

    atoms: Annotated[int, Range(2, 2**20)] = 51
    lowest_return: float = 0.0
    highest_return: float = 100.0
    """The range of the atoms: discounted returns in apples, 200 of one apple a step with gamma 0.995."""
    update = "stacked"  # all agents in one batch; without this line, the fastest way that works is found

    def __post_init__(self):
        super().__post_init__()
        atoms = np.linspace(self.lowest_return, self.highest_return, self.atoms, dtype=np.float32)
        if not (np.diff(atoms) > 0).all():
            raise ValueError(
                f"C51.highest_return is {self.highest_return}; allowed: above lowest_return, "
                f"{self.lowest_return}, and so far that float32 tells {self.atoms} atoms apart"
            )

    def make_network(self, spaces):
        network = self.new_network(spaces, spaces.actions * self.atoms)
        return AtomNetwork(network, spaces.actions, self.lowest_return, self.highest_return, self.atoms)

    def make_loss(self, network):
        self.refuse_relu()
        logits = MethodModule(network, "atom_logits")
        support = {"support": network.support, "spec": None, "action_space": "categorical"}
        actor = DistributionalQValueActor(logits, **support)
        return FlatLoss(actor, gamma=self.settings.gamma, delay_value=True)


class FlatLoss(DistributionalDQNLoss):
    """TorchRL's loss, which needs a flat batch, for transitions of any batch size."""

    def forward(self, tensordict):
        out = super().forward(tensordict.reshape(-1))
        if self.reduction != "none":
            return out
        size = tensordict.batch_size
        return TensorDict({name: value.reshape(size) for name, value in out.items() if value.ndim})


class AtomNetwork(nn.Module):
    """The distribution of each action's return over fixed values, called atoms."""

    inner_network_names = ("network",)  # stacked by itself for many agents

    def __init__(self, network, actions, lowest, highest, atoms):
        super().__init__()
        self.network = network
        self.actions = actions
        self.atoms = atoms
        self.register_buffer("support", support(lowest, highest, atoms))

    def atom_logits(self, observation):
        """Return [..., atoms, A] of windows, uint8 [..., C, X, Y], before the softmax over atoms."""
        return self.network(observation).unflatten(-1, (self.atoms, self.actions))

    def forward(self, observation):
        """Return the expected values [..., A] of windows, uint8 [..., C, X, Y]."""
        return (self.atom_logits(observation).softmax(-2) * self.support[:, None]).sum(-2)


def support(lowest, highest, atoms):
    """Return the atoms, float32 [atoms], such that none is projected beyond the last one.

    `DistributionalDQNLoss` finds the place of a return by dividing its distance to the lowest atom by that
    between atoms. From -5 to 100 the quotient of the highest of 51 is rounded to 50.000004, whose neighbour
    above, 51, is no atom: the loss would write beyond its memory. So the highest atom is a little lower.
    """
    finest = float(np.spacing(np.float32(max(abs(lowest), abs(highest)))))
    for lower in range(atoms):  # where atoms - 1 divides the range, in units of `finest`, all is exact
        top = float(np.float32(highest)) - lower * finest if lower else highest
        support = torch.linspace(lowest, top, atoms)
        low = support.min().item()
        high = support.max().item()
        if (support.max() - low) / ((high - low) / (atoms - 1)) <= atoms - 1:
            break
    return support


if __name__ == "__main__":
    game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
    settings = DQNSettings(learning_rate=1e-3, gamma=0.9, epsilon_decay_steps=500)
    agent = Learning(C51(settings=settings, atoms=21, highest_return=5.0))
    experiment = cprl.Experiment(name="c51", game=game, agents=(agent, agent), episodes=10)
    run = cprl.load(cprl.run(experiment, watch="off"))
    seen = run.env(worlds=1).reset()["agents", "observation"][0]
    for (lane, network), observation in zip(run.networks.items(), seen, strict=True):
        print(f"{lane}: {network(observation).max():.2f} apples")
