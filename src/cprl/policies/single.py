"""Actors: TensorDict modules by which ONE agent chooses, under TorchRL's default keys.

They read "observation", uint8 [..., 3, X, Y], and write "action", int64 [...].
"""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.data import Categorical
from torchrl.modules import EGreedyModule, QValueActor


class QActor(TensorDictSequential):
    """TorchRL's `QValueActor` followed by its `EGreedyModule`.

    Args:
        network: from "observation" to the value of each of A actions.
        actions: how many actions A there are.
        device: where it chooses.

    It explores under `ExplorationType.RANDOM` alone, with chance `epsilon`.
    """

    def __init__(self, network: nn.Module, actions: int, *, device: str | torch.device = "cpu") -> None:
        spec = Categorical(actions, shape=(), dtype=torch.int64, device=torch.device(device))
        super().__init__(
            QValueActor(network, spec=spec, action_space="categorical"),
            EGreedyModule(spec=spec, eps_init=1.0, eps_end=0.0, device=torch.device(device)),
        )

    @property
    def greedy(self) -> QValueActor:
        """The actor without exploration, as a loss wants it."""
        return self.module[0]

    @property
    def epsilon(self) -> float:
        """The chance of a random action."""
        return float(self.module[1].eps)

    @epsilon.setter
    def epsilon(self, chance: float) -> None:
        self.module[1].eps.fill_(chance)


class RandomActor(TensorDictModuleBase):
    """Every action is equally likely, whatever is seen.

    Args:
        actions: how many actions A there are.
        device: where it chooses.
        seed: of its own stream of random numbers.
    """

    in_keys = ("observation",)
    out_keys = ("action",)

    def __init__(self, actions: int, *, device: str | torch.device = "cpu", seed: int = 0) -> None:
        super().__init__()
        self.actions = actions
        self.generator = torch.Generator(device).manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 of the TensorDict's batch size."""
        chosen = torch.randint(
            self.actions, tensordict.batch_size, generator=self.generator, device=self.generator.device
        )
        return tensordict.set("action", chosen)
