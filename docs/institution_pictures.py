"""What `draw_institutions.py` draws with: turns that are played for a picture, and panels."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from cprl import Game, Rules, maps, presets
from cprl.commons.batch import Batch
from cprl.institutions import COUNT_NAMES, Institution
from cprl.pictures.colours import agent_colour
from cprl.pictures.image import world_image
from cprl.policies.scripted import Plan, ScriptedActor, ScriptedPolicy
from cprl.terminal.style import MARK_COLOUR, MEAN_COLOUR, RAW_COLOUR

SEED: Final = 3
CELL: Final = 24
"""The side of a cell in pixels."""
EDGE: Final = "#303030"


class Course(NamedTuple):
    """What came of some turns of one world: [T, N] for T turns and N agents, unless said otherwise."""

    harvest: Any
    fines: Any
    transfers: Any
    counts: Any
    """[T, N, C], the `COUNT_NAMES` so far."""
    in_force: Any
    """[T, V]"""
    in_play: Any
    level: Any
    """The level of the next sanction."""
    apples: Any
    """[T, K], 1 for a site with an apple."""
    row: Any
    col: Any
    image: Any
    """The board after the last turn, with agents that were tagged in it."""

    def counted(self, name: str) -> Any:
        """Return what was counted in each turn, [T, N]."""
        return np.diff(self.counts[:, :, COUNT_NAMES.index(name)], axis=0, prepend=0)


def play(
    game: Game,
    policy: ScriptedPolicy | Sequence[str],
    turns: int,
    *,
    episodes: int = 1,
    decisions: Callable[[int], Sequence[int]] | None = None,
) -> Course:
    """Play episodes of a game with institutions.

    Args:
        game: what is played.
        policy: what all agents follow, or a text for each turn with the action of each agent.
        turns: of an episode.
        episodes: how many.
        decisions: those of the agents in an episode.
    """
    batch = Batch(game, 1, seed=SEED)
    output = batch.begin()
    choose = _scripted(game, policy) if isinstance(policy, str) else _named(game, policy)
    turns_played = []
    for episode in range(episodes):
        decided = None if decisions is None else np.array([decisions(episode)], np.int64)
        for turn in range(turns):
            batch.play(choose(turn, output), output, decided)
            now = batch.now
            paid = (output.harvest, output.fines, output.transfers, output.counts, output.in_force)
            state = (now.in_play, batch.law.sanctions.level, now.stock, now.row, now.col)
            turns_played.append([array[0].copy() for array in (*paid, *state)])
        shown = batch.show(output)._replace(in_play=np.ones(game.agents, np.bool_))
        if episode + 1 < episodes:
            batch.begin(output)
    columns = map(np.array, zip(*turns_played, strict=True))
    return Course(*columns, world_image(game.map, shown, cell_pixels=CELL))


def _named(game: Game, texts: Sequence[str]) -> Callable[[int, Any], Any]:
    rows = [np.array([_numbers(game, text)], np.int64) for text in texts]
    return lambda turn, output: rows[turn]


def _numbers(game: Game, text: str) -> list[int]:
    return [game.actions.index(name) for name in text.split()]


def _scripted(game: Game, policy: ScriptedPolicy) -> Callable[[int, Any], Any]:
    seeds = [(SEED, agent) for agent in range(game.agents)]
    actor = ScriptedActor(Plan(policy), game, seeds=seeds, agents=game.agents)
    return lambda turn, output: actor.choose(torch.from_numpy(output.observation)).numpy()


def commons(*institutions: Institution) -> Game:
    """Return the study's board for four agents."""
    return replace(presets.game("commons"), institutions=institutions)


def drawn(drawing: str, *institutions: Institution, **rules: Any) -> Game:
    """Return a drawn board, on which nothing regrows."""
    return Game(map=maps.parse(drawing), rules=Rules(regrow_prob=(0.0,), **rules), institutions=institutions)


def label(panel: Axes, title: str, x: str = "", y: str = "") -> None:
    """Say what a panel and its axes show."""
    panel.set_title(title)
    panel.set_xlabel(x)
    panel.set_ylabel(y)


def hue(agent: int) -> tuple[float, ...]:
    """Return an agent's colour."""
    return tuple(part / 255 for part in agent_colour(agent))


def show_board(panel: Axes, image: Any, title: str) -> None:
    """Show a board, without axes."""
    panel.imshow(image, interpolation="nearest")
    panel.set_title(title)
    panel.set_axis_off()


def shade(panel: Axes, row: int, col: int, rows: int = 1, cols: int = 1, **look: Any) -> None:
    """Shade cells of a board."""
    corner = (col * CELL + 0.5, row * CELL + 0.5)
    panel.add_patch(Rectangle(corner, cols * CELL - 1, rows * CELL - 1, **look))


def point(panel: Axes, text: str, to: tuple[float, float], at: tuple[float, float]) -> None:
    """Write a note at (row, col) of a board, with an arrow to a cell."""
    panel.annotate(
        text,
        ((to[1] + 0.5) * CELL, (to[0] + 0.5) * CELL),
        ((at[1] + 0.5) * CELL, (at[0] + 0.5) * CELL),
        color="white",
        ha="center",
        va="center",
        arrowprops={"arrowstyle": "->", "color": "white", "linewidth": 1.4},
    )


def pay_bars(panel: Axes, course: Course, title: str) -> None:
    """Draw what each agent harvested, paid, was given, and has in the end."""
    harvest = course.harvest.sum(0)
    paid = course.fines.sum(0)
    given = course.transfers.sum(0)
    income = harvest - paid + given
    names = np.arange(len(harvest))
    panel.bar(names - 0.2, harvest, 0.36, color=[hue(i) for i in names], edgecolor=EDGE, label="harvest")
    panel.bar(names - 0.2, -paid, 0.36, color="white", edgecolor=EDGE, hatch="////", label="paid")
    panel.bar(names + 0.2, given, 0.36, color="white", edgecolor=EDGE, hatch="....", label="given")
    panel.plot(names, income, "D", color=MARK_COLOUR, markersize=7, label="income")
    panel.axhline(0, color=EDGE, linewidth=0.8)
    panel.set_xticks(names, [f"agent {i}" for i in names])
    label(panel, title, y="apples")


def stock_lines(panel: Axes, governed: Course, free: Course, name: str) -> None:
    """Draw the apples on the board with an institution and without."""
    turns = np.arange(1, len(governed.apples) + 1)
    panel.plot(
        turns, free.apples.sum(1), color=RAW_COLOUR, linestyle="--", linewidth=2, label="no institution"
    )
    panel.plot(turns, governed.apples.sum(1), color=MEAN_COLOUR, linewidth=2, label=name)
    label(panel, "Apples on the board, four greedy agents", "turn", "apples")
