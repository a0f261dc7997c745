"""The rewards that agents want, out of the rewards of all agents."""

from collections.abc import Mapping, Sequence
from math import pi
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from cprl.arguments import object_of
from cprl.checks import checked, shown
from cprl.preferences.values import (
    PREFERENCE,
    Exchange,
    InequityAversion,
    Preference,
    SocialValueOrientation,
    check_preference,
)

Array = Any
"""A numpy array, or a tensor; what is computed from it is of the same kind, on the same device."""

_REWARDS: Final = "numbers [worlds, agents], an array or tensor"
_WHOLE: Final = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


def wanted_rewards(
    preference: Preference, rewards: Array, smoothed: Array | None = None
) -> tuple[Array, Array | None]:
    """The rewards that agents want who all have the same preference, in one turn; a pure function.

    Args:
        preference: what they want.
        rewards: float [B, N], what the environment gives each of N agents in each of B worlds.
        smoothed: float64 [B, N], what the turn before left to remember; None at an episode's first turn.

    Returns:
        The wanted rewards, [B, N]: "individual" those given, as they are; else float32, computed in float64.
        And what is to be remembered, float64 [B, N], for `InequityAversion`; None for all others.

    Raises:
        ValueError: for what is no preference, rewards of another shape, and a comparison with others where
            there are none.
    """
    _check("rewards", rewards)
    check_preference("preference", preference, rewards.shape[1])
    if smoothed is not None:
        _check("smoothed", smoothed)
        if smoothed.shape != rewards.shape or _of_kind(smoothed) is not _of_kind(rewards):
            raise ValueError(
                f"smoothed is {list(smoothed.shape)}; allowed: as rewards, {list(rewards.shape)}"
            )
    with np.errstate(all="ignore"):  # rewards that are not finite are found and named elsewhere
        return _wanted(preference, rewards, smoothed)


def _wanted(preference: Preference, rewards: Array, smoothed: Array | None) -> tuple[Array, Array | None]:
    if preference == "individual":
        return rewards, None
    if preference == "team":
        return _of_kind(rewards).ones_like(rewards) * rewards.sum(-1)[:, None], None
    own = _double(rewards)
    if isinstance(preference, InequityAversion):
        now = own if smoothed is None else preference.smoothing * smoothed + own
        return _single(own - _dislike(preference, now)), now
    of_others = (own.sum(-1)[:, None] - own) / (own.shape[1] - 1)
    if isinstance(preference, SocialValueOrientation):
        return _single(own - preference.weight * _off(preference.angle, own, of_others)), None
    assert isinstance(preference, Exchange)
    return _single((1 - preference.share) * own + preference.share * of_others), None


def _dislike(preference: InequityAversion, smoothed: Array) -> Array:
    """What each agent loses by inequity, [B, N]."""
    difference = smoothed[:, None, :] - smoothed[:, :, None]  # [B, own, other]: above 0 where own is behind
    behind, ahead = difference.clip(min=0).sum(-1), (-difference).clip(min=0).sum(-1)
    loss: Array = (preference.alpha * behind + preference.beta * ahead) / (smoothed.shape[1] - 1)
    return loss


def _off(angle: float, own: Array, of_others: Array) -> Array:
    """How far each agent's share is from the one it likes, radians [B, N]; 0 where nobody gets anything."""
    kind = _of_kind(own)
    plain = abs(kind.arctan2(of_others, own) - angle)
    shorter = kind.where(plain > pi, 2 * pi - plain, plain)
    return kind.where((own == 0) & (of_others == 0), kind.zeros_like(own), shorter)


def _check(name: str, array: Array) -> None:
    """Refuses what are no numbers [B, N]."""
    if isinstance(array, Tensor):
        fits = array.ndim == 2 and (array.is_floating_point() or array.dtype in _WHOLE)
    else:
        fits = isinstance(array, np.ndarray) and array.ndim == 2 and array.dtype.kind in "fiu"
    if not fits:
        raise ValueError(f"{name} is {shown(array)}; allowed: {_REWARDS}")


def _of_kind(array: Array) -> Any:
    return torch if isinstance(array, Tensor) else np


def _double(array: Array) -> Array:
    """A copy in float64."""
    return array.to(torch.float64, copy=True) if isinstance(array, Tensor) else array.astype(np.float64)


