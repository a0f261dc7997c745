"""CommonsEnv: B worlds of a commons as one TorchRL environment."""

from collections.abc import Iterable, Mapping
from math import prod
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded

from cprl import keys, recurrent_state
from cprl.commons.batch import Batch
from cprl.commons.game import Game, output_forms
from cprl.commons.quirks import paints_over
from cprl.commons.world import PLAYING, StepOutput
from cprl.envs.drivers import device_of, drawn_seed, driver_for
from cprl.envs.stepping import carry_on, chosen
from cprl.pictures.image import world_image
from cprl.system.compat import LeanStepEnv, flag_spec, unchecked_tensordict
from cprl.values import Range, Seed, checked
from cprl.values.arrays import UInt8

WORLD_ENTRIES = ("stock", "regrown")
DONE_ENTRIES = ("done", "terminated", "truncated")
_AGENT_ENTRIES = ("observation", "harvest", "in_play", "fired", "hit_by", "tagged_by")
_AHEAD_BYTES = 2**16
"""Below this size, memory is allocated for sixteen turns at once: an allocation takes as long as a world."""
_AHEAD_TURNS = 16
_BALLOT_ENTRIES = (keys.IN_FORCE, keys.BALLOTS_DUE)
_PAID_ENTRIES = tuple(key[-1] for key in (keys.FINES, keys.TRANSFERS, keys.VIOLATED, keys.COUNTS))
"""Entries of agents in games with institutions."""
_REPLACED = frozenset((*StepOutput._fields, keys.STATE, keys.AGENTS, "next", "_reset"))
"""The entries that the environment writes anew in each turn."""


