"""Views of a training besides its lines: the boards of all replicas, where agents go, the stock over the
turn, the Lorenz curve, what institutions do.
"""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from math import ceil
from typing import Any, Final, TypeAlias

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cprl.commons.colours import GROUND, PALETTE, WALL, agent_colour
from cprl.commons.decoding import UNSEEN
from cprl.envs.commons_env import CommonsEnv
from cprl.institutions import Boundaries
from cprl.measuring.episodes import Episode
from cprl.system.compat import send_chunk
from cprl.viewer.institutions import lines
from cprl.viewer.logger import RerunLogger, components, timelines, times
from cprl.viewer.panels import Axes, Panels, titled
from cprl.viewer.scenery import BACKGROUND, GREEN, GREY, ORANGE, STATES, Curves, Scene, has_lorenz, has_wall
from cprl.viewer.stage import RIM_CELLS, boards, image_form
from cprl.viewer.story import has_died


class View:
    """What a recording shows of a training besides its lines; each does what it needs of the following."""

    def on_step(self, step: int, episode: int, frame: int | None) -> None:
        """Look at the worlds after a step of the run; `frame` is the number of the recorded one, if any."""

    def on_episode(self, episode: Episode) -> None:
        """Add an episode of a replica."""

    def log(self, first: int, last: int) -> None:
        """Log these episodes, counted from 1, which all replicas have ended, at the logger's time."""

    def close(self) -> None:
        """Send what is left."""

    def state_dict(self) -> Any: ...

    def load_state_dict(self, state: Any) -> None: ...


ROOM: Final = 100
"""Looks that are kept, at most."""


class Looks:
    """Keeps some arrays of the worlds as they are at some steps.

    A copy takes a microsecond; adding up right away takes twenty, since whatever runs between two steps of a
    training runs out of cold caches.

    Args:
        names: the arrays, by their names in `cprl.commons.world.Worlds`.
    """

    def __init__(self, env: CommonsEnv, names: Sequence[str]) -> None:
        self._read = env.worlds.driver.read
        arrays = [getattr(env.worlds.now, name) for name in names]
        self._pairs = [(array, np.empty((ROOM, *array.shape), array.dtype)) for array in arrays]
        self._on_cpu = all(isinstance(array, np.ndarray) for array in arrays)
        self._count = 0

    @property
    def is_full(self) -> bool:
        """Whether `take` must be called before `add`."""
        return self._count == ROOM

    def add(self) -> None:
        """Copies the arrays as they are now."""
        at = self._count
        self._count = at + 1
        for array, copies in self._pairs:
            copies[at] = array if self._on_cpu else self._read(array)

    def take(self) -> list[NDArray[Any]]:
        """The copies [T, ...] of each array, good until the next `add`; there are none afterwards."""
        count, self._count = self._count, 0
        return [copies[:count] for _, copies in self._pairs]


WALL_BYTES: Final = 4_000_000
"""The target size of the wall in a file, about."""
_LIVE_PERIOD_S: Final = 2.0
_LIVE_ROWS: Final = 10_000
"""From then on rows for viewers get rarer, because a server's memory holds them: period = time / rows."""
_FEWEST_STEPS: Final = 10
"""Steps from one row of the file to the next, at least."""
_DIED: Final = STATES["tragedy"]
_Row = tuple[int, int, int, Any, list[str], Any]
"""A step, episode and frame, the image, and the label and outline of each board."""


