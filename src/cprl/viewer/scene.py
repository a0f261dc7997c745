"""The contents of a recording: its numbers, its board, and the positions of boards in joint images."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import ceil
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from torchrl.envs import EnvBase

from cprl.commons.cells import Colour
from cprl.commons.game import Game
from cprl.commons.quirks import self_stays
from cprl.envs.commons_env import CommonsEnv
from cprl.envs.unwrap import commons_game_of, joint_actions
from cprl.measuring.registry import (
    AGENT_TOTALS,
    COLLECTIVE_RETURN,
    EQUALITY,
    INCOME,
    INSTITUTIONS,
    SOCIAL_METRICS,
    left_out_note,
    metrics_for,
)
from cprl.measuring.tracker import decisions_of
from cprl.values.array_types import Float32
from cprl.viewer.names import TEXT

_MOST_JOINT: Final = 16
"""The largest number of joint actions whose shares are plotted; a game with more has no such plot."""
_MOST_BOARDS: Final = 16
"""The largest number of worlds of a replica whose boards are shown side by side."""


@dataclass(frozen=True, kw_only=True)
class Curves:
    """The numbers that a recording plots. The recording of a game without a board shows nothing else."""

    agents: tuple[str, ...]
    """The names of the agents, agent 0 first."""
    replicas: int = 1
    """The number of replicas. Each is a thin line, and their mean is a thick line."""
    worlds: int = 1
    """The number of worlds W of each replica."""
    mean_over: int = 10
    """The number of episodes of a replica over which the bold line is a running mean; a multiple of W."""
    metrics: tuple[str, ...] = tuple(name for name in SOCIAL_METRICS if name != INCOME)
    """The names of the metrics that the game reports, and of the user's metrics."""
    has_tags: bool = True
    """Whether the game reports who tagged whom."""
    in_force: tuple[str, ...] = ()
    """The names of the values that agents decide on by vote, e.g. "the tax rate"."""
    joint: tuple[str, ...] = ()
    """The joint actions whose shares are plotted, e.g. "CC", "CD", "DC" and "DD"."""

    @property
    def boards(self) -> int:
        """Return the number of boards that are shown side by side.

        They are one board for each replica or, with several worlds per replica, those of the first worlds of
        the first replica.
        """
        return self.replicas if self.worlds == 1 else min(self.worlds, _MOST_BOARDS)

    @property
    def has_lorenz(self) -> bool:
        """Return whether there is a Lorenz curve: several agents share a harvest."""
        return EQUALITY in self.metrics and len(self.agents) > 1

    @property
    def has_tags_between(self) -> bool:
        """Return whether the game has several agents and reports who tagged whom."""
        return self.has_tags and len(self.agents) > 1

    @property
    def has_institutions(self) -> bool:
        """Return whether institutions take, give or decide anything that can be plotted."""
        return bool(self.agent_amounts or self.in_force)

    @property
    def agent_amounts(self) -> tuple[str, ...]:
        """Return the names of the plots with a line for each agent: violations, fines and transfers."""
        return tuple(name for name in AGENT_TOTALS if f"{INSTITUTIONS}{name}" in self.metrics)

    @property
    def unit(self) -> str:
        """Return "apples", or "return" for the sum of rewards in a game that reports no harvest."""
        return "apples" if COLLECTIVE_RETURN in self.metrics else "return"

    @property
    def mean(self) -> str:
        """Return the name of the bold line of a plot."""
        return f"mean of {self.mean_over} episodes"

    @property
    def legend(self) -> str:
        """Return the words that explain the lines of all plots."""
        point = "" if self.worlds == 1 else f"a point is the mean of {self.worlds} episodes; "
        thin = "thin: a replica, " if self.replicas > 1 else ""
        return f"Curves by episode: {point}{thin}bold: {self.mean}, grey: random play"


