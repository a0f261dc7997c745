"""What a recording shows: its numbers, the board if there is one, and where parts of pictures stand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from cprl.envs.unwrap import joint_actions
from cprl.measuring.episodes import decisions_of, metrics_of
from cprl.measuring.registry import (
    COLLECTIVE_RETURN,
    EQUALITY,
    INCOME,
    INSTITUTIONS,
    OF_AGENTS,
    SOCIAL,
    left_out,
)
from cprl.values.arrays import Float32
from cprl.viewer.names import TEXT

MOST_JOINT: Final = 16
"""Joint actions that have a line each; of a game with more none has."""
_MOST_BOARDS: Final = 16
"""Of the worlds of a replica, side by side."""


def window_of(episodes: int, *, worlds: int = 1) -> int:
    """Return the episodes whose mean is the bold line of a run of so many, as many of each world."""
    return worlds * ceil(max(10, round(0.02 * episodes)) / worlds)


@dataclass(frozen=True, kw_only=True)
class Curves:
    """The numbers that a recording plots; a game without a board has nothing else."""

    agents: tuple[str, ...]
    """The names of the agents, agent 0 first."""
    replicas: int = 1
    """The number of replicas: each is a thin line, and their mean a thick one."""
    worlds: int = 1
    """The worlds W of each replica."""
    mean_over: int = 10
    """The episodes of a replica whose mean is the bold line, a multiple of W."""
    metrics: tuple[str, ...] = tuple(name for name in SOCIAL if name != INCOME)
    """The metrics that the game reports, and those of the user's own."""
    has_tags: bool = True
    """Whether the game reports who tagged whom."""
    in_force: tuple[str, ...] = ()
    """What is decided in an episode, in words, e.g. "the tax rate"."""
    joint: tuple[str, ...] = ()
    """The joint actions whose shares are plotted, e.g. "CC" and so on."""

    @property
    def boards(self) -> int:
        """How many boards are shown side by side: that of each replica, or, of replicas in several worlds,
        the first ones of the first."""
        return self.replicas if self.worlds == 1 else min(self.worlds, _MOST_BOARDS)

    @property
    def has_lorenz(self) -> bool:
        """Whether there is a harvest, and somebody to share it with."""
        return EQUALITY in self.metrics and len(self.agents) > 1

    @property
    def has_tags_between(self) -> bool:
        """Whether the game reports who tagged whom, and there is somebody to tag."""
        return self.has_tags and len(self.agents) > 1

    @property
    def has_institutions(self) -> bool:
        return bool(self.of_agents or self.in_force)

    @property
    def of_agents(self) -> tuple[str, ...]:
        """What each agent breaks, pays and gets, by the names of its lines."""
        return tuple(name for name in OF_AGENTS if f"{INSTITUTIONS}{name}" in self.metrics)

    @property
    def unit(self) -> str:
        """Apples, or "return" for the sum of rewards in a game that reports no harvest."""
        return "apples" if COLLECTIVE_RETURN in self.metrics else "return"

    @property
    def bold(self) -> str:
        """What the bold line is, in words."""
        return f"bold: mean of {self.mean_over} episodes"

    @property
    def legend(self) -> str:
        """What the lines of plots are, and how many episodes a point of them is of."""
        point = "" if self.worlds == 1 else f"a point is the mean of {self.worlds} episodes; "
        thin = "thin: a replica, " if self.replicas > 1 else ""
        return f"Curves by episode: {point}{thin}{self.bold}, grey: random play"


@dataclass(frozen=True, kw_only=True)
class Scene(Curves):
    """The contents of the board that a recording shows."""

    height: int
    width: int
    walls: tuple[tuple[int, int], ...]
    """(row, col) of each cell of inner wall."""
    sites: tuple[tuple[int, int], ...]
    """(row, col) of each of the K sites, the cells where apples grow."""
    window: tuple[int, int]
    """(X, Y) of a window."""
    caption: str = "itself blue at the bottom; others red"
    """How to read windows."""
    actions: int = 8
    """The number of actions A."""
    is_replay: bool = False
    """Whether it is one episode of a stored policy; then harvest and stock are plotted turn by turn, and
    there are no curves over episodes."""


def curves_of(
    env: EnvBase,
    agents: tuple[str, ...],
    reported: Sequence[str],
    *,
    episodes: int,
    worlds: int = 1,
    own: Sequence[str] = (),
) -> Curves:
    """Return the numbers of an environment that are plotted, and metrics of the user's own by their names."""
    joint = joint_actions(env)
    return Curves(
        agents=agents,
        replicas=env.batch_size.numel() // worlds,
        worlds=worlds,
        mean_over=window_of(episodes, worlds=worlds),
        metrics=(*metrics_of(env, reported), *own),
        has_tags="tagged_by" in reported,
        in_force=decisions_of(env) if "in_force" in reported else (),
        joint=joint if len(joint) <= MOST_JOINT else (),
    )