class Wall(View):
    """Logs the boards of all replicas: same rules, as many fates.

    Viewers get them every two seconds, after hours more rarely; the file gets every `stride`-th step of the
    episodes whose frames are recorded. A board is outlined while the last episode of its replica has ended
    because no apple was left.

    Args:
        recorded_steps: the steps of the run whose frames are recorded, about; determines the stride.
    """

    def __init__(self, env: CommonsEnv, logger: RerunLogger, *, scene: Scene, recorded_steps: int) -> None:
        self._env, self._logger, self._scene = env, logger, scene
        self._panels = Panels(scene.replicas, (scene.height + 2, scene.width + 2))
        rows, columns = self._panels.shape
        row_bytes = 100 + 20 * scene.replicas + 0.35 * rows * columns
        self.stride = max(_FEWEST_STEPS, ceil(recorded_steps * row_bytes / WALL_BYTES))
        """Steps from one row of the file to the next."""
        self._died = np.zeros(scene.replicas, np.bool_)
        self._rows: list[_Row] = []
        self._began = self._due = time.perf_counter()
        form = rr.SegmentationImage.from_fields(format=image_form(self._panels.shape), opacity=1.0)
        logger.log_static("wall/boards", form)
        logger.log_static("wall/labels", self._panels.labels())
        logger.log_static("wall/died", self._panels.frames())

    def on_step(self, step: int, episode: int, frame: int | None) -> None:
        """Logs the boards if they are due; `frame` is the number of the recorded one, if any."""
        if frame is not None and step % self.stride == 0:
            self._rows.append(self._row(step, episode, frame))
        elif (now := time.perf_counter()) > self._due:
            self._due = now + max(_LIVE_PERIOD_S, (now - self._began) / _LIVE_ROWS)
            if self._logger.is_live:
                self._send([self._row(step, episode, self._logger.frames)], live_only=True)

    def on_episode(self, episode: Episode) -> None:
        """Notes whether the replica's board has died, and sends the rows of the episode."""
        self._died[episode.world] = bool(has_died(episode))
        if episode.world == 0:
            self.close()

    def close(self) -> None:
        if self._rows:
            self._send(self._rows)
            self._rows = []

    def _row(self, step: int, episode: int, frame: int) -> _Row:
        """A step, episode and frame, the image, and the label and outline of each board."""
        now, read = self._env.worlds.now, self._env.worlds.driver.read
        state = {name: read(getattr(now, name)) for name in ("stock", "in_play", "row", "col")}
        image = self._panels.joined(boards(self._scene, {"step": state["stock"], **state}), UNSEEN)
        turns = read(now.step)[:, 0].tolist()
        labels = [f"{replica}: turn {turn}" for replica, turn in enumerate(turns)]
        outlines = np.where(self._died[:, None], _DIED, BACKGROUND).astype(np.uint8)
        return step, episode, frame, image, labels, outlines

    def _send(self, rows: list[_Row], *, live_only: bool = False) -> None:
        self._logger.do(partial(_send_rows, rows=rows), live_only=live_only)

    def state_dict(self) -> list[bool]:
        self.close()
        died: list[bool] = self._died.tolist()
        return died

    def load_state_dict(self, state: list[bool]) -> None:
        self._died = np.array(state, np.bool_)


def _send_rows(recording: Any, *, rows: list[_Row]) -> None:
    """Sends rows, for viewers in the thread that sends."""
    steps, episodes, frames, images, labels, outlines = zip(*rows, strict=True)
    at, replicas = timelines(times(steps, episodes, frames)), [len(labels[0])] * len(rows)
    parts = {
        "wall/boards": rr.SegmentationImage.columns(buffer=np.stack(images).reshape(len(rows), -1)),
        "wall/labels": rr.Points2D.columns(labels=list(chain(*labels))).partition(replicas),
        "wall/died": rr.Boxes2D.columns(colors=np.concatenate(outlines)).partition(replicas),
    }
    for entity, columns in parts.items():
        send_chunk(recording, entity, at, components(columns))


SAMPLED_EVERY: Final = 10
"""Steps from one look at the agents' cells to the next."""
_DARKEST: Final = 0.35
"""The brightness of a cell that was visited once; 1 is the cell with the longest stay."""


