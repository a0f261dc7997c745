"""What a recording shows of a training beside its frames: lines over episodes, joint actions, tags, the
boards of all replicas, where agents go, the stock over the turn, the Lorenz curve, and borders of regions."""

import time
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from math import ceil
from statistics import fmean
from typing import Any, Final, TypeAlias

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cprl import keys
from cprl.commons.colours import GREEN, GREY, GROUND, ORANGE, PALETTE, WALL, agent_colour
from cprl.commons.decoding import UNSEEN
from cprl.envs.commons_env import CommonsEnv
from cprl.institutions import Boundaries
from cprl.measuring.episodes import Episode
from cprl.measuring.series import OF_AGENTS, STEPS, Recent, Values, mean_of
from cprl.viewer.board import RIM_CELLS, boards, image_form
from cprl.viewer.layout import (
    JOINT,
    PLOT_HIGH,
    PLOT_WIDE,
    RANDOM_PLAY,
    RETURN,
    STATES,
    TEXT,
    TITLE,
    Scene,
    boards_of,
)
from cprl.viewer.logger import RerunLogger, times


class View:
    """A part of the recording of a training; each does what it needs of the following.

    It logs at the logger's time, and its state follows from the episodes: of a run that is resumed it gets
    those so far again, while the logger is silent.
    """

    stride = 0
    """The view needs to look at the worlds in every so many turns; 0 for no certain ones."""

    def on_step(self, turn: int, episode: int, frame: int | None) -> None:
        """Look at the worlds after a turn of the run; `frame` is the number of the recorded one, if any."""

    def on_batch(self, batch: TensorDictBase) -> None:
        """Look at a turn of all worlds, after `on_step`."""

    def on_episode(self, episode: Episode) -> None:
        """Add an episode of a replica."""

    def on_numbers(self, episode: int, numbers: Mapping[str, Values]) -> None:
        """Add an episode, counted from 0, that all replicas have ended; of replicas in W worlds the last of W
        whose means these are.

        Args:
            numbers: [R] by name.
        """

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Compare the training with these episodes of random play."""

    def finished(self, played: Mapping[str, Sequence[Episode]]) -> None:
        """Show the evaluation of a run that is over: the episodes of "trained" and "random"."""

    def resumed(self) -> None:
        """The episodes so far have been added again, but not their steps."""

    def close(self) -> None:
        """Log what is left; a second call does nothing."""


def has_died(episode: Episode) -> bool | None:
    """Whether the episode ended before its time because no apple was left; None if no stock is reported."""
    return None if episode.depletion_step is None else episode.terminated


_WITH_MEAN: Final = tuple(f"/{name}" for name in ("return", *OF_AGENTS))


class Plots(View):
    """Logs the lines of each episode: social metrics, those of institutions and what agents get and pay
    with a running mean, all else as it is."""

    def __init__(self, logger: RerunLogger) -> None:
        self._logger = logger
        self._recent: dict[str, Recent] = {}
        self._random: dict[str, float] = {}

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Sets the lines of random play: the mean of each metric in these episodes, where it is defined."""
        curves = self._logger.curves
        played = [
            {**episode.social, **episode.of_institutions, RETURN: float(episode.return_.sum())}
            for episode in episodes
        ]
        of_institutions = (f"institutions/{metric}" for metric in curves.institutions)
        for name in (*curves.metrics, *of_institutions, *([RETURN] if curves.unit == "return" else [])):
            values = [metrics.get(name, float("nan")) for metrics in played]
            defined = [value for value in values if value == value]
            if defined:
                self._random[name] = fmean(defined)
        for name, mean in self._random.items():  # a line in plots that have no curve yet
            points = rr.Scalars.columns(scalars=[mean, mean])
            self._logger.log_columns(
                f"{RANDOM_PLAY}/{name}", ([0, 0], [0, 1], [0, 0]), points, live_only=True
            )

    def on_numbers(self, episode: int, numbers: Mapping[str, Values]) -> None:
        curves = self._logger.curves
        if curves.unit == "return":
            numbers = {**numbers, RETURN: np.sum([numbers[f"{name}/return"] for name in curves.agents], 0)}
        for name, values in numbers.items():
            if name == STEPS:  # what its timeline says
                continue
            is_social = name.startswith(("social/", "institutions/", RETURN))
            singles = values.tolist() if is_social and len(values) > 1 else []
            lines = [*singles, mean := mean_of(values)]
            if is_social or name.endswith(_WITH_MEAN):
                recent = self._recent.setdefault(name, Recent(curves.mean_over, each=curves.worlds))
                lines.append(recent.add(mean))
            self._logger.log_lines(name, lines)
        for name, mean in self._random.items():
            self._logger.log_scalar(f"{RANDOM_PLAY}/{name}", mean)


