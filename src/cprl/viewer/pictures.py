"""Pictures that are drawn every some episodes of a training, and the borders of regions.

The pictures show who tagged whom, where agents go, the stock over the turn, and the Lorenz curve. To add a
picture, write a function from `PictureData` to Rerun's archetypes, and add it to `Pictures` and to
`cprl.viewer.layout`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import rerun as rr
from tensordict import TensorDictBase

from cprl.commons.cells import GROUND, WALL
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.social import gini, lorenz_curve
from cprl.measuring.tracker import Episode
from cprl.pictures.colours import GREEN, GREY, ORANGE, PALETTE, PURPLE, agent_colour
from cprl.pictures.image import OwnedRegions, region_colour
from cprl.values.array_types import Bool, Float32, Float64, Int64, UInt8
from cprl.viewer.board import RIM_CELLS
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import DIED, TEXT
from cprl.viewer.scene import PLOT_HIGH, PLOT_WIDE, TITLE, Scene, boards_of
from cprl.viewer.view import Numbers, View, has_died

Archetypes: TypeAlias = Mapping[str, Any]
"""Rerun's archetypes by entity."""


class PictureData(NamedTuple):
    """The data from which a picture is drawn."""

    episodes: Sequence[Episode]
    """The episodes of all replicas since the last picture, or the last `Picture.over` episodes."""
    span: str
    """The numbers of these episodes, e.g. "episodes 51 to 100"; of a resumed run those since the resume."""
    first: "PictureData | None"
    """The data of the first picture of this kind; None for the first one."""


class Samples(View):
    """Samples the agents' cells in the first world, and the stock of each shown board, every `stride` turns.

    Samples are copied to a buffer and evaluated later. A copy takes one microsecond; an evaluation between
    two steps of the training would take twenty, because its code and data are not in the CPU caches then.
    """

    BUFFERED_SAMPLES = 100
    """The number of samples that the buffer holds."""
    MOST_SAMPLES = 100
    """The largest number of samples in an episode."""

    def __init__(self, env: CommonsEnv, logger: RerunLogger) -> None:
        scene = logger.curves
        assert isinstance(scene, Scene)
        self._logger = logger
        steps = env.game.rules.episode_steps
        self.stride = ceil(steps / self.MOST_SAMPLES)
        self.axes = Axes("turn", "turn of the episode", steps, max(1, len(scene.sites)))
        """The axes of the picture of the stock."""
        self.lines: list[list[tuple[int, int]]] = [[] for _ in range(scene.boards)]
        """The points (turn, stock) of each board's last episode."""
        self.died = [False] * scene.boards
        """Whether each board died in its last episode."""
        self.on_board(env, scene)

    def on_board(self, env: CommonsEnv, scene: Scene) -> None:
        """Sample these worlds from now on; begin the visits anew."""
        now = env.worlds.now
        boards = scene.boards
        self._scene = scene
        self._count = 0
        """The number of samples in the buffer."""
        arrays: list[Any] = [
            now.row[:1],
            now.col[:1],
            now.in_play[:1],
            now.step[:boards],
            now.stock_left[:boards],
        ]
        self._buffers = [
            (array, np.empty((self.BUFFERED_SAMPLES, *array.shape), array.dtype)) for array in arrays
        ]
        """Each sampled array of the worlds, with the buffer of its samples."""
        self._read = env.worlds.driver.read
        self.visits = np.zeros((len(scene.agents), scene.height, scene.width), np.int64)
        """int [N, H, W], the samples in which each agent of the first world was on each cell, since the last
        picture."""
        self._running_stock: list[dict[int, int]] = [{} for _ in range(boards)]
        """The stock by turn in the running episode of each board."""

    def on_step(self, batch: TensorDictBase) -> None:
        if self._logger.turn % self.stride:
            return
        for array, buffer in self._buffers:
            buffer[self._count] = self._read(array)
        self._count += 1
        if self._count == self.BUFFERED_SAMPLES:
            self.evaluate()

    def evaluate(self) -> None:
        """Add the samples in the buffer to the visits and to the running episodes; empty the buffer."""
        *first_world, turn, stock = (buffer[: self._count] for _, buffer in self._buffers)
        row, col, in_play = (samples[:, 0] for samples in first_world)
        self._count = 0
        agent = np.broadcast_to(np.arange(len(self.visits)), row.shape)
        np.add.at(self.visits, (agent[in_play], row[in_play], col[in_play]), 1)
        for board, stock_by_turn in enumerate(self._running_stock):
            stock_by_turn.update(zip(turn[:, board, 0].tolist(), stock[:, board, 0].tolist(), strict=True))

    def on_episode(self, episode: Episode) -> None:
        if episode.world >= len(self.lines):
            return
        self.evaluate()
        stock_by_turn = self._running_stock[episode.world]
        points = [(turn, stock) for turn, stock in sorted(stock_by_turn.items()) if turn < episode.steps]
        # All episodes begin with the same stock, so the next one has the point of turn 0 already.
        self._running_stock[episode.world] = {turn: stock for turn, stock in points if turn == 0}
        if episode.stock_left is not None:
            points.append((episode.steps, episode.stock_left))
        self.lines[episode.world] = points
        self.died[episode.world] = bool(has_died(episode))

    def draw_visit_maps(self, data: PictureData) -> Archetypes:
        """Draw a map per agent of the first world: a cell's brightness shows how long the agent was there."""
        self.evaluate()
        panels = boards_of(self._scene, len(self.visits))
        image = panels.join(visit_maps(self.visits, self._scene), PALETTE[GROUND])
        texts = [f"{agent}: {data.span}" for agent in range(len(self.visits))]
        self.visits[:] = 0
        return {"visits": rr.Image(image), "visits/labels": _texts(panels.tops, texts)}

    def draw_stock(self, data: PictureData) -> Archetypes:
        """Draw the stock over the turns of the last episode of each shown board, in orange if the board
        died."""
        boards = [board for board, line in enumerate(self.lines) if len(line) > 1]
        if not boards:
            return {}
        owners = "each replica"
        worlds = self._scene.worlds
        if worlds > 1:
            count = len(self.lines)
            shown_worlds = "each world" if worlds == count else f"the first {count} worlds"
            owners = f"{shown_worlds} of the first replica"
        return self.axes.lines(
            f"last episode of {owners}: {sum(self.died)} of {len(boards)} died (orange)",
            [tuple(np.array(self.lines[board]).T) for board in boards],
            colours=[DIED if self.died[board] else GREY for board in boards],
            radii=0.5,
        )


