"""Losses that TorchRL lacks: each a `torchrl.objectives.LossModule` that works without the rest of cprl.

Modules, in the order in which one reads them:
    maddpg            MADDPGLoss: an actor and a centralised critic for each of several agents
    log_cosh          ln cosh of an error, and TorchRL's DQN loss with it
    td_loss           what losses share whose targets bootstrap by one step
    pr2               probabilistic recursive reasoning: joint action values, the peers' expected answers
    lola              gradients and losses that look one learning step of the others ahead
    dice              what rollouts say of returns, differentiable any number of times
    lola_losses       LOLALoss, LOLADiCELoss: the two put together for policies
    iterated          the exact values of policies that remember one turn of a repeated matrix game
"""

from cprl.objectives.lola import (
    LOLADiCELoss,
    LOLALoss,
    dice_objective,
    iterated_value,
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
    "iterated_value",
    "loaded_dice",
    "log_cosh",
    "lola_gradients",
    "look_ahead_losses",
    "looked_ahead",
    "magic_box",
]
