"""What agents want, and losses that TorchRL lacks: each a `torchrl.objectives.LossModule` that works without
the rest of cprl.

Modules, in the order in which one reads them:
    rewards      the reward that each agent learns from, out of those of everybody
    functional   a TorchRL loss as a function of its weights, for updates of many agents at once
    td           ln cosh of an error, and TorchRL's DQN loss with it; losses that bootstrap by one step
    maddpg       MADDPGLoss: an actor and a centralised critic for each of several agents
    pr2          probabilistic recursive reasoning: joint action values, the peers' expected answers
    lola         losses that look one learning step of the others ahead, by policy gradients and by DiCE
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