class Visits(View):
    """Counts the agents' cells in the first replica, the one that is shown, every `SAMPLED_EVERY` steps.

    The image has a map for each agent: hue the agent, brightness the time it spent on the cell while in play,
    by its square root, as a share of the longest time that any agent spent on one cell.
    """

    def __init__(self, env: CommonsEnv, logger: RerunLogger, *, scene: Scene) -> None:
        self._logger, self._looks = logger, Looks(env, ("row", "col", "in_play"))
        self._size = scene.height, scene.width
        self._agents = np.arange(len(scene.agents)) * scene.height * scene.width
        self._counts = np.zeros(len(scene.agents) * scene.height * scene.width, np.int64)
        self._panels = Panels(len(scene.agents), (scene.height + 2, scene.width + 2))
        self._walls = np.ones((scene.height + 2, scene.width + 2), np.bool_)
        self._walls[1:-1, 1:-1] = False
        for row, col in scene.walls:
            self._walls[row + 1, col + 1] = True
        self._hues = np.array([agent_colour(agent) for agent in range(len(scene.agents))])
        self._ended = self._logged = 0
        logger.log_static("visits/labels", self._panels.labels())

    def on_step(self, step: int, episode: int, frame: int | None) -> None:
        if step % SAMPLED_EVERY:
            return
        self._looks.add()
        if self._looks.is_full:
            self._count()

    def _count(self) -> None:
        """Counts where the agents in play were."""
        row, col, in_play = (copies[:, 0] for copies in self._looks.take())
        cells = self._agents + row * self._size[1] + col
        self._counts += np.bincount(cells[in_play], minlength=len(self._counts))

    def on_episode(self, episode: Episode) -> None:
        if episode.world == 0:
            self._ended = episode.episode + 1

    def log(self, first: int, last: int) -> None:
        image = self._panels.joined(self.maps(), PALETTE[GROUND])
        self._logger.log_row("visits", rr.Image(image))
        first, last = self._logged + 1, max(self._ended, self._logged + 1)
        episodes = f"episode {last}" if first == last else f"{first} to {last}"
        texts = [f"{agent}: {episodes}" for agent in range(len(self._agents))]
        self._logger.log_row("visits/labels", rr.Points2D.from_fields(labels=texts))
        self._counts[:] = 0
        self._logged = self._ended

    def maps(self) -> Any:
        """The maps of the time since the last image: uint8 [N, H + 2, W + 2, 3], with a rim of wall."""
        self._count()
        counts = self._counts.reshape(-1, *self._size)
        share = np.sqrt(counts / max(1, counts.max()))
        light = np.where(counts > 0, _DARKEST + (1 - _DARKEST) * share, 0.0)[..., None]
        inner = np.array(PALETTE[GROUND]) * (1 - light) + self._hues[:, None, None] * light
        whole = np.pad(inner, ((0, 0), (1, 1), (1, 1), (0, 0)))
        whole[:, self._walls] = PALETTE[WALL]
        return whole.round().astype(np.uint8)

    def state_dict(self) -> dict[str, Any]:
        self._count()
        return {"counts": self._counts.tolist(), "ended": self._ended, "logged": self._logged}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._looks.take()
        self._counts[:] = state["counts"]
        self._ended, self._logged = int(state["ended"]), int(state["logged"])


POINTS: Final = 100
"""The points of a line, at most."""


