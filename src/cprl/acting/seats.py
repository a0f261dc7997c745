"""Seats: one actor for each agent of a game, as one policy for the environment."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from cprl import keys


class Seats(TensorDictModuleBase):
    """Lets actor i see the window of agent i alone, and puts the actions together.

    Args:
        actors: one for each agent, agent 0 first; see `cprl.acting.actors`.

    Reads ("agents", "observation"), uint8 [B, N, 3, X, Y]; writes ("agents", "action"), int64 [B, N].
    """

    in_keys = (keys.OBSERVATION,)
    out_keys = (keys.ACTION,)

    def __init__(self, actors: Sequence[nn.Module]) -> None:
        super().__init__()
        self.actors = nn.ModuleList(actors)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Each actor chooses for its agent, in all worlds at once."""
        agents = tensordict.get(keys.AGENTS)
        observation = agents.get("observation")
        if observation.shape[len(tensordict.batch_size)] != len(self.actors):
            raise ValueError(
                f"{len(self.actors)} actors for {observation.shape[len(tensordict.batch_size)]} agents; "
                "one actor for each agent is wanted"
            )
        chosen = []
        for i, actor in enumerate(self.actors):
            view = TensorDict._new_unsafe(
                {"observation": observation[..., i, :, :, :]}, batch_size=tensordict.batch_size
            )
            chosen.append(actor(view).get("action"))
        agents.set("action", torch.stack(chosen, -1))
        return tensordict
