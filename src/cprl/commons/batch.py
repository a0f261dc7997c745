"""Batch: B worlds of a game, which a driver (CPU threads or a GPU) plays a turn at a time."""

from collections.abc import Mapping
from typing import Annotated, Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons import state as states
from cprl.commons.game import Game, output_forms
from cprl.commons.tables import Tables
from cprl.commons.threads import CpuThreads
from cprl.commons.world import BEGIN, PLAY, REFRESH, StepOutput, Worlds, WorldView, empty_worlds
from cprl.institutions import Law
from cprl.institutions.arrays import state_arrays
from cprl.institutions.law import new_law
from cprl.institutions.ledger import VIOLATIONS
from cprl.values import Range, Seed, checked, refusal
from cprl.values.array_types import Bool, Float32, Int64, UInt8


class Driver(Protocol):
    """The interface of what runs the rules on B worlds: `CpuThreads` or `cprl.commons.cuda.CudaThreads`."""

    threads: int
    tables: Tables

    def place(self, arrays: Any) -> Any:
        """Copy `Worlds`, `Law` or `Tables` from numpy arrays to the memory in which the rules run."""

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return a new array of the driver, with undefined entries."""

    def read(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return a copy of an array of the driver, as a numpy array."""

    def write(self, array: NDArray[Any], values: NDArray[Any]) -> None:
        """Copy numpy values of the same shape and dtype into an array of the driver."""

    def first_invalid(self, actions: Int64, known: int) -> int:
        """Return the row-major index of the first action that is not in 0 .. known - 1, or -1."""

    def run(self, task: int, game: tuple[Any, ...]) -> None:
        """Do a task of `cprl.commons.loops.run_worlds` with the worlds.

        Nothing is checked. All arrays must be contiguous and have the shapes and dtypes of the game.

        Args:
            task: PLAY, BEGIN or REFRESH, see `cprl.commons.world`.
            game: the entries of `Played`, as a plain tuple, since that is made in a third of the time.
        """

    def show(self, game: tuple[Worlds, Tables, UInt8]) -> None:
        """Draw the boards of the worlds, see `cprl.commons.loops.show_worlds`."""


