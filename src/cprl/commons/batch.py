"""B worlds at once: the compiled rules, driven by CPU threads over worlds."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cprl.commons.compiled import rules_for_cpu
from cprl.commons.game import Game
from cprl.commons.world import Actions, Bools, Bytes, Told, empty_scratch, empty_worlds

WORLDS_PER_THREAD = 512
"""Fewer are not worth handing to another thread, which takes a tenth of a millisecond."""


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Threads of this very process; a fork makes its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix=f"cprl-{process}")


class Batch:
    """B worlds of a game, played a turn at a time on the CPU.

    Args:
        game: what is played.
        worlds: how many worlds B, at least 1.
        seed: 0 .. 2**64 - 1; with it, the world's number, the episode and the step all chance is settled.
        first_world: the number of the first world, so that world b can be played alone.
        threads: how many CPU threads share the worlds; None for all cores where it pays.
    """

    def __init__(
        self, game: Game, worlds: int, *, seed: int = 0, first_world: int = 0, threads: int | None = None
    ) -> None:
        if worlds < 1:
            raise ValueError(f"worlds is {worlds}; at least 1 is wanted")
        if first_world < 0 or first_world + worlds > 2**32:
            raise ValueError(f"worlds {first_world} to {first_world + worlds - 1}; allowed: 0 to 2**32 - 1")
        if threads is not None and threads < 1:
            raise ValueError(f"threads is {threads}; at least 1 is wanted, or None for all cores")
        self.game = game
        self.size = worlds
        most = threads or os.cpu_count() or 1
        self.threads = min(most, worlds if threads else -(-worlds // WORLDS_PER_THREAD))
        self.worlds = empty_worlds(worlds=worlds, agents=game.agents, sites=len(game.map.sites))
        self.worlds.number[:, 0] = np.arange(first_world, first_world + worlds, dtype=np.uint64)
        self._tables = game.tables
        self._sheets = [
            empty_scratch(
                agents=game.agents,
                sites=len(game.map.sites),
                cells=self._tables.background.size,
                window=self._tables.window_cells.shape[1],
            )
            for _ in range(self.threads)
        ]
        self.set_seed(seed)

    def set_seed(self, seed: int) -> None:
        """Starts all over: the next episode of each world is the first of this seed."""
        if not 0 <= seed < 2**64:
            raise ValueError(f"seed is {seed}; allowed: 0 to 2**64 - 1")
        self.worlds.seed[:] = seed
        self.worlds.episode[:] = -1

    def new_told(self) -> Told:
        """Fresh arrays for what a turn tells."""
        shape = self.size, self.game.agents
        return Told(
            observation=np.empty((*shape, *self.game.window_shape), np.uint8),
            harvest=np.empty(shape, np.float32),
            in_play=np.empty(shape, np.bool_),
            fired=np.empty(shape, np.bool_),
            hit_by=np.empty((*shape, self.game.agents), np.bool_),
            tagged_by=np.empty((*shape, self.game.agents), np.bool_),
            stock=np.empty((self.size, 1), np.int64),
            regrown=np.empty((self.size, 1), np.int64),
            terminated=np.empty((self.size, 1), np.bool_),
            truncated=np.empty((self.size, 1), np.bool_),
            done=np.empty((self.size, 1), np.bool_),
        )

    def begin(self, told: Told, which: Bools | None = None) -> Told:
        """Begins the next episode of the marked worlds, all if None; only their rows of `told` are written.

        Args:
            which: bool [B].
        """
        which = np.ones(self.size, np.bool_) if which is None else which
        self._share(rules_for_cpu()["begin_worlds"], which, told)
        return told

    def play(self, actions: Actions, told: Told) -> Told:
        """One turn of every world, into `told`.

        Args:
            actions: int64 [B, N], contiguous.

        Raises:
            ValueError: for an action that the game does not know; then nothing has changed.
        """
        self.check(actions)
        return self.play_checked(actions, told)

    def play_checked(self, actions: Actions, told: Told) -> Told:
        """`play` for actions that `check` has seen."""
        self._share(rules_for_cpu()["play_worlds"], actions, told)
        return told

    def boards(self, told: Told) -> Bytes:
        """The whole boards as they stand, uint8 [B, H, W], colour classes of `cprl.commons.game`."""
        boards = np.empty((self.size, self.game.map.height, self.game.map.width), np.uint8)
        self._share(rules_for_cpu()["show_worlds"], boards, told)
        return boards

    def check(self, actions: Actions) -> None:
        """Raises ValueError unless all actions are known; see `play`."""
        wanted = self.size, self.game.agents
        if actions.shape != wanted or actions.dtype != np.int64:
            raise ValueError(f"actions are {actions.dtype} {actions.shape}; wanted: int64 {wanted}")
        known = len(self.game.actions)
        at = rules_for_cpu()["first_unknown"](actions.reshape(-1), known)
        if at >= 0:
            world, agent = divmod(at, self.game.agents)
            raise ValueError(
                f"action {actions[world, agent]} of agent {agent} in world {world} is unknown; "
                f"allowed: 0 to {known - 1} ({', '.join(self.game.actions)})"
            )

    def _share(self, rule: Callable[..., None], what: NDArray[Any], told: Told) -> None:
        """Runs a rule on all worlds, each thread on its share of them; this thread takes the last share."""
        play = partial(rule, self.worlds, self._tables, what, told)
        if self.threads == 1:
            play(self._sheets[0], 0, self.size)
            return
        bounds = [self.size * t // self.threads for t in range(self.threads + 1)]
        *others, own = zip(self._sheets, bounds, bounds[1:], strict=False)
        pool = _pool(os.getpid(), self.threads - 1)
        shares = [pool.submit(play, *share) for share in others]
        play(*own)
        for share in shares:
            share.result()
