"""JointActionEnv: B worlds of a game in which all that happens is the agents' joint action."""

from abc import abstractmethod
from collections.abc import Callable
from math import log1p
from typing import Any, Final

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from cprl import arguments, keys
from cprl.commons.chance import LOW_WORD, WORD_BITS, philox4x32
from cprl.compat import LeanStepEnv, flag_spec, put_all, unchecked_tensordict
from cprl.envs.drivers import device_of, drawn_seed
from cprl.envs.recurrent_states import begin_states

_OWN_KEYS: Final = frozenset((keys.AGENTS, keys.DONE, keys.TERMINATED, keys.TRUNCATED, "next", "_reset"))
_OWN_AGENT_KEYS: Final = frozenset(("observation", "reward"))
_LENGTH: Final = np.uint64(5 << 28)
"""The purpose of a draw in `cprl.commons.chance`: how many turns an episode lasts."""


class JointActionEnv(LeanStepEnv):
    """B worlds of N agents; an episode lasts a number of turns, or goes on after each with a probability.

    Dones are at the root only. A world that has ended and is stepped again stays as it is, pays nothing and
    stays ended. Every step writes to new tensors. A world's lengths of episodes follow from seed, world and
    episode alone.

    Args:
        agents: N.
        observation_size: the length of an agent's observation, float32 [B, N, size], numbers in 0..1.
        action: makes the spec of ("agents", "action") for a shape, [B, N].
        turns: the largest number of turns of an episode, which is truncated then; a game of one turn
            terminates, since nothing follows.
        continue_prob: the probability that a further turn follows; where none does, the episode terminates.
        worlds: B.
        seed: of the lengths of episodes; None draws one from torch's generator.
        device: where the worlds are, "cpu" or "cuda".
        first_world: the number of the first world.

    Raises:
        ValueError: for another number of worlds, seed or device, and in `step` for actions that are missing
            or of another form, or out of range; then nothing changes.
    """

    batch_locked = True

    def __init__(
        self,
        *,
        agents: int,
        observation_size: int,
        action: Callable[[torch.Size], TensorSpec],
        turns: int,
        continue_prob: float,
        worlds: int,
        seed: int | None,
        device: Any,
        first_world: int,
    ) -> None:
        worlds = arguments.integer("worlds", worlds, 1, 2**32)
        first_world = arguments.integer("first_world", first_world, 0, 2**32 - 1)
        device = device_of(device)
        super().__init__(device=device, batch_size=torch.Size([worlds]))
        self.group_map = {keys.AGENTS: [f"agent_{agent}" for agent in range(agents)]}
        self._agents_size = torch.Size([worlds, agents])
        self._turns, self._continue_prob, self._first_world = turns, continue_prob, first_world
        self._never = torch.zeros(worlds, 1, dtype=torch.bool, device=device)
        for name, dtype in _STATE.items():
            self.register_buffer(name, torch.zeros(worlds, 1, dtype=dtype, device=device))
        self.register_buffer("seed_bits", torch.zeros((), dtype=torch.int64))
        self._set_seed(seed)
        self._make_specs(observation_size, action(self._agents_size))

    def __repr__(self) -> str:
        worlds, agents = self._agents_size
        return f"{type(self).__name__}({agents} agents, worlds={worlds}, device={str(self.device)!r})"

    def _make_specs(self, observation_size: int, action: TensorSpec) -> None:
        size, of_agents = self.batch_size, self._agents_size

        def group(name: str, spec: TensorSpec) -> Composite:
            agents = Composite({name: spec}, shape=of_agents, device=self.device)
            return Composite({keys.AGENTS: agents}, shape=size, device=self.device)

        seen, paid = (*of_agents, observation_size), (*of_agents, 1)
        self.observation_spec = group(
            "observation", Bounded(0, 1, shape=seen, dtype=torch.float32, device=self.device)
        )
        self.action_spec = group("action", action.to(self.device))
        self.reward_spec = group("reward", Unbounded(shape=paid, dtype=torch.float32, device=self.device))
        flag = {name: flag_spec(*size, 1).to(self.device) for name in (keys.DONE, *_ENDS)}
        self.done_spec = Composite(flag, shape=size, device=self.device)

    @abstractmethod
    def checked_action(self, action: Any) -> Tensor:
        """("agents", "action") in the form that `pay` reads; raises a ValueError for anything else."""

    @abstractmethod
    def pay(self, action: Tensor, over: Tensor | None) -> Tensor:
        """The rewards of a joint action, float32 [B, N], in a new tensor; the game keeps what it remembers of
        it, except in worlds that are over, bool [B, 1] (None: in none)."""

    @abstractmethod
    def observe(self) -> Tensor:
        """What agents see now, float32 [B, N, size], in a new tensor."""

    def forget(self, which: Tensor | None) -> None:
        """Puts what the game remembers to how episodes begin in these worlds, bool [B, 1] (None: in all)."""

    def lean_step(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Does the same as `EnvBase.step_and_maybe_reset`, without its handling of keys; a test checks it."""
        following = self._step(tensordict)
        keys.put(tensordict, "next", following)
        done = keys.entry(following, keys.DONE)
        if done.any():
            carried = self._reset_worlds(done)
        else:
            observation = keys.entry(keys.entry(following, keys.AGENTS), "observation")
            ends = {name: keys.entry(following, name) for name in (keys.DONE, *_ENDS)}
            carried = self._moment({"observation": observation}, ends)
        put_all(carried, {name: value for name, value in tensordict.items() if name not in _OWN_KEYS})
        of_agents = keys.entry(tensordict, keys.AGENTS).items()
        others = {name: value for name, value in of_agents if name not in _OWN_AGENT_KEYS}
        put_all(keys.entry(carried, keys.AGENTS), others)
        if keys.RECURRENT_STATE[1] in others:
            begin_states(carried, tensordict, done)
        return tensordict, carried

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        try:
            action = keys.entry(keys.entry(tensordict, keys.AGENTS), "action")
        except (KeyError, AttributeError):
            raise ValueError('("agents", "action") is missing; allowed: one for each agent') from None
        action = self.checked_action(action)
        own = self._buffers
        over: Any = own["turn"] >= own["last_turn"]
        is_any_over = bool(over.any())
        paid = self.pay(action, over if is_any_over else None)
        if is_any_over:
            paid = torch.where(over, 0.0, paid)
            own["turn"] = torch.where(over, own["turn"], own["turn"] + 1)
        else:
            own["turn"] = own["turn"] + 1
        done: Any = own["turn"] >= own["last_turn"]
        ends = {keys.DONE: done, keys.TERMINATED: done & own["is_final"]}
        ends[keys.TRUNCATED] = done ^ ends[keys.TERMINATED]
        return self._moment({"observation": self.observe(), "reward": paid.unsqueeze(-1)}, ends)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        which = None if tensordict is None else tensordict.get("_reset", None)
        if which is not None and (which.dtype != torch.bool or which.numel() != self.batch_size.numel()):
            raise ValueError(
                f'"_reset" is {which.dtype} {list(which.shape)}; allowed: bool [{self.batch_size[0]}, 1]'
            )
        begun = self._reset_worlds(None if which is None else which.reshape(-1, 1))
        if tensordict is not None:
            begin_states(begun, tensordict, which)
        return begun

    def _reset_worlds(self, which: Tensor | None) -> TensorDict:
        """Begins the next episode of these worlds, bool [B, 1] (None: of all)."""
        own: Any = self._buffers
        marked = ~self._never if which is None else which
        own["turn"] = torch.where(marked, 0, own["turn"])
        own["episode"] = own["episode"] + marked
        if self._continue_prob < 1.0:
            last_turn, is_final = self._lengths()
            own["last_turn"] = torch.where(marked, last_turn, own["last_turn"])
            own["is_final"] = torch.where(marked, is_final, own["is_final"])
        else:
            own["last_turn"] = own["last_turn"].masked_fill(marked, self._turns)
            own["is_final"] = own["is_final"].masked_fill(marked, self._turns == 1)
        self.forget(which)
        over = own["turn"] >= own["last_turn"]
        ends = {keys.DONE: over, keys.TERMINATED: over & own["is_final"]}
        ends[keys.TRUNCATED] = over ^ ends[keys.TERMINATED]
        return self._moment({"observation": self.observe()}, ends)

    def _lengths(self) -> tuple[Tensor, Tensor]:
        """Of each world's current episode: its last turn, and whether chance ends it then."""
        own: Any = self._buffers
        seed: Any = np.int64(own["seed_bits"].item()).astype(np.uint64)
        episode: Any = own["episode"].numpy(force=True).astype(np.uint64)
        world: Any = (np.arange(len(episode)) + self._first_world).astype(np.uint64)[:, None]
        zero = np.zeros_like(episode)
        word = philox4x32(_LENGTH + zero, zero, episode, world, seed & LOW_WORD, seed >> WORD_BITS)[0]
        unit = (word.astype(np.float64) + 0.5) / 2**32
        length = 1.0 + np.floor(np.log(unit) / log1p(self._continue_prob - 1.0))
        last_turn = np.minimum(length, self._turns).astype(np.int64)
        is_final = length <= self._turns
        return torch.from_numpy(last_turn).to(self.device), torch.from_numpy(is_final).to(self.device)

    def _moment(self, agents: dict[str, Any], ends: dict[str, Any]) -> TensorDict:
        group = unchecked_tensordict(agents, self._agents_size, self.device)
        return unchecked_tensordict({keys.AGENTS: group, **ends}, self.batch_size, self.device)

    def _set_seed(self, seed: int | None) -> None:
        seed = drawn_seed() if seed is None else arguments.seed(seed)
        self.seed_bits.fill_(int(np.uint64(seed).astype(np.int64)))
        for name in _STATE:
            self._buffers[name] = torch.zeros_like(self._buffers[name])


_ENDS: Final = (keys.TERMINATED, keys.TRUNCATED)
_STATE: Final = {
    "turn": torch.int64,
    "last_turn": torch.int64,
    "episode": torch.int64,
    "is_final": torch.bool,
}
"""Of each world, [B, 1]: turns played in this episode, the turn at which it ends, the episode's number from
1, and whether it terminates there."""
