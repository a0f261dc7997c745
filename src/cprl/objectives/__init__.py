"""The objectives of learning: shaped rewards, and losses that TorchRL lacks.

Each loss is a `torchrl.objectives.LossModule` that also works without the rest of cprl.

Modules, in the order in which one reads them:
    rewards      Reward: the reward that an agent learns from, computed from the rewards of all agents
    functional   a TorchRL loss as a function of its weights, for updates of many agents at once
    td           the log-cosh loss, TorchRL's DQN loss with it, and the base of losses with one-step targets
    maddpg       MADDPGLoss: an actor and a centralised critic for each of several agents
    pr2          PR2Loss: values of joint actions, with the answers that an agent expects of its peers
    lola         LOLALoss, LOLADiCELoss: losses after the learning step that the others are expected to take
"""

from cprl.objectives.lola import (
    LOLADiCELoss,
    LOLALoss,
    dice_objective,
    loaded_dice,
    lola_gradients,
    look_ahead_losses,
    looked_ahead,
    magic_box,
)
from cprl.objectives.maddpg import MADDPGLoss
from cprl.objectives.pr2 import PR2Loss
from cprl.objectives.td import LogCoshDQNLoss, log_cosh

__all__ = [
    "LOLADiCELoss",
    "LOLALoss",
    "LogCoshDQNLoss",
    "MADDPGLoss",
    "PR2Loss",
    "dice_objective",
    "loaded_dice",
    "log_cosh",
    "lola_gradients",
    "look_ahead_losses",
    "looked_ahead",
    "magic_box",
]