def _single(array: Array) -> Array:
    return array.float() if isinstance(array, Tensor) else array.astype(np.float32, copy=False)


def _like(array: Array, other: Array) -> Array:
    """The same values as the kind of array that another one is, on its device."""
    if isinstance(other, Tensor):
        return torch.as_tensor(array, device=other.device)
    return array.numpy(force=True) if isinstance(array, Tensor) else array


class WantedRewards:
    """The rewards that agents want, turn by turn, with what they remember of the running episodes.

    Args:
        preferences: what all agents want; or a preference for each of the N agents.

    Raises:
        ValueError: for what is no preference.
    """

    def __init__(self, preferences: Preference | Sequence[Preference]) -> None:
        self.preferences = preferences
        listed = tuple(preferences) if isinstance(preferences, list | tuple) else None
        for place, own in enumerate(listed or ()):
            checked(f"preferences[{place}]", own, PREFERENCE)
        if not listed:
            checked("preferences", preferences, PREFERENCE)
        self._listed = listed
        kinds: Any = dict.fromkeys(listed) if listed else [preferences]
        self._columns = {
            own: [agent for agent, other in enumerate(listed or ()) if other == own] for own in kinds
        }
        self._smoothed: dict[Preference, Array] = {}
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
        for own in self._columns:
            check_preference("preferences", own, agents)
        self._agents = agents

    def add(self, rewards: Array, ended: Array) -> Array:
        """The rewards wanted in the next turn of all worlds.

        Args:
            rewards: float [B, N], what the environment gives.
            ended: bool [B], the worlds whose episode ends with this turn; they remember nothing of it.

        Returns:
            The wanted rewards, [B, N], a numpy array or a tensor as `rewards`.

        Raises:
            ValueError: for another number of agents, or of worlds than before.
        """
        _check("rewards", rewards)
        if rewards.shape[1] != self._agents:
            self.check_agents(rewards.shape[1])
        wanted = None
        for preference, columns in self._columns.items():
            before = self._before(preference, rewards)
            with np.errstate(all="ignore"):
                own, after = _wanted(preference, rewards, before)
            if after is not None:
                after[ended] = 0
                self._smoothed[preference] = after
            if not self._listed:
                wanted = own
            else:
                wanted = _of_kind(own).zeros_like(_single(rewards)) if wanted is None else wanted
                wanted[:, columns] = _single(own)[:, columns]
        self.now = wanted
        return wanted

    def _before(self, preference: Preference, rewards: Array) -> Array | None:
        """What is remembered, as the same kind of array as rewards."""
        kept = self._smoothed.get(preference)
        if kept is None:
            return None
        if kept.shape != rewards.shape:
            raise ValueError(
                f"rewards is {list(rewards.shape)}; allowed: {list(kept.shape)}, as in the turn before, "
                "or clear() before"
            )
        return _like(kept, rewards)

    def clear(self, worlds: Array | None = None) -> None:
        """Forgets the episodes of the marked worlds, bool [B]; by default of all."""
        self.now = None
        if worlds is None:
            self._smoothed = {}
            return
        for preference, kept in self._smoothed.items():
            left = kept.clone() if isinstance(kept, Tensor) else kept.copy()
            left[_like(worlds, kept)] = 0
            self._smoothed[preference] = left

    def state_dict(self) -> dict[str, Tensor]:
        """What is remembered: "smoothed" float64 [K, B, N], for each of the K preferences that remember, in
        the order of their first agents; empty if nothing is."""
        kept = [torch.as_tensor(self._smoothed[own]) for own in self._columns if own in self._smoothed]
        return {"smoothed": torch.stack(kept)} if kept else {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continues from a state that `state_dict` returned.

        Raises:
            ValueError: if it is that of other preferences.
        """
        object_of("state", state, Mapping, "a value of state_dict()")
        remember = [own for own in self._columns if isinstance(own, InequityAversion)]
        kept = state.get("smoothed")
        if kept is not None and (kept.ndim != 3 or len(kept) != len(remember)):
            raise ValueError(
                f'"smoothed" of the state is {list(kept.shape)}; allowed: [{len(remember)}, worlds, agents], '
                "a table for each preference that remembers"
            )
        self.now = None
        self._smoothed = {} if kept is None else dict(zip(remember, kept.clone(), strict=True))
