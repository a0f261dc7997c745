"""crossplay: one agent of a stored run at a time among those of another, at every seat.

Cell (i, j) of the matrix: at seat s sits run i's agent for seat s, the visitor; at all other seats run j's
agents, its hosts. That is played for every seat s and every replica r, run i's r among run j's r, in the
same worlds for all cells and seats. A number of a cell is the mean over seats, estimated over replicas,
which alone are independent.

On the diagonal stands self-play: the visitor is of the hosts' own replica, trained with them. Elsewhere it
is a stranger besides being of another run. diagonal="strangers" tells the two apart: there the visitor is of
the run's next replica, which learned the same way and never met its hosts.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import pyarrow as pa

from cprl.evaluation.evaluate import SEED, check, chosen_replicas, opened
from cprl.evaluation.lanes import Played, Sitter, play, seated
from cprl.evaluation.same_game import check_same_game
from cprl.measuring.episodes import Episode
from cprl.measuring.replicas import Measured, over_replicas, social_measures
from cprl.runs.labelled import labelled
from cprl.stored import LoadedRun

Diagonal: TypeAlias = Literal["self", "strangers"]

NOBODY_VISITS = -1
"""The seat, in tables, of episodes of self-play, in which everybody is visitor and host."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cell:
    """What happened where one run's agents visited another's."""

    visitor: str
    hosts: str
    visits: Mapping[int, Played]
    """By the seat of the visitor; in self-play the same episodes at each."""
    is_self_play: bool

    def measures(self, agent: int | None = None) -> dict[str, Measured]:
        """visitor/return, hosts/return (of a host, their mean) and group/return, then the social metrics.

        Args:
            agent: the visitor's; None for the mean over seats.
        """
        agents = list(self.visits) if agent is None else [agent]
        told = {
            "visitor/return": self._returns(agents, lambda returns, at: returns[at]),
            "hosts/return": self._returns(agents, lambda returns, at: np.delete(returns, at).mean()),
            "group/return": self._returns(agents, lambda returns, at: returns.sum()),
        }
        return {**told, **social_measures(self._played(agents[:1] if self.is_self_play else agents))}

    def _played(self, agents: Sequence[int]) -> Played:
        """The episodes with a visitor at these seats, by replica."""
        together: Played = {}
        for agent in agents:
            for replica, episodes in self.visits[agent].items():
                together.setdefault(replica, []).extend(episodes)
        return together

    def _returns(self, agents: Sequence[int], of: Callable[..., float]) -> Measured:
        """A number of the agents' returns [N] and the visitor's seat, over replicas."""
        values: dict[int, list[float]] = {}
        for agent in agents:
            for replica, episodes in self.visits[agent].items():
                own: list[Episode] = episodes
                values.setdefault(replica, []).extend(float(of(one.return_, agent)) for one in own)
        return over_replicas(values)


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossPlay:
    """The matrix; see the top of this module."""

    runs: Mapping[str, LoadedRun]
    """By the names by which they are told apart."""
    cells: Mapping[tuple[str, str], Cell]
    """By the names of the visitor's run and the hosts'."""
    replicas: list[int]
    episodes: int
    seed: int
    greedy: bool
    diagonal: Diagonal

    def cell(self, visitor: str, hosts: str) -> Cell:
        """A cell, by the names of two runs.

        Raises:
            ValueError: for a name that no run has.
        """
        if (visitor, hosts) not in self.cells:
            raise ValueError(f"there is no cell {visitor!r} among {hosts!r}; runs are {list(self.runs)}")
        return self.cells[visitor, hosts]

    def table(self) -> pa.Table:
        """All episodes as `episodes.parquet` has them, behind "visitor", "hosts" and "seat", the visitor's;
        -1 in self-play. "replica" is the hosts'."""
        return labelled(
            (
                {
                    "visitor": cell.visitor,
                    "hosts": cell.hosts,
                    "seat": NOBODY_VISITS if cell.is_self_play else agent,
                },
                replica,
                episodes,
            )
            for cell in self.cells.values()
            for agent, played in list(cell.visits.items())[: 1 if cell.is_self_play else None]
            for replica, episodes in played.items()
        )


def crossplay(
    runs: Sequence[str | Path | LoadedRun],
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
    diagonal: Diagonal = "self",
) -> CrossPlay:
    """AgentPolicies the agents of each run among those of each other, one visitor at a time.

    Args:
        runs: at least two of the same game: directories, results, or what `cprl.load` gave.
        episodes: of each replica with the visitor at each seat, each in a world of its own.
        greedy: see `cprl.evaluate_run`.
        seed: of the worlds and of all chance.
        replicas: the numbers of those that play; by default all that every run has.
        diagonal: whom a run's agents meet there: "self", those they were trained with, or "strangers", those
            of the run's next replica.

    Raises:
        ValueError: for runs of unlike games, saying what differs, of a game of one seat, or given twice; for
            "strangers" of a single replica; and see `cprl.evaluate_run`.
    """
    named = _named([opened(run) for run in runs])
    first, *_ = named.values()
    check_same_game(named)
    if first.game.agents == 1:
        raise ValueError("the game has one seat, so nobody to visit; `cprl evaluate` is what fits")
    check(episodes=episodes, seed=seed, runs=list(named.values()))
    numbers = chosen_replicas(named, replicas)
    if diagonal == "strangers" and len(numbers) < 2:
        raise ValueError(f"strangers are of another replica; there is only {numbers}")
    following = dict(zip(numbers, [*numbers[1:], numbers[0]], strict=True))
    among = partial(_visits, replicas=numbers, episodes=episodes, seed=seed, explore=not greedy)
    cells = {}
    for visitor, hosts in product(named, repeat=2):
        is_self_play = visitor == hosts and diagonal == "self"
        of_replicas = following if visitor == hosts and not is_self_play else None
        guest = None if is_self_play else Sitter(named[visitor], of_replicas)
        cells[visitor, hosts] = Cell(
            visitor=visitor, hosts=hosts, visits=among(guest, named[hosts]), is_self_play=is_self_play
        )
    return CrossPlay(
        runs=named,
        cells=cells,
        replicas=numbers,
        episodes=episodes,
        seed=seed,
        greedy=greedy,
        diagonal=diagonal,
    )


def _visits(
    guest: Sitter | None,
    hosts: LoadedRun,
    *,
    replicas: Sequence[int],
    episodes: int,
    seed: int,
    explore: bool,
) -> dict[int, Played]:
    """By the seat that the guest takes; without one the hosts play once among themselves, for all seats."""
    game = hosts.game

    def played(sitters: Sequence[Sitter]) -> Played:
        who = partial(seated, sitters, worlds=episodes, seed=seed)
        return play(game, who, replicas, episodes=episodes, seed=seed, explore=explore)

    at_home = [Sitter(hosts)] * game.agents
    if guest is None:
        return dict.fromkeys(range(game.agents), played(at_home))
    return {agent: played([*at_home[:agent], guest, *at_home[agent + 1 :]]) for agent in range(game.agents)}


def _named(runs: Sequence[LoadedRun]) -> dict[str, LoadedRun]:
    """By the names of their directories, by their paths where those are not all different."""
    if len(runs) < 2:
        raise ValueError(f"{len(runs)} run came; at least two are wanted: cprl crossplay RUN RUN...")
    paths = [run.path.resolve() for run in runs]
    for place, path in enumerate(paths):
        if path in paths[:place]:
            raise ValueError(f"{runs[place].path} is given twice")
    names = [path.name for path in paths]
    if len(set(names)) < len(names):
        names = [str(path) for path in paths]
    return dict(zip(names, runs, strict=True))
