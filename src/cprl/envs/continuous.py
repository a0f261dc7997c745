"""Games in which agents choose numbers: MaxOfTwoQuadratics, and its TorchRL environment."""

from dataclasses import asdict, dataclass
from typing import Any, Final

import torch
from torch import Tensor
from torchrl.data import Bounded

from cprl import arguments
from cprl.checks import Check, check_fields, is_number, number
from cprl.envs.joint_action_env import JointActionEnv


@dataclass(frozen=True, kw_only=True)
class MaxOfTwoQuadratics:
    """Two agents choose a number each, once, and both are paid the larger of two hills.

    For numbers a and b they are, with the default values,

        0.8 * (-((a + 5)^2 + (b + 5)^2) / 3)    a wide one, 0 at its top
        -((a - 5)^2 + (b - 5)^2) + 10           a steep one, 10 at its top

    Whoever ascends the gradient from a uniformly random point reaches the steep one from about 30 % of them:
    those at which it is the higher of the two.

    Sources: Wei et al. (2018), "Multiagent Soft Q-Learning"; Wen et al. (2019), "Probabilistic Recursive
    Reasoning for Multi-Agent Reinforcement Learning", section 5.

    Raises:
        ValueError: names the field, what came and what is allowed.
    """

    bound: float = 10.0
    """The largest number that agents can choose; the least is its negative."""
    wide_top: float = -5.0
    """Of both numbers, where the wide hill has its top."""
    wide_factor: float = 0.8
    """By which the wide hill is multiplied."""
    wide_width: float = 3.0
    """By which its squares are divided."""
    steep_top: float = 5.0
    """Of both numbers, where the steep hill has its top."""
    steep_width: float = 1.0
    """By which its squares are divided."""
    steep_height: float = 10.0
    """The reward at its top."""

    def __post_init__(self) -> None:
        check_fields(self, _CHECKS)

    @property
    def agents(self) -> int:
        """The number of agents N, 2."""
        return 2

    def reward(self, first: Tensor, second: Tensor) -> Tensor:
        """What both agents are paid for their numbers, float tensors of one shape."""

        def distance(top: float) -> Tensor:
            return (first - top) ** 2 + (second - top) ** 2

        wide = -self.wide_factor * distance(self.wide_top) / self.wide_width
        return torch.maximum(wide, self.steep_height - distance(self.steep_top) / self.steep_width)

    def to_config(self) -> dict[str, Any]:
        """Its fields."""
        return asdict(self)

    def make(self, worlds: int, seed: int, device: Any) -> "MaxOfTwoQuadraticsEnv":
        """Its environment, so many worlds; nothing in it is left to chance."""
        return MaxOfTwoQuadraticsEnv(self, worlds, seed=seed, device=device)


_SIZE: Final = number(1e-6, 1e6)
_CHECKS: Final[dict[str, Check]] = {
    **dict.fromkeys(("bound", "wide_width", "steep_width", "wide_factor"), _SIZE),
    **dict.fromkeys(
        ("wide_top", "steep_top", "steep_height"),
        Check(lambda value: is_number(value, -1e6, 1e6), "a number in -1e6..1e6"),
    ),
}


class MaxOfTwoQuadraticsEnv(JointActionEnv):
    """B worlds of `MaxOfTwoQuadratics`, batch size [B], both agents in the group "agents".

    Entries: ("agents", "action") float32 [B, 2, 1], ("agents", "observation") float32 [B, 2, 1], always 1,
    ("agents", "reward") float32 [B, 2, 1], done, terminated and truncated bool [B, 1]. An episode has one
    turn, and terminates.

    Args:
        game: the game.
        worlds: B.
        seed: accepted as by other environments; nothing depends on it.
        device: "cpu" or "cuda".

    Raises:
        ValueError: see `JointActionEnv`.
    """

    def __init__(
        self,
        game: MaxOfTwoQuadratics,
        worlds: int = 1,
        *,
        seed: int | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        arguments.object_of("game", game, MaxOfTwoQuadratics, "a MaxOfTwoQuadratics")
        super().__init__(
            agents=2,
            observation_size=1,
            action=lambda shape: Bounded(-game.bound, game.bound, shape=(*shape, 1), dtype=torch.float32),
            turns=1,
            continue_prob=1.0,
            worlds=worlds,
            seed=seed,
            device=device,
            first_world=0,
        )
        self.game = game

    def checked_action(self, action: Any) -> Tensor:
        """float32 [B, 2, 1] within the bounds; raises a ValueError for anything else."""
        size = [*self._agents_size, 1]
        if not isinstance(action, Tensor) or action.dtype != torch.float32 or list(action.shape) != size:
            kind = f"{action.dtype} {list(action.shape)}" if isinstance(action, Tensor) else type(action)
            raise ValueError(f'("agents", "action") is {kind}; allowed: float32 {size}')
        most = action.abs().max()
        if not most <= self.game.bound:  # NaN is refused too
            raise ValueError(
                f'("agents", "action") has numbers up to {float(most):g}; allowed: -{self.game.bound:g} to '
                f"{self.game.bound:g}"
            )
        return action

    def pay(self, action: Tensor, over: Tensor | None) -> Tensor:
        """The reward of both agents, [B, 2]."""
        return self.game.reward(*action.squeeze(-1).unbind(1))[:, None].repeat(1, 2)

    def observe(self) -> Tensor:
        """Ones, [B, 2, 1]."""
        return torch.ones(*self._agents_size, 1, device=self.device)
