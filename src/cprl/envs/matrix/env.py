"""MatrixEnv: B worlds of a matrix game as one TorchRL environment."""

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Categorical

from cprl import arguments
from cprl.envs.joint_action_env import JointActionEnv
from cprl.envs.matrix.game import MatrixGame


class MatrixEnv(JointActionEnv):
    """B worlds of a matrix game, batch size [B], all agents in the group "agents".

    Entries: ("agents", "action") int64 [B, N], ("agents", "reward") float32 [B, N, 1], done, terminated and
    truncated bool [B, 1], and ("agents", "observation") float32: where nothing is remembered the number 1,
    [B, N, 1]; else of each remembered joint action, the last one first, A**N + 1 numbers of which one is 1.
    Each agent sees joint actions from its own side: its own action first, then those of the following
    agents, cyclically. Of two agents with two actions, agent 0 sees the joint action (1, 0) as number 2 of
    0..3, agent 1 as number 1. The number A**N stands for a turn before the first.

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
        game: MatrixGame,
        worlds: int = 1,
        *,
        seed: int | None = None,
        device: str | torch.device = "cpu",
        first_world: int = 0,
    ) -> None:
        arguments.object_of("game", game, MatrixGame, "a MatrixGame")
        agents, actions, remembered = game.agents, game.actions, game.remembered
        self._none = actions**agents
        super().__init__(
            agents=agents,
            observation_size=remembered * (self._none + 1) if remembered else 1,
            action=lambda shape: Categorical(actions, shape=shape, dtype=torch.int64),
            turns=game.turns,
            continue_prob=game.continue_prob,
            worlds=worlds,
            seed=seed,
            device=device,
            first_world=first_world,
        )
        self.game = game
        payoffs = torch.tensor(game.payoffs, dtype=torch.float32, device=self.device)
        self._payoffs = payoffs.reshape(self._none, agents)
        """What agents are paid, [A**N, N], by the number of the joint action as agent 0 sees it."""
        self._places = _places(agents, actions).to(self.device)
        self._remembered = remembered
        size = (*self._agents_size, remembered)
        self.register_buffer("joint", torch.full(size, self._none, device=self.device))

    def checked_action(self, action: Any) -> Tensor:
        """int64 [B, N], 0 to A - 1; raises a ValueError for anything else."""
        size = list(self._agents_size)
        if not isinstance(action, Tensor) or action.dtype != torch.int64 or list(action.shape) != size:
            kind = f"{action.dtype} {list(action.shape)}" if isinstance(action, Tensor) else type(action)
            raise ValueError(f'("agents", "action") is {kind}; allowed: int64 {size}')
        least, most = action.aminmax()
        if least < 0 or most >= self.game.actions:
            raise ValueError(
                f'("agents", "action") has numbers from {int(least)} to {int(most)}; allowed: 0 to '
                f"{self.game.actions - 1}"
            )
        return action

    def pay(self, action: Tensor, over: Tensor | None) -> Tensor:
        """The payoffs of joint actions, [B, N], which agents remember."""
        seen = (action[:, None] * self._places).sum(-1)
        if self._remembered:
            before: Any = self._buffers["joint"]
            joint = torch.cat((seen.unsqueeze(-1), before[..., :-1]), -1)
            self._buffers["joint"] = joint if over is None else torch.where(over[..., None], before, joint)
        return self._payoffs[seen[:, 0]]

    def observe(self) -> Tensor:
        """What agents see now, float32 [B, N, size]."""
        if not self._remembered:
            return torch.ones(*self._agents_size, 1, device=self.device)
        joint: Any = self._buffers["joint"]
        seen = torch.zeros(*joint.shape, self._none + 1, device=self.device)
        return seen.scatter_(-1, joint.unsqueeze(-1), 1.0).flatten(2)

    def forget(self, which: Tensor | None) -> None:
        """No joint action yet in these worlds."""
        joint: Any = self._buffers["joint"]
        marked = torch.ones_like(joint, dtype=torch.bool) if which is None else which[..., None]
        self._buffers["joint"] = joint.masked_fill(marked, self._none)


def _places(agents: int, actions: int) -> Tensor:
    """By which each agent's action counts in the joint action's number that an agent sees, [N, N]: of a row's
    agent its own most, then the following agents' cyclically."""
    return torch.tensor(
        [
            [actions ** (agents - 1 - (other - own) % agents) for other in range(agents)]
            for own in range(agents)
        ]
    )
