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

from cprl import keys, recurrent_state
from cprl.commons.chance import LOW_WORD, WORD_BITS, philox4x32
from cprl.envs.drivers import device_of, drawn_seed
from cprl.envs.stepping import carry_on, chosen
from cprl.system.compat import LeanStepEnv, flag_spec, unchecked_tensordict
from cprl.values import Positive, PositiveShare, Range, Seed, Value, checked

_REPLACED: Final = frozenset(
    (keys.AGENTS, keys.DONE, keys.TERMINATED, keys.TRUNCATED, "next", "_reset", "observation", "reward")
)
"""The entries that the environment writes anew in each turn."""
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
    """How many of the last turns agents observe; by default 1, and 0 in a game of one turn, in which the
    observation is the number 1."""
    continue_prob: PositiveShare = 1.0
    """The probability that a further turn follows."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.turns == 1 and self.continue_prob < 1:
            name = type(self).__name__
            raise ValueError(f"{name}.continue_prob is {self.continue_prob}; allowed for one turn: 1.0")

    @property
    def joint_actions(self) -> tuple[str, ...]:
        """The names of the joint actions, which the viewer plots; () for no plot."""
        return ()

    @property
    def remembered(self) -> int:
        """The number of turns that agents observe: `memory`, or what its default means."""
        return int(self.turns > 1) if self.memory is None else self.memory

    def make(self, worlds: int, seed: int, device: Any, first_world: int = 0) -> "StageEnv":
        """Return its environment, so many worlds."""
        return StageEnv(self, worlds, seed=seed, device=device, first_world=first_world)

    def tables(self, device: torch.device) -> Any:
        """The tensors by which a game pays, on a device; `blank` of them is what agents remember of a turn
        before the first."""
        raise NotImplementedError

    def pay(self, tables: Any, action: Tensor) -> tuple[Tensor, Tensor]:
        """The rewards of a joint action, float32 [B, N], in a new tensor, and what each agent may remember of
        it, [B, N, ...]."""
        raise NotImplementedError

    def observe(self, tables: Any, memory: Tensor) -> Tensor:
        """What agents see of the turns that they remember, float32 [B, N, size], in a new tensor."""
        raise NotImplementedError


class StageEnv(LeanStepEnv):
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
        game: Any,
        worlds: int = 1,
        *,
        seed: int | None = None,
        device: str | torch.device = "cpu",
        first_world: int = 0,
    ) -> None:
        worlds = checked("worlds", worlds, Annotated[int, Range(1, 2**32)])
        first_world = checked("first_world", first_world, Annotated[int, Range(0, 2**32 - 1)])
        device = device_of(device)
        super().__init__(device=device, batch_size=torch.Size([worlds]))
        self.game = game
        self.joint_actions = game.joint_actions
        self._first_world = first_world
        self.group_map = {keys.AGENTS: [f"agent_{agent}" for agent in range(game.agents)]}
        self._agents_size = torch.Size([worlds, game.agents])
        for name, dtype in _STATE.items():
            self.register_buffer(name, torch.zeros(worlds, 1, dtype=dtype, device=device))
        self.register_buffer("seed_bits", torch.zeros((), dtype=torch.int64))
        self._set_seed(seed)
        self._tables = game.tables(device)
        shape = *self._agents_size, game.remembered, *self._tables.blank.shape
        self.register_buffer(_MEMORY, self._tables.blank.expand(shape).clone())
        self._make_specs()

    def __repr__(self) -> str:
        worlds, agents = self._agents_size
        return f"{type(self).__name__}({agents} agents, worlds={worlds}, device={str(self.device)!r})"

    def _make_specs(self) -> None:
        size, of_agents = self.batch_size, self._agents_size

        def group(name: str, spec: TensorSpec) -> Composite:
            agents = Composite({name: spec}, shape=of_agents, device=self.device)
            return Composite({keys.AGENTS: agents}, shape=size, device=self.device)

        seen, paid = self._observe().shape, (*of_agents, 1)
        self.observation_spec = group(
            "observation", Bounded(0, 1, shape=seen, dtype=torch.float32, device=self.device)
        )
        action = Categorical(self.game.actions, shape=of_agents, dtype=torch.int64)
        self.action_spec = group("action", action.to(self.device))
        self.reward_spec = group("reward", Unbounded(shape=paid, dtype=torch.float32, device=self.device))
        flag = {name: flag_spec(*size, 1).to(self.device) for name in (keys.DONE, *_ENDS)}
        self.done_spec = Composite(flag, shape=size, device=self.device)

    def _observe(self) -> Tensor:
        if not self.game.remembered:
            return torch.ones(*self._agents_size, 1, device=self.device)
        seen: Tensor = self.game.observe(self._tables, self._buffers[_MEMORY])
        return seen

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
        carry_on(carried, tensordict, done, _REPLACED)
        return tensordict, carried

    def _checked_action(self, tensordict: TensorDictBase) -> Tensor:
        """("agents", "action"); raises a ValueError unless it is [B, N] of integers from 0 to A - 1."""
        action = chosen(tensordict, "action", self._agents_size, self.device)
        lowest, highest = action.aminmax()
        if lowest < 0 or highest >= self.game.actions:
            raise ValueError(
                f'("agents", "action") has numbers from {int(lowest)} to {int(highest)}; allowed: 0 to '
                f"{self.game.actions - 1}"
            )
        return action

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = self._checked_action(tensordict)
        state: Any = self._buffers
        over = state["turn"] >= state["last_turn"]
        paid, turn = self.game.pay(self._tables, action)
        if self.game.remembered:
            before = state[_MEMORY]
            memory = torch.cat((turn.unsqueeze(2), before[:, :, :-1]), 2)
            state[_MEMORY] = torch.where(_like(over, memory), before, memory)
        paid = torch.where(over, 0.0, paid)
        state["turn"] = torch.where(over, state["turn"], state["turn"] + 1)
        return self._moment({"observation": self._observe(), "reward": paid.unsqueeze(-1)}, self._ends())

    def _ends(self) -> dict[str, Any]:
        """Which worlds are over, and how they ended."""
        state: Any = self._buffers
        done = state["turn"] >= state["last_turn"]
        terminated = done & state["is_final"]
        return {keys.DONE: done, keys.TERMINATED: terminated, keys.TRUNCATED: done ^ terminated}

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        which = None if tensordict is None else tensordict.get("_reset", None)
        begun = self._reset_worlds(None if which is None else which.reshape(-1, 1))
        if tensordict is not None:
            recurrent_state.carry(begun, tensordict, which)
        return begun

    def _reset_worlds(self, which: Tensor | None) -> TensorDict:
        """Begins the next episode of these worlds, bool [B, 1] (None: of all)."""
        state: Any = self._buffers
        marked = torch.ones_like(state["is_final"]) if which is None else which
        state["turn"] = torch.where(marked, 0, state["turn"])
        state["episode"] = state["episode"] + marked
        if self.game.continue_prob < 1.0:
            last_turn, is_final = self._lengths()
            state["last_turn"] = torch.where(marked, last_turn, state["last_turn"])
            state["is_final"] = torch.where(marked, is_final, state["is_final"])
        else:
            state["last_turn"] = state["last_turn"].masked_fill(marked, self.game.turns)
            state["is_final"] = state["is_final"].masked_fill(marked, self.game.turns == 1)
        memory = state[_MEMORY]
        state[_MEMORY] = torch.where(_like(marked, memory), self._tables.blank, memory)
        return self._moment({"observation": self._observe()}, self._ends())

    def _lengths(self) -> tuple[Tensor, Tensor]:
        """Of each world's current episode: its last turn, and whether chance ends it then."""
        state: Any = self._buffers
        seed: Any = np.int64(state["seed_bits"].item()).astype(np.uint64)
        episode: Any = state["episode"].numpy(force=True).astype(np.uint64)
        world: Any = (np.arange(len(episode)) + self._first_world).astype(np.uint64)[:, None]
        zero = np.zeros_like(episode)
        word = philox4x32(_EPISODE_LENGTH + zero, zero, episode, world, seed & LOW_WORD, seed >> WORD_BITS)[0]
        unit = (word.astype(np.float64) + 0.5) / 2**32
        length = 1.0 + np.floor(np.log(unit) / log1p(self.game.continue_prob - 1.0))
        last_turn = np.minimum(length, self.game.turns).astype(np.int64)
        is_final = length <= self.game.turns
        return torch.from_numpy(last_turn).to(self.device), torch.from_numpy(is_final).to(self.device)

    def _moment(self, agents: dict[str, Any], ends: dict[str, Any]) -> TensorDict:
        group = unchecked_tensordict(agents, self._agents_size, self.device)
        return unchecked_tensordict({keys.AGENTS: group, **ends}, self.batch_size, self.device)

    def _set_seed(self, seed: int | None) -> None:
        seed = drawn_seed() if seed is None else checked("seed", seed, Seed)
        self.seed_bits.fill_(int(np.uint64(seed).astype(np.int64)))
        for name in _STATE:
            self._buffers[name] = torch.zeros_like(self._buffers[name])


def _like(flags: Tensor, memory: Tensor) -> Tensor:
    """Flags of worlds, [B, 1], with the axes of a memory."""
    return flags.reshape(-1, *(1,) * (memory.ndim - 1))


_MEMORY: Final = "memory"
"""The buffer of the last turns, [B, N, remembered, ...], the last one first."""
_ENDS: Final = (keys.TERMINATED, keys.TRUNCATED)
_STATE: Final = {
    "turn": torch.int64,
    "last_turn": torch.int64,
    "episode": torch.int64,
    "is_final": torch.bool,
}
"""Of each world, [B, 1]: turns played in this episode, the turn at which it ends, the episode's number from
1, and whether it terminates there."""
