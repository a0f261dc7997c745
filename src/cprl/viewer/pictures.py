"""Pictures of the episodes of a training, drawn every so many: who tagged whom, where agents go, the stock
over the turn, the Lorenz curve; and the borders of regions.

A new picture is a function from what was `Seen` to Rerun's archetypes, with its line in `PICTURES`, and a
view in `cprl.viewer.layout`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, Final, Self, TypeAlias

import numpy as np
import rerun as rr
from tensordict import TensorDictBase

from cprl.commons.cells import GROUND, WALL
from cprl.envs.commons_env import CommonsEnv
from cprl.institutions import Boundaries
from cprl.measuring.episodes import Episode
from cprl.pictures.colours import GREEN, GREY, ORANGE, PALETTE, PURPLE, agent_colour
from cprl.values.arrays import Bool, Float32, Float64, Int64, UInt8
from cprl.viewer.board import RIM_CELLS
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import DIED, TEXT
from cprl.viewer.scene import PLOT_HIGH, PLOT_WIDE, TITLE, Curves, Scene, boards_of
from cprl.viewer.views import View, has_died


class Samples(View):
    """Looks at the shown worlds every so many turns: where agents of the first one are, and the apples on
    each board over the turn.

    What it sees is copied, and added up later: a copy takes a microsecond; adding up right away takes twenty,
    since whatever runs between two steps of a training runs out of cold caches.
    """

    ROOM = 100
    """Copies that are kept, at most."""
    POINTS = 100
    """Looks at a board in an episode, at most."""

    def __init__(self, env: CommonsEnv, logger: RerunLogger) -> None:
        game = env.game
        now = env.worlds.now
        boards = logger.curves.boards
        self._logger = logger
        self._count = 0
        self.clock = game.rules.episode_steps
        self.stride = ceil(self.clock / self.POINTS)
        arrays: list[Any] = [
            now.row[:1],
            now.col[:1],
            now.in_play[:1],
            now.step[:boards],
            now.stock_left[:boards],
        ]
        self._pairs = [(array, np.empty((self.ROOM, *array.shape), array.dtype)) for array in arrays]
        self._read = env.worlds.driver.read
        self.visits = np.zeros((game.agents, game.map.height, game.map.width), np.int64)
        """Looks at which each agent of the first world was on each cell, since the last picture."""
        self._playing: list[dict[int, int]] = [{} for _ in range(boards)]
        """The stock by the turn in each board's episode that is being played."""
        self.lines: list[list[tuple[int, int]]] = [[] for _ in range(boards)]
        """The points of each board's last episode, (turn, stock)."""
        self.died = [False] * boards
        """Whether it died in it."""

    def on_step(self, batch: TensorDictBase) -> None:
        if self._logger.turn % self.stride:
            return
        for array, copies in self._pairs:
            copies[self._count] = self._read(array)
        self._count += 1
        if self._count == self.ROOM:
            self.add_up()

    def add_up(self) -> None:
        """Add up what was copied."""
        row, col, in_play, turn, stock = (copies[: self._count] for _, copies in self._pairs)
        self._count = 0
        row = row[:, 0]
        col = col[:, 0]
        in_play = in_play[:, 0]
        agent = np.broadcast_to(np.arange(len(self.visits)), row.shape)
        np.add.at(self.visits, (agent[in_play], row[in_play], col[in_play]), 1)
        for board, playing in enumerate(self._playing):
            playing.update(zip(turn[:, board, 0].tolist(), stock[:, board, 0].tolist(), strict=True))

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        if episode.world >= len(self.lines):
            return
        self.add_up()
        playing = self._playing[episode.world]
        points = [point for point in sorted(playing.items()) if point[0] < episode.steps]
        end = [] if episode.stock_left is None else [(episode.steps, episode.stock_left)]
        self.lines[episode.world] = points + end
        self.died[episode.world] = bool(has_died(episode))
        # Episodes begin alike: the first point is already that of the next one.
        self._playing[episode.world] = {turn: stock for turn, stock in points if not turn}


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What a picture is drawn of."""

    curves: Curves
    """The numbers that are plotted; a `Scene` if there is a board."""
    samples: Samples | None
    """Looks at the boards; None without one."""
    episodes: Sequence[Episode] = ()
    """Those of all replicas since the picture before, or as many as it is drawn over."""
    words: str = ""
    """Which they are, e.g. "episodes 51 to 100"; since a resume where that is later."""
    first: Self | None = None
    """What the first picture was drawn of."""


Archetypes: TypeAlias = Mapping[str, Any]
"""Rerun's archetypes by entity."""


