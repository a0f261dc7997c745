"""Losses that TorchRL does not have, as `torchrl.objectives.LossModule` that work without the rest of cprl.

Modules, in the order in which one reads them:
    lola            gradients and losses that look one learning step of the others ahead, of any objective
    dice            what rollouts say of returns, differentiable any number of times
    lola_losses     LOLALoss, LOLADiCELoss: the two put together for policies
    iterated        the exact values of policies that remember one turn of a repeated matrix game
"""

from cprl.objectives.dice import dice_objective, loaded_dice, magic_box
from cprl.objectives.iterated import iterated_value
from cprl.objectives.lola import lola_gradients, look_ahead_losses, looked_ahead
from cprl.objectives.lola_losses import LOLADiCELoss, LOLALoss

__all__ = [
    "LOLADiCELoss",
    "LOLALoss",
    "dice_objective",
    "iterated_value",
    "loaded_dice",
    "lola_gradients",
    "look_ahead_losses",
    "looked_ahead",
    "magic_box",
]
