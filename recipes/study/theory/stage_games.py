"""Stage games: all that happens is the agents' joint action, once or for several turns; B worlds at once.

Games of one's own: frozen values with `agents`, `to_config` and `make`, as `cprl.envs.make_env` asks for.
matrix_games.py and taking_games.py have such games; cprl itself knows none of them.
"""

from dataclasses import dataclass
from math import log1p
from typing import Annotated, Any, Final

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons.chance import LOW_WORD, WORD_BITS, philox4x32
from cprl.envs.drivers import device_of, drawn_seed
from cprl.envs.stepping import read_choices
from cprl.values import Positive, PositiveShare, Range, Seed, Value, checked

_EPISODE_LENGTH: Final = np.uint64(15 << 28)
"""The purpose of the only draw, of how many turns an episode lasts: the last of the 16 that four bits hold.
`cprl.commons.chance` counts those of a commons from 0."""


@dataclass(frozen=True, kw_only=True)
class StageGame(Value):
    """A game of N agents who act at once, for one turn or several: what `StageEnv` asks of a game.

    An episode of one turn terminates. One of several is truncated: its end is a clock that nobody sees, so
    agents learn as if it went on; with a `continue_prob` below 1 it terminates where no further turn follows.
    """

    turns: Positive = 1
    """Turns of an episode, at most."""
    memory: Annotated[int, Range(0, 64)] | None = None
    """The number of the last turns that agents observe; by default 1, and 0 in a game of one turn, in which
    the observation is the number 1."""
    continue_prob: PositiveShare = 1.0
    """The probability that a further turn follows."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.turns == 1 and self.continue_prob < 1:
            name = type(self).__name__
            raise ValueError(f"{name}.continue_prob is {self.continue_prob}; allowed for one turn: 1.0")

    @property
    def joint_actions(self) -> tuple[str, ...]:
        """Return the names of the joint actions, which the viewer plots; () for no plot."""
        return ()

    @property
    def remembered(self) -> int:
        """Return the number of turns that agents observe: `memory`, or what its default means."""
        return int(self.turns > 1) if self.memory is None else self.memory

    def make(self, worlds: int, seed: int, device: Any, first_world: int = 0) -> "StageEnv":
        """Return its environment, so many worlds."""
        return StageEnv(self, worlds, seed=seed, device=device, first_world=first_world)

    def tables(self, device: torch.device) -> Any:
        """Return the tensors by which a game pays, on a device; `blank` of them is what agents remember of a
        turn before the first."""
        raise NotImplementedError

    def pay(self, tables: Any, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rewards of a joint action, float32 [B, N], in a new tensor, and what each agent may
        remember of it, [B, N, ...]."""
        raise NotImplementedError

    def observe(self, tables: Any, memory: Tensor) -> Tensor:
        """Return what agents see of the turns that they remember, float32 [B, N, size], in a new tensor."""
        raise NotImplementedError


