"""Losses that TorchRL lacks: each a `torchrl.objectives.LossModule` that works without the rest of cprl.

Modules, in the order in which one reads them:
    maddpg  MADDPGLoss: an actor and a centralised critic for each of several agents
"""

from cprl.objectives.maddpg import MADDPGLoss

__all__ = ["MADDPGLoss"]
