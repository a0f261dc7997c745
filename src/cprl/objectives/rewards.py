"""Shaped rewards: the rewards that agents learn from, computed from the rewards of all agents.

A `Reward` says how an agent's reward is shaped; `RewardModel` computes shaped rewards turn by turn. In the
formulas N is the number of agents, r_i the reward that the environment gives agent i in a turn (harvest -
fines + transfers, in apples), and r'_i the shaped reward that agent i learns from.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from cprl.values import Range, Share, Value, Where, checked
from cprl.values.array_types import Float64

_Array = Any
"""A numpy array or a tensor."""
Weight = Annotated[float, Range(0, 1e6)]
"""The weight of a term of a shaped reward."""
Angle = Annotated[float, Where(lambda angle: -pi <= angle <= pi, "radians in -pi..pi, e.g. math.radians(45)")]


@dataclass(frozen=True, kw_only=True)
class InequityAversion(Value):
    """The reward of an agent that dislikes having less than others, and dislikes having more.

    r'_i = r_i - alpha / (N - 1) sum_j max(e_j - e_i, 0) - beta / (N - 1) sum_j max(e_i - e_j, 0), over the
    others j, with smoothed rewards e_i = smoothing x (e_i of the turn before) + r_i, zero before an episode's
    first turn.

    Source: Hughes et al., "Inequity aversion improves cooperation in intertemporal social dilemmas" (2018),
    after Fehr and Schmidt (1999).

    Args:
        alpha: the weight of being behind (disadvantageous inequity); 5 is usual.
        beta: the weight of being ahead (advantageous inequity); 0.05 is usual.
        smoothing: the share of smoothed rewards that lasts into the next turn; gamma x lambda in the source.
            0 compares the rewards of one turn, 1 the returns so far.
    """

    alpha: Weight
    beta: Weight
    smoothing: Share

    def shaped(self, rewards: Float64, smoothed: Float64) -> Float64:
        """Return shaped rewards, [B, N].

        Args:
            rewards: [B, N], the rewards of a turn.
            smoothed: [B, N], the smoothed rewards e_i after the turn.
        """
        # [B, i, j]: e_j - e_i, above 0 where agent i is behind agent j.
        difference = smoothed[:, None, :] - smoothed[:, :, None]
        behind = difference.clip(min=0).sum(-1)
        ahead = (-difference).clip(min=0).sum(-1)
        penalty: Float64 = (self.alpha * behind + self.beta * ahead) / (rewards.shape[1] - 1)
        return rewards - penalty


@dataclass(frozen=True, kw_only=True)
class SocialValueOrientation(Value):
    """The reward of an agent that prefers a certain proportion between the others' rewards and its own.

    r'_i = r_i - weight x |angle - theta_i|, with theta_i = atan2(mean of the others' rewards, r_i), in
    radians. The difference is the shorter way around the circle, 0..pi. In a turn in which r_i and the mean
    of the others are both 0, no angle is defined, and r'_i = r_i = 0.

    Source: McKee et al., "Social Diversity and Social Preferences in Mixed-Motive Reinforcement Learning"
    (2020). There rewards are never negative, so that the shorter way is the plain difference.

    Args:
        angle: the preferred proportion, in radians: 0 is all for itself, pi / 4 the same for itself and the
            others, pi / 2 all for the others; a negative angle is against the others.
        weight: the reward lost per radian of difference.
    """

    angle: Angle
    weight: Weight

    def shaped(self, rewards: Float64) -> Float64:
        """Return the shaped rewards of agents with these rewards, [B, N]."""
        others_mean = _mean_of_others(rewards)
        plain_difference = abs(np.arctan2(others_mean, rewards) - self.angle)
        shorter_way = np.where(plain_difference > pi, 2 * pi - plain_difference, plain_difference)
        has_no_angle = (rewards == 0) & (others_mean == 0)
        difference = np.where(has_no_angle, np.zeros_like(rewards), shorter_way)
        return rewards - self.weight * difference


@dataclass(frozen=True)
class Exchange(Value):
    """The reward of an agent that exchanges a share of its reward with the others.

    r'_i = (1 - share) r_i + share x mean of the others' rewards. If all agents exchange the same share, the
    sum of their rewards stays the same.

    Source: the reward transfers of Willis et al., "Resolving social dilemmas with minimal reward transfer"
    (2024), in which 1 - share is the self-interest level.

    Args:
        share: 0 keeps the agent's own reward, 1 replaces it by the mean of the others'.
    """

    share: Share

    def shaped(self, rewards: Float64) -> Float64:
        """Return the shaped rewards of agents with these rewards, [B, N]."""
        return (1 - self.share) * rewards + self.share * _mean_of_others(rewards)


def _mean_of_others(rewards: Float64) -> Float64:
    """Return for each agent the mean of the others' rewards, [B, N]."""
    return (rewards.sum(-1)[:, None] - rewards) / (rewards.shape[1] - 1)