@dataclass(frozen=True, kw_only=True)
class Scene(Curves):
    """The board that a recording shows, beside the numbers that it plots."""

    height: int
    """The number of rows H."""
    width: int
    """The number of columns W."""
    walls: tuple[tuple[int, int], ...]
    """(row, col) of each wall inside the board."""
    sites: tuple[tuple[int, int], ...]
    """(row, col) of each of the K sites, the cells where apples grow."""
    window: tuple[int, int]
    """The rows and the columns (X, Y) of an agent's window."""
    caption: str = "itself blue at the bottom; others red"
    """The words that explain the colours in the agents' windows."""
    actions: int = 8
    """The number of actions A."""
    is_replay: bool = False
    """Whether the recording shows a single episode of a stored policy. Then harvest and stock are plotted
    turn by turn, and nothing is plotted over episodes."""


def plotted_numbers(
    env: EnvBase,
    agents: tuple[str, ...],
    reported: Sequence[str],
    *,
    episodes: int,
    worlds: int = 1,
    user_metrics: Sequence[str] = (),
) -> Curves:
    """Return the numbers that the recording of a training plots.

    Args:
        env: the worlds of all replicas.
        agents: the names of the agents.
        reported: the entries that the game reports, see `cprl.measuring.registry.reported_by`.
        episodes: the number of episodes of each replica.
        worlds: the number of worlds of each replica.
        user_metrics: the names of the user's metrics.
    """
    mean_over = max(10, round(0.02 * episodes))
    in_force = decisions_of(env) if "in_force" in reported else ()
    joint = joint_actions(env)
    if len(joint) > _MOST_JOINT:
        joint = ()
    return Curves(
        agents=agents,
        replicas=env.batch_size.numel() // worlds,
        worlds=worlds,
        mean_over=worlds * ceil(mean_over / worlds),
        metrics=(*metrics_for(reported, commons_game_of(env)), *user_metrics),
        has_tags="tagged_by" in reported,
        in_force=in_force,
        joint=joint,
    )


def scene_of(
    env: CommonsEnv, curves: Curves, *, is_replay: bool = False, size: tuple[int, int] = (0, 0)
) -> Scene:
    """Return the board of an environment, together with the numbers that are plotted beside it.

    Args:
        size: the least rows and columns of the picture; what lies beyond the board is wall.
    """
    board = env.game.map
    height, width = np.maximum(size, (board.height, board.width)).tolist()
    beyond = np.ones((height, width), np.bool_)
    beyond[: board.height, : board.width] = False
    return Scene(
        **{field.name: getattr(curves, field.name) for field in fields(Curves)},
        height=height,
        width=width,
        walls=(*board.walls, *((row, col) for row, col in np.argwhere(beyond).tolist())),
        sites=board.sites,
        window=env.game.observation_shape[1:],
        caption=_caption(env.game),
        actions=len(env.game.actions),
        is_replay=is_replay,
    )


def _caption(game: Game) -> str:
    if game.observation.agents_apart:
        return "each agent in a colour of its own"
    caption = "itself blue at the bottom"
    if game.agents == 1:
        return caption
    if self_stays(game.rules.quirks):
        caption += "; as run also agents of lower number"
    return f"{caption}; others red"


_NEEDED_ENTRIES: Final = {
    "new bests": ("harvest",),
    "who tagged whom": ("tagged_by",),
    "the Lorenz curve": ("harvest",),
    "all boards side by side": ("board",),
    "where agents go": ("board",),
    "the stock over the turn": ("board",),
    "the board and what agents see": ("board",),
}
"""The views of a recording beside the metrics, each with the entries that the game must report for it."""


def missing_in(reported: Sequence[str], *, has_board: bool) -> list[str]:
    """Return the texts that name the views that a recording lacks, and the entries missing for them."""
    entries = [*reported, "board"] if has_board else reported
    return list(filter(None, left_out_note(entries, more=_NEEDED_ENTRIES).split("; ")))


_WINDOWS_ASPECT: Final = 1.7
"""About the ratio of width to height of the viewer's area for windows."""
_BOARDS_ASPECT: Final = 3.0
"""About the ratio of width to height of half a tab."""
_LABEL_SHARE: Final = 0.3
"""The room for the text above a board, as a share of the board's height: texts have a fixed size."""


