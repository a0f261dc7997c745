"""Losses that TorchRL lacks; each is a `torchrl.objectives.LossModule` and works without the rest of cprl.

Modules, in the order in which one reads them:
    pr2  probabilistic recursive reasoning: joint action values and the peers' expected answers
"""

from cprl.objectives.pr2 import PR2Loss

__all__ = ["PR2Loss"]