Reward: TypeAlias = Literal["individual", "team"] | InequityAversion | SocialValueOrientation | Exchange
"""The reward that an agent learns from: "individual", its own reward; "team", the sum of the rewards of all
agents; or a value that compares its reward with the others'."""


def check_reward(name: str, reward: Any, agents: int) -> None:
    """Raise a ValueError unless a value is a `Reward` that a game of this many agents supports.

    Args:
        name: names the value in messages, e.g. "agents[0].reward".
    """
    checked(name, reward, Reward)
    if agents < 2 and not isinstance(reward, str):
        raise ValueError(
            f"{name} is {reward_name(reward)}, which compares an agent with others, in a game of {agents} "
            "agent; allowed there: 'individual', 'team'"
        )


def reward_name(reward: object) -> str:
    """Return the name of a reward in messages, e.g. '"team"', with quotes, or 'Exchange'."""
    return f'"{reward}"' if isinstance(reward, str) else type(reward).__name__


class RewardModel:
    """Computes the shaped rewards of agents turn by turn, with a memory of running episodes.

    Args:
        reward: how the rewards of all agents are shaped.
    """

    def __init__(self, reward: Reward) -> None:
        checked("reward", reward, Reward)
        self.reward = reward
        self._smoothed: Float64 | None = None
        """[B, N], the smoothed rewards after the latest turn, for `InequityAversion`; None before the first
        turn."""
        self.latest: _Array | None = None
        """[B, N], the shaped rewards of the latest turn; None before the first turn."""

    def add(self, rewards: _Array, ended: _Array) -> _Array:
        """Return the shaped rewards of the next turn of all worlds, a numpy array or a tensor as `rewards`.

        Args:
            rewards: float [B, N], the rewards of the environment.
            ended: bool [B], marks the worlds whose episode ends with this turn: their smoothed rewards are
                zero from the next turn on.

        Returns:
            [B, N]: the rewards as they are if they are "individual"; else float32, computed in float64.
        """
        if isinstance(rewards, Tensor):
            shaped = self.add(rewards.numpy(force=True), ended.numpy(force=True))
            self.latest = torch.as_tensor(shaped, device=rewards.device)
            return self.latest
        if rewards.shape[1] < 2:
            check_reward("reward", self.reward, rewards.shape[1])
        with np.errstate(all="ignore"):  # `cprl.training.nan_check` reports rewards that are not finite
            self.latest = self._shaped(rewards, ended)
        return self.latest

    def _shaped(self, rewards: _Array, ended: _Array) -> _Array:
        """Return the shaped rewards of a turn as a numpy array; update the smoothed rewards."""
        if self.reward == "individual":
            return rewards
        if self.reward == "team":
            return np.ones_like(rewards) * rewards.sum(-1)[:, None]
        assert not isinstance(self.reward, str)
        raw = rewards.astype(np.float64)
        if not isinstance(self.reward, InequityAversion):
            return self.reward.shaped(raw).astype(np.float32)
        smoothed = raw.copy()
        if self._smoothed is not None:
            if self._smoothed.shape != rewards.shape:
                raise ValueError(
                    f"rewards is {list(rewards.shape)}; allowed: {list(self._smoothed.shape)}, as in the "
                    "turn before, or clear() before"
                )
            smoothed = self.reward.smoothing * self._smoothed + raw
        shaped = self.reward.shaped(raw, smoothed).astype(np.float32)
        smoothed[ended] = 0
        self._smoothed = smoothed
        return shaped

    def clear(self) -> None:
        """Forget the running episodes of all worlds."""
        self._smoothed = self.latest = None

    def state_dict(self) -> dict[str, Tensor]:
        """Return the memory of running episodes: "smoothed", float64 [B, N]; empty if there is none."""
        return {} if self._smoothed is None else {"smoothed": torch.from_numpy(self._smoothed)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continue from a state that `state_dict` returned.

        Raises:
            ValueError: if the state is not [B, N], or the reward has no memory.
        """
        smoothed = state.get("smoothed")
        has_memory = isinstance(self.reward, InequityAversion)
        if smoothed is not None and (smoothed.ndim != 2 or not has_memory):
            allowed = "[worlds, agents]" if has_memory else "none, since this reward remembers nothing"
            raise ValueError(f'"smoothed" of the state is {list(smoothed.shape)}; allowed: {allowed}')
        self.clear()
        if smoothed is not None:
            self._smoothed = smoothed.numpy(force=True).copy()
