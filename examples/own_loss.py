"""How to learn by a loss of your own, or by any of TorchRL's, in place of an algorithm's.
Prints the loss of each agent, and what it harvests in the first and in the last episodes."""

from functools import partial

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictParams
from torchrl.objectives import DQNLoss, LossModule

import cprl
from cprl import Game, Rules, maps
from cprl.algorithms import DQN, DQNSettings
from cprl.algorithms.base import q_actor
from cprl.population import Learning
from cprl.runs.curves import curves_of


def huber(network, settings):
    """Return one of TorchRL's losses: errors above 1 count by their size, not by their square."""
    loss = DQNLoss(q_actor(network), loss_function="smooth_l1", delay_value=True, action_space="categorical")
    loss.make_value_estimator(gamma=settings.gamma)
    return loss


class Hysteretic(LossModule):
    """A loss that learns more slowly from disappointments than from good news (Matignon et al. 2007)."""

    values: TensorDictModule
    values_params: TensorDictParams
    target_values_params: TensorDictParams

    def __init__(self, network, settings, slow):
        super().__init__()
        values = TensorDictModule(network, ["observation"], ["value"])
        self.convert_to_functional(values, "values", create_target_params=True)
        self.gamma = settings.gamma
        self.slow = slow

    def value(self, weights, turn):
        with weights.to_module(self.values, preserve_module_state=False):
            return self.values(turn.select("observation"))["value"]

    def forward(self, batch):
        after = batch["next"]
        best = self.value(self.target_values_params, after).amax(-1, keepdim=True)
        target = after["reward"] + self.gamma * best * ~after["terminated"]
        chosen = self.value(self.values_params, batch).gather(-1, batch["action"].unsqueeze(-1))
        error = target.detach() - chosen
        return TensorDict({"loss": torch.where(error < 0, self.slow, 1.0) * error.square()})


game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
settings = DQNSettings(learning_rate=1e-3, gamma=0.9, epsilon_decay_steps=500)
losses = (huber, partial(Hysteretic, slow=0.2))
agents = tuple(Learning(DQN(settings=settings, loss=loss)) for loss in losses)
experiment = cprl.Experiment(name="own_loss", game=game, agents=agents, episodes=20, evaluation_episodes=5)
run = cprl.run(experiment, watch="off")
for agent, spec in enumerate(agents):
    apples = curves_of(run)[f"return_{agent}"]
    print(f"{spec.algorithm.loss.target}: {apples[:, :5].mean():.1f}, {apples[:, -5:].mean():.1f} apples")