@dataclass(frozen=True)
class Axes:
    """The axes of a plot that is not over time. Both begin at 0; the title of the view names the y-axis."""

    origin: str
    """The entity of the plot."""
    x_name: str
    """The name of the x-axis."""
    x_end: float
    y_end: float

    def static_parts(self) -> Archetypes:
        """Return the axes, their grid and their numbers, which never change."""
        faint = (50, 52, 58)
        grey = (120, 120, 120)
        x_ticks = _ticks(self.x_end)
        y_ticks = _ticks(self.y_end)
        grid = [self._to_view([tick, tick], [0, self.y_end]) for tick in x_ticks]
        grid += [self._to_view([0, self.x_end], [tick, tick]) for tick in y_ticks]
        axes = self._to_view([0, 0, self.x_end], [self.y_end, 0, 0])
        colours = [*[faint] * len(grid), grey]
        radii = [*[0.1] * len(grid), 0.3]
        below = [(self._to_view(tick, 0)[0], PLOT_HIGH + 1.0) for tick in x_ticks]
        left = [(-10.0, self._to_view(0, tick)[1] - 6.0) for tick in y_ticks]
        texts = [*(f"{tick:g}" for tick in (*x_ticks, *y_ticks)), self.x_name]
        return {
            f"{self.origin}/axes": rr.LineStrips2D([*grid, axes], colors=colours, radii=radii),
            f"{self.origin}/axes/texts": _texts([*below, *left, (PLOT_WIDE / 2, PLOT_HIGH + 13.0)], texts),
        }

    def lines(self, title: str, curves: Sequence[tuple[Any, Any]], *, colours: Any, radii: Any) -> Archetypes:
        """Return a title and lines, each given by its x and its y."""
        strips = [self._to_view(x, y) for x, y in curves]
        return {
            f"{self.origin}/lines": rr.LineStrips2D(strips, colors=colours, radii=radii),
            f"{self.origin}/title": _texts([TITLE], [title]),
        }

    def _to_view(self, x: Any, y: Any) -> Float32:
        """Return the positions of points in the view's units, float32 [points, 2]."""
        share = np.stack([np.asarray(x) / self.x_end, np.asarray(y) / self.y_end], -1)
        positions: Float32 = (share * (PLOT_WIDE, -PLOT_HIGH) + (0, PLOT_HIGH)).astype(np.float32)
        return positions


