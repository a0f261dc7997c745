"""TakingEnv: B worlds of a game of people who share a resource, as one TorchRL environment."""

from typing import Any, Final

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Categorical, TensorSpec

from cprl import arguments
from cprl.envs.joint_action_env import JointActionEnv
from cprl.envs.taking.game import TakingGame

OBSERVED: Final = ("played", "own", "total")
"""The numbers by which an agent observes a turn: 1 if there was such a turn, the share that it took of the
most that it can take, and the share that all took of the most that all can take."""


class TakingEnv(JointActionEnv):
    """B worlds of a `TakingGame`, batch size [B], all agents in the group "agents".

    Entries: ("agents", "action") int64 [B, N], a level; ("agents", "reward") float32 [B, N, 1],
    computed in double precision; done, terminated and truncated bool
    [B, 1]; and ("agents", "observation") float32: where nothing is remembered the number 1, [B, N, 1]; else
    the numbers of `OBSERVED` of each remembered turn, the last one first; all 0 for a turn before the first.

    Args:
        game: the game.
        worlds: B.
        seed: of the lengths of episodes, where they have chance; None draws one from torch's generator.
        device: "cpu" or "cuda".
        first_world: the number of the first world: its episodes are as long as those of that world in a
            larger batch.

    Raises:
        ValueError: see `JointActionEnv`.
    """

    def __init__(
        self,
        game: TakingGame,
        worlds: int = 1,
        *,
        seed: int | None = None,
        device: str | torch.device = "cpu",
        first_world: int = 0,
    ) -> None:
        arguments.object_of("game", game, TakingGame, "a TakingGame")
        self.game, self._remembered = game, game.remembered
        super().__init__(
            agents=game.agents,
            observation_size=self._remembered * len(OBSERVED) or 1,
            action=self._action_spec,
            turns=game.turns,
            continue_prob=game.continue_prob,
            worlds=worlds,
            seed=seed,
            device=device,
            first_world=first_world,
        )
        sharing, totals = game.sharing, game.agents * (game.levels - 1) + 1
        taken = np.linspace(0, game.agents * game.most_each, totals)
        gains = np.vectorize(sharing.worth.at, otypes=[np.float64])(taken) - sharing.cost
        self._amounts = torch.tensor(game.amounts, dtype=torch.float64, device=self.device)
        self._gains = torch.from_numpy(gains).to(self.device)
        """What a unit is worth beyond its cost, by the sum of all levels."""
        shape = (*self._agents_size, self._remembered, len(OBSERVED))
        self.register_buffer("seen", torch.zeros(shape, device=self.device))

    def _action_spec(self, shape: torch.Size) -> TensorSpec:
        return Categorical(self.game.levels, shape=shape, dtype=torch.int64)

    def checked_action(self, action: Any) -> Tensor:
        """int64 [B, N], levels; raises a ValueError for anything else."""
        size, most = list(self._agents_size), self.game.levels - 1
        if not isinstance(action, Tensor) or action.dtype != torch.int64 or list(action.shape) != size:
            kind = f"{action.dtype} {list(action.shape)}" if isinstance(action, Tensor) else type(action)
            raise ValueError(f'("agents", "action") is {kind}; allowed: int64 {size}')
        least, largest = action.aminmax()
        if least < 0 or largest > most:
            raise ValueError(
                f'("agents", "action") has numbers from {least.item():g} to {largest.item():g}; allowed: 0 '
                f"to {most}"
            )
        return action

    def pay(self, action: Tensor, over: Tensor | None) -> Tensor:
        """The payoffs of what was taken, [B, N], which agents remember."""
        total, most = action.sum(-1, keepdim=True), self.game.levels - 1
        paid = self._amounts[action] * self._gains[total] + self.game.sharing.payment
        if self._remembered:
            self._remember(action / most, total / (most * self.game.agents), over)
        return paid.float()

    def _remember(self, own: Tensor, total: Tensor, over: Tensor | None) -> None:
        """Keeps the shares that agents took, [B, N], and that all took, [B, 1], as the last turn."""
        turn = torch.stack((torch.ones_like(own), own, total.expand_as(own)), -1).float()
        before: Any = self._buffers["seen"]
        seen = torch.cat((turn.clamp(0, 1).unsqueeze(2), before[:, :, :-1]), 2)
        self._buffers["seen"] = seen if over is None else torch.where(over[..., None, None], before, seen)

    def observe(self) -> Tensor:
        """What agents see now, float32 [B, N, size]."""
        if not self._remembered:
            return torch.ones(*self._agents_size, 1, device=self.device)
        seen: Any = self._buffers["seen"]
        flat: Tensor = seen.flatten(2)
        return flat.clone()

    def forget(self, which: Tensor | None) -> None:
        """No turn yet in these worlds."""
        seen: Any = self._buffers["seen"]
        marked = torch.ones_like(seen, dtype=torch.bool) if which is None else which[..., None, None]
        self._buffers["seen"] = seen.masked_fill(marked, 0.0)