@dataclass(frozen=True)
class Axes:
    """Those of a plot that is not over time, from 0 on; the name of its view says what y is."""

    origin: str
    x: str
    """What the other axis is."""
    x_end: float
    y_end: float

    def fixed(self) -> Archetypes:
        """Return the parts that never change."""
        faint, grey = (50, 52, 58), (120, 120, 120)
        ticks = [_ticks(self.x_end), _ticks(self.y_end)]
        grid = [self._placed([tick, tick], [0, self.y_end]) for tick in ticks[0]]
        grid += [self._placed([0, self.x_end], [tick, tick]) for tick in ticks[1]]
        axes = self._placed([0, 0, self.x_end], [self.y_end, 0, 0])
        colours = [*[faint] * len(grid), grey]
        radii = [*[0.1] * len(grid), 0.3]
        below = [(self._placed(tick, 0)[0], PLOT_HIGH + 1.0) for tick in ticks[0]]
        left = [(-10.0, self._placed(0, tick)[1] - 6.0) for tick in ticks[1]]
        texts = [*(f"{tick:g}" for of_axis in ticks for tick in of_axis), self.x]
        return {
            f"{self.origin}/axes": rr.LineStrips2D([*grid, axes], colors=colours, radii=radii),
            f"{self.origin}/axes/texts": _texts([*below, *left, (PLOT_WIDE / 2, PLOT_HIGH + 13.0)], texts),
        }

    def lines(self, title: str, curves: Sequence[tuple[Any, Any]], *, colours: Any, radii: Any) -> Archetypes:
        """Return a title and lines, each of x and y."""
        strips = [self._placed(x, y) for x, y in curves]
        return {
            f"{self.origin}/lines": rr.LineStrips2D(strips, colors=colours, radii=radii),
            f"{self.origin}/title": _texts([TITLE], [title]),
        }

    def _placed(self, x: Any, y: Any) -> Float32:
        """Return where numbers are in the view: [points, 2]."""
        share = np.stack([np.asarray(x) / self.x_end, np.asarray(y) / self.y_end], -1)
        placed: Float32 = (share * (PLOT_WIDE, -PLOT_HIGH) + (0, PLOT_HIGH)).astype(np.float32)
        return placed


def _texts(places: Any, texts: Sequence[str]) -> Any:
    return rr.Points2D(places, labels=texts, colors=TEXT, radii=0.0, show_labels=True)


def _ticks(end: float) -> list[float]:
    """Return four or five round numbers from 0 on."""
    size = 10 ** np.floor(np.log10(end))
    step = next(part * size for part in (0.1, 0.2, 0.25, 0.5, 1.0, 2.0) if end / (part * size) <= 5)
    return [step * index for index in range(int(end / step + 1e-9) + 1)]


def tags(seen: Seen) -> Archetypes:
    """Draw a matrix of who tagged whom in an episode, the mean over episodes."""
    counted = [episode.tagged_by for episode in seen.episodes if episode.tagged_by is not None]
    if not counted:
        return {}
    tags = np.mean(counted, 0)
    light = (tags / (tags.max() or 1.0))[..., None]
    image = np.array(PALETTE[GROUND]) * (1 - light) + np.array(PURPLE) * light
    agents = range(len(tags))
    cells = [(col + 0.5, row + 0.3) for row in agents for col in agents]
    edges = [(-0.5, agent + 0.3) for agent in agents] + [(agent + 0.5, -0.7) for agent in agents]
    texts = [*(f"{count:.3g}" for count in tags.ravel()), *2 * [f"{agent}" for agent in agents]]
    return {"tags": rr.Image(image.round().astype(np.uint8)), "tags/counts": _texts([*cells, *edges], texts)}


def visits(seen: Seen) -> Archetypes:
    """Draw a map for each agent of the first world: hue the agent, brightness the time it spent on the cell
    while in play."""
    scene = seen.curves
    samples = seen.samples
    assert isinstance(scene, Scene)
    assert samples is not None
    samples.add_up()
    panels = boards_of(scene, len(scene.agents))
    image = panels.joined(visits_drawn(samples.visits, scene), PALETTE[GROUND])
    samples.visits[:] = 0
    texts = [f"{agent}: {seen.words}" for agent in range(len(scene.agents))]
    return {"visits": rr.Image(image), "visits/labels": _texts(panels.tops, texts)}


_DARKEST: Final = 0.35
"""The brightness of a cell that was visited once; 1 is the cell with the longest stay."""


def visits_drawn(visits: Int64, scene: Scene) -> UInt8:
    """Return maps of visits [N, H, W]: uint8 [N, H + 2, W + 2, 3], with a rim of wall. The brightness goes by
    the square root of the share of the longest time that any agent spent on one cell."""
    share = np.sqrt(visits / max(1, visits.max()))
    light = np.where(visits > 0, _DARKEST + (1 - _DARKEST) * share, 0.0)[..., None]
    hues = np.array([agent_colour(agent) for agent in range(len(visits))])[:, None, None]
    drawn = np.array(PALETTE[GROUND]) * (1 - light) + hues * light
    for row, col in scene.walls:
        drawn[:, row, col] = PALETTE[WALL]
    whole = np.empty((len(drawn), scene.height + 2, scene.width + 2, 3), np.uint8)
    whole[:] = PALETTE[WALL]
    whole[:, 1:-1, 1:-1] = drawn.round()
    return whole


