"""PreferenceTransform: rewards as agents want them, for TorchRL programs of one's own."""

from collections.abc import Sequence
from typing import ClassVar, Final

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from cprl import keys
from cprl.checks import TEXT, checked, either, tuple_of
from cprl.preferences.values import Preference
from cprl.preferences.wanted import WantedRewards

_KEY: Final = either(TEXT, tuple_of(TEXT, at_least=1))


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

    Raises:
        ValueError: for what is no preference, and once it is in an environment, for rewards of another shape
            and preferences that its number of agents does not allow.
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
        for name, key in (("in_key", in_key), ("out_key", out_key)):
            checked(name, key, _KEY)
        wants = WantedRewards(preferences)
        super().__init__(in_keys=[in_key], out_keys=[out_key])
        self.wants = wants

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
        """The rewards may be any number."""
        given = reward_spec[self.in_keys[0]] if isinstance(reward_spec, Composite) else None
        if given is None or len(given.shape) < 2 or given.shape[-1] != 1:
            found = None if given is None else list(given.shape)
            raise ValueError(f"the rewards are {found}; allowed: [..., agents, 1], at {self.in_keys[0]!r}")
        self.wants.check_agents(given.shape[-2])
        reward_spec[self.out_keys[0]] = Unbounded(shape=given.shape, dtype=torch.float32, device=given.device)
        return reward_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Not for replay buffers, whose turns need not follow each other.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            "PreferenceTransform is called outside an environment; allowed: TransformedEnv(env, "
            "PreferenceTransform(...)), where every turn follows the one before"
        )

    def get_extra_state(self) -> Tensor:
        """What agents remember, float64 [K, worlds, N], as `WantedRewards.state_dict`; else empty."""
        return self.wants.state_dict().get("smoothed", torch.zeros(0))

    def set_extra_state(self, state: Tensor) -> None:
        """Continues from it."""
        self.wants.load_state_dict({"smoothed": state} if state.numel() else {})
