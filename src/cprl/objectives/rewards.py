"""What agents want: the reward that an agent learns from, out of the rewards of everybody.

In each of these, N is the number of agents, r_i the reward that the environment gives agent i in a turn
(apples, less fines, plus transfers), and r'_i the reward that agent i wants and learns from. First come the
values that a recipe says, each a `Reward`; then `RewardModel`, which computes what agents want turn by turn.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from cprl.values import Range, Share, Value, Where, checked
from cprl.values.arrays import Float64

Array = Any
"""A numpy array, or a tensor."""
Weight = Annotated[float, Range(0, 1e6)]
Angle = Annotated[float, Where(lambda angle: -pi <= angle <= pi, "radians in -pi..pi, e.g. math.radians(45)")]


@dataclass(frozen=True, kw_only=True)
class InequityAversion(Value):
    """Dislikes having less than others, and having more.

    r'_i = r_i - alpha / (N - 1) sum_j max(e_j - e_i, 0) - beta / (N - 1) sum_j max(e_i - e_j, 0), over the
    others j, with smoothed rewards e_i = smoothing x (e_i of the turn before) + r_i, zero before an episode's
    first turn.

    Source: Hughes et al., "Inequity aversion improves cooperation in intertemporal social dilemmas" (2018),
    after Fehr and Schmidt (1999).

    Args:
        alpha: the dislike of being behind (disadvantageous inequity); 5 is usual.
        beta: the dislike of being ahead (advantageous inequity); 0.05 is usual.
        smoothing: the share of smoothed rewards that lasts into the next turn; gamma x lambda of the
            source. With 0 only the rewards of the turn are compared, with 1 the returns so far.
    """

    alpha: Weight
    beta: Weight
    smoothing: Share

    def wanted(self, rewards: Float64, smoothed: Float64) -> Float64:
        """What agents want who get these rewards, [B, N], and have these smoothed ones."""
        # [B, one, other]: above 0 where one is behind
        difference = smoothed[:, None, :] - smoothed[:, :, None]
        behind, ahead = difference.clip(min=0).sum(-1), (-difference).clip(min=0).sum(-1)
        loss: Float64 = (self.alpha * behind + self.beta * ahead) / (rewards.shape[1] - 1)
        return rewards - loss


@dataclass(frozen=True, kw_only=True)
class SocialValueOrientation(Value):
    """Dislikes turns in which rewards are shared in another proportion than it likes.

    r'_i = r_i - weight x |angle - theta_i|, with theta_i = atan2(mean of the others' rewards, r_i), in
    radians. The difference is the shorter way around the circle, 0..pi. In a turn in which r_i and the mean
    of the others are both 0, no angle is defined, and r'_i = r_i = 0.

    Source: McKee et al., "Social Diversity and Social Preferences in Mixed-Motive Reinforcement Learning"
    (2020), where rewards are never negative, so that the shorter way is the plain difference.

    Args:
        angle: the proportion that it likes, in radians: 0 is for itself alone, pi / 4 for both
            alike, pi / 2 for others alone, negative against others.
        weight: reward lost per radian.
    """

    angle: Angle
    weight: Weight

    def wanted(self, rewards: Float64) -> Float64:
        of_others = _mean_of_others(rewards)
        plain = abs(np.arctan2(of_others, rewards) - self.angle)
        shorter = np.where(plain > pi, 2 * pi - plain, plain)
        off = np.where((rewards == 0) & (of_others == 0), np.zeros_like(rewards), shorter)
        return rewards - self.weight * off


@dataclass(frozen=True)
class Exchange(Value):
    """Gives a share of its reward away, and gets one of each other's: r'_i = (1 - share) r_i + share x mean
    of the others' rewards.

    If all agents do, with the same share, the sum of their rewards stays.

    Source: the reward transfers of Willis et al., "Resolving social dilemmas with minimal reward transfer"
    (2024), in which 1 - share is the self-interest level.

    Args:
        share: 0 is the agent's own reward, 1 that of the others alone.
    """

    share: Share

    def wanted(self, rewards: Float64) -> Float64:
        return (1 - self.share) * rewards + self.share * _mean_of_others(rewards)


def _mean_of_others(rewards: Float64) -> Float64:
    of_others: Float64 = (rewards.sum(-1)[:, None] - rewards) / (rewards.shape[1] - 1)
    return of_others


Reward: TypeAlias = Literal["individual", "team"] | InequityAversion | SocialValueOrientation | Exchange
"""What an agent wants: "individual", its own reward; "team", the sum over all agents; or a comparison of its
own with those of others."""


def check_reward(name: str, reward: Any, agents: int) -> None:
    """Refuse what is no `Reward`, or none for a game of so few agents.

    Raises:
        ValueError: names what is given by `name`, e.g. "agents[0].reward".
    """
    checked(name, reward, Reward)
    if agents < 2 and not isinstance(reward, str):
        raise ValueError(
            f"{name} is {reward_name(reward)}, which compares an agent with others, in a game of {agents} "
            "agent; allowed there: 'individual', 'team'"
        )


def reward_name(reward: object) -> str:
    """Return a reward as messages name it: "team" in quotes, a value by its class."""
    return f'"{reward}"' if isinstance(reward, str) else type(reward).__name__


class RewardModel:
    """Compute the rewards that agents want, turn by turn, and remember of the running episodes what that
    needs.

    Args:
        reward: what all agents want.
    """

    def __init__(self, reward: Reward) -> None:
        checked("reward", reward, Reward)
        self.reward = reward
        self._smoothed: Float64 | None = None
        """[B, N], the smoothed rewards after the latest turn, of an `InequityAversion`; None before the
        first."""
        self.now: Array | None = None
        """[B, N], the wanted rewards of the latest turn; None before the first."""

    def add(self, rewards: Array, ended: Array) -> Array:
        """Return the rewards wanted in the next turn of all worlds, a numpy array or a tensor as `rewards`.

        Args:
            rewards: float [B, N], what the environment gives.
            ended: bool [B], the worlds whose episode ends with this turn; they remember nothing of it.

        Returns:
            [B, N]: where all want their own those given, as they are; else float32, computed in float64.
        """
        if isinstance(rewards, Tensor):
            wanted = self.add(rewards.numpy(force=True), ended.numpy(force=True))
            self.now = torch.as_tensor(wanted, device=rewards.device)
            return self.now
        if rewards.shape[1] < 2:
            check_reward("reward", self.reward, rewards.shape[1])
        with np.errstate(all="ignore"):  # rewards that are not finite are found and named elsewhere
            self.now = self._wanted(rewards, ended)
        return self.now

    def _wanted(self, rewards: Array, ended: Array) -> Array:
        if self.reward == "individual":
            return rewards
        if self.reward == "team":
            return np.ones_like(rewards) * rewards.sum(-1)[:, None]
        assert not isinstance(self.reward, str)
        given = rewards.astype(np.float64)
        if not isinstance(self.reward, InequityAversion):
            return self.reward.wanted(given).astype(np.float32)
        smoothed = given.copy()
        if self._smoothed is not None:
            if self._smoothed.shape != rewards.shape:
                raise ValueError(
                    f"rewards is {list(rewards.shape)}; allowed: {list(self._smoothed.shape)}, as in the "
                    "turn before, or clear() before"
                )
            smoothed = self.reward.smoothing * self._smoothed + given
        wanted = self.reward.wanted(given, smoothed).astype(np.float32)
        smoothed[ended] = 0
        self._smoothed = smoothed
        return wanted

    def clear(self) -> None:
        """Forget the running episodes of all worlds."""
        self._smoothed = self.now = None

    def state_dict(self) -> dict[str, Tensor]:
        """What is remembered: "smoothed" float64 [B, N]; empty if nothing is."""
        return {} if self._smoothed is None else {"smoothed": torch.from_numpy(self._smoothed)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        smoothed = state.get("smoothed")
        remembers = isinstance(self.reward, InequityAversion)
        if smoothed is not None and (smoothed.ndim != 2 or not remembers):
            allowed = "[worlds, agents]" if remembers else "none, since this reward remembers nothing"
            raise ValueError(f'"smoothed" of the state is {list(smoothed.shape)}; allowed: {allowed}')
        self.clear()
        if smoothed is not None:
            self._smoothed = smoothed.numpy(force=True).copy()