def axes_of_turns(seen: Seen) -> Axes:
    assert isinstance(seen.curves, Scene)
    assert seen.samples is not None
    return Axes("turn", "turn of the episode", seen.samples.clock, max(1, len(seen.curves.sites)))


def turns(seen: Seen) -> Archetypes:
    """Draw the apples on the board over the turns of the last episode of each replica, or of each world that
    the wall shows: grey where the board lived until the time was up, in a colour of its own where it died."""
    assert seen.samples is not None
    lines = seen.samples.lines
    died = seen.samples.died
    boards = [board for board, line in enumerate(lines) if len(line) > 1]
    if not boards:
        return {}
    whose = "each replica"
    worlds = seen.curves.worlds
    if worlds > 1:
        each = "each world" if worlds == len(lines) else f"the first {len(lines)} worlds"
        whose = f"{each} of the first replica"
    return axes_of_turns(seen).lines(
        f"last episode of {whose}: {sum(died)} of {len(boards)} died (orange)",
        [tuple(np.array(lines[board]).T) for board in boards],
        colours=[DIED if died[board] else GREY for board in boards],
        radii=0.5,
    )


def lorenz_curve(harvest: Float64) -> Float64:
    """Return the share of the harvest that the k agents with the least have together, k = 0..N; [N + 1].

    The area between it and the diagonal, doubled, is the Gini coefficient, 1 - equality. NaN without harvest.
    """
    total = harvest.sum()
    if total <= 0:
        return np.full(len(harvest) + 1, np.nan)
    return np.concatenate([[0.0], np.sort(harvest).cumsum() / total])


def gini(curve: Float64) -> float:
    """Return the Gini coefficient of a Lorenz curve [N + 1], 0 for equal shares."""
    return float(1 - (curve[1:] + curve[:-1]).sum() / (len(curve) - 1))


def axes_of_lorenz(seen: Seen) -> Axes:
    return Axes("lorenz", "agents, the poorest first, %", 100.0, 100.0)


def lorenz(seen: Seen) -> Archetypes:
    """Draw the mean Lorenz curve of the episodes beside the first one.

    The mean is over episodes, so its Gini coefficient is 1 minus their mean equality; episodes without a
    harvest have no curve and are left out.
    """
    curves = _lorenz_curves(seen)
    if not curves:
        return {}
    first = seen.first or seen
    curve = np.mean(curves, 0)
    earliest = np.mean(_lorenz_curves(first), 0)
    share = np.linspace(0, 100, len(curve))
    title = (
        f"Gini {gini(curve):.2f}: {seen.words}, {len(curves)} with a harvest "
        f"(green: {first.words}, {gini(earliest):.2f}; grey: equal shares)"
    )
    lines = [(share, 100 * shares) for shares in (share / 100, earliest, curve)]
    return axes_of_lorenz(seen).lines(title, lines, colours=[GREY, GREEN, ORANGE], radii=[0.3, 0.5, 1.0])


def _lorenz_curves(seen: Seen) -> list[Float64]:
    harvests = [episode.harvest for episode in seen.episodes if episode.harvest is not None]
    return [lorenz_curve(harvest) for harvest in harvests if harvest.sum() > 0]


@dataclass(frozen=True, kw_only=True)
class Picture:
    """How a picture is drawn, and how often."""

    draw: Callable[[Seen], Archetypes]
    """Returns nothing where there is nothing to draw."""
    is_there: Callable[[Curves], bool]
    """Whether a game has it."""
    every: int | None = None
    """Episodes of a replica from one to the next; by default as many as of most."""
    over: int = 0
    """The last episodes of a replica that it is drawn of; 0 for those since the one before."""
    axes: Callable[[Seen], Axes] | None = None
    """Of a plot that is not over time."""
    is_sampled: bool = False
    """Whether it needs samples of boards; those of earlier processes are not kept."""


def _has_board(curves: Curves) -> bool:
    return isinstance(curves, Scene)


OVER: Final = 50
"""Episodes of a replica whose tags are drawn."""
PICTURES: Final[Mapping[str, Picture]] = {
    "tags": Picture(draw=tags, is_there=lambda curves: curves.has_tags_between, every=10, over=OVER),
    "visits": Picture(draw=visits, is_there=_has_board, is_sampled=True),
    "turn": Picture(draw=turns, is_there=_has_board, axes=axes_of_turns, is_sampled=True),
    "lorenz": Picture(draw=lorenz, is_there=lambda curves: curves.has_lorenz, axes=axes_of_lorenz),
}
"""The pictures of a training; each logs what its function returns."""