def _texts(positions: Any, texts: Sequence[str]) -> Any:
    """Return texts at positions (x, y)."""
    return rr.Points2D(positions, labels=texts, colors=TEXT, radii=0.0, show_labels=True)


def _ticks(end: float) -> list[float]:
    """Return a few round numbers from 0 to at most `end`: 260 gives 0, 100 and 200."""
    magnitude = 10 ** np.floor(np.log10(end))
    steps = (factor * magnitude for factor in (0.1, 0.2, 0.25, 0.5, 1.0, 2.0))
    step = next(step for step in steps if end / step <= 5)
    return [step * index for index in range(int(end / step + 1e-9) + 1)]


def draw_tags(data: PictureData) -> Archetypes:
    """Draw the mean number of tags per episode as a matrix: who (row) was tagged by whom (column)."""
    counts = [episode.tagged_by for episode in data.episodes if episode.tagged_by is not None]
    if not counts:
        return {}
    tags = np.mean(counts, 0)
    brightness = (tags / (tags.max() or 1.0))[..., None]
    image = np.array(PALETTE[GROUND]) * (1 - brightness) + np.array(PURPLE) * brightness
    agents = range(len(tags))
    cells = [(col + 0.5, row + 0.3) for row in agents for col in agents]
    edges = [(-0.5, agent + 0.3) for agent in agents] + [(agent + 0.5, -0.7) for agent in agents]
    texts = [*(f"{count:.3g}" for count in tags.ravel()), *2 * [f"{agent}" for agent in agents]]
    return {"tags": rr.Image(image.round().astype(np.uint8)), "tags/counts": _texts([*cells, *edges], texts)}


_DARKEST: Final = 0.35
"""The least brightness of a visited cell; the cell with the longest stay has brightness 1."""


def visit_maps(visits: Int64, scene: Scene) -> UInt8:
    """Return a map for each agent, with a rim of wall around the board.

    The brightness of a cell is the square root of the number of visits, as a share of the largest number.

    Args:
        visits: int [N, H, W], the number of samples in which each agent was on each cell.

    Returns:
        uint8 [N, H + 2, W + 2, 3], colours.
    """
    share = np.sqrt(visits / max(1, visits.max()))
    brightness = np.where(visits > 0, _DARKEST + (1 - _DARKEST) * share, 0.0)[..., None]
    hues = np.array([agent_colour(agent) for agent in range(len(visits))])[:, None, None]
    maps = np.array(PALETTE[GROUND]) * (1 - brightness) + hues * brightness
    for row, col in scene.walls:
        maps[:, row, col] = PALETTE[WALL]
    with_rim = np.empty((len(maps), scene.height + 2, scene.width + 2, 3), np.uint8)
    with_rim[:] = PALETTE[WALL]
    with_rim[:, 1:-1, 1:-1] = maps.round()
    return with_rim


_LORENZ_AXES: Final = Axes("lorenz", "agents, the poorest first, %", 100.0, 100.0)


def draw_lorenz(data: PictureData) -> Archetypes:
    """Draw the mean Lorenz curve of the latest episodes and that of the first picture.

    The Gini coefficient of the mean curve is 1 minus the mean equality of the episodes. Episodes without a
    harvest have no curve and are left out.
    """
    curves = _lorenz_curves(data)
    if not curves:
        return {}
    first = data.first or data
    curve = np.mean(curves, 0)
    earliest = np.mean(_lorenz_curves(first), 0)
    share = np.linspace(0, 100, len(curve))
    title = (
        f"Gini {gini(curve):.2f}: {data.span}, {len(curves)} with a harvest "
        f"(green: {first.span}, {gini(earliest):.2f}; grey: equal shares)"
    )
    lines = [(share, 100 * shares) for shares in (share / 100, earliest, curve)]
    return _LORENZ_AXES.lines(title, lines, colours=[GREY, GREEN, ORANGE], radii=[0.3, 0.5, 1.0])


def _lorenz_curves(data: PictureData) -> list[Float64]:
    harvests = [episode.harvest for episode in data.episodes if episode.harvest is not None]
    return [lorenz_curve(harvest) for harvest in harvests if harvest.sum() > 0]


