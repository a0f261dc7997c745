"""Helpers of the tests: play a drawn board and draw the result."""

import importlib.util
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from cprl import Game, Map, Observation, Quirks2019, Rules, maps, presets
from cprl.commons.batch import Batch
from cprl.commons.cells import CLASS_NAMES, FIRST_AGENT, class_colour
from cprl.commons.maps import SIGN_OF_HEADING
from cprl.commons.rules import RuleGroups
from cprl.commons.world import StepOutput, Worlds
from cprl.institutions import COUNT_NAMES, Institution
from cprl.institutions.arrays import state_arrays

RGB_SIGN = {
    (10, 10, 10): ".",
    (125, 125, 125): "#",
    (0, 255, 0): "A",
    (50, 50, 50): "m",
    (255, 204, 51): "b",
    (255, 0, 0): "o",
    (0, 0, 255): "S",
    (0, 0, 0): "?",
    (70, 120, 170): "~",
    (113, 75, 24): "H",
    (100, 255, 255): "c",
}
SIGN_OF_NAME = dict(zip(CLASS_NAMES, ".#AmboS?~Hc", strict=True))


class Play:
    """Worlds of a board, in which all do the same, played by the names of actions; apples regrow only if
    `rules` says so. What is shown is the first world.

    The agents of a drawing are numbered in reading order; `order` gives them other indices.
    """

    def __init__(
        self,
        board: str | Map,
        *,
        worlds: int = 1,
        seed: int = 0,
        order: Sequence[int] | None = None,
        observation: Observation | None = None,
        institutions: Sequence[Institution] = (),
        **rules,
    ):
        board = maps.parse(board) if isinstance(board, str) else board
        if order is not None:
            board = replace(board, starts=tuple(board.starts[i] for i in order))
        rules = {"regrow_prob": (0.0,), **rules}
        self.game = Game(
            map=board,
            rules=Rules(**rules),
            observation=observation or Observation(),
            institutions=tuple(institutions),
        )
        self.batch = Batch(self.game, worlds, seed=seed)
        self.output = self.batch.begin()

    def turn(self, *names: str, decisions: Sequence[int] | None = None) -> "Play":
        """Plays one turn: one action per agent, or one for all agents."""
        names = names * self.game.agents if len(names) == 1 else names
        everywhere = (self.batch.size, 1)
        actions = np.tile([self.game.actions.index(name) for name in names], everywhere)
        self.batch.play(actions, self.output, None if decisions is None else np.tile(decisions, everywhere))
        return self

    def put(self, **changes: Any) -> "Play":
        """Loads the state of all worlds with other entries."""
        self.batch.load({**self.batch.state(), **changes}, self.output)
        return self

    def shown(self, count: int) -> list[list[int]]:
        """What institutions show each agent, 0..255, after the plane of forbidden cells."""
        first = len(self.game.cell_channels) + ("forbidden" in self.game.channels)
        return [seen[first:].reshape(-1)[:count].tolist() for seen in self.output.observation[0]]

    def again(self) -> "Play":
        """Begins the next episode."""
        self.batch.begin(self.output)
        return self

    fines = property(lambda play: play.output.fines[0].tolist())
    transfers = property(lambda play: play.output.transfers[0].tolist())
    reward = property(lambda play: play.output.reward[0].tolist())
    violated = property(lambda play: play.output.violated[0].tolist())
    in_play = property(lambda play: play.batch.now.in_play[0].tolist())
    harvest = property(lambda play: play.output.harvest[0].tolist())

    def counts(self, name: str) -> list[int]:
        """What was counted for each agent in this episode, by its name in `COUNT_NAMES`."""
        return self.output.counts[0, :, COUNT_NAMES.index(name)].tolist()

    @property
    def places(self) -> list[tuple[int, int]]:
        worlds = self.batch.now
        return [(int(r), int(c)) for r, c in zip(worlds.row[0], worlds.col[0], strict=True)]

    @property
    def board(self) -> str:
        """Ground, walls, apples and agents in play, each with its heading."""
        worlds, board = self.batch.now, self.game.map
        signs = [["."] * board.width for _ in range(board.height)]
        for row, col in board.walls:
            signs[row][col] = "#"
        for (row, col), apples in zip(board.sites, worlds.stock[0], strict=True):
            signs[row][col] = "A" if apples else "."
        for i in range(self.game.agents):
            if worlds.in_play[0, i]:
                signs[worlds.row[0, i]][worlds.col[0, i]] = SIGN_OF_HEADING[int(worlds.heading[0, i])]
        return "\n".join("".join(row) for row in signs)

    def window(self, agent: int) -> str:
        """An agent's observation in the signs of `RGB_SIGN`; other agents by index under `agents_apart`."""
        if self.game.observation.encoding == "one_hot":
            return self._one_hot_window(agent)
        pixels = self.output.observation[0, agent].transpose(1, 2, 0)
        numbers = {class_colour(FIRST_AGENT + i): str(i) for i in range(self.game.agents)}
        signs = {**RGB_SIGN, **(numbers if self.game.observation.agents_apart else {})}
        return "\n".join("".join(signs[tuple(map(int, cell))] for cell in row) for row in pixels)

    def _one_hot_window(self, agent: int) -> str:
        planes = self.output.observation[0, agent]
        assert (planes.sum(0) == 1).all(), "each cell is of one class"
        signs = [SIGN_OF_NAME.get(name, name[-1]) for name in self.game.channels]
        return "\n".join("".join(signs[kind] for kind in row) for row in planes.argmax(0))