class Panels:
    """The positions of boards of equal size in one image, with a pixel between them.

    Args:
        count: the number of boards.
        size: the rows and the columns of a board.
        aspect: the ratio of width to height of the area in which the viewer shows the image.
        columns: the number of boards in a row; by default the number that makes the boards largest.
        has_labels: whether to leave room for a text above each board.
    """

    def __init__(
        self,
        count: int,
        size: tuple[int, int],
        *,
        aspect: float = _BOARDS_ASPECT,
        columns: int | None = None,
        has_labels: bool = True,
    ) -> None:
        self.size = size
        self._label_rows = max(2, ceil(_LABEL_SHARE * size[0])) if has_labels else 0
        row_spacing = size[0] + self._label_rows + 1
        column_spacing = size[1] + 1

        def cell_size(columns: int) -> float:
            rows = ceil(count / columns)
            return min(aspect / (columns * column_spacing), 1 / (rows * row_spacing))

        self.columns = columns or max(range(1, count + 1), key=cell_size)
        position = np.stack(np.divmod(np.arange(count), self.columns), 1)
        self.corners = position * np.array((row_spacing, column_spacing)) + (self._label_rows, 0)
        """int [count, 2], the top-left (row, col) of each board."""
        rows, width = (self.corners.max(0) + size).tolist()
        self.shape: tuple[int, int] = (rows, width)
        """The rows and columns of the image."""

    def join(self, boards: NDArray[Any], background: Any) -> NDArray[Any]:
        """Join all boards in one image: [count, rows, columns, ...] to [*shape, ...]."""
        image = np.empty((*self.shape, *boards.shape[3:]), boards.dtype)
        image[:] = background
        for (top, left), board in zip(self.corners, boards, strict=True):
            image[top : top + self.size[0], left : left + self.size[1]] = board
        return image

    def labels(self, colours: Sequence[Colour] | None = (TEXT,)) -> Any:
        """Return the static part of the texts above boards: their positions, and their colours unless None.

        The texts, and colours that vary, are logged with a time, because static data hides data with a time.
        """
        return rr.Points2D.from_fields(positions=self.tops, radii=[0.0], colors=colours, show_labels=True)

    @property
    def tops(self) -> Float32:
        """Return the position (x, y) of the text above each board, float32 [count, 2]."""
        tops = self.corners[:, ::-1] + (self.size[1] / 2, 0.1 - self._label_rows)
        return np.asarray(tops, np.float32)


def boards_of(scene: Scene, count: int) -> Panels:
    """Return the positions of boards with their rim in one image."""
    return Panels(count, (scene.height + 2, scene.width + 2))


def windows_of(agents: int, window: tuple[int, int]) -> Panels:
    """Return the positions of the agents' windows of X rows and Y columns in one image."""
    return Panels(agents, window, aspect=_WINDOWS_ASPECT, has_labels=False)


BAR_HIGH: Final = 12
"""The height of a panel of bars, in pixels; the longest bar is one pixel shorter."""
_NAMES_HIGH: Final = 4
"""The room below bars for the names of actions, in pixels."""
BAR_WIDE: Final = 5
"""The width of a bar, in pixels."""
BAR_GAP: Final = 1
"""The width of the gap between two bars, in pixels."""


def decision_panels(agents: int, actions: int, window: tuple[int, int]) -> Panels:
    """Return the positions of the agents' panels of bars in one image, arranged as their windows are."""
    columns = windows_of(agents, window).columns
    return Panels(agents, (BAR_HIGH + _NAMES_HIGH, actions * (BAR_WIDE + BAR_GAP) + BAR_GAP), columns=columns)


PLOT_WIDE: Final = 260.0
"""The width of a plot that is not over time, in the view's units; (0, 0) is the top left of its area."""
PLOT_HIGH: Final = 80.0
"""The height of such a plot."""
TITLE: Final = PLOT_WIDE / 2, -22.0
"""The position (x, y) of the title of such a plot."""