class Pictures(View):
    """Logs all pictures that a game has, every so many episodes and at the end.

    Args:
        every: episodes of a replica from one picture to the next.
    """

    def __init__(self, logger: RerunLogger, samples: Samples | None, *, every: int) -> None:
        self._logger = logger
        self._every = every
        self._nothing = Seen(curves=logger.curves, samples=samples)
        self._pictures = {
            name: picture for name, picture in PICTURES.items() if picture.is_there(logger.curves)
        }
        self._episodes: list[Episode] = []
        self._ended = 0
        self._drawn = dict.fromkeys(self._pictures, 0)
        """The episodes of a replica that had ended when each was drawn."""
        self._first: dict[str, Seen] = {}
        worlds = logger.curves.worlds
        soon = rr.Points2D.columns(
            positions=[TITLE],
            labels=[f"lines from episode {ceil(every / worlds) * worlds} on"],
            colors=[TEXT],
            radii=[0.0],
            show_labels=[True],
        )
        for name, picture in self._pictures.items():
            if picture.axes is not None:
                for entity, part in picture.axes(self._nothing).fixed().items():
                    logger.log_static(entity, part)
                logger.log_columns(f"{name}/title", ([0], [0], [0]), soon, live_only=True)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        self._episodes.append(episode)

    def on_numbers(self, episode: int, numbers: Mapping[str, Float64]) -> None:
        before = self._ended
        self._ended = episode + 1
        for name, picture in self._pictures.items():
            every = picture.every or self._every
            if self._ended // every > before // every:
                self._draw(name, picture)
        oldest = min([self._ended - OVER, *self._drawn.values()])
        self._episodes = [one for one in self._episodes if one.episode >= oldest]

    def close(self) -> None:
        for name, picture in self._pictures.items():
            if self._ended > self._drawn[name]:
                self._draw(name, picture)

    def resumed(self) -> None:
        for name, picture in self._pictures.items():
            if picture.is_sampled:
                self._drawn[name] = self._ended

    def _draw(self, name: str, picture: Picture) -> None:
        since = self._drawn[name]
        ended = self._ended
        begins = ended - picture.over if picture.over else since
        seen = replace(
            self._nothing,
            episodes=[one for one in self._episodes if begins <= one.episode < ended],
            words=f"episode {ended}" if ended == since + 1 else f"episodes {since + 1} to {ended}",
            first=self._first.get(name),
        )
        self._drawn[name] = ended
        drawn = picture.draw(seen)
        if drawn:
            self._first.setdefault(name, seen)
        for entity, archetype in drawn.items():
            self._logger.log_row(entity, archetype)


Regions: TypeAlias = list[tuple[list[int], Bool]]
"""The owners of each region, and its cells, bool [H, W]."""
_OPACITY: Final = 170
_INSET_CELLS, _BORDER_CELLS = 0.08, 0.04


def regions_of(env: CommonsEnv) -> Regions:
    """Return the regions of all `Boundaries` of a game; those that are open to all are none."""
    regions: Regions = []
    for institution in env.game.institutions:
        if isinstance(institution, Boundaries):
            signs = np.array([list(line) for line in institution.regions])
            of_agents = [institution.signs_of(agent) for agent in range(env.game.agents)]
            for sign in sorted(set("".join(of_agents))):
                owners = [agent for agent, ours in enumerate(of_agents) if sign in ours]
                regions.append((owners, signs == sign))
    return regions


def borders(regions: Regions) -> Any:
    """Return the borders of regions in the hue of their owner, or grey where several share one, as lines."""
    strips = []
    colours = []
    for owners, cells in regions:
        sides = _borders(cells)
        strips += sides
        hue = agent_colour(owners[0]) if len(owners) == 1 else GREY
        colours += [(*hue, _OPACITY)] * len(sides)
    return rr.LineStrips2D(strips, colors=colours, radii=_BORDER_CELLS, draw_order=-4.0)


def _borders(cells: Bool) -> list[list[tuple[float, float]]]:
    """Return the sides of cells beyond which the region ends, (x, y), a little inside of it."""
    around = np.pad(cells, 1)
    strips = []
    for row, col in np.argwhere(cells).tolist():
        for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            if not around[1 + row + down, 1 + col + right]:
                x = RIM_CELLS + col + 0.5 + (0.5 - _INSET_CELLS) * right
                y = RIM_CELLS + row + 0.5 + (0.5 - _INSET_CELLS) * down
                strips.append([(x + side * down, y + side * right) for side in (-0.5, 0.5)])
    return strips