class JointActions(View):
    """Logs the share of turns in which agents of a small matrix game chose each joint action: the mean over
    replicas and over the last episodes."""

    stride = 1

    def __init__(self, logger: RerunLogger, *, actions: int) -> None:
        curves = logger.curves
        self._logger, self._worlds = logger, np.arange(curves.replicas * curves.worlds)
        self._places = actions ** np.arange(len(curves.agents))[::-1]
        self._counts = np.zeros((len(self._worlds), len(curves.joint)))
        self._shares: dict[int, list[NDArray[np.float64]]] = {}
        self._recent = [Recent(curves.mean_over, each=curves.worlds) for _ in curves.joint]

    def on_batch(self, batch: TensorDictBase) -> None:
        action = batch[keys.ACTION].cpu().numpy()
        self._counts[self._worlds, action @ self._places] += 1

    def on_episode(self, episode: Episode) -> None:
        counts = self._counts[episode.world]
        if counts.any():
            together = episode.episode // self._logger.curves.worlds
            self._shares.setdefault(together, []).append(counts / counts.sum())
        counts[:] = 0

    def on_numbers(self, episode: int, numbers: Mapping[str, Values]) -> None:
        if shares := self._shares.pop(episode // self._logger.curves.worlds, None):
            means = zip(self._recent, np.mean(shares, 0), strict=True)
            self._logger.log_lines(JOINT, [recent.add(share) for recent, share in means])


class Tags(View):
    """Draws a matrix of who tagged whom every ten episodes of a replica: the mean over its last fifty, or as
    many of each of its worlds as have fifty, and over all replicas."""

    EVERY = 10
    OVER = 50

    def __init__(self, logger: RerunLogger) -> None:
        self._logger = logger
        agents = range(len(logger.curves.agents))
        self._every = ceil(self.EVERY / logger.curves.worlds)
        """Groups of W episodes from one matrix to the next."""
        self._groups = 0
        parts = ceil(self.OVER / (self._every * logger.curves.worlds))
        self._last = deque([(0, np.zeros((len(agents),) * 2))], maxlen=parts)
        """Episodes of all replicas and their tags, since the last matrix and between those before."""
        cells = [(col + 0.5, row + 0.3) for row in agents for col in agents]
        edges = [(-0.5, agent + 0.3) for agent in agents] + [(agent + 0.5, -0.7) for agent in agents]
        places = rr.Points2D.from_fields(
            positions=[*cells, *edges], radii=[0.0], colors=[TEXT], show_labels=True
        )
        logger.log_static("tags/counts", places)

    def on_episode(self, episode: Episode) -> None:
        if episode.tagged_by is not None:
            count, tags = self._last[-1]
            self._last[-1] = count + 1, tags + episode.tagged_by

    def on_numbers(self, episode: int, numbers: Mapping[str, Values]) -> None:
        self._groups += 1
        if self._groups % self._every == 0:
            counts, sums = zip(*self._last, strict=True)
            tags = np.sum(sums, 0) / max(1, sum(counts))
            light = (tags / (tags.max() or 1.0))[..., None]
            image = np.array(PALETTE[GROUND]) * (1 - light) + np.array(STATES["combat"]) * light
            self._logger.log_row("tags", rr.Image(image.round().astype(np.uint8)))
            texts = [
                *(f"{count:.3g}" for count in tags.ravel()),
                *2 * [f"{agent}" for agent in range(len(tags))],
            ]
            self._logger.log_row("tags/counts", rr.Points2D.from_fields(labels=texts))
            self._last.append((0, np.zeros_like(tags)))


WALL_BYTES: Final = 4_000_000
"""The target size of the wall in a file, about."""
_LIVE_PERIOD_S: Final = 2.0
_LIVE_ROWS: Final = 10_000
"""From then on rows for viewers get rarer, because a server's memory holds them: period = time / rows."""
_FEWEST_STEPS: Final = 10
"""Steps from one row of the file to the next, at least."""
_LABELLED: Final = 8
"""The largest number of boards whose labels say "turn" before its number."""
_DIED: Final = STATES["tragedy"]
_Row: TypeAlias = tuple[int, int, int, NDArray[np.uint8], list[str], NDArray[np.uint8]]
"""A step, episode and frame, the image, and the text of each board and its colour."""


class Wall(View):
    """Logs the boards of all replicas, or of the first worlds of one: same rules, as many fates.

    Viewers get them every two seconds, after hours more rarely; the file gets every `stride_in_file`-th step
    of the episodes whose frames are recorded. The text of a board says its turn, in orange if the episode of
    its world before this one ended because no apple was left.

    Args:
        recorded_steps: the steps of the run whose frames are recorded, about; determines the stride.
    """

    def __init__(self, env: CommonsEnv, logger: RerunLogger, scene: Scene, *, recorded_steps: int) -> None:
        self._env, self._logger, self._scene = env, logger, scene
        self._panels = boards_of(scene, scene.boards)
        rows, columns = self._panels.shape
        row_bytes = 100 + 20 * scene.boards + 0.35 * rows * columns
        self._stride = max(_FEWEST_STEPS, ceil(recorded_steps * row_bytes / WALL_BYTES))
        self._died = np.zeros(scene.boards, np.bool_)
        self._rows: list[_Row] = []
        self._began = self._due = time.perf_counter()
        form = rr.SegmentationImage.from_fields(format=image_form(self._panels.shape), opacity=1.0)
        logger.log_static("wall/boards", form)
        logger.log_static("wall/labels", self._panels.labels(colours=None))

    def on_step(self, turn: int, episode: int, frame: int | None) -> None:
        step = turn * self._scene.worlds
        if frame is not None and turn % self._stride == 0:
            self._rows.append(self._row(step, episode, frame))
        elif (now := time.perf_counter()) > self._due:
            self._due = now + max(_LIVE_PERIOD_S, (now - self._began) / _LIVE_ROWS)
            if self._logger.is_live:
                row = self._row(step, episode, self._logger.frames)
                self._logger.do(partial(_send_rows, rows=[row]), live_only=True)

    def on_episode(self, episode: Episode) -> None:
        """Notes whether the board has died, and sends the rows of the episode."""
        if episode.world < len(self._died):
            self._died[episode.world] = bool(has_died(episode))
        if episode.world == 0:
            self.close()

    def close(self) -> None:
        if self._rows:
            self._logger.do(partial(_send_rows, rows=self._rows))
            self._rows = []

    def _row(self, step: int, episode: int, frame: int) -> _Row:
        now, read = self._env.worlds.now, self._env.worlds.driver.read
        shown = len(self._died)
        state = {name: read(getattr(now, name)[:shown]) for name in ("stock", "in_play", "row", "col")}
        image = self._panels.joined(boards(self._scene, {"step": state["stock"], **state}), UNSEEN)
        turns = read(now.step[:shown])[:, 0].tolist()
        word = "turn " if shown <= _LABELLED else ""  # more labels would stand on each other
        labels = [f"{board}: {word}{turn}" for board, turn in enumerate(turns)]
        colours = np.where(self._died[:, None], _DIED, TEXT).astype(np.uint8)
        return step, episode, frame, image, labels, colours


def _send_rows(recording: Any, *, rows: list[_Row]) -> None:
    """Sends rows, for viewers in the thread that sends."""
    steps, episodes, frames, images, labels, colours = zip(*rows, strict=True)
    at, replicas = times(steps, episodes, frames), [len(labels[0])] * len(rows)
    texts = rr.Points2D.columns(labels=list(chain(*labels)), colors=np.concatenate(colours))
    parts = {
        "wall/boards": rr.SegmentationImage.columns(buffer=np.stack(images).reshape(len(rows), -1)),
        "wall/labels": texts.partition(replicas),
    }
    for entity, columns in parts.items():
        recording.send_columns(entity, at, columns)


class Picture(View):
    """A view that is logged every so many episodes, and at the end."""

    def __init__(self, every: int) -> None:
        self._every = every
        self._ended = self._logged = 0

    def on_numbers(self, episode: int, numbers: Mapping[str, Values]) -> None:
        before, self._ended = self._ended, episode + 1
        if self._ended // self._every > before // self._every:
            self.close()

    def close(self) -> None:
        if self._ended > self._logged:
            is_one = self._ended == self._logged + 1
            self.log(f"episode{'' if is_one else f's {self._logged + 1} to'} {self._ended}")
            self._logged = self._ended

    def resumed(self) -> None:
        self._logged = self._ended

    def log(self, episodes: str) -> None:
        """Log what is new since the last time, "episodes 51 to 100"; since a resume where that is later."""


class Sampled(Picture):
    """A picture of some arrays of the first worlds every `stride` turns.

    They are copied, and added up later: a copy takes a microsecond; adding up right away takes twenty, since
    whatever runs between two steps of a training runs out of cold caches.

    Args:
        names: the arrays, by their names in `cprl.commons.world.Worlds`.
    """

    ROOM = 100
    """Copies that are kept, at most."""

    def __init__(
        self, env: CommonsEnv, names: Sequence[str], *, worlds: int, every: int, stride: int
    ) -> None:
        super().__init__(every)
        self.stride, self._count, self._read = stride, 0, env.worlds.driver.read
        arrays = [getattr(env.worlds.now, name)[:worlds] for name in names]
        self._pairs = [(array, np.empty((self.ROOM, *array.shape), array.dtype)) for array in arrays]
        self._on_cpu = all(isinstance(array, np.ndarray) for array in arrays)

    def on_step(self, turn: int, episode: int, frame: int | None) -> None:
        if turn % self.stride:
            return
        for array, copies in self._pairs:
            copies[self._count] = array if self._on_cpu else self._read(array)
        self._count += 1
        if self._count == self.ROOM:
            self._add_copies()

    def _add_copies(self) -> None:
        count, self._count = self._count, 0
        self._add(*(copies[:count] for _, copies in self._pairs))

    def _add(self, *arrays: NDArray[Any]) -> None:
        """Add the arrays [T, worlds, ...] at T steps, which are overwritten afterwards."""
        raise NotImplementedError


_DARKEST: Final = 0.35
"""The brightness of a cell that was visited once; 1 is the cell with the longest stay."""


class Visits(Sampled):
    """Counts the agents' cells in the first world, the one that is shown, every ten turns.

    The image has a map for each agent: hue the agent, brightness the time it spent on the cell while in play,
    by its square root, as a share of the longest time that any agent spent on one cell.
    """

    def __init__(self, env: CommonsEnv, logger: RerunLogger, scene: Scene, *, every: int) -> None:
        super().__init__(env, ("row", "col", "in_play"), worlds=1, every=every, stride=10)
        self._logger = logger
        self.counts = np.zeros((len(scene.agents), scene.height, scene.width), np.int64)
        """Of the time since the last image."""
        self._panels = boards_of(scene, len(scene.agents))
        self._walls = np.ones((scene.height + 2, scene.width + 2), np.bool_)
        self._walls[1:-1, 1:-1] = False
        for row, col in scene.walls:
            self._walls[row + 1, col + 1] = True
        logger.log_static("visits/labels", self._panels.labels())

    def _add(self, *arrays: NDArray[Any]) -> None:
        row, col, in_play = (copies[:, 0] for copies in arrays)
        agent = np.broadcast_to(np.arange(len(self.counts)), row.shape)
        np.add.at(self.counts, (agent[in_play], row[in_play], col[in_play]), 1)

    def log(self, episodes: str) -> None:
        self._add_copies()
        self._logger.log_row("visits", rr.Image(self._panels.joined(self.maps(), PALETTE[GROUND])))
        texts = [f"{agent}: {episodes}" for agent in range(len(self.counts))]
        self._logger.log_row("visits/labels", rr.Points2D.from_fields(labels=texts))
        self.counts[:] = 0

    def maps(self) -> NDArray[np.uint8]:
        """The maps of the counts: uint8 [N, H + 2, W + 2, 3], with a rim of wall."""
        share = np.sqrt(self.counts / max(1, self.counts.max()))
        light = np.where(self.counts > 0, _DARKEST + (1 - _DARKEST) * share, 0.0)[..., None]
        hues = np.array([agent_colour(agent) for agent in range(len(self.counts))])[:, None, None]
        inner = np.array(PALETTE[GROUND]) * (1 - light) + hues * light
        whole = np.pad(inner, ((0, 0), (1, 1), (1, 1), (0, 0)))
        whole[:, self._walls] = PALETTE[WALL]
        return whole.round().astype(np.uint8)


class DrawnPlot:
    """A plot that is not over time, with two axes from 0 on; the name of its view says what y is.

    Args:
        x: what the other axis is.
        begins: the episodes after which it has its first lines; until then viewers read that.
    """

    def __init__(
        self, logger: RerunLogger, origin: str, x: str, *, x_end: float, y_end: float, begins: int
    ) -> None:
        self._logger, self._origin, self._ends = logger, origin, np.array((x_end, y_end))
        faint, grey = (50, 52, 58), (120, 120, 120)
        ticks = [_ticks(x_end), _ticks(y_end)]
        grid = [self._placed([tick, tick], [0, y_end]) for tick in ticks[0]]
        grid += [self._placed([0, x_end], [tick, tick]) for tick in ticks[1]]
        axes = self._placed([0, 0, x_end], [y_end, 0, 0])
        lines = rr.LineStrips2D(
            [*grid, axes], colors=[*[faint] * len(grid), grey], radii=[*[0.1] * len(grid), 0.3]
        )
        below = [(self._placed(tick, 0)[0], PLOT_HIGH + 1.0) for tick in ticks[0]]
        left = [(-10.0, self._placed(0, tick)[1] - 6.0) for tick in ticks[1]]
        texts = [*(f"{tick:g}" for of_axis in ticks for tick in of_axis), x]
        logger.log_static(f"{origin}/axes", lines)
        logger.log_static(
            f"{origin}/axes/texts", _texts([*below, *left, (PLOT_WIDE / 2, PLOT_HIGH + 13.0)], texts)
        )
        soon = rr.Points2D.columns(positions=[TITLE], labels=[f"lines from episode {begins} on"])
        style = rr.Points2D.columns(colors=[TEXT], radii=[0.0], show_labels=[True])
        logger.log_columns(f"{origin}/title", ([0], [0], [0]), [*soon, *style], live_only=True)

    def log(self, title: str, curves: Sequence[tuple[Any, Any]], *, colours: Any, radii: Any) -> None:
        """Log a title and lines, each of x and y."""
        strips = [self._placed(x, y) for x, y in curves]
        self._logger.log_row(f"{self._origin}/lines", rr.LineStrips2D(strips, colors=colours, radii=radii))
        self._logger.log_row(f"{self._origin}/title", _texts([TITLE], [title]))

    def _placed(self, x: Any, y: Any) -> NDArray[np.float32]:
        """Where numbers are in the view: [points, 2]."""
        share = np.stack([np.asarray(x, np.float64), np.asarray(y, np.float64)], -1) / self._ends
        placed: NDArray[np.float32] = (share * (PLOT_WIDE, -PLOT_HIGH) + (0, PLOT_HIGH)).astype(np.float32)
        return placed


def _texts(places: Sequence[Any], texts: Sequence[str]) -> Any:
    return rr.Points2D(places, labels=texts, colors=TEXT, radii=0.0, show_labels=True)


def _ticks(end: float) -> list[float]:
    """Four or five round numbers from 0 on."""
    size = 10 ** np.floor(np.log10(end))
    step = next(part * size for part in (0.1, 0.2, 0.25, 0.5, 1.0, 2.0) if end / (part * size) <= 5)
    return [step * index for index in range(int(end / step + 1e-9) + 1)]


class Turns(Sampled):
    """Logs the apples on the board over the turns of the last episode of each replica, or of each world that
    the wall shows, grey where the board lived until the time was up, in the colour of a tragedy where it
    died."""

    POINTS = 100
    """The points of a line, at most."""

    def __init__(self, env: CommonsEnv, logger: RerunLogger, *, every: int) -> None:
        game, boards = env.game, logger.curves.boards
        self._whose = "each replica"
        if logger.curves.worlds > 1:
            worlds = "each world" if logger.curves.worlds == boards else f"the first {boards} worlds"
            self._whose = f"{worlds} of the first replica"
        stride = ceil(game.rules.episode_steps / self.POINTS)
        super().__init__(env, ("step", "stock_left"), worlds=boards, every=every, stride=stride)
        self._playing = np.full((boards, game.rules.episode_steps // self.stride + 1, 2), np.nan)
        """[boards, points, 2], turn and stock of the episodes that are being played."""
        self.lines: list[list[tuple[float, float]]] = [[] for _ in range(boards)]
        """The points of each board's last episode, (turn, stock)."""
        self._died = [False] * boards
        ends = {"x_end": game.rules.episode_steps, "y_end": max(1, len(game.map.sites))}
        begins = ceil(every / logger.curves.worlds) * logger.curves.worlds
        self._plot = DrawnPlot(logger, "turn", "turn of the episode", begins=begins, **ends)

    def _add(self, *arrays: NDArray[Any]) -> None:
        """Places the points, the latest last: it stays where two have the same place."""
        turn, stock = (copies[..., 0] for copies in arrays)
        point = np.arange(len(self.lines)), turn // self.stride
        self._playing[(*point, 0)], self._playing[(*point, 1)] = turn, stock

    def on_episode(self, episode: Episode) -> None:
        if episode.world >= len(self.lines):
            return
        self._add_copies()
        playing = self._playing[episode.world]
        points = playing[playing[:, 0] < episode.steps]
        end = [] if episode.stock_left is None else [(float(episode.steps), float(episode.stock_left))]
        self.lines[episode.world] = [*map(tuple, points.tolist()), *end]
        self._died[episode.world] = bool(has_died(episode))
        playing[1:] = np.nan  # the first point is already that of the next episode, which begins alike

    def log(self, episodes: str) -> None:
        boards = [board for board, line in enumerate(self.lines) if len(line) > 1]
        if boards:
            self._plot.log(
                f"last episode of {self._whose}: {sum(self._died)} of {len(boards)} died (orange)",
                [tuple(np.array(self.lines[board]).T) for board in boards],
                colours=[_DIED if self._died[board] else GREY for board in boards],
                radii=0.5,
            )


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


class Lorenz(Picture):
    """Logs the mean Lorenz curve of the episodes of all replicas since the last one, beside the first one.

    The mean is over episodes, so its Gini coefficient is 1 minus their mean equality; episodes without a
    harvest have no curve and are left out.
    """

    def __init__(self, logger: RerunLogger, *, every: int) -> None:
        super().__init__(every)
        self._curves: dict[int, list[NDArray[np.float64]]] = {}
        """Of each episode, for those of the replicas that had a harvest."""
        self._first: tuple[NDArray[np.float64], str] | None = None
        begins = ceil(every / logger.curves.worlds) * logger.curves.worlds
        ends = {"x_end": 100.0, "y_end": 100.0}
        self._plot = DrawnPlot(logger, "lorenz", "agents, the poorest first, %", begins=begins, **ends)

    def on_episode(self, episode: Episode) -> None:
        if episode.harvest is not None and episode.harvest.sum() > 0:
            self._curves.setdefault(episode.episode, []).append(lorenz_curve(episode.harvest))

    def resumed(self) -> None:
        """Its curves follow from the episodes."""

    def log(self, episodes: str) -> None:
        ended = [number for number in self._curves if number < self._ended]
        curves = [curve for number in ended for curve in self._curves.pop(number)]
        if not curves:
            return
        curve = np.mean(curves, 0)
        self._first = self._first or (curve, episodes)
        earliest, began = self._first
        share = np.linspace(0, 100, len(curve))
        title = (
            f"Gini {gini(curve):.2f}: {episodes}, {len(curves)} with a harvest "
            f"(green: {began}, {gini(earliest):.2f}; grey: equal shares)"
        )
        lines = [(share, 100 * shares) for shares in (share / 100, earliest, curve)]
        self._plot.log(title, lines, colours=[GREY, GREEN, ORANGE], radii=[0.3, 0.5, 1.0])


Regions: TypeAlias = list[tuple[list[int], NDArray[np.bool_]]]
"""The owners of each region, and its cells, bool [H, W]."""
_OPACITY: Final = 170
_INSET_CELLS, _BORDER_CELLS = 0.08, 0.04


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
    around, (height, width) = np.pad(cells, 1), cells.shape
    strips = []
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        beyond = around[1 + down : 1 + down + height, 1 + right : 1 + right + width]
        for row, col in np.argwhere(cells & ~beyond).tolist():
            x, y = (RIM_CELLS + at + 0.5 for at in (col, row))
            x, y = x + (0.5 - _INSET_CELLS) * right, y + (0.5 - _INSET_CELLS) * down
            strips.append([(x + side * abs(down), y + side * abs(right)) for side in (-0.5, 0.5)])
    return strips
