"""Batch: B worlds of a game, played a turn at a time by a driver (CPU threads or a GPU)."""

from collections.abc import Mapping
from typing import Annotated, Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons import state as states
from cprl.commons.game import Game, output_forms
from cprl.commons.tables import Tables
from cprl.commons.threads import CpuThreads
from cprl.commons.world import BEGIN, PLAY, REFRESH, Shown, StepOutput, Worlds, empty_worlds
from cprl.institutions import Law
from cprl.institutions.arrays import lasting
from cprl.institutions.law import new_law
from cprl.values import Range, Seed, checked
from cprl.values.arrays import Bool, Int64, UInt8


class Driver(Protocol):
    """Runs the rules on B worlds: `CpuThreads` or `cprl.commons.cuda.CudaThreads`."""

    threads: int
    tables: Tables

    def place(self, arrays: Any) -> Any:
        """Copy a tuple of numpy arrays, `Worlds`, `Law` or `Tables`, to where the rules run."""

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return a new array with undefined entries."""

    def read(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return a copy as a numpy array."""

    def write(self, array: NDArray[Any], values: NDArray[Any]) -> None:
        """Copy values of the same shape and dtype into an array."""

    def first_unknown(self, actions: Int64, known: int) -> int:
        """Return the index, in row-major order, of the first action outside 0 .. known - 1; -1 if there is
        none."""

    def run(self, task: int, game: tuple[Any, ...]) -> None:
        """Do a task of `cprl.commons.loops.run_worlds`. Nothing is checked: all arrays are contiguous and
        have the form that the game gives them.

        Args:
            game: what `Played` says, as a plain tuple, which takes a third of the time to make.
        """

    def show(self, game: tuple[Worlds, Tables, UInt8]) -> None:
        """Draw boards, see `cprl.commons.loops.show_worlds`."""


