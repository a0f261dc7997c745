"""What agents want: the reward that an agent learns from, out of the rewards of everybody.

In each preference, N is the number of agents, r_i the reward that the environment gives agent i in a turn
(apples, less fines, plus transfers), and r'_i the reward that agent i wants and learns from. First come the
values of a recipe, then `WantedRewards`, which computes what they want turn by turn; last
`PreferenceTransform` and `PreferenceWrapper`, for TorchRL programs of one's own and for PettingZoo.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

import numpy as np
import torch
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from cprl import keys
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

    def wanted(self, rewards: Float64, _smoothed: Float64) -> Float64:
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

    def wanted(self, rewards: Float64, _smoothed: Float64) -> Float64:
        return (1 - self.share) * rewards + self.share * _mean_of_others(rewards)


def _mean_of_others(rewards: Float64) -> Float64:
    of_others: Float64 = (rewards.sum(-1)[:, None] - rewards) / (rewards.shape[1] - 1)
    return of_others


Preference: TypeAlias = Literal["individual", "team"] | InequityAversion | SocialValueOrientation | Exchange
"""What an agent wants: "individual", its own reward; "team", the sum over all agents; or a comparison of its
own with those of others."""


def check_preference(name: str, preference: Any, agents: int) -> None:
    """Refuses what is no preference, or none for a game of so few agents."""
    checked(name, preference, Preference)
    if agents < 2 and not isinstance(preference, str):
        raise ValueError(
            f"{name} is {named(preference)}, which compares an agent with others, in a game of {agents} "
            "agent; allowed there: 'individual', 'team'"
        )


def named(preference: object) -> str:
    """A preference as messages name it: "team" in quotes, a value by its class."""
    return f'"{preference}"' if isinstance(preference, str) else type(preference).__name__


class WantedRewards:
    """The rewards that agents want, turn by turn, with what they remember of the running episodes.

    Args:
        preferences: what all agents want; or a preference for each of the N agents.
    """

    def __init__(self, preferences: Preference | Sequence[Preference]) -> None:
        self.preferences = preferences
        listed: Any = preferences if isinstance(preferences, list | tuple) and preferences else ()
        for place, preference in enumerate(listed):
            checked(f"preferences[{place}]", preference, Preference)
        if not listed:
            checked("preferences", preferences, Preference)
        self._listed = tuple(listed)
        kinds: Any = dict.fromkeys(self._listed or [preferences])
        self._agents_of = {
            preference: [agent for agent, other in enumerate(self._listed) if other == preference]
            for preference in kinds
        }
        self._smoothed: dict[Preference, Float64] = {}
        self._agents: int | None = None
        self.now: Array | None = None
        """[B, N], the wanted rewards of the latest turn; None before the first."""

    def check_agents(self, agents: int) -> None:
        """Raises a ValueError if these cannot be the preferences of N agents."""
        if self._listed and len(self._listed) != agents:
            raise ValueError(
                f"preferences has {len(self._listed)} entries; allowed: one preference for all agents, "
                f"or one for each of {agents}"
            )
        for preference in self._agents_of:
            check_preference("preferences", preference, agents)
        self._agents = agents

    def add(self, rewards: Array, ended: Array) -> Array:
        """Return the rewards wanted in the next turn of all worlds, a numpy array or a tensor as `rewards`.

        Args:
            rewards: float [B, N], what the environment gives.
            ended: bool [B], the worlds whose episode ends with this turn; they remember nothing of it.

        Returns:
            [B, N]: where all want their own those given, as they are; else float32, computed in float64.
        """
        if rewards.shape[1] != self._agents:
            self.check_agents(rewards.shape[1])
        if isinstance(rewards, Tensor):
            wanted = self.add(rewards.numpy(force=True), ended.numpy(force=True))
            self.now = torch.as_tensor(wanted, device=rewards.device)
            return self.now
        with np.errstate(all="ignore"):  # rewards that are not finite are found and named elsewhere
            if not self._listed:
                (preference,) = self._agents_of
                self.now = self._wanted(preference, rewards, ended)
                return self.now
            self.now = np.empty(rewards.shape, np.float32)
            for preference, agents in self._agents_of.items():
                self.now[:, agents] = self._wanted(preference, rewards, ended)[:, agents]
        return self.now

    def _wanted(self, preference: Preference, rewards: Array, ended: Array) -> Array:
        if preference == "individual":
            return rewards
        if preference == "team":
            return np.ones_like(rewards) * rewards.sum(-1)[:, None]
        assert not isinstance(preference, str)
        given = smoothed = rewards.astype(np.float64)
        if isinstance(preference, InequityAversion):
            smoothed = given.copy()
            if (before := self._smoothed.get(preference)) is not None:
                if before.shape != rewards.shape:
                    raise ValueError(
                        f"rewards is {list(rewards.shape)}; allowed: {list(before.shape)}, as in the turn "
                        "before, or clear() before"
                    )
                smoothed = preference.smoothing * before + given
        wanted = preference.wanted(given, smoothed).astype(np.float32)
        if isinstance(preference, InequityAversion):
            smoothed[ended] = 0
            self._smoothed[preference] = smoothed
        return wanted

    def clear(self, worlds: Array | None = None) -> None:
        """Forgets the episodes of the marked worlds, bool [B]; by default of all."""
        self.now = None
        if worlds is None:
            self._smoothed = {}
            return
        marked = worlds.numpy(force=True) if isinstance(worlds, Tensor) else worlds
        for preference, smoothed in self._smoothed.items():
            self._smoothed[preference] = np.where(marked[:, None], 0.0, smoothed)

    def state_dict(self) -> dict[str, Tensor]:
        """What is remembered: "smoothed" float64 [K, B, N], for each of the K preferences that remember, in
        the order of their first agents; empty if nothing is."""
        tables = [self._smoothed[kind] for kind in self._agents_of if kind in self._smoothed]
        return {"smoothed": torch.from_numpy(np.stack(tables))} if tables else {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        remember = [kind for kind in self._agents_of if isinstance(kind, InequityAversion)]
        smoothed = state.get("smoothed")
        if smoothed is not None and (smoothed.ndim != 3 or len(smoothed) != len(remember)):
            raise ValueError(
                f'"smoothed" of the state is {list(smoothed.shape)}; allowed: [{len(remember)}, worlds, '
                "agents], a table for each preference that remembers"
            )
        self.now = None
        tables = () if smoothed is None else smoothed.numpy(force=True).copy()
        self._smoothed = dict(zip(remember, tables, strict=False))


class PreferenceTransform(Transform):
    """Rewrites the rewards of a group of agents as they want them, or adds an entry with them.

    In an `Experiment` say `Learning(algorithm, reward=...)` instead: the table of episodes then still has the
    returns of the environment. Here they are those that this transform writes.

    What agents remember of an episode is cleared where it ends and where the environment is reset, world by
    world, and is in the `state_dict`.

    Args:
        preferences: what all agents want; or a preference for each of the N agents.
        in_key: the environment's rewards, float [..., N, 1].
        out_key: where the wanted ones are written, float32 [..., N, 1]; by default in their place.
    """

    remembers_worlds: ClassVar[bool] = True
    """That its extra state is of the worlds that are played, so that no other worlds begin with it."""

    def __init__(
        self,
        preferences: Preference | Sequence[Preference],
        *,
        in_key: NestedKey = keys.REWARD,
        out_key: NestedKey | None = None,
    ) -> None:
        out_key = in_key if out_key is None else out_key
        super().__init__(in_keys=[in_key], out_keys=[out_key])
        self.wants = WantedRewards(preferences)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        given = next_tensordict.get(self.in_keys[0])
        rewards = given.reshape(-1, given.shape[-2])
        done = next_tensordict.get(keys.DONE, None)
        ended = torch.zeros(len(rewards), dtype=torch.bool) if done is None else done.reshape(-1)
        wanted = self.wants.add(rewards, ended.to(rewards.device))
        next_tensordict.set(self.out_keys[0], wanted.reshape(given.shape).clone())
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        marked = None if tensordict is None else tensordict.get("_reset", None)
        self.wants.clear(None if marked is None or marked.all() else marked.reshape(-1))
        return tensordict_reset

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        given = reward_spec[self.in_keys[0]] if isinstance(reward_spec, Composite) else None
        if given is None or len(given.shape) < 2 or given.shape[-1] != 1:
            shape = None if given is None else list(given.shape)
            raise ValueError(f"the rewards are {shape}; allowed: [..., agents, 1], at {self.in_keys[0]!r}")
        self.wants.check_agents(given.shape[-2])
        reward_spec[self.out_keys[0]] = Unbounded(shape=given.shape, dtype=torch.float32, device=given.device)
        return reward_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Not for replay buffers, whose turns need not follow each other."""
        raise ValueError(
            "PreferenceTransform is called outside an environment; allowed: TransformedEnv(env, "
            "PreferenceTransform(...)), where every turn follows the one before"
        )

    def get_extra_state(self) -> Tensor:
        """What agents remember, float64 [K, worlds, N], as `WantedRewards.state_dict`; else empty."""
        return self.wants.state_dict().get("smoothed", torch.zeros(0))

    def set_extra_state(self, state: Tensor) -> None:
        self.wants.load_state_dict({"smoothed": state} if state.numel() else {})