class CommonsEnv(LeanStepEnv):
    """B worlds of a game, batch size [B], all agents in the group "agents"; entries as in `cprl.keys`.

    Dones are at the root only. Stepping a world that has ended does not change it. Every step writes to new
    tensors, so that a TensorDict from an earlier step never changes.

    Args:
        seed: the seed of all random numbers; `set_seed` restarts from another. None draws one from torch's
            generator, a different one in each worker process: environments that TorchRL's `ParallelEnv`,
            `SerialEnv` or a collector makes by the same call have different worlds.
        device: "cpu", or "cuda" with a GPU and the package numba-cuda; worlds and all outputs stay there.
        threads: the number of CPU threads that share the worlds; None for all cores if that is faster.
        first_world: the index of the first world: `CommonsEnv(game, 1, first_world=b)` plays the same as
            world b of a larger batch.
        state: whether outputs include the whole board as "state", uint8 [B, 3, H, W].

    Raises:
        ValueError: if a number is out of range, for the device "cuda" if torch or Numba finds no GPU, and, in
            `step`, for actions that are missing, unknown or of another form (int64 [B, N]; other integers are
            converted); then nothing changes.
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
        self.game, self._as_array = game, as_array
        seed = drawn_seed() if seed is None else seed
        self.worlds = Batch(game, worlds, seed=seed, first_world=first_world, driver=driver)
        self.group_map = {keys.AGENTS: list(game.agent_names)}
        self.n_agents = game.agents
        self._size = worlds
        self._agents_size = torch.Size([worlds, game.agents])
        paid = _PAID_ENTRIES if game.institutions else ()
        covered = keys.APPLE_AHEAD[1:] if paints_over(game.rules.quirks) else ()
        of_agents, of_worlds = (keys.CLEANED[1:], (keys.WASTE,)) if game.map.river else ((), ())
        self._agent_entries = (*_AGENT_ENTRIES, *of_agents, *covered, *paid)
        self._world_entries = (*WORLD_ENTRIES, *of_worlds, *(_BALLOT_ENTRIES if game.ballots else ()))
        self._decides = game.decisions > 0
        self._with_state = state
        self._forms = {
            name: (shape, torch.from_numpy(np.empty(0, dtype)).dtype)
            for name, (shape, dtype) in output_forms(game, worlds).items()
        }
        self._colours = torch.from_numpy(game.palette).to(device)
        output_bytes = sum(prod(shape) * dtype.itemsize for shape, dtype in self._forms.values())
        self._lacking = {
            name: as_array(torch.empty(shape, dtype=dtype, device=device))
            for name, (shape, dtype) in self._forms.items()
            if not prod(shape)
        }
        """The arrays, in every turn, of entries that the game lacks: made anew they would take as long as a
        world."""
        self._turns_ahead = _AHEAD_TURNS if output_bytes < _AHEAD_BYTES else 1
        self._ahead: list[tuple[dict[str, Tensor], StepOutput]] = []
        self._tensors: dict[str, Tensor]
        self.output: StepOutput
        self._show_in(*self._fresh())
        self._make_specs()

    def _make_specs(self) -> None:
        game, worlds, per_agent = self.game, self._size, self._agents_size
        highest = {"observation": game.observation_highest, "harvest": 1}
        highest |= dict.fromkeys(WORLD_ENTRIES, len(game.map.sites)) | {"waste": len(game.map.river)}
        highest |= {"cleaned": game.rules.beam_width_cells}

        def specs(names: Iterable[str]) -> dict[str, TensorSpec]:
            return {name: spec(name, *self._forms[name]) for name in names}

        def spec(name: str, shape: tuple[int, ...], dtype: torch.dtype) -> TensorSpec:
            if dtype is torch.bool:
                return flag_spec(*shape)
            if name in highest:
                return Bounded(0, highest[name], shape=shape, dtype=dtype)
            return Unbounded(shape=shape, dtype=dtype)

        def group(of_agents: dict[str, TensorSpec], **of_worlds: TensorSpec) -> Composite:
            return Composite(agents=Composite(of_agents, shape=per_agent), **of_worlds, shape=(worlds,))

        choices = {"action": len(game.actions), **({"decision": game.decisions} if self._decides else {})}
        self.action_spec = group(
            {name: Categorical(count, shape=per_agent, dtype=torch.int64) for name, count in choices.items()}
        )
        of_worlds = specs(self._world_entries)
        if self._with_state:
            board = worlds, 3, game.map.height, game.map.width
            of_worlds[keys.STATE] = Bounded(0, 255, shape=board, dtype=torch.uint8)
        self.observation_spec = group(specs(self._agent_entries), **of_worlds)
        self.reward_spec = group({"reward": Unbounded(shape=(*per_agent, 1), dtype=torch.float32)})
        self.done_spec = Composite(specs(DONE_ENTRIES), shape=(worlds,))

    def __repr__(self) -> str:
        return f"CommonsEnv({self.game!r}, worlds={self._size}, device={str(self.device)!r})"

    def _fresh(self) -> tuple[dict[str, Tensor], StepOutput]:
        """New memory for the output of a turn: as tensors by name, and the same memory as arrays."""
        if not self._ahead:
            blocks = {
                name: torch.empty((self._turns_ahead, *shape), dtype=dtype, device=self.device)
                for name, (shape, dtype) in self._forms.items()
                if name not in self._lacking
            }
            tensors = zip(*(block.unbind() for block in blocks.values()), strict=True)
            arrays = zip(*(self._turns_of(blocks, name) for name in self._forms), strict=True)
            for turn, output in zip(tensors, arrays, strict=True):
                self._ahead.append((dict(zip(blocks, turn, strict=True)), StepOutput(*output)))
        return self._ahead.pop()

    def _show_in(self, tensors: dict[str, Tensor], output: StepOutput) -> None:
        """Set the memory of the current output; faster than through attributes of a module."""
        object.__setattr__(self, "_tensors", tensors)
        object.__setattr__(self, "output", output)

    def _turns_of(self, blocks: Mapping[str, Tensor], name: str) -> Any:
        """Return the turns of a block as arrays."""
        if name in self._lacking:
            return [self._lacking[name]] * self._turns_ahead
        block = blocks[name]
        on_cpu = block.device.type == "cpu"
        return block.numpy() if on_cpu else [self._as_array(turn) for turn in block.unbind()]

    def _as_tensordict(self, tensors: dict[str, Tensor], reward: Tensor | None = None) -> TensorDict:
        """Return the entries of one time step; without a reward, as `reset` returns them."""
        agents = {name: tensors[name] for name in self._agent_entries}
        if reward is not None:
            agents["reward"] = reward
        entries: dict[str, Any] = {name: tensors[name] for name in (*self._world_entries, *DONE_ENTRIES)}
        if self._with_state:
            boards = torch.as_tensor(self.worlds.boards(self.output), device=self.device)
            entries[keys.STATE] = self._colours[boards.long()].permute(0, 3, 1, 2)
        entries[keys.AGENTS] = unchecked_tensordict(agents, self._agents_size, self.device)
        return unchecked_tensordict(entries, self.batch_size, self.device)

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Restart from a seed, 0 to 2**64 - 1; see `EnvBase.set_seed`."""
        following: int | None = super().set_seed(checked("seed", seed, Seed | None), static_seed)
        return following

    def _set_seed(self, seed: int | None) -> None:
        self.worlds.set_seed(drawn_seed() if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        which = None if tensordict is None else tensordict.get("_reset", None)
        begun = self._as_tensordict(self._begin(which))
        if tensordict is not None:
            recurrent_state.carry(begun, tensordict, which)
        return begun

    def _begin(self, which: Tensor | None) -> dict[str, Tensor]:
        """Start the next episode of the marked worlds (bool [B, 1]; None for all), in new tensors."""
        before = self._tensors
        self._show_in(*self._fresh())
        if which is None:
            self.worlds.begin(self.output)
        else:
            for name, tensor in self._tensors.items():
                tensor.copy_(before[name])
            self.worlds.begin(self.output, self._as_array(which.reshape(-1)))
        return self._tensors

    def load(self, state: Mapping[str, NDArray[Any]]) -> TensorDict:
        """Set all worlds to a state, and return their entries as `reset` does.

        The events of the turn before are not told: harvest, fired, hit_by, tagged_by, regrown, and of
        institutions fines, transfers and violated are 0 and false, also where windows show the beam of an
        agent whose "fired" in the state is true.

        Args:
            state: a value of `env.worlds.state()`: arrays by name, for as many worlds of the same game.

        Raises:
            ValueError: if the state is impossible; worlds are then unchanged.
        """
        tensors, output = self._fresh()
        self.worlds.load(state, output)
        self._show_in(tensors, output)
        return self._as_tensordict(tensors)

    def render(self, *, world: int | None = None, cell_pixels: int = 24) -> UInt8:
        """Images of the boards as they are now, e.g. for TorchRL's `PixelRenderTransform`.

        Returns:
            A numpy array, uint8 [B, rows, columns, 3] in RGB; of one `world` uint8 [rows, columns, 3].
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
        states = (batch.show(self.output, world=number) for number in range(batch.size))
        return np.stack([world_image(board, one, cell_pixels=cell_pixels) for one in states])

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        actions = self._as_array(self._chosen(tensordict, "action"))
        self.worlds.check(actions)
        decisions = None
        if self._decides:
            decisions = self._as_array(self._chosen(tensordict, "decision"))
            self.worlds.check_decisions(decisions)
        stepped = tensordict.get("_step", None)
        if stepped is not None:
            self._check_stepped(stepped.reshape(-1))
        self._show_in(*self._fresh())
        self.worlds.play(actions, self.output, decisions)
        return self._as_tensordict(self._tensors, self._tensors["reward"].unsqueeze(-1))

    def _check_stepped(self, stepped: Tensor) -> None:
        """That the worlds that a "_step" mask, bool [B], leaves out have all ended."""
        playing = self.worlds.driver.read(self.worlds.now.ended)[:, 0] == PLAYING
        left_out = playing & ~stepped.numpy(force=True)
        if left_out.any():
            raise ValueError(
                f'"_step" leaves out world {int(left_out.argmax())}, which is playing; allowed: masks that '
                "leave out worlds that have ended, since all others play every turn together"
            )

    def _chosen(self, tensordict: TensorDictBase, name: str) -> Tensor:
        return chosen(tensordict, name, self._agents_size, self.device).contiguous()

    def _any_done(self) -> bool:
        """Return whether any world has ended; numpy counts in a tenth of the time that torch takes."""
        done = self.output.done
        return bool(np.count_nonzero(done) if isinstance(done, np.ndarray) else self._tensors["done"].any())

    def lean_step(
        self, tensordict: TensorDictBase, *, resets: bool = True
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Do the same as `EnvBase.step_and_maybe_reset`, without its handling of keys.

        A test checks that they are equal, including the entries of policies. Without `resets` worlds that
        have ended stay as they are.
        """
        following = self._step(tensordict)
        keys.put(tensordict, "next", following)
        done = self._tensors["done"]
        carried = self._as_tensordict(self._begin(done) if resets and self._any_done() else self._tensors)
        carry_on(carried, tensordict, done if resets else None, _REPLACED)
        return tensordict, carried