class StageEnv(EnvBase):
    """B worlds of a stage game, batch size [B], all agents in the group "agents".

    Entries: ("agents", "action") int64 [B, N], 0 to A - 1, ("agents", "reward") float32 [B, N, 1],
    ("agents", "observation") float32 [B, N, size] in 0..1, the number 1 where nothing is remembered; done,
    terminated and truncated bool [B, 1], at the root only. A world that has ended and is stepped again stays
    as it is, pays nothing and stays ended. Every step writes to new tensors. A world's lengths of episodes
    follow from seed, world and episode alone.

    Args:
        seed: of the lengths of episodes, where they have chance; None draws one from torch's generator.
        first_world: the number of the first world: its episodes are as long as those of that world in a
            larger batch.
    """

    batch_locked = True

    def __init__(
        self,
        game: StageGame,
        worlds: int = 1,
        *,
        seed: int | None = None,
        device: str | torch.device = "cpu",
        first_world: int = 0,
    ) -> None:
        worlds = checked("worlds", worlds, Annotated[int, Range(1, 2**32)])
        super().__init__(device=device_of(device), batch_size=torch.Size([worlds]))
        self.game = game
        self.joint_actions = game.joint_actions
        self._first_world = checked("first_world", first_world, Annotated[int, Range(0, 2**32 - 1)])
        self.group_map = {keys.AGENTS: [f"agent_{agent}" for agent in range(game.agents)]}
        self._each = torch.Size([worlds, game.agents])
        self.register_buffer("turn", torch.zeros(worlds, 1, dtype=torch.int64, device=self.device))
        """The turns played in this episode, like all that follow of each world, [B, 1]."""
        self.register_buffer("last_turn", torch.zeros_like(self.turn))
        """The turn at which this episode ends."""
        self.register_buffer("episode", torch.zeros_like(self.turn))
        """The number of the episode from 1."""
        self.register_buffer("is_final", torch.zeros_like(self.turn, dtype=torch.bool))
        """Whether it terminates at its last turn."""
        self.register_buffer("seed_bits", torch.zeros((), dtype=torch.int64))
        self._set_seed(seed)
        self._tables = game.tables(self.device)
        shape = (*self._each, game.remembered, *self._tables.blank.shape)
        self.register_buffer("memory", self._tables.blank.expand(shape).clone())
        """The last turns, [B, N, remembered, ...], the last one first."""

        def group(name: str, spec: TensorSpec) -> Composite:
            agents = Composite({name: spec}, shape=self._each)
            return Composite({keys.AGENTS: agents}, shape=self.batch_size).to(self.device)

        self.observation_spec = group(
            "observation", Bounded(0, 1, shape=self._observe().shape, dtype=torch.float32)
        )
        self.action_spec = group("action", Categorical(game.actions, shape=self._each, dtype=torch.int64))
        self.reward_spec = group("reward", Unbounded(shape=(*self._each, 1), dtype=torch.float32))
        flags = {name: Categorical(2, shape=(worlds, 1), dtype=torch.bool) for name in self._ends()}
        self.done_spec = Composite(flags, shape=self.batch_size).to(self.device)

    def __repr__(self) -> str:
        worlds, agents = self._each
        return f"{type(self).__name__}({agents} agents, worlds={worlds}, device={str(self.device)!r})"

    def _observe(self) -> Tensor:
        if not self.game.remembered:
            return torch.ones(*self._each, 1, device=self.device)
        return self.game.observe(self._tables, self.memory)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = read_choices(tensordict, "action", self._each, self.device)
        lowest, highest = action.aminmax()
        if lowest < 0 or highest >= self.game.actions:
            raise ValueError(
                f'("agents", "action") has numbers from {int(lowest)} to {int(highest)}; allowed: 0 to '
                f"{self.game.actions - 1}"
            )
        is_over = self.turn >= self.last_turn
        reward, turn = self.game.pay(self._tables, action)
        if self.game.remembered:
            memory = torch.cat((turn.unsqueeze(2), self.memory[:, :, :-1]), 2)
            self.memory = torch.where(_like(is_over, memory), self.memory, memory)
        self.turn = torch.where(is_over, self.turn, self.turn + 1)
        return self._output(reward=torch.where(is_over, 0.0, reward).unsqueeze(-1))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        begins = None if tensordict is None else tensordict.get("_reset", None)
        begins = torch.ones_like(self.is_final) if begins is None else begins.reshape(-1, 1)
        self.turn = torch.where(begins, 0, self.turn)
        self.episode = self.episode + begins
        last_turn, is_final = self._lengths()
        self.last_turn = torch.where(begins, last_turn, self.last_turn)
        self.is_final = torch.where(begins, is_final, self.is_final)
        self.memory = torch.where(_like(begins, self.memory), self._tables.blank, self.memory)
        return self._output()

    def _lengths(self) -> tuple[Tensor, Tensor]:
        """Return of each world's current episode its last turn, and whether it terminates then."""
        if self.game.continue_prob == 1.0:
            is_final = self.game.turns == 1
            return torch.full_like(self.turn, self.game.turns), torch.full_like(self.is_final, is_final)
        seed = np.int64(self.seed_bits.item()).astype(np.uint64)
        episode = self.episode.numpy(force=True).astype(np.uint64)
        world = (np.arange(len(episode)) + self._first_world).astype(np.uint64)[:, None]
        zero = np.zeros_like(episode)
        word = philox4x32(_EPISODE_LENGTH + zero, zero, episode, world, seed & LOW_WORD, seed >> WORD_BITS)[0]
        unit = (word.astype(np.float64) + 0.5) / 2**32
        length = torch.from_numpy(1.0 + np.floor(np.log(unit) / log1p(self.game.continue_prob - 1.0)))
        length = length.to(self.device)
        return length.clamp(max=self.game.turns).long(), length <= self.game.turns

    def _output(self, **agents: Tensor) -> TensorDict:
        group = TensorDict({"observation": self._observe(), **agents}, self._each, self.device)
        return TensorDict({keys.AGENTS: group, **self._ends()}, self.batch_size, self.device)

    def _ends(self) -> dict[str, Tensor]:
        """Return which worlds are over, and how they ended."""
        done = self.turn >= self.last_turn
        terminated = done & self.is_final
        return {keys.DONE: done, keys.TERMINATED: terminated, keys.TRUNCATED: done ^ terminated}

    def _set_seed(self, seed: int | None) -> None:
        seed = drawn_seed() if seed is None else checked("seed", seed, Seed)
        self.seed_bits.fill_(int(np.uint64(seed).astype(np.int64)))
        for state in (self.turn, self.last_turn, self.episode, self.is_final):
            state.zero_()


def _like(flags: Tensor, memory: Tensor) -> Tensor:
    """Return flags of worlds, [B, 1], with the axes of a memory."""
    return flags.reshape(-1, *(1,) * (memory.ndim - 1))
