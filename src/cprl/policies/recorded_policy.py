"""RecordedPolicy: a policy that takes the actions of an episode that was played."""

from collections.abc import Mapping
from typing import Any

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
        choices: what was chosen in T turns, by the entry of `cprl.keys`: ACTION, integers [T, 1, N]; in a
            game with ballots also DECISION, like the actions; where a governor decided RULE, [T, 1].
    """

    def __init__(self, choices: Mapping[Any, AnyArray]) -> None:
        super().__init__([nn.Identity()] * choices[keys.ACTION].shape[-1])
        self._choices = choices
        self._turn = -1

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._turn += 1
        for key, choices in self._choices.items():
            turn = min(self._turn, len(choices) - 1)
            tensordict[key] = torch.tensor(choices[turn], dtype=torch.int64)
        return tensordict