class Batch:
    """B worlds of a game, played a turn at a time.

    Args:
        game: the game to play.
        worlds: the number of worlds B.
        seed: 0 to 2**64 - 1. All random numbers follow from the seed, the index of the world, the episode and
            the step.
        first_world: the index of the first world, with which world b of a larger batch can be played alone.
        threads: the number of CPU threads that share the worlds; None uses all cores where that is faster.
        driver: runs the rules; None makes `CpuThreads`.
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
        """True once all worlds have begun an episode."""
        host = empty_worlds(game, worlds)
        host.number[:, 0] = np.arange(first_world, first_world + worlds, dtype=np.uint64)
        self.now: Worlds = self.driver.place(host)
        """The current state of the worlds, in the driver's arrays."""
        self.law: Law | None = self.driver.place(new_law(game, worlds)) if game.institutions else None
        """The state and parameters of the institutions, in the driver's arrays; None without any."""
        self._first_choices: Int64 = self.driver.empty((worlds, game.agents), np.int64)
        """Zeros, int64 [B, N]: the actions or decisions of a task that is given none."""
        self.driver.write(self._first_choices, np.zeros((worlds, game.agents), np.int64))
        self._all_worlds: Bool = self.driver.empty((worlds,), np.bool_)
        self.driver.write(self._all_worlds, np.ones(worlds, np.bool_))
        self.set_seed(seed)

    def set_seed(self, seed: int) -> None:
        """Restart from a seed, so that the next episode of each world is the first episode of that seed."""
        self.driver.write(self.now.seed, np.full((self.size, 1), checked("seed", seed, Seed), np.uint64))
        self.driver.write(self.now.episode, np.full((self.size, 1), -1, np.int32))

    def new_output(self) -> StepOutput:
        """Return new arrays for the output of a turn, with undefined entries."""
        forms = output_forms(self.game, self.size)
        return StepOutput(*(self.driver.empty(*form) for form in forms.values()))

    def _run(
        self,
        task: int,
        output: StepOutput,
        *,
        actions: Int64 | None = None,
        decisions: Int64 | None = None,
        selected: Bool | None = None,
    ) -> None:
        """Do a task with the selected worlds, by default with all of them.

        Agents take their first action and decision where none are given.
        """
        actions = self._first_choices if actions is None else actions
        decisions = self._first_choices if decisions is None else decisions
        selected = self._all_worlds if selected is None else selected
        self.driver.run(task, (self.now, self.driver.tables, output, self.law, actions, decisions, selected))

    def begin(self, output: StepOutput | None = None, selected: Bool | None = None) -> StepOutput:
        """Begin the next episode of the selected worlds, and write their rows of the output.

        Args:
            output: the output to write into; None for a new one.
            selected: bool [B], True for worlds that begin; None for all. In a new batch all worlds must
                begin.

        Raises:
            ValueError: if `selected` has another form, or leaves out worlds of a new batch.
        """
        if selected is not None:
            if selected.shape != (self.size,) or selected.dtype != np.bool_:
                raise ValueError(
                    f"selected is {selected.dtype} {list(selected.shape)}; allowed: bool [{self.size}]"
                )
            if not self.has_begun and not self.driver.read(selected).all():
                raise ValueError(
                    "selected leaves worlds out; allowed at first: None, so that all worlds begin"
                )
        output = self.new_output() if output is None else output
        self._run(BEGIN, output, selected=selected)
        self.has_begun = True
        return output

    def play(self, actions: Int64, output: StepOutput, decisions: Int64 | None = None) -> StepOutput:
        """Play one turn of every world, and write its output.

        Nothing is checked here, since a check takes as long as a turn of one world. Call `check` for actions
        of unknown origin, and `check_decisions` for decisions.

        Args:
            actions: int64 [B, N], contiguous, indices of `Game.actions`.
            output: the output to write into.
            decisions: int64 [B, N], contiguous, below `Game.decisions`; read only in the first turn of an
                episode. None lets all agents take the first option.
        """
        self._run(PLAY, output, actions=actions, decisions=decisions)
        return output

    def put_in_force(self, rule: Int64) -> None:
        """Put an option of the governor in force in each world from the coming turn on.

        Args:
            rule: int64 [B], the index of the option in each world.

        Raises:
            ValueError: for an index that no option has.
        """
        assert self.game.governor is not None
        assert self.law is not None
        options = np.array(self.game.governor.options)
        if rule.min() < 0 or rule.max() >= len(options):
            raise refusal("rule", rule, f"indices of the {len(options)} options")
        in_force = self.driver.read(self.law.ledger.in_force)
        in_force[:, -1] = options[rule]
        self.driver.write(self.law.ledger.in_force, in_force)

    def governor_features(self) -> Float32:
        """Return the features that the governor observes of each world, float32 [B, S], see
        `Governor.sees`."""
        assert self.game.governor is not None
        assert self.law is not None
        read = self.driver.read
        return self.game.governor.observe(
            stock=read(self.now.stock_left)[:, 0] / len(self.game.map.sites),
            elapsed_steps=read(self.now.step)[:, 0],
            harvested=read(self.now.harvested),
            violations=read(self.law.ledger.counts)[..., VIOLATIONS],
            horizon_steps=self.game.rules.episode_steps,
        )

    def boards(self) -> UInt8:
        """Return the current boards as classes of cells (`cprl.commons.cells`): uint8 [B, H, W]."""
        boards = self.driver.empty((self.size, self.game.map.height, self.game.map.width), np.uint8)
        self.driver.show((self.now, self.driver.tables, boards))
        return boards

    def show(self, output: StepOutput, *, world: int = 0) -> WorldView:
        """Return a copy of one world for display; `output` holds its latest observation."""
        read = self.driver.read
        return WorldView(
            read(output.observation[world]),
            read(self.boards())[world],
            *(read(getattr(self.now, name))[world] for name in WorldView._fields[2:]),
        )

    def state(self) -> states.State:
        """Return the state of all worlds: copies of the arrays in `Worlds` and `Law`, [B, ...], by name.

        State and game together determine everything that follows, including all random numbers.
        """
        return {name: self.driver.read(array) for name, array in self._state_arrays().items()}

    def _state_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the driver's arrays that make up the state, by name."""
        arrays = {name: array for name, array, _ in state_arrays(self.now)}
        if self.law is not None:
            arrays |= {name: array for name, array, _ in state_arrays(self.law)}
        return arrays

    def load(self, state: Mapping[str, NDArray[Any]], output: StepOutput | None = None) -> StepOutput:
        """Restore a state of the worlds, and return the output that belongs to it.

        Harvest, shots, hits and growth are 0 in this output: the events of the last turn are not part of a
        state.

        Args:
            state: a result of `state`, of the same game and number of worlds.
            output: the output to write into; None for a new one.

        Raises:
            ValueError: if the state does not fit the game; the worlds are then unchanged.
        """
        checked_state = states.check_state(state, worlds=self.size, game=self.game)
        arrays = self._state_arrays()
        for name, values in checked_state.items():
            self.driver.write(arrays[name], values)
        output = self.new_output() if output is None else output
        self._run(REFRESH, output)
        self.has_begun = bool((checked_state["episode"] >= 0).all())
        return output

    def check(self, actions: Int64) -> None:
        """Raise a ValueError for actions, int64 [B, N], that cannot be played."""
        if not self.has_begun:
            raise ValueError("the worlds have not begun; allowed: reset() or load() before the first step")
        self._check_known("action", actions, len(self.game.actions), self.game.actions)

    def check_decisions(self, decisions: Int64) -> None:
        """Raise a ValueError for decisions, int64 [B, N], that agents cannot take."""
        self._check_known("decision", decisions, max(1, self.game.decisions))

    def _check_known(self, noun: str, choices: Int64, known: int, names: tuple[str, ...] = ()) -> None:
        """Refuse choices, int64 [B, N], outside 0 .. known - 1; `noun` and `names` are for the message."""
        invalid_index = self.driver.first_invalid(choices, known)
        if invalid_index >= 0:
            world, agent = divmod(invalid_index, self.game.agents)
            choice = self.driver.read(choices)[world, agent]
            allowed = f"0 to {known - 1}" + (f" ({', '.join(names)})" if names else "")
            raise ValueError(
                f"{noun} {choice} of agent {agent} in world {world} is unknown; allowed: {allowed}"
            )
