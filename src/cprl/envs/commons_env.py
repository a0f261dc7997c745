"""CommonsEnv: B worlds of a commons as one TorchRL environment."""

from collections.abc import Iterable, Mapping
from math import prod
from typing import Annotated, Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded

from cprl import keys
from cprl.commons.batch import Batch
from cprl.commons.game import Game, output_forms
from cprl.commons.world import PLAYING, StepOutput
from cprl.envs.drivers import device_of, drawn_seed, driver_for
from cprl.envs.stepping import carry_on, read_choices
from cprl.keys import recurrent_state
from cprl.pictures.image import world_image
from cprl.system.compat.tensordicts import unchecked_tensordict
from cprl.system.compat.torchrl import LeanStepEnv, flag_spec
from cprl.values import Range, Seed, checked
from cprl.values.array_types import UInt8

_AGENT_ENTRIES: Final = (
    "observation",
    "harvest",
    "in_play",
    "fired",
    "hit_by",
    "tagged_by",
    "cleaned",
    "apple_ahead",
    "fines",
    "transfers",
    "violated",
    "counts",
)
_WORLD_ENTRIES: Final = ("stock", "regrown", "waste", "in_force", "ballots_due")
_DONE_ENTRIES: Final = ("done", "terminated", "truncated")
"""The entries per agent, per world, and those that say whether the episode has ended. A game whose rules
never fill an entry leaves it out."""
_SMALL_OUTPUT_BYTES: Final = 2**16
"""Outputs smaller than this are allocated for several turns at once: one allocation takes as long as playing
a turn of one world."""
_TURNS_PER_ALLOCATION: Final = 16
"""The number of turns whose small outputs share one allocation."""
_WRITTEN_ENTRIES: Final = frozenset(
    (*StepOutput._fields, keys.SEEN, keys.STATE, keys.AGENTS, "next", "_reset")
)
"""The entries that the environment writes in every turn; all others are carried over from the turn before."""