@dataclass(kw_only=True)
class Picture:
    """A picture of a training: the function that draws it, and when it is drawn."""

    draw: Callable[[PictureData], Archetypes]
    """Draws the picture; returns an empty mapping if there is nothing to draw."""
    every: int
    """The number of episodes of a replica between two pictures."""
    over: int = 0
    """The number of last episodes of a replica that the picture shows; 0 for all since the last picture."""
    axes: Axes | None = None
    """The axes of the picture, if it has any."""
    is_sampled: bool = False
    """Whether the picture needs samples of boards, which are lost when a run is resumed."""
    drawn: int = 0
    """How many episodes all replicas had ended when it was drawn last."""
    first: PictureData | None = None
    """The data of the first picture."""


TAGS_EPISODES: Final = 50
"""The number of last episodes of a replica whose tags are drawn."""


class Pictures(View):
    """Logs the pictures that a game has, every `every` episodes of a replica and at the end."""

    def __init__(self, logger: RerunLogger, samples: Samples | None, *, every: int) -> None:
        self._logger = logger
        self._episodes: list[Episode] = []
        self._ended = 0
        self._pictures: list[Picture] = []
        curves = logger.curves
        if curves.has_tags_between:
            self._pictures.append(Picture(draw=draw_tags, every=10, over=TAGS_EPISODES))
        if samples is not None:
            self._pictures += [
                Picture(draw=samples.draw_visit_maps, every=every, is_sampled=True),
                Picture(draw=samples.draw_stock, every=every, is_sampled=True, axes=samples.axes),
            ]
        if curves.has_lorenz:
            self._pictures.append(Picture(draw=draw_lorenz, every=every, axes=_LORENZ_AXES))
        notice = _texts([TITLE], [f"lines from episode {ceil(every / curves.worlds) * curves.worlds} on"])
        for picture in self._pictures:
            if picture.axes is not None:
                for entity, archetype in picture.axes.static_parts().items():
                    logger.log_static(entity, archetype)
                logger.log_row(f"{picture.axes.origin}/title", notice, live_only=True)

    def on_episode(self, episode: Episode) -> None:
        self._episodes.append(episode)

    def on_numbers(self, episode: int, numbers: Numbers) -> None:
        ended_before = self._ended
        self._ended = episode + 1
        for picture in self._pictures:
            if self._ended // picture.every > ended_before // picture.every:
                self._draw(picture)
        oldest = min([self._ended - TAGS_EPISODES, *(picture.drawn for picture in self._pictures)])
        self._episodes = [past for past in self._episodes if past.episode >= oldest]

    def close(self) -> None:
        for picture in self._pictures:
            if self._ended > picture.drawn:
                self._draw(picture)

    def resumed(self) -> None:
        for picture in self._pictures:
            if picture.is_sampled:
                picture.drawn = self._ended

    def _draw(self, picture: Picture) -> None:
        ended = self._ended
        begin = ended - picture.over if picture.over else picture.drawn
        episodes = [episode for episode in self._episodes if begin <= episode.episode < ended]
        span = f"episodes {picture.drawn + 1} to {ended}"
        if ended == picture.drawn + 1:
            span = f"episode {ended}"
        data = PictureData(episodes, span, picture.first)
        picture.drawn = ended
        archetypes = picture.draw(data)
        if archetypes:
            picture.first = picture.first or data
        for entity, archetype in archetypes.items():
            self._logger.log_row(entity, archetype)


_BORDER_OPACITY: Final = 170
"""The alpha channel of borders, 0 to 255."""
_BORDER_INSET_CELLS: Final = 0.08
_BORDER_RADIUS_CELLS: Final = 0.04


def borders(regions: OwnedRegions) -> Any:
    """Return the borders of regions as lines, in the colour of the owner, or in grey for several owners."""
    strips = []
    colours = []
    for owners, cells in regions:
        sides = _borders(cells)
        strips += sides
        colours += [(*region_colour(owners), _BORDER_OPACITY)] * len(sides)
    return rr.LineStrips2D(strips, colors=colours, radii=_BORDER_RADIUS_CELLS, draw_order=-4.0)


def _borders(cells: Bool) -> list[list[tuple[float, float]]]:
    """Return the sides of cells at which the region ends, each as two points (x, y) a little inside of it."""
    padded = np.pad(cells, 1)
    strips = []
    for row, col in np.argwhere(cells).tolist():
        for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            if not padded[1 + row + down, 1 + col + right]:
                x = RIM_CELLS + col + 0.5 + (0.5 - _BORDER_INSET_CELLS) * right
                y = RIM_CELLS + row + 0.5 + (0.5 - _BORDER_INSET_CELLS) * down
                strips.append([(x + side * down, y + side * right) for side in (-0.5, 0.5)])
    return strips