class Turns(View):
    """Logs the apples on the board over the turns of each replica's last episode, grey where the board lived
    until the time was up, in the colour of a tragedy where it died.
    """

    def __init__(self, env: CommonsEnv, logger: RerunLogger) -> None:
        game, replicas = env.game, env.worlds.size
        self._logger, self._looks = logger, Looks(env, ("step", "stock_left"))
        self.stride = ceil(game.rules.episode_steps / POINTS)
        """Turns from one point to the next."""
        self._every_replica = np.arange(replicas)
        self._playing = np.full((replicas, game.rules.episode_steps // self.stride + 1, 2), np.nan)
        """[R, points, 2], turn and stock of the episodes that are being played."""
        self._ended: list[list[tuple[float, float]]] = [[] for _ in range(replicas)]
        self._died = [False] * replicas
        ends = {"x_end": game.rules.episode_steps, "y_end": max(1, len(game.map.sites))}
        self._axes = _axes(logger, "turn", "turn of the episode", **ends)

    def on_step(self, step: int, episode: int, frame: int | None) -> None:
        if step % self.stride:
            return
        self._looks.add()
        if self._looks.is_full:
            self._place()

    def _place(self) -> None:
        """Places the points that were noted, the latest last: it stays where two have the same place."""
        turn, stock = (copies[..., 0] for copies in self._looks.take())
        point = self._every_replica, turn // self.stride
        self._playing[(*point, 0)], self._playing[(*point, 1)] = turn, stock

    def on_episode(self, episode: Episode) -> None:
        self._place()
        playing = self._playing[episode.world]
        points = playing[playing[:, 0] < episode.steps]
        end = [] if episode.stock_left is None else [(float(episode.steps), float(episode.stock_left))]
        self._ended[episode.world] = [*map(tuple, points.tolist()), *end]
        self._died[episode.world] = bool(has_died(episode))
        playing[1:] = np.nan  # the first point is already that of the next episode, which begins alike

    def log(self, first: int, last: int) -> None:
        replicas = [replica for replica, line in enumerate(self._ended) if len(line) > 1]
        if not replicas:
            return
        strips = [self._axes.placed(*np.array(self._ended[replica]).T) for replica in replicas]
        colours = [STATES["tragedy"] if self._died[replica] else GREY for replica in replicas]
        self._logger.log_row("turn/lines", rr.LineStrips2D(strips, colors=colours, radii=0.5))
        died = sum(self._died)
        text = f"last episode of each replica: {died} of {len(replicas)} boards died (orange)"
        self._logger.log_row("turn/title", titled(text))

    def state_dict(self) -> dict[str, Any]:
        self._place()
        return {"playing": self._playing.tolist(), "ended": self._ended, "died": self._died}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._looks.take()
        self._playing[:] = state["playing"]
        self._ended = [[(turn, stock) for turn, stock in line] for line in state["ended"]]
        self._died = list(state["died"])


def _axes(logger: RerunLogger, origin: str, x: str, *, x_end: float, y_end: float) -> Axes:
    """The axes of a plot, which are logged once."""
    axes = Axes(x, x_end=x_end, y_end=y_end)
    for entity, drawn in zip(("axes", "axes/texts"), axes.drawn(), strict=True):
        logger.log_static(f"{origin}/{entity}", drawn)
    return axes


def lorenz_curve(harvest: NDArray[np.float64]) -> NDArray[np.float64]:
    """The share of the harvest that the k agents with the least have together, k = 0..N; [N + 1].

    The area between it and the diagonal, doubled, is the Gini coefficient, 1 - equality. NaN without harvest.
    """
    total = harvest.sum()
    if total <= 0:
        return np.full(len(harvest) + 1, np.nan)
    return np.concatenate([[0.0], np.sort(harvest).cumsum() / total])


def gini(curve: NDArray[np.float64]) -> float:
    """The Gini coefficient of a Lorenz curve [N + 1], 0 for equal shares."""
    return float(1 - (curve[1:] + curve[:-1]).sum() / (len(curve) - 1))


class Lorenz(View):
    """Logs the mean Lorenz curve of the episodes of all replicas since the last one, beside the first one.

    The mean is over episodes, so its Gini coefficient is 1 minus their mean equality; episodes without a
    harvest have no curve and are left out.
    """

    def __init__(self, logger: RerunLogger, agents: int) -> None:
        self._logger, self._agents = logger, agents
        self._sums: dict[int, NDArray[np.float64]] = {}
        self._first: tuple[list[float], str] | None = None
        self._axes = _axes(logger, "lorenz", "agents, the poorest first, %", x_end=100, y_end=100)

    def on_episode(self, episode: Episode) -> None:
        if episode.harvest is not None and episode.harvest.sum() > 0:
            row = np.append(lorenz_curve(episode.harvest), 1.0)
            self._sums[episode.episode] = self._sums.get(episode.episode, 0.0) + row

    def log(self, first: int, last: int) -> None:
        """Logs the curve of these episodes, counted from 1, at the logger's time, if any had a harvest."""
        taken = [self._sums.pop(episode) for episode in sorted(self._sums) if episode < last]
        if not taken:
            return
        *total, count = np.sum(taken, 0)
        curve = np.array(total) / count
        episodes = f"episode {last}" if first == last else f"episodes {first} to {last}"
        self._first = self._first or (curve.tolist(), episodes)
        earliest, began = np.array(self._first[0]), self._first[1]
        share = np.linspace(0, 100, self._agents + 1)
        curves = share / 100, earliest, curve
        strips = [self._axes.placed(share, 100 * shares) for shares in curves]
        lines = rr.LineStrips2D(strips, colors=[GREY, GREEN, ORANGE], radii=[0.3, 0.5, 1.0])
        self._logger.log_row("lorenz", lines)
        text = (
            f"Gini {gini(curve):.2f}: {episodes}, {count:.0f} with a harvest "
            f"(green: {began}, {gini(earliest):.2f}; grey: equal shares)"
        )
        self._logger.log_row("lorenz/title", titled(text))

    def state_dict(self) -> dict[str, Any]:
        sums = [[episode, *row.tolist()] for episode, row in self._sums.items()]
        return {"sums": sums, "first": self._first}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._sums = {int(episode): np.array(row) for episode, *row in state["sums"]}
        first = state["first"]
        self._first = None if first is None else (list(first[0]), str(first[1]))


Regions: TypeAlias = list[tuple[list[int], NDArray[np.bool_]]]
"""The owners of each region, and its cells, bool [H, W]."""

_OPACITY: Final = 170
_INSET_CELLS, _BORDER_CELLS = 0.08, 0.04


def log_institutions(logger: RerunLogger, env: CommonsEnv | None) -> None:
    """Logs the styles of what institutions plot, and the regions of a board."""
    for entity, style in lines(logger.curves).items():
        logger.log_static(entity, style)
    if logger.scene is not None and env is not None and (regions := regions_of(env)):
        logger.log_static("world/regions", borders(regions))


def in_words(episode: Episode, curves: Curves) -> str:
    """What was decided, broken and paid in an episode, e.g. "3 violations; agent 2 fined 1.5"; "" if nothing
    was."""
    parts = []
    if episode.in_force is not None:
        decided = zip(curves.in_force, episode.in_force, strict=False)
        parts.append(", ".join(f"{title}: {value:g}" for title, value in decided))
    if episode.violations is not None and episode.violations.any():
        broken = int(episode.violations.sum())
        parts.append(f"{broken:,} violation{'s' * (broken > 1)}")
    fines = [] if episode.fines is None else episode.fines.tolist()
    parts.append(", ".join(f"agent {agent} fined {fine:.4g}" for agent, fine in enumerate(fines) if fine > 0))
    return "; ".join(part for part in parts if part)


def regions_of(env: CommonsEnv) -> Regions:
    """The regions of all `Boundaries` of a game; those that are open to all are none."""
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
    """The borders of regions in the hue of their owner, or grey where several share one, as lines."""
    strips, colours = [], []
    for owners, cells in regions:
        sides = _borders(cells)
        strips += sides
        hue = agent_colour(owners[0]) if len(owners) == 1 else GREY
        colours += [(*hue, _OPACITY)] * len(sides)
    return rr.LineStrips2D(strips, colors=colours, radii=_BORDER_CELLS, draw_order=-4.0)


def _borders(cells: NDArray[np.bool_]) -> list[list[tuple[float, float]]]:
    """The sides of cells beyond which the region ends, (x, y), a little inside of it."""
    around = np.pad(cells, 1)
    sides = {  # where the neighbour is, and from which to which corner of a cell the side goes
        (-1, 0): ((0, 0), (1, 0)),
        (1, 0): ((0, 1), (1, 1)),
        (0, -1): ((0, 0), (0, 1)),
        (0, 1): ((1, 0), (1, 1)),
    }
    strips = []
    for (down, right), corners in sides.items():
        height, width = cells.shape
        beyond = around[1 + down : 1 + down + height, 1 + right : 1 + right + width]
        inset = -_INSET_CELLS * right, -_INSET_CELLS * down
        for row_, col in np.argwhere(cells & ~beyond).tolist():
            strips.append(
                [(col + x + inset[0] + RIM_CELLS, row_ + y + inset[1] + RIM_CELLS) for x, y in corners]
            )
    return strips


def views_of(
    env: CommonsEnv | None, logger: RerunLogger, curves: Curves, *, episodes: int, every: int
) -> dict[str, View]:
    """Return those of the views that the game has: without a board none of it, without a harvest no curve.

    Args:
        env: the worlds, one for each replica; None without boards.
        every: episodes from one with recorded frames to the next; 0 without frames.
    """
    views: dict[str, View] = {}
    is_replay = isinstance(curves, Scene) and curves.is_replay
    if env is not None and isinstance(curves, Scene) and not is_replay:
        if has_wall(curves):
            recorded = env.game.rules.episode_steps * (episodes // max(1, every) + 1)
            views["wall"] = Wall(env, logger, scene=curves, recorded_steps=recorded)
        views["visits"] = Visits(env, logger, scene=curves)
        views["turns"] = Turns(env, logger)
    if has_lorenz(curves) and not is_replay:
        views["lorenz"] = Lorenz(logger, len(curves.agents))
    return views
