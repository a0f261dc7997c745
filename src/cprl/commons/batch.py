"""B worlds of a game at once, on whatever driver plays them."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons import state as states
from cprl.commons.game import Game, output_shapes
from cprl.commons.loops import Loop
from cprl.commons.threads import CpuThreads
from cprl.commons.world import Actions, Bools, Bytes, Shown, StepOutput, Worlds, empty_worlds


class Driver(Protocol):
    """What runs the rules: `CpuThreads`, or `cprl.commons.cuda.CudaThreads`."""

    threads: int

    def place(self, worlds: Worlds) -> Worlds: ...
    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]: ...
    def read(self, array: NDArray[Any]) -> NDArray[Any]: ...
    def write(self, array: NDArray[Any], values: NDArray[Any]) -> None: ...
    def first_unknown(self, actions: Actions, known: int) -> int: ...
    def run(
        self, loop: Loop, worlds: Worlds, what: NDArray[Any], output: StepOutput, *, vouched: bool = False
    ) -> None: ...


class Batch:
    """B worlds of a game, played a turn at a time.

    Args:
        game: what is played.
        worlds: how many worlds B, at least 1.
        seed: 0 .. 2**64 - 1; with it, the world's number, the episode and the step all chance is settled.
        first_world: the number of the first world, so that world b can be played alone.
        threads: how many CPU threads share the worlds; None for all cores where it pays.
        driver: what plays them; by default CPU threads.
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
        if worlds < 1:
            raise ValueError(f"worlds is {worlds}; at least 1 is wanted")
        if first_world < 0 or first_world + worlds > 2**32:
            raise ValueError(f"worlds {first_world} to {first_world + worlds - 1}; allowed: 0 to 2**32 - 1")
        self.game = game
        self.size = worlds
        self.driver: Driver = driver or CpuThreads(game, worlds, threads=threads)
        host = empty_worlds(worlds=worlds, agents=game.agents, sites=len(game.map.sites))
        host.number[:, 0] = np.arange(first_world, first_world + worlds, dtype=np.uint64)
        self.now: Worlds = self.driver.place(host)
        """How the worlds stand, in the driver's arrays."""
        self._everyone = self._marked(np.ones(worlds, np.bool_))
        self.set_seed(seed)

    def _marked(self, which: Bools) -> Bools:
        marks = self.driver.empty((self.size,), np.bool_)
        self.driver.write(marks, which)
        return marks

    def set_seed(self, seed: int) -> None:
        """Starts all over: the next episode of each world is the first of this seed."""
        if not 0 <= seed < 2**64:
            raise ValueError(f"seed is {seed}; allowed: 0 to 2**64 - 1")
        self.driver.write(self.now.seed, np.full((self.size, 1), seed, np.uint64))
        self.driver.write(self.now.episode, np.full((self.size, 1), -1, np.int32))

    def new_output(self) -> StepOutput:
        """Fresh arrays for what a turn tells."""
        shapes = output_shapes(self.game, self.size)
        return StepOutput(**{name: self.driver.empty(*form) for name, form in shapes.items()})

    def begin(self, output: StepOutput, which: Bools | None = None) -> StepOutput:
        """Begins the next episode of the marked worlds, all if None; only their rows of `output` are written.

        Args:
            output: as `new_output` makes it.
            which: bool [B].
        """
        self.driver.run("begin_worlds", self.now, self._everyone if which is None else which, output)
        return output

    def play(self, actions: Actions, output: StepOutput) -> StepOutput:
        """One turn of every world, into `output`.

        Args:
            actions: int64 [B, N], contiguous.
            output: as `new_output` makes it.

        Raises:
            ValueError: for an action that the game does not know; then nothing has changed.
        """
        self.check(actions)
        self.driver.run("play_worlds", self.now, actions, output)
        return output

    def play_checked(self, actions: Actions, output: StepOutput) -> StepOutput:
        """`play` for contiguous actions that `check` has seen, into an `output` known to have its form: to
        look at it again takes as long as a turn of one world."""
        self.driver.run("play_worlds", self.now, actions, output, vouched=True)
        return output

    def boards(self, output: StepOutput) -> Bytes:
        """The whole boards as they stand, uint8 [B, H, W], classes of `cprl.commons.colours`."""
        boards = self.driver.empty((self.size, self.game.map.height, self.game.map.width), np.uint8)
        self.driver.run("show_worlds", self.now, boards, output)
        return boards

    def show(self, output: StepOutput, *, world: int = 0) -> Shown:
        """One world for people to look at."""
        read, now = self.driver.read, self.now
        return Shown(
            observation=read(output.observation[world]),
            board=read(self.boards(output))[world],
            stock=read(now.stock)[world],
            row=read(now.row)[world],
            col=read(now.col)[world],
            heading=read(now.heading)[world],
            in_play=read(now.in_play)[world],
            harvested=read(now.harvested)[world],
        )

    def state(self) -> states.State:
        """How all worlds stand, as plain arrays by the names of `Worlds`: copies, [B, ...] each.

        With the game it says all that the future depends on, chance included.
        """
        return {name: self.driver.read(getattr(self.now, name)) for name in states.NAMES}

    def load(self, state: Mapping[str, NDArray[Any]], output: StepOutput) -> StepOutput:
        """Puts the worlds where a state says; `output` shows them so, and says that nothing happened.

        Args:
            state: as `state` gives it, of as many worlds of the same game.
            output: as `new_output` makes it.

        Raises:
            ValueError: for a state that cannot be; then nothing has changed.
        """
        for name, values in states.checked(state, worlds=self.size, game=self.game).items():
            self.driver.write(getattr(self.now, name), values)
        self.driver.run("look_at_worlds", self.now, self._everyone, output)
        return output

    def check(self, actions: Actions) -> None:
        """Raises ValueError unless all actions are known; see `play`."""
        wanted = self.size, self.game.agents
        if actions.shape != wanted or actions.dtype != np.int64:
            raise ValueError(f"actions are {actions.dtype} {actions.shape}; wanted: int64 {wanted}")
        known = len(self.game.actions)
        at = self.driver.first_unknown(actions, known)
        if at >= 0:
            world, agent = divmod(at, self.game.agents)
            raise ValueError(
                f"action {self.driver.read(actions)[world, agent]} of agent {agent} in world {world} is "
                f"unknown; allowed: 0 to {known - 1} ({', '.join(self.game.actions)})"
            )
