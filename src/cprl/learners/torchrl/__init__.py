"""engine="torchrl": the same training with TorchRL's stock parts, one agent after the other.

agents     an agent's loss, optimiser and target updater; all agents of a learner
buffers    the replay buffers of all agents, and their state
replay     learning from replay: one `TensorDictReplayBuffer` an agent
rollouts   learning from rollouts: TorchRL's `GAE`, minibatches without replacement
"""

from cprl.learners.torchrl.replay import TorchRLReplayLearner
from cprl.learners.torchrl.rollouts import TorchRLRolloutLearner

__all__ = ["TorchRLReplayLearner", "TorchRLRolloutLearner"]