class CommonsEnv(LeanStepEnv):
    """B worlds of a game as one TorchRL environment with batch size [B] and all agents in the group "agents".

    `cprl.keys` describes the entries. "done", "terminated" and "truncated" are at the root only. Stepping a
    world whose episode has ended does not change that world. Every step writes to new tensors, so a
    TensorDict from an earlier step never changes.

    `env.worlds.state()` returns the state of all worlds, and `load` restores it. The `state_dict` of torch is
    empty: TorchRL's `EnvCreator` hands that of one environment to all workers, whose worlds must differ.

    Args:
        worlds: the number of worlds B.
        seed: the seed of all random numbers; `set_seed` restarts from another seed. None draws a seed from
            torch's generator, a different one in each worker process, so that the environments that TorchRL's
            `ParallelEnv`, `SerialEnv` or a collector makes by the same call have different worlds.
        device: "cpu", or "cuda" with a GPU and the package numba-cuda. The worlds and all outputs stay on
            this device.
        threads: the number of CPU threads that share the worlds; None uses all cores where that is faster.
        first_world: the index of the first world: `CommonsEnv(game, 1, first_world=b)` plays the same
            episodes as world b of a larger batch.
        state: whether outputs include the whole board as "state", uint8 [B, 3, H, W].

    Raises:
        ValueError: if an argument is out of range, or if the device is "cuda" and torch or Numba finds no
            GPU. `step` raises it for actions that are missing, unknown, or not int64 [B, N] (other integer
            types are converted); the worlds are then unchanged.
        MemoryError: if the worlds do not fit into memory.
    """

    batch_locked = True

    def __init__(
        self,
        game: Game,
        worlds: int = 1,
        *,
        seed: int | None = None,
        device: str | torch.device = "cpu",
        threads: int | None = None,
        first_world: int = 0,
        state: bool = False,
    ) -> None:
        device = device_of(device)
        driver, as_array = driver_for(game, worlds, device, threads)
        super().__init__(device=device, batch_size=torch.Size([worlds]))
        self.game = game
        self._as_array = as_array
        seed = drawn_seed() if seed is None else seed
        self.worlds = Batch(game, worlds, seed=seed, first_world=first_world, driver=driver)
        self.group_map = {keys.AGENTS: list(game.agent_names)}
        self.n_agents = game.agents
        self._world_count = worlds
        self._agents_size = torch.Size([worlds, game.agents])
        self._has_decisions = game.decisions > 0
        self._has_state = state
        self._colours = torch.from_numpy(game.palette).to(device)
        self._plan_outputs()
        self._tensors: dict[str, Tensor]
        self.output: StepOutput
        self._set_output(*self._new_output())
        self._make_specs()

    def _plan_outputs(self) -> None:
        """Prepare how memory for outputs is allocated, and which entries the game has."""
        self._forms = {
            name: (shape, torch.from_numpy(np.empty(0, dtype)).dtype)
            for name, (shape, dtype) in output_forms(self.game, self._world_count).items()
        }
        self._empty_arrays = {
            name: self._as_array(torch.empty(shape, dtype=dtype, device=self.device))
            for name, (shape, dtype) in self._forms.items()
            if not prod(shape)
        }
        """The arrays of length 0 of the entries that the game lacks. They serve every turn, since making new
        ones would take as long as playing a turn of one world."""
        self._agent_entries = [name for name in _AGENT_ENTRIES if name not in self._empty_arrays]
        self._world_entries = [name for name in _WORLD_ENTRIES if name not in self._empty_arrays]
        output_bytes = sum(prod(shape) * dtype.itemsize for shape, dtype in self._forms.values())
        self._allocated_turns = _TURNS_PER_ALLOCATION if output_bytes < _SMALL_OUTPUT_BYTES else 1
        self._unused_outputs: list[tuple[dict[str, Tensor], StepOutput]] = []

    def _make_specs(self) -> None:
        """Set the specs of actions, observations, rewards and dones."""
        game = self.game
        choice_counts = {"action": len(game.actions)}
        if self._has_decisions:
            choice_counts["decision"] = game.decisions
        choices = {
            name: Categorical(count, shape=self._agents_size, dtype=torch.int64)
            for name, count in choice_counts.items()
        }
        rules = {}
        root_specs = self._entry_specs(self._world_entries)
        if game.governor is not None:
            options = len(game.governor.options)
            rules[keys.RULE] = Categorical(options, shape=self.batch_size, dtype=torch.int64)
            features = len(game.governor.sees)
            root_specs[keys.SEEN] = Unbounded(shape=(*self.batch_size, features), dtype=torch.float32)
        self.action_spec = self._group_spec(choices, **rules)
        if self._has_state:
            board = self._world_count, 3, game.map.height, game.map.width
            root_specs[keys.STATE] = Bounded(0, 255, shape=board, dtype=torch.uint8)
        self.observation_spec = self._group_spec(self._entry_specs(self._agent_entries), **root_specs)
        reward = Unbounded(shape=(*self._agents_size, 1), dtype=torch.float32)
        self.reward_spec = self._group_spec({"reward": reward})
        self.done_spec = Composite(self._entry_specs(_DONE_ENTRIES), shape=(self._world_count,))

    def _group_spec(self, agent_specs: Mapping[str, TensorSpec], **root_specs: TensorSpec) -> Composite:
        """Return the spec of entries in the group "agents" and of entries at the root."""
        agents = Composite(dict(agent_specs), shape=self._agents_size)
        return Composite(agents=agents, **root_specs, shape=(self._world_count,))

    def _entry_specs(self, names: Iterable[str]) -> dict[str, TensorSpec]:
        """Return the spec of each of these entries of `StepOutput`."""
        game = self.game
        highest = {
            "observation": game.observation_highest,
            "harvest": 1,
            "stock": len(game.map.sites),
            "regrown": len(game.map.sites),
            "waste": len(game.map.river),
            "cleaned": game.rules.beam_width_cells,
        }
        specs: dict[str, TensorSpec] = {}
        for name in names:
            shape, dtype = self._forms[name]
            if dtype is torch.bool:
                specs[name] = flag_spec(*shape)
            elif name in highest:
                specs[name] = Bounded(0, highest[name], shape=shape, dtype=dtype)
            else:
                specs[name] = Unbounded(shape=shape, dtype=dtype)
        return specs

    def __repr__(self) -> str:
        return f"CommonsEnv({self.game!r}, worlds={self._world_count}, device={str(self.device)!r})"

    def _new_output(self) -> tuple[dict[str, Tensor], StepOutput]:
        """Return new memory for the output of one turn, as tensors by name and as arrays that share it."""
        if not self._unused_outputs:
            self._allocate_outputs()
        return self._unused_outputs.pop()

    def _allocate_outputs(self) -> None:
        """Allocate the outputs of the next turns; small ones for several turns at once."""
        blocks = {
            name: torch.empty((self._allocated_turns, *shape), dtype=dtype, device=self.device)
            for name, (shape, dtype) in self._forms.items()
            if name not in self._empty_arrays
        }
        tensors_by_turn = zip(*(block.unbind() for block in blocks.values()), strict=True)
        arrays_by_turn = zip(*(self._block_arrays(blocks, name) for name in self._forms), strict=True)
        for tensors, arrays in zip(tensors_by_turn, arrays_by_turn, strict=True):
            self._unused_outputs.append((dict(zip(blocks, tensors, strict=True)), StepOutput(*arrays)))

    def _block_arrays(self, blocks: Mapping[str, Tensor], name: str) -> Any:
        """Return the arrays of one entry, one for each turn of an allocated block."""
        if name in self._empty_arrays:
            return [self._empty_arrays[name]] * self._allocated_turns
        block = blocks[name]
        on_cpu = block.device.type == "cpu"
        return block.numpy() if on_cpu else [self._as_array(turn) for turn in block.unbind()]

    def _set_output(self, tensors: dict[str, Tensor], output: StepOutput) -> None:
        """Set the memory of the current output, past the slow `__setattr__` of torch modules."""
        object.__setattr__(self, "_tensors", tensors)
        object.__setattr__(self, "output", output)

    def _as_tensordict(self, tensors: dict[str, Tensor], reward: Tensor | None = None) -> TensorDict:
        """Return one time step as a TensorDict, without a reward as `reset` returns it."""
        agents = {name: tensors[name] for name in self._agent_entries}
        if reward is not None:
            agents["reward"] = reward
        entries: dict[str, Any] = {name: tensors[name] for name in (*self._world_entries, *_DONE_ENTRIES)}
        if self.game.governor is not None:
            entries[keys.SEEN] = torch.as_tensor(self.worlds.governor_features(), device=self.device)
        if self._has_state:
            boards = torch.as_tensor(self.worlds.boards(), device=self.device)
            entries[keys.STATE] = self._colours[boards.long()].permute(0, 3, 1, 2)
        entries[keys.AGENTS] = unchecked_tensordict(agents, self._agents_size, self.device)
        return unchecked_tensordict(entries, self.batch_size, self.device)

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Restart from a seed, 0 to 2**64 - 1; see `EnvBase.set_seed`."""
        next_seed: int | None = super().set_seed(checked("seed", seed, Seed | None), static_seed)
        return next_seed

    def _set_seed(self, seed: int | None) -> None:
        seed = drawn_seed() if seed is None else seed
        self.worlds.set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        reset_worlds = None if tensordict is None else tensordict.get("_reset", None)
        reset_td = self._as_tensordict(self._begin(reset_worlds))
        if tensordict is not None:
            recurrent_state.carry(reset_td, tensordict, reset_worlds)
        return reset_td

    def _begin(self, reset_worlds: Tensor | None) -> dict[str, Tensor]:
        """Begin the next episode in some worlds, leave the others as they are, and return the new output.

        `reset_worlds`: bool [B, 1], True for worlds that begin; None for all.
        """
        previous = self._tensors
        self._set_output(*self._new_output())
        if reset_worlds is None:
            self.worlds.begin(self.output)
        else:
            for name, tensor in self._tensors.items():
                tensor.copy_(previous[name])
            self.worlds.begin(self.output, self._as_array(reset_worlds.reshape(-1)))
        return self._tensors

    def load(self, state: Mapping[str, NDArray[Any]]) -> TensorDict:
        """Set all worlds to a saved state, and return the TensorDict that `reset` would return there.

        A state does not hold the events of the step before it: harvest, fired, hit_by, tagged_by, regrown,
        and with institutions fines, transfers and violated are 0 and False, although the windows may still
        show a beam.

        Args:
            state: a result of `env.worlds.state()`, arrays by name, of the same game and number of worlds.

        Raises:
            ValueError: if the state is impossible; the worlds are then unchanged.
        """
        tensors, output = self._new_output()
        self.worlds.load(state, output)
        self._set_output(tensors, output)
        return self._as_tensordict(tensors)

    def render(self, *, world: int | None = None, cell_pixels: int = 24) -> UInt8:
        """Return images of the current boards, e.g. for TorchRL's `PixelRenderTransform`.

        Args:
            world: the index of the only world to draw; None draws all of them.
            cell_pixels: the width and height of a cell in pixels.

        Returns:
            A numpy array in RGB: uint8 [rows, columns, 3] for one world, uint8 [B, rows, columns, 3] for all.

        Raises:
            ValueError: before the first reset, or for a world that the environment does not have.
        """
        batch = self.worlds
        if not batch.has_begun:
            raise ValueError(
                "the worlds have not begun; allowed: reset() or load() before the first render()"
            )
        board = batch.game.map
        if world is not None:
            world = checked("world", world, Annotated[int, Range(0, batch.size - 1)])
            return world_image(board, batch.show(self.output, world=world), cell_pixels=cell_pixels)
        views = (batch.show(self.output, world=index) for index in range(batch.size))
        return np.stack([world_image(board, view, cell_pixels=cell_pixels) for view in views])

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        actions = self._as_array(self._read_choices(tensordict, "action"))
        self.worlds.check(actions)
        decisions = None
        if self._has_decisions:
            decisions = self._as_array(self._read_choices(tensordict, "decision"))
            self.worlds.check_decisions(decisions)
        step_mask = tensordict.get("_step", None)
        if step_mask is not None:
            self._check_step_mask(step_mask.reshape(-1))
        rule = None if self.game.governor is None else tensordict.get(keys.RULE, None)
        if rule is not None:
            self.worlds.put_in_force(rule.numpy(force=True))
        self._set_output(*self._new_output())
        self.worlds.play(actions, self.output, decisions)
        return self._as_tensordict(self._tensors, self._tensors["reward"].unsqueeze(-1))

    def _check_step_mask(self, step_mask: Tensor) -> None:
        """Refuse a "_step" mask, bool [B], that leaves out a world whose episode has not ended."""
        playing = self.worlds.driver.read(self.worlds.now.ended)[:, 0] == PLAYING
        left_out = playing & ~step_mask.numpy(force=True)
        if left_out.any():
            raise ValueError(
                f'"_step" leaves out world {int(left_out.argmax())}, which is playing; allowed: masks that '
                "leave out worlds that have ended, since all others play every turn together"
            )

    def _read_choices(self, tensordict: TensorDictBase, name: str) -> Tensor:
        """Return ("agents", "action") or ("agents", "decision") as contiguous int64 [B, N]."""
        return read_choices(tensordict, name, self._agents_size, self.device).contiguous()

    def _any_done(self) -> bool:
        """Return whether the episode of any world has ended."""
        done = self.output.done
        if isinstance(done, np.ndarray):  # numpy takes a tenth of torch's time to count so few numbers
            return bool(np.count_nonzero(done))
        return bool(self._tensors["done"].any())

    def lean_step(
        self, tensordict: TensorDictBase, *, resets: bool = True
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Play one turn like `EnvBase.step_and_maybe_reset`, without the slow handling of keys in TorchRL.

        A test checks that both give equal results, including the entries that policies wrote.

        Args:
            tensordict: the input of this turn; its result is stored in it as "next".
            resets: whether worlds whose episode ends begin the next one; otherwise they stay as they are.

        Returns:
            `tensordict`, and the input of the next turn.
        """
        keys.put(tensordict, "next", self._step(tensordict))
        done = self._tensors["done"]
        if resets and self._any_done():
            self._begin(done)
        next_input = self._as_tensordict(self._tensors)
        is_first = done if resets else None
        carry_on(next_input, tensordict, is_first, _WRITTEN_ENTRIES)
        return tensordict, next_input
