"""RecordedPolicy: a policy that takes the actions of an episode that was played."""

import torch
from tensordict import TensorDictBase
from torch import nn

from cprl import keys
from cprl.policies.joint_policy import JointPolicy
from cprl.values.array_types import AnyArray


class RecordedPolicy(JointPolicy):
    """The policy of one world in which agents act as they did in an episode; after its end they act as in its
    last turn.

    Args:
        actions: the actions of T turns, integers [T, 1, N].
        decisions: the decisions, like the actions, in a game with ballots.
    """

    def __init__(self, actions: AnyArray, decisions: AnyArray | None = None) -> None:
        super().__init__([nn.Identity()] * actions.shape[-1])
        self._choices = {keys.ACTION: actions}
        if decisions is not None:
            self._choices[keys.DECISION] = decisions
        self._turn = -1

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._turn += 1
        for key, choices in self._choices.items():
            turn = min(self._turn, len(choices) - 1)
            tensordict[key] = torch.tensor(choices[turn], dtype=torch.int64)
        return tensordict