def only_quirks(**on: bool) -> Quirks2019:
    """The quirks of the program of 2019 that are named, without the others."""
    off = {field.name: False for field in fields(Quirks2019)}
    return Quirks2019(**{**off, **on})


def drawn(text: str) -> str:
    """A drawing without the indentation it has in a test."""
    return "\n".join(line.strip() for line in text.strip().splitlines())


def random_actions(steps: int, worlds: int, game: Game, *, seed: int = 0) -> np.ndarray:
    """int64 [steps, worlds, N], every action equally likely."""
    shape = steps, worlds, game.agents
    return np.random.default_rng(seed).integers(0, len(game.actions), shape)


class Moment(NamedTuple):
    """Copies of all arrays after a turn; `law`: of what institutions remember."""

    worlds: Worlds
    turn: StepOutput
    law: dict[str, np.ndarray] | None = None


def copied(record: Any) -> Any:
    """A record of arrays with copies of them; groups of rules by the names of what they remember."""
    entries = (remembered(entry) if isinstance(entry, RuleGroups) else entry.copy() for entry in record)
    return type(record)(*entries)


def remembered(record: Any) -> dict[str, np.ndarray]:
    """Copies of the arrays of a record, of institutions or groups of rules, that are part of the state."""
    return {name: array.copy() for name, array, _ in state_arrays(record, derived=True)}


def kept(batch: Batch, output: StepOutput) -> Moment:
    """The moment after the last turn."""
    moment = Moment(copied(batch.now), copied(output))
    if batch.law is None:
        return moment
    return moment._replace(law=remembered(batch.law))


def play_on(batch: Batch, output: Any, actions: Any, decisions: Any = None) -> list[Moment]:
    """The moments after each turn."""
    moments = []
    for number, turn in enumerate(actions):
        batch.play(turn, output, None if decisions is None else decisions[number])
        moments.append(kept(batch, output))
    return moments


def played(game: Game, actions: Any, decisions: Any = None, **options) -> list[Moment]:
    """The moments before the first turn and after each."""
    batch = Batch(game, actions.shape[1], **options)
    output = batch.begin()
    return [kept(batch, output), *play_on(batch, output, actions, decisions)]


def assert_same(record: Any, other: Any, *, rows: Any = slice(None), other_rows: Any = slice(None)) -> None:
    """All arrays of records, and of the records in them, are equal in the given worlds."""
    others = by_name(other)
    for name, one in by_name(record).items():
        if isinstance(one, tuple | dict):
            assert_same(one, others[name], rows=rows, other_rows=other_rows)
        elif one is not None:
            assert np.array_equal(one[rows], others[name][other_rows]), name


def by_name(record: Any) -> dict[str, Any]:
    """The entries of a record; groups of rules by the names of what they remember."""
    entries = record if isinstance(record, dict) else record._asdict()
    return {
        name: remembered(entry) if isinstance(entry, RuleGroups) else entry for name, entry in entries.items()
    }


def module_at(path: Path) -> ModuleType:
    """A module, e.g. a recipe, imported by its path."""
    spec: Any = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


CROSS = maps.parse(
    """
    >Av
    AAA
    .A.
    """
)
AS_RUN = presets.game("commons", variant="as_run").rules
PUBLISHED = presets.game("commons").rules