class PreferenceWrapper(BaseParallelWrapper[str, Any, Any]):
    """A PettingZoo `ParallelEnv` whose agents get the rewards that they want.

    The environment's own reward is in `infos`, as "env_reward". An agent that has left the game counts with a
    reward of 0.

    Args:
        preferences: what all agents want; or a preference for each of `env.possible_agents`.
    """

    def __init__(
        self, env: ParallelEnv[str, Any, Any], preferences: Preference | Sequence[Preference]
    ) -> None:
        super().__init__(env)
        self.wants = WantedRewards(preferences)
        self.wants.check_agents(len(env.possible_agents))

    def __repr__(self) -> str:
        return f"PreferenceWrapper({self.env!r})"

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begins the next episode; nothing is remembered of the last one."""
        self.wants.clear()
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: dict[str, Any]) -> Any:
        seen, given, terminations, truncations, infos = self.env.step(actions)
        everyone = self.env.possible_agents
        of_turn = np.array([[given.get(agent, 0.0) for agent in everyone]], np.float32)
        wanted = dict(zip(everyone, self.wants.add(of_turn, np.zeros(1, np.bool_))[0], strict=True))
        infos = {
            agent: {**infos.get(agent, {}), "env_reward": float(reward)} for agent, reward in given.items()
        }
        rewards = {agent: float(reward) for agent, reward in wanted.items() if agent in given}
        return seen, rewards, terminations, truncations, infos