class Batch:
    """B worlds of a game, played a turn at a time.

    Args:
        seed: 0 to 2**64 - 1. Random numbers are a function of the seed, the index of the world, the episode
            and the step alone.
        first_world: The index of the first world; with it, world b of a larger batch can be played alone.
        threads: The number of CPU threads that share the worlds; None uses all cores where that is faster.
    """

    def __init__(
        self,
        game: Game,
        worlds: int,
        *,
        seed: int = 0,
        first_world: int = 0,
        threads: int | None = None,
        driver: Driver | None = None,
    ) -> None:
        worlds = checked("worlds", worlds, Annotated[int, Range(1, 2**32)])
        first_world = checked("first_world", first_world, Annotated[int, Range(0, 2**32 - 1)])
        if first_world + worlds > 2**32:
            raise ValueError(
                f"first_world is {first_world} and worlds is {worlds}; "
                "allowed: worlds with indices from 0 to 2**32 - 1"
            )
        self.game = game
        self.size = worlds
        self.driver: Driver = driver or CpuThreads(game, worlds, threads=threads)
        self.has_begun = False
        """Whether the worlds have begun an episode, so that there is something to show."""
        host = empty_worlds(game, worlds)
        host.number[:, 0] = np.arange(first_world, first_world + worlds, dtype=np.uint64)
        self.now: Worlds = self.driver.place(host)
        """The current state of the worlds, in the driver's arrays."""
        self.law: Law | None = self.driver.place(new_law(game, worlds)) if game.institutions else None
        """Likewise; None without institutions."""
        self._nothing: Int64 = self.driver.empty((worlds, game.agents), np.int64)
        self.driver.write(self._nothing, np.zeros((worlds, game.agents), np.int64))
        self._all_worlds: Bool = self.driver.empty((worlds,), np.bool_)
        self.driver.write(self._all_worlds, np.ones(worlds, np.bool_))
        self.set_seed(seed)

    def set_seed(self, seed: int) -> None:
        """Restart from a seed: the next episode of each world is the first episode of this seed."""
        self.driver.write(self.now.seed, np.full((self.size, 1), checked("seed", seed, Seed), np.uint64))
        self.driver.write(self.now.episode, np.full((self.size, 1), -1, np.int32))

    def new_output(self) -> StepOutput:
        """Return new arrays for the output of a turn."""
        forms = output_forms(self.game, self.size)
        return StepOutput(*(self.driver.empty(*form) for form in forms.values()))

    def _run(
        self,
        task: int,
        output: StepOutput,
        *,
        actions: Int64 | None = None,
        decisions: Int64 | None = None,
        which: Bool | None = None,
    ) -> None:
        """Do a task with the worlds, by default all of them and with the first action and decision."""
        acted = self._nothing if actions is None else actions
        decided = self._nothing if decisions is None else decisions
        marked = self._all_worlds if which is None else which
        self.driver.run(task, (self.now, self.driver.tables, output, self.law, acted, decided, marked))

    def begin(self, output: StepOutput, which: Bool | None = None) -> StepOutput:
        """Begin the next episode of some worlds and write their rows of `output`.

        Args:
            which: bool [B], the worlds that begin; None for all. Of a new batch, all worlds begin.
        """
        if which is not None:
            if which.shape != (self.size,) or which.dtype != np.bool_:
                raise ValueError(f"which is {which.dtype} {list(which.shape)}; allowed: bool [{self.size}]")
            if not self.has_begun and not self.driver.read(which).all():
                raise ValueError("which leaves worlds out; allowed at first: None, so that all worlds begin")
        self._run(BEGIN, output, which=which)
        self.has_begun = True
        return output

    def play(self, actions: Int64, output: StepOutput, decisions: Int64 | None = None) -> StepOutput:
        """Play one turn of every world and write its output.

        Nothing is checked, which would take as long as a turn of one world: `check` says whether actions of
        unknown origin can be played, `check_decisions` whether decisions can.

        Args:
            actions: int64 [B, N], contiguous.
            decisions: int64 [B, N], contiguous, where agents decide something, see `Game.decisions`; read of
                worlds in the first turn of an episode alone. None for the first option of all agents.
        """
        self._run(PLAY, output, actions=actions, decisions=decisions)
        return output

    def boards(self, output: StepOutput) -> UInt8:
        """Return the current boards: uint8 [B, H, W], classes of `cprl.commons.cells`."""
        boards = self.driver.empty((self.size, self.game.map.height, self.game.map.width), np.uint8)
        self.driver.show((self.now, self.driver.tables, boards))
        return boards

    def show(self, output: StepOutput, *, world: int = 0) -> Shown:
        """Return a copy of one world for display; `output` holds its latest observation."""
        read, observation = self.driver.read, output.observation[world]
        of_world = {name: read(getattr(self.now, name))[world] for name in Shown._fields[2:]}
        return Shown(read(observation), read(self.boards(output))[world], **of_world)

    def state(self) -> states.State:
        """Return the state of all worlds: copies of arrays [B, ...] by the names of `Worlds`.

        The state and the game together determine the future, including all random numbers.
        """
        return {name: self.driver.read(array) for name, array in self._state_arrays().items()}

    def _state_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the driver's arrays of a state by name."""
        arrays = {name: array for name, array, _ in lasting(self.now)}
        if self.law is not None:
            arrays |= {name: array for name, array, _ in lasting(self.law)}
        return arrays

    def load(self, state: Mapping[str, NDArray[Any]], output: StepOutput) -> StepOutput:
        """Set the state of the worlds and write it into `output`, with no harvest, shots, hits or growth,
        whatever happened in the turn before.
        """
        sound, arrays = states.checked(state, worlds=self.size, game=self.game), self._state_arrays()
        for name, values in sound.items():
            self.driver.write(arrays[name], values)
        self._run(REFRESH, output)
        self.has_begun = bool((sound["episode"] >= 0).all())
        return output

    def check(self, actions: Int64) -> None:
        """Raise a ValueError for actions, int64 [B, N], that cannot be played."""
        if not self.has_begun:
            raise ValueError("the worlds have not begun; allowed: reset() or load() before the first step")
        self._check_known("action", actions, len(self.game.actions), self.game.actions)

    def check_decisions(self, decisions: Int64) -> None:
        """Raise a ValueError for decisions, int64 [B, N], that agents cannot take."""
        self._check_known("decision", decisions, max(1, self.game.decisions))

    def _check_known(self, what: str, chosen: Int64, known: int, names: tuple[str, ...] = ()) -> None:
        at = self.driver.first_unknown(chosen, known)
        if at >= 0:
            world, agent = divmod(at, self.game.agents)
            came = self.driver.read(chosen)[world, agent]
            allowed = f"0 to {known - 1}" + (f" ({', '.join(names)})" if names else "")
            raise ValueError(
                f"{what} {came} of agent {agent} in world {world} is unknown; allowed: {allowed}"
            )