def scene_of(env: CommonsEnv, curves: Curves, *, is_replay: bool = False) -> Scene:
    """Return the scene of an environment's recording, and the numbers that are plotted beside it."""
    board = env.game.map
    return Scene(
        **vars(curves),
        height=board.height,
        width=board.width,
        walls=board.walls,
        sites=board.sites,
        window=env.game.observation_shape[1:],
        caption=_caption(env.game),
        actions=len(env.game.actions),
        is_replay=is_replay,
    )


def _caption(game: Game) -> str:
    if game.observation.agents_apart:
        return "each agent in a colour of its own"
    stays = self_stays(game.rules.quirks)
    also = "; as run also agents of lower number" if stays else ""
    return "itself blue at the bottom" + (f"{also}; others red" if game.agents > 1 else "")


_SHOWN: Final[Mapping[str, tuple[str, ...]]] = {
    "new bests": ("harvest",),
    "who tagged whom": ("tagged_by",),
    "the Lorenz curve": ("harvest",),
    "all boards side by side": ("board",),
    "where agents go": ("board",),
    "the stock over the turn": ("board",),
    "the board and what agents see": ("board",),
}
"""The views of a recording besides metrics, and the entries that each needs."""


def missing_in(reported: Sequence[str], *, has_board: bool) -> list[str]:
    """Return lines that name what the recording lacks, and why."""
    lines = left_out([*reported, *(["board"] if has_board else [])], more=_SHOWN).split("; ")
    return [line for line in lines if line]


_WINDOWS_WIDE, _BOARDS_WIDE = 1.7, 3.0
"""The width of the viewer's area for windows, and of half a tab, divided by its height, about."""
_LABEL_SHARE: Final = 0.3
"""The height of a line of text, of that of a board: texts have a size of their own on the screen."""


class Panels:
    """The places of equal boards in one image, a pixel apart.

    Args:
        wide: the width of the viewer's area, divided by its height.
        columns: how many stand side by side; by default so many that they are as large as possible.
        has_labels: whether there is room for a text above each.
    """

    def __init__(
        self,
        count: int,
        size: tuple[int, int],
        *,
        wide: float = _BOARDS_WIDE,
        columns: int | None = None,
        has_labels: bool = True,
    ) -> None:
        self.size = size
        self._label = max(2, ceil(_LABEL_SHARE * size[0])) if has_labels else 0
        apart = np.array((size[0] + self._label + 1, size[1] + 1))

        def cell_size(columns: int) -> float:
            return min(wide / (columns * int(apart[1])), 1 / (ceil(count / columns) * int(apart[0])))

        self.columns = columns or max(range(1, count + 1), key=cell_size)
        self.corners = np.stack(np.divmod(np.arange(count), self.columns), 1) * apart + (self._label, 0)
        """int [count, 2], the top-left (row, col) of each board."""
        rows, width = (self.corners.max(0) + size).tolist()
        self.shape: tuple[int, int] = (rows, width)
        """The rows and columns of the image."""

    def joined(self, boards: NDArray[Any], background: Any) -> NDArray[Any]:
        """Return one image of all boards: [count, rows, columns, ...] to [*shape, ...]."""
        image = np.empty((*self.shape, *boards.shape[3:]), boards.dtype)
        image[:] = background
        for (top, left), board in zip(self.corners, boards, strict=True):
            image[top : top + self.size[0], left : left + self.size[1]] = board
        return image

    def labels(self, colours: Sequence[Colour] | None = (TEXT,)) -> Any:
        """Return the points at which texts stand, as Rerun's static part of `Points2D`; labels vary, and
        colours for None: what is static hides what is not."""
        return rr.Points2D.from_fields(positions=self.tops, radii=[0.0], colors=colours, show_labels=True)

    @property
    def tops(self) -> Float32:
        """Where the text of each board stands, (x, y)."""
        tops: Float32 = self.corners[:, ::-1] + (self.size[1] / 2, 0.1 - self._label)
        return tops.astype(np.float32)


def boards_of(scene: Scene, count: int) -> Panels:
    """Return the places of so many boards with their rim."""
    return Panels(count, (scene.height + 2, scene.width + 2))


def windows_of(agents: int, window: tuple[int, int]) -> Panels:
    """Return the places of the agents' windows (X, Y)."""
    return Panels(agents, window, wide=_WINDOWS_WIDE, has_labels=False)


HIGH: Final = 12
"""The height of a panel of bars, in pixels: the largest bar has one less."""
BELOW: Final = 4
"""The room below bars for the names of actions."""
BAR, APART = 5, 1
"""The width of a bar and of the gap, in pixels."""


def decision_panels(agents: int, actions: int, window: tuple[int, int]) -> Panels:
    """Return the places of the agents' bars, arranged as their windows (X, Y) are."""
    columns = windows_of(agents, window).columns
    return Panels(agents, (HIGH + BELOW, actions * (BAR + APART) + APART), columns=columns)


PLOT_WIDE, PLOT_HIGH = 260.0, 80.0
"""The size of a plot that is not over time, in the view's units; (0, 0) is the top left of its area."""
TITLE: Final = PLOT_WIDE / 2, -22.0
"""Where its title hangs."""
