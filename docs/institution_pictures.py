"""What `draw_institutions.py` draws with: a game that is played for a picture, and panels."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cprl import Game, Rules, maps, presets
from cprl.commons.batch import Batch
from cprl.institutions import COUNTS, Institution
from cprl.pictures.colours import agent_colour
from cprl.pictures.image import world_image
from cprl.policies.scripted import ScriptedActor, ScriptedPolicy
from cprl.terminal.style import MARK, MEAN, RAW

SEED: Final = 3
WIDTH_IN, TEXT_PT = 7.2, 9.5
CELL: Final = 24
EDGE: Final = "#303030"


class Course(NamedTuple):
    """What came of some turns of one world: [T, N] for T turns and N agents, unless said otherwise."""

    harvest: Any
    fines: Any
    transfers: Any
    counts: Any
    """[T, N, C], the `COUNTS` so far."""
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
        """What was counted in each turn, [T, N]."""
        return np.diff(self.counts[:, :, COUNTS.index(name)], axis=0, prepend=0)


def play(
    game: Game,
    policy: ScriptedPolicy | Sequence[str],
    turns: int,
    *,
    episodes: int = 1,
    decisions: Callable[[int], Sequence[int]] | None = None,
) -> Course:
    """Plays episodes of a game with institutions.

    Args:
        game: what is played.
        policy: what all agents follow, or a text for each turn with the action of each agent.
        turns: of an episode.
        episodes: how many.
        decisions: those of the agents in an episode.
    """
    batch, found = Batch(game, 1, seed=SEED), []
    output = batch.begin(batch.new_output())
    choose = _scripted(game, policy) if isinstance(policy, str) else _named(game, policy)
    for episode in range(episodes):
        decided = None if decisions is None else np.array([decisions(episode)], np.int64)
        for turn in range(turns):
            batch.play(choose(turn, output), output, decided)
            now = batch.now
            one = output.harvest, output.fines, output.transfers, output.counts, output.in_force
            more = now.in_play, batch.law.sanctions.level, now.stock, now.row, now.col
            found.append([array[0].copy() for array in (*one, *more)])
        shown = batch.show(output)._replace(in_play=np.ones(game.agents, np.bool_))
        if episode + 1 < episodes:
            batch.begin(output)
    return Course(*map(np.array, zip(*found, strict=True)), world_image(game.map, shown, cell_pixels=CELL))


def _named(game: Game, texts: Sequence[str]) -> Callable[[int, Any], Any]:
    rows = [[game.actions.index(name) for name in text.split()] for text in texts]
    return lambda turn, output: np.array([rows[turn]], np.int64)


def _scripted(game: Game, policy: ScriptedPolicy) -> Callable[[int, Any], Any]:
    seeds = [(SEED, agent) for agent in range(game.agents)]
    actor = ScriptedActor(policy, game, seeds=seeds, agents=game.agents)
    return lambda turn, output: actor.choose(torch.from_numpy(output.observation)).numpy()


def commons(*institutions: Institution) -> Game:
    """The study's board for four agents."""
    return replace(presets.game("commons"), institutions=institutions)


def drawn(drawing: str, *institutions: Institution, **rules: Any) -> Game:
    """A drawn board, on which nothing regrows."""
    return Game(map=maps.parse(drawing), rules=Rules(regrow_prob=(0.0,), **rules), institutions=institutions)


def new_figure(height_in: float, rows: int = 1, columns: int = 1, **grid: Any) -> tuple[Figure, list[Axes]]:
    """A figure as wide as the page, and its panels."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False, **grid).ravel())
    for panel in panels:
        panel.tick_params(labelsize=TEXT_PT)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, panels


def titled(panel: Axes, title: str, x: str = "", y: str = "") -> None:
    """What a panel shows."""
    panel.set_title(title, fontsize=TEXT_PT + 0.5, loc="left")
    panel.set_xlabel(x, fontsize=TEXT_PT)
    panel.set_ylabel(y, fontsize=TEXT_PT)


def legend(panel: Axes, **how: Any) -> None:
    """The legend of a panel."""
    panel.legend(**{"fontsize": TEXT_PT - 0.5, "frameon": False, "loc": "best", **how})


def hue(agent: int) -> tuple[float, ...]:
    """An agent's colour."""
    return tuple(part / 255 for part in agent_colour(agent))


def show_board(panel: Axes, image: Any, title: str) -> None:
    """A board, without axes."""
    panel.imshow(image, interpolation="nearest")
    panel.set_title(title, fontsize=TEXT_PT + 0.5, loc="left")
    panel.set_axis_off()


def shade(panel: Axes, row: int, col: int, rows: int = 1, cols: int = 1, **how: Any) -> None:
    """Shades cells of a board."""
    size = cols * CELL - 1, rows * CELL - 1
    panel.add_patch(Rectangle((col * CELL + 0.5, row * CELL + 0.5), *size, **how))


def point(panel: Axes, text: str, to: tuple[float, float], at: tuple[float, float]) -> None:
    """A note at (row, col) of a board, with an arrow to a cell."""
    panel.annotate(
        text,
        ((to[1] + 0.5) * CELL, (to[0] + 0.5) * CELL),
        ((at[1] + 0.5) * CELL, (at[0] + 0.5) * CELL),
        color="white",
        fontsize=TEXT_PT,
        ha="center",
        va="center",
        arrowprops={"arrowstyle": "->", "color": "white", "linewidth": 1.4},
    )


def pay_bars(panel: Axes, course: Course, title: str) -> None:
    """What each agent harvested, paid, was given, and has in the end."""
    got, paid, given = (values.sum(0) for values in (course.harvest, course.fines, course.transfers))
    names = np.arange(len(got))
    panel.bar(names - 0.2, got, 0.36, color=[hue(i) for i in names], edgecolor=EDGE, label="harvest")
    panel.bar(names - 0.2, -paid, 0.36, color="white", edgecolor=EDGE, hatch="////", label="paid")
    panel.bar(names + 0.2, given, 0.36, color="white", edgecolor=EDGE, hatch="....", label="given")
    panel.plot(names, got - paid + given, "D", color=MARK, markersize=7, label="return")
    panel.axhline(0, color=EDGE, linewidth=0.8)
    panel.set_xticks(names, [f"agent {i}" for i in names])
    titled(panel, title, y="apples")
    panel.set_ylim(top=1.35 * float(max(got.max(), (got - paid + given).max())))
    legend(panel, ncols=4, loc="upper center", columnspacing=1.2)


def stock_lines(panel: Axes, governed: Course, free: Course, name: str) -> None:
    """The apples on the board with an institution and without."""
    turns = np.arange(1, len(governed.apples) + 1)
    panel.plot(turns, free.apples.sum(1), color=RAW, linestyle="--", linewidth=2, label="no institution")
    panel.plot(turns, governed.apples.sum(1), color=MEAN, linewidth=2, label=name)
    titled(panel, "Apples on the board, four greedy agents", "turn", "apples")
