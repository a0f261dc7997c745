"""Losses that TorchRL lacks: each a `torchrl.objectives.LossModule` that works without the rest of cprl.

Modules, in the order in which one reads them:
    maddpg            MADDPGLoss: an actor and a centralised critic for each of several agents
    pr2               probabilistic recursive reasoning: joint action values, the peers' expected answers
    stein             how particles, here samples of those answers, move towards a density
    pr2_actor_critic  the same for continuous actions, with an actor, a critic and a sampler of answers
"""

from cprl.objectives.maddpg import MADDPGLoss
from cprl.objectives.pr2 import PR2Loss
from cprl.objectives.pr2_actor_critic import PR2ActorCriticLoss

__all__ = ["MADDPGLoss", "PR2ActorCriticLoss", "PR2Loss"]
