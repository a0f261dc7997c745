"""Losses that TorchRL lacks: each a `torchrl.objectives.LossModule` that works without the rest of cprl.

Modules, in the order in which one reads them:
    maddpg  MADDPGLoss: an actor and a centralised critic for each of several agents
    pr2     probabilistic recursive reasoning: joint action values and the peers' expected answers
"""

from cprl.objectives.maddpg import MADDPGLoss
from cprl.objectives.pr2 import PR2Loss

__all__ = ["MADDPGLoss", "PR2Loss"]
