"""Actors of a single agent: TensorDict modules with TorchRL's default keys.

They read "observation", uint8 [..., 3, X, Y], and write "action", int64 [...].
"""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.data import Categorical
from torchrl.modules import EGreedyModule, QValueActor

from cprl import arguments
from cprl.envs.drivers import device_of


class QActor(TensorDictSequential):
    """TorchRL's `QValueActor` followed by its `EGreedyModule`.

    Args:
        network: maps "observation" to the values of A actions.
        actions: the number of actions A.
        device: the device of its specs and of epsilon.

    It explores only under `ExplorationType.RANDOM`, with probability `epsilon`.
    """

    def __init__(self, network: nn.Module, actions: int, *, device: str | torch.device = "cpu") -> None:
        actions = arguments.integer("actions", actions, 1)
        spec = Categorical(actions, shape=(), dtype=torch.int64, device=torch.device(device))
        super().__init__(
            QValueActor(network, spec=spec, action_space="categorical"),
            EGreedyModule(spec=spec, eps_init=1.0, eps_end=0.0, device=torch.device(device)),
        )

    @property
    def greedy(self) -> QValueActor:
        """The actor without exploration, for losses."""
        return self.module[0]

    @property
    def epsilon(self) -> float:
        """The probability of a random action, 0..1."""
        return float(self.module[1].eps)

    @epsilon.setter
    def epsilon(self, chance: float) -> None:
        self.module[1].eps.fill_(arguments.number("epsilon", chance, low=0, high=1, allowed="0..1"))


class RandomActor(TensorDictModuleBase):
    """Chooses uniformly random actions.

    Args:
        actions: the number of actions A.
        device: the device of the actions.
        seed: the seed of its own generator.
    """

    in_keys = ("observation",)
    out_keys = ("action",)

    def __init__(self, actions: int, *, device: str | torch.device = "cpu", seed: int = 0) -> None:
        super().__init__()
        self.actions = arguments.integer("actions", actions, 1)
        self.generator = torch.Generator(device_of(device)).manual_seed(arguments.seed(seed))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 with the TensorDict's batch size."""
        chosen = torch.randint(
            self.actions, tensordict.batch_size, generator=self.generator, device=self.generator.device
        )
        return tensordict.set("action", chosen)
