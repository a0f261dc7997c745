"""What a recording shows: the numbers and boards, their names and colours, and the layout of the viewer.

    header: one line in large type
    tabs, of which the first has the board (live: the current policy's) beside the harvest, the apples left
    and the boards of all replicas, or the apples on the board over the turn in all worlds of one
    the live label, whether agents explore and, at the end, the phases, as strips

A new tab is a line of `_tabs`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import ceil
from typing import Any, Final, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.blueprint.encodings import TimelineColumn
from torchrl.envs import EnvBase

from cprl.commons.colours import (
    APPLE,
    BLUE,
    FIRST_AGENT,
    GREEN,
    GREY,
    ORANGE,
    PALETTE,
    PURPLE,
    VERMILION,
    Colour,
    class_name,
    line_colour,
    picture_colour,
)
from cprl.commons.decoding import UNSEEN
from cprl.commons.game import Game
from cprl.commons.picture import EMPTY_SITE_COLOUR
from cprl.envs.commons_env import CommonsEnv
from cprl.envs.matrix import MatrixGame
from cprl.envs.unwrap import base_env
from cprl.measuring import now, phases
from cprl.measuring.episodes import decisions_of, metrics_of
from cprl.measuring.registry import INCOME, METRICS, SOCIAL, colour, is_own, left_out, title
from cprl.measuring.series import OF_AGENTS
from cprl.viewer.live import HEADER

SHARES: Final = (
    "violations_per_step",
    "own_share_of_bites",
    "detection_rate",
    "recidivism",
    "unjust_share_of_tags",
)
"""The metrics of institutions that share a plot; only their running means are shown there, as of those of
net incomes."""
INCOMES: Final = ("income_equality", "income_equality_within", "income_equality_between")
PAYMENTS: Final = {
    "violations": "Violations of each, turns",
    "fines": "Fines of each, apples",
    "transfers": "Transfers to each, apples",
}
"""The plots of what each agent breaks, pays and gets, by the name of their lines."""
PAID, GIVEN = "paid", "given"
"""The lines of each agent in a replay: what institutions take in a turn, downwards, and give, upwards."""
RETURN: Final = "return_of_all"
"""The line of the summed return, in games that report no harvest."""
JOINT: Final = "joint_actions"
"""The lines of the shares of joint actions, in small matrix games."""
MOST_JOINT: Final = 16
"""Joint actions that have a line each."""
RANDOM_PLAY: Final = "random_play"
"""The folder of the lines of random play; each has the name of its metric."""
EVALUATION: Final = "evaluation"
"""The folder of the lines of evaluations while agents are trained, likewise."""
ANOTHER: Final = "another"
"""The name of a phase that matches no pattern of the study."""
SETTLED: Final = "settled"
"""The state of agents who explore no more, which is not drawn."""
EMPTY_SITE: Final = UNSEEN - 1
"""The class of a site without an apple on boards."""
TEXT: Final = (200, 200, 200)
BACKGROUND: Final = (24, 26, 32)
"""The background of boards and windows, which sets their dark cells apart from the viewer's own colour."""
STATES: Final = {
    "exploration": BLUE,
    "tragedy": VERMILION,
    "combat": PURPLE,
    "cultivation": GREEN,
    ANOTHER: (120, 120, 120),
    now.BEGINS: (80, 80, 80),
    now.RISING: GREEN,
    now.RECOVERING: BLUE,
    now.STEADY: GREY,
    now.FALLING: ORANGE,
    now.BELOW: VERMILION,
    now.EXPLORING: (60, 90, 130),
    SETTLED: BACKGROUND,
}
"""The colours of phases and live labels, which share one where they mean the same."""
STRIPS: Final = ("now", "exploring", "phase/found", "phase/as_published")
"""The entities of states: the live label, whether agents explore, and the phases that are logged when a long
run ends."""


def window_of(episodes: int, *, worlds: int = 1) -> int:
    """The episodes whose mean is the bold line of a run of so many, as many of each world of a replica."""
    return worlds * ceil(max(10, round(0.02 * episodes)) / worlds)


_MOST_BOARDS: Final = 16
"""Of the worlds of a replica, side by side."""


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
    """The metrics that the game reports, without the prefix `social/`."""
    has_phases: bool = True
    """Whether phases are found when the run ends: it is long enough, these metrics tell, and the means of W
    episodes are no further apart than the resolution of phases."""
    has_tags: bool = True
    """Whether the game reports who tagged whom."""
    institutions: tuple[str, ...] = ()
    """The metrics of institutions that the game reports, without the prefix `institutions/`."""
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
        return "equality" in self.metrics and len(self.agents) > 1

    @property
    def has_tags_between(self) -> bool:
        """Whether the game reports who tagged whom, and there is somebody to tag."""
        return self.has_tags and len(self.agents) > 1

    @property
    def has_institutions(self) -> bool:
        return bool(self.institutions or self.in_force)

    @property
    def unit(self) -> str:
        """Apples, or "return" for the sum of rewards in a game that reports no harvest."""
        return "apples" if "collective_return" in self.metrics else "return"


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
    """The numbers of an environment that are plotted, and metrics of the user's own by their names."""
    known = metrics_of(env, reported)
    metrics = (*(name for name in known if not name.startswith("institutions/")), *own)
    game = getattr(base_env(env), "game", None)
    return Curves(
        agents=agents,
        replicas=env.batch_size.numel() // worlds,
        worlds=worlds,
        mean_over=window_of(episodes, worlds=worlds),
        metrics=metrics,
        has_phases=(
            episodes in phases.EPISODES and worlds <= phases.GRID and set(phases.METRICS) <= set(metrics)
        ),
        has_tags="tagged_by" in reported,
        institutions=tuple(
            name.removeprefix("institutions/") for name in known if name.startswith("institutions/")
        ),
        in_force=decisions_of(env) if "in_force" in reported else (),
        joint=joint_actions(game) if isinstance(game, MatrixGame) else (),
    )


def joint_actions(game: MatrixGame) -> tuple[str, ...]:
    """The joint actions of a small game in letters, that of agent 0 first: C and D in a social dilemma of
    two, where both are paid more if both choose action 0, else A and so on. None of a large game."""
    if game.actions**game.agents > MOST_JOINT:
        return ()
    letters, payoffs = "ABCDEFGHIJKLMNOP"[: game.actions], np.array(game.payoffs)
    if payoffs.shape == (2, 2, 2) and (payoffs[..., 0] == payoffs[..., 1].T).all():
        (reward, sucker), (temptation, punishment) = payoffs[..., 0]
        if reward > max(punishment, sucker) and (temptation > reward or punishment > sucker):
            letters = "CD"
    return tuple(map("".join, product(letters, repeat=game.agents)))


def scene_of(env: CommonsEnv, curves: Curves, *, is_replay: bool = False) -> Scene:
    """The scene of an environment's recording, and the numbers that are plotted beside it."""
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
    also = "; as run also agents of lower number" if game.rules.self_paint_stays else ""
    return "itself blue at the bottom" + (f"{also}; others red" if game.agents > 1 else "")


_SHOWN: Final[Mapping[str, tuple[str, ...]]] = {
    "phases and new bests": tuple(
        dict.fromkeys(entry for name in phases.METRICS for entry in METRICS[name].entries)
    ),
    "who tagged whom": ("tagged_by",),
    "the Lorenz curve": ("harvest",),
    "all boards side by side": ("board",),
    "where agents go": ("board",),
    "the stock over the turn": ("board",),
    "the board and what agents see": ("board",),
}
"""The views of a recording besides metrics, and the entries that each needs."""


def missing_in(reported: Sequence[str], *, has_board: bool) -> list[str]:
    """Lines that name what the recording lacks, and why."""
    lines = left_out([*reported, *(["board"] if has_board else [])], more=_SHOWN).split("; ")
    return [line for line in lines if line]


def classes(curves: Curves, colour_of: Callable[[int], Colour] = picture_colour) -> Any:
    """Names and colours of the classes on boards, or by another function in windows."""
    known = [
        rr.AnnotationInfo(id=kind, label=class_name(kind), color=colour_of(kind))
        for kind in range(FIRST_AGENT + len(curves.agents))
    ]
    empty = rr.AnnotationInfo(id=EMPTY_SITE, label="no apple", color=EMPTY_SITE_COLOUR)
    unseen = rr.AnnotationInfo(id=UNSEEN, label="", color=(0, 0, 0, 0))
    return rr.AnnotationContext([*known, empty, unseen])


def styles(curves: Curves) -> dict[str, Any]:
    """The names, colours and widths of each plot's lines, and the colours of states, by entity."""
    replicas = curves.replicas
    mean = f"mean of {curves.mean_over} episodes"
    lines = {
        "time/env_steps_per_s": line("steps per second", GREY),
        f"{EVALUATION}/greedy_return": line("greedy, evaluated", ORANGE),
        f"{EVALUATION}/return": line("sum of all, evaluated", ORANGE),
        "turn/stock": line("apples", PALETTE[APPLE]),
    }
    if curves.unit == "return":
        lines[RETURN] = running(mean, ORANGE, replicas)
        lines[f"{RANDOM_PLAY}/{RETURN}"] = line("random play", GREY)
    for metric in curves.metrics:
        is_alone = metric in INCOMES
        words = METRICS[metric].words if is_alone else mean
        lines[f"social/{metric}"] = running(words, colour(metric), replicas, is_alone=is_alone)
        lines[f"{RANDOM_PLAY}/{metric}"] = line("random play", GREY)
        lines[f"{EVALUATION}/{metric}"] = line("greedy, evaluated", ORANGE)
    for name in (f"institutions/{metric}" for metric in curves.institutions):
        lines[f"{RANDOM_PLAY}/{name}"] = line("random play", GREY)
        is_alone = name.removeprefix("institutions/") in (*SHARES, *INCOMES)
        lines[name] = running(METRICS[name].words, colour(name), replicas, is_alone=is_alone)
    for ballot, decided in enumerate(curves.in_force):
        hue = (ORANGE, BLUE, GREEN, PURPLE)[ballot % 4]
        lines[f"institutions/in_force_{ballot}"] = running(decided, hue, replicas)
    for agent, name in enumerate(curves.agents):
        hue = line_colour(agent)
        for entity in ("loss", "q", "harvested"):
            lines[f"{name}/{entity}"] = line(name, hue)
        # Equal ones are seen as stripes.
        lines[f"{name}/epsilon"] = line(name, hue, width=1.0 + 2.0 * ((len(curves.agents) - 1 - agent) % 4))
        for entity in ("return", *(kind for kind in OF_AGENTS if kind in curves.institutions)):
            lines[f"{name}/{entity}"] = running(name, hue, replicas=1, is_alone=len(curves.agents) > 4)
    if curves.joint:
        count = len(curves.joint)
        hues = (GREEN, BLUE, ORANGE, VERMILION) if count == 4 else tuple(map(line_colour, range(count)))
        lines[JOINT] = rr.SeriesLines(names=list(curves.joint), colors=list(hues), widths=[2.5] * count)
    packed = [red << 24 | green << 16 | blue << 8 | 255 for red, green, blue in STATES.values()]
    states = rr.StateConfiguration(
        values=list(STATES),
        labels=list(STATES),
        colors=np.array(packed, np.uint32),  # 0xRRGGBBAA
        visible=[state != SETTLED for state in STATES],
    )
    return lines | dict.fromkeys(STRIPS if curves.has_phases else STRIPS[:2], states)


def line(name: str, colour: Colour, *, width: float = 1.0) -> Any:
    return rr.SeriesLines(names=[name], colors=[colour], widths=[width])


def running(name: str, colour: Colour, replicas: int, *, is_alone: bool = False) -> Any:
    """Thin, dark lines for each of several replicas, a faint one for their mean, and on top a bold one for
    its running mean; `is_alone` shows that one alone, where others share the plot."""
    singles = replicas if replicas > 1 else 0
    dark, faint = (tuple(round(share * part) for part in colour) for share in (0.35, 0.6))
    return rr.SeriesLines(
        names=[*["replicas"] * singles, "episodes", name],
        colors=[*[dark] * singles, faint, colour],
        widths=[*[0.7] * singles, 1.0, 2.5],
        visible_series=[*[False] * (singles + 1), True] if is_alone else None,
    )


_APART_PIXELS: Final = 1
_WINDOWS_WIDE, _BOARDS_WIDE = 1.7, 3.0
"""The width of the viewer's area for windows, and of half a tab, divided by its height, about."""
_LABEL_SHARE: Final = 0.3
"""The height of a line of text, of that of a board: texts have a size of their own on the screen."""


def window_corners(
    agents: int, window: tuple[int, int], *, wide: float = _WINDOWS_WIDE
) -> list[tuple[int, int]]:
    """The top-left corner (row, col) of each agent's window in a mosaic with cells as large as possible."""
    rows, cols = (length + _APART_PIXELS for length in window)

    def cell_size(columns: int) -> float:
        return min(wide / (columns * cols), 1 / (ceil(agents / columns) * rows))

    columns = max(range(1, agents + 1), key=cell_size)
    return [(agent // columns * rows, agent % columns * cols) for agent in range(agents)]


class Panels:
    """The places of equal boards in one image.

    Args:
        columns: how many stand side by side; by default so many that they are as large as possible.
    """

    def __init__(self, count: int, size: tuple[int, int], *, columns: int | None = None) -> None:
        self._label = max(2, ceil(_LABEL_SHARE * size[0]))
        padded = size[0] + self._label, size[1]
        corners = np.array(window_corners(count, padded, wide=_BOARDS_WIDE))
        if columns is not None:
            corners = np.stack(np.divmod(np.arange(count), columns), 1) * (np.array(padded) + 1)
        self.size = size
        self.corners = corners + np.array((self._label, 0))
        """int [count, 2], the top-left (row, col) of each board."""
        rows, width = (self.corners.max(0) + size).tolist()
        self.shape: tuple[int, int] = (rows, width)
        """The rows and columns of the image."""

    def joined(self, boards: NDArray[Any], background: Any) -> NDArray[Any]:
        """One image of all boards: [count, rows, columns, ...] to [*shape, ...]."""
        image = np.empty((*self.shape, *boards.shape[3:]), boards.dtype)
        image[:] = background
        for (top, left), board in zip(self.corners, boards, strict=True):
            image[top : top + self.size[0], left : left + self.size[1]] = board
        return image

    def labels(self, colours: Sequence[Colour] | None = (TEXT,)) -> Any:
        """The points at which texts stand, as Rerun's static part of `Points2D`; labels vary, and colours for
        None: what is static hides what is not."""
        tops = self.corners[:, ::-1] + (self.size[1] / 2, 0.1 - self._label)
        return rr.Points2D.from_fields(
            positions=tops.astype(np.float32), radii=[0.0], colors=colours, show_labels=True
        )

    def view(self, name: str, origin: str) -> Any:
        rows, columns = self.shape
        return flat(name, origin, x=(-0.5, columns + 0.5), y=(-0.5, rows + 0.5))


def boards_of(scene: Scene, count: int) -> Panels:
    """The places of so many boards with their rim."""
    return Panels(count, (scene.height + 2, scene.width + 2))


HIGH: Final = 12
"""The height of a panel of bars, in pixels: the largest bar has one less."""
BELOW: Final = 4
"""The room below bars for the names of actions."""
BAR, APART = 5, 1
"""The width of a bar and of the gap, in pixels."""


def decision_panels(agents: int, actions: int, window: tuple[int, int]) -> Panels:
    """The places of the agents' bars, arranged as their windows (X, Y) are."""
    columns = sum(row == 0 for row, _ in window_corners(agents, window))
    return Panels(agents, (HIGH + BELOW, actions * (BAR + APART) + APART), columns=columns)


PLOT_WIDE, PLOT_HIGH = 260.0, 80.0
"""The size of a plot that is not over time, in the view's units; (0, 0) is the top left of its area."""
TITLE: Final = PLOT_WIDE / 2, -22.0
"""Where its title hangs."""


def _drawn_plot(name: str, origin: str) -> Any:
    """The view of a plot that is not over time, with room for its texts."""
    return flat(name, origin, x=(-24.0, PLOT_WIDE + 16.0), y=(TITLE[1], PLOT_HIGH + 34.0))


def flat(
    name: str, origin: str, *, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None
) -> Any:
    bounds = rrb.VisualBounds2D(x_range=x, y_range=y) if x and y else None
    return rrb.Spatial2DView(name=name, origin=f"/{origin}", background=BACKGROUND, visual_bounds=bounds)


_HEADER, _RULER, _STRIP, _VIEWS = 90, 22, 40, 462
"""Heights in a window of 1280 x 720, in pixels: the header, the ruler above strips, a strip, and all else.
Rows share out any other height as they do this one."""


def layout(curves: Curves, *, live: bool = False, ended: bool = False) -> Any:
    """The layout of a recording; a replay has fewer views, and a game without a board none of the board.

    The timeline of the time panel is the axis of every plot: episodes, and in a replay, which records all
    its steps, steps. Boards of a run are played back on `frame`, which counts recorded frames alone.

    Args:
        curves: the numbers that are plotted; a `Scene` if there is a board.
        live: whether it is the layout of the live view, which has the current policy's exhibition
            (`/exhibition`, in the live stream alone), and no room for phases before they are there.
    """
    is_replay = isinstance(curves, Scene) and curves.is_replay
    strips = 4 if curves.has_phases and (ended or not live) else 2
    views = (
        _replay(curves)
        if isinstance(curves, Scene) and is_replay
        else rrb.Vertical(
            rrb.TextDocumentView(name="Now", origin=f"/{HEADER}", titlebar=False),
            rrb.Tabs(*_tabs(curves, live=live), active_tab=0),
            _strips(),
            row_shares=[_HEADER, _VIEWS, _RULER + strips * _STRIP],
        )
    )
    play_state: Literal["playing", "following"] = "playing" if is_replay else "following"
    return rrb.Blueprint(
        views,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed", timeline="step" if is_replay else "episode", play_state=play_state, fps=15
        ),
    )


def _replay(scene: Scene) -> Any:
    """A large board, the agents' windows, what their policies say, and the harvest and stock of one episode,
    turn by turn, and what institutions take and give."""
    bars = decision_panels(len(scene.agents), scene.actions, scene.window)
    paid = [*_of(scene.agents, PAID), *_of(scene.agents, GIVEN)] if scene.has_institutions else []
    right = _present(
        [
            flat(f"What agents see: {scene.caption}", "windows"),
            bars.view("What policies say (L, R turn, B beam, S stay), taken: white", "decisions"),
            _plot("Harvest so far, apples", _of(scene.agents, "harvested")),
            _plot("Apples on the board", ["turn/stock"]),
            _plot("Fined (down) and given (up) in the turn, apples", paid),
        ]
    )
    left = [_board("Board", scene), rrb.Tabs(_events(), _recipe(), active_tab=0)]
    return rrb.Horizontal(
        rrb.Vertical(*left, row_shares=[7, 2]),
        rrb.Vertical(*right, row_shares=[4, 4, 2, 2, 2][: len(right)]),
        column_shares=[3, 2],
    )


def _board(name: str, scene: Scene, *, origin: str = "world", below: float = 2.6) -> Any:
    """The view of a board with room for what stands below it, in cells."""
    return flat(name, origin, x=(-0.2, scene.width + 2.2), y=(-0.2, scene.height + 2.0 + below))


def _events() -> Any:
    """The events, whose texts say when; the viewer's own column is so narrow that it cuts the numbers."""
    hidden = [TimelineColumn("step", visible=False)]
    columns = rrb.TextLogColumns(timeline_columns=hidden, text_log_columns=["Body"])
    return rrb.TextLogView(name="Events", origin="/log", columns=columns)


def _strips() -> Any:
    """The live label, below it whether agents explore, and the phases found at the end and the published
    ones, as bands over episodes."""
    contents = [f"+ /{strip}" for strip in STRIPS]
    return rrb.StateTimelineView(name="Phases", contents=contents, time_view=_whole(), titlebar=False)


def _overview(curves: Curves, *, live: bool) -> Any:
    """What a newcomer sees: the board large, and beside it what the group gets and leaves."""
    if curves.unit == "apples":
        gets = _social(curves, "collective_return", is_explained=True)
    else:
        entities = [RETURN, f"{RANDOM_PLAY}/{RETURN}", f"{EVALUATION}/return"]
        gets = _plot(f"Sum of all returns; {_bold(curves)}", entities, has_legend=False)
    if not isinstance(curves, Scene):
        joint = (
            _plot("Joint actions, share of turns; agent 0 first", [JOINT], share=True)
            if curves.joint
            else None
        )
        return rrb.Horizontal(rrb.Vertical(gets, _returns(curves)), *_present([joint]), name="Overview")
    board = _board("Live board", curves, origin="exhibition", below=4.2) if live else _board("Board", curves)
    boards = _social(curves, "survival_steps")
    high = 1.0
    if curves.worlds > 1:
        boards = _turns()
        high = 1.4
    elif curves.boards > 1:
        boards = _wall(curves)
    beside = _present([gets, _social(curves, "stock_left"), boards])
    rows = rrb.Vertical(*beside, row_shares=[1.0, 1.0, high][-len(beside) :])
    return rrb.Horizontal(board, rows, column_shares=[3, 2], name="Overview")


def _tabs(curves: Curves, *, live: bool) -> list[Any]:
    """The tabs, with up to six views each; those of which the game has nothing are left out."""
    agents, several = curves.agents, len(curves.agents) > 1
    decided = [f"institutions/in_force_{ballot}" for ballot in range(len(curves.in_force))]
    shares = [f"institutions/{name}" for name in SHARES if name in curves.institutions]
    equalities = [f"social/{name}" for name in INCOMES if name in curves.metrics]
    equalities += [f"institutions/{name}" for name in INCOMES if name in curves.institutions]
    recorded = None
    windows = None
    visits = None
    stock = None
    wall = None
    if isinstance(curves, Scene):
        recorded = _board("Recorded episodes", curves) if live else None
        windows = flat(f"Recorded windows: {curves.caption}", "windows")
        stock = _turns() if curves.worlds == 1 else None
        wall = _wall(curves) if curves.worlds > 1 else None
        places = boards_of(curves, len(agents))
        visits = places.view("Where agents go in the first replica, by episodes", "visits")
    tabs = {
        "Worlds": [wall],
        "Windows and events" if windows else "Events": [recorded, windows, _events()],
        "Agents": [
            _returns(curves) if windows else None,
            _drawn_plot("Lorenz curve: harvest in %", "lorenz") if curves.has_lorenz else None,
            visits,
            _tags(len(agents)) if curves.has_tags_between else None,
        ],
        "Institutions": [
            *(
                _plot(words, _of(agents, name))
                for name, words in PAYMENTS.items()
                if name in curves.institutions
            ),
            _plot("Shares of turns, bites, violations, tags", shares, share=True),
            _plot("Equality of net incomes", equalities, share=True),
            _plot(f"In force: {', '.join(curves.in_force)}", decided),
        ],
        "Learning": [
            _plot("Loss", _of(agents, "loss")),
            _plot(f"Highest Q value, {_rewards(curves)}", _of(agents, "q")),
            _plot("Epsilon, 0 to 1", _of(agents, "epsilon"), share=True),
            _plot("Steps per second", ["time/env_steps_per_s"]),
        ],
        "More metrics": [
            _social(curves, "survival_steps"),
            _social(curves, "equality", share=True) if several else None,
            stock,
            *(
                _social(curves, name)
                for name in ("peacefulness", "peace", "efficiency", "sustainability", "yield_share")
            ),
        ],
        "Your metrics": [_social(curves, name) for name in filter(is_own, curves.metrics)],
    }
    grids = [
        rrb.Grid(*views, grid_columns=len(views) if len(views) < 4 else ceil(len(views) / 2), name=name)
        for name, tab in tabs.items()
        if (views := _present(tab))
    ]
    return [_overview(curves, live=live), *grids, _recipe()]


def _recipe() -> Any:
    return rrb.TextDocumentView(name="Recipe", origin="/recipe")


def _present(views: Iterable[Any]) -> list[Any]:
    return [view for view in views if view is not None]


def _wall(scene: Scene) -> Any:
    whose = "All replicas" if scene.worlds == 1 else "Worlds of the first replica, number: turn"
    wall = boards_of(scene, scene.boards)
    return wall.view(f"{whose}; orange: the episode before ended without an apple", "wall")


def _turns() -> Any:
    return _drawn_plot("Apples on the board, over the turn", "turn")


def _tags(agents: int) -> Any:
    bounds = (-1.0, agents + 0.5)
    return flat("Tags in an episode: who (row) was tagged by whom (column)", "tags", x=bounds, y=bounds)


def _rewards(curves: Curves) -> str:
    return "apples" if curves.unit == "apples" else "rewards"


def _returns(curves: Curves) -> Any:
    summed = [f"{EVALUATION}/greedy_return", *([f"{EVALUATION}/return"] if curves.unit == "apples" else [])]
    entities = [*_of(curves.agents, "return"), *summed]
    return _plot(f"Return of each, {_rewards(curves)}", entities)


def _social(curves: Curves, metric: str, *, share: bool = False, is_explained: bool = False) -> Any:
    """Return the plot of a metric with the lines of random play and of evaluations, whose name says what the
    bold line is if it is explained; None if the game does not report it."""
    folders = ("social", RANDOM_PLAY, EVALUATION) if metric in curves.metrics else ()
    name = metric if is_own(metric) else title(metric)[0].upper() + title(metric)[1:]
    name += f"; {_bold(curves)}" if is_explained else ""
    return _plot(name, [f"{folder}/{metric}" for folder in folders], share=share, has_legend=False)


def legend_of(curves: Curves) -> str:
    """Return what the lines of plots are, and how many episodes a point of them is of."""
    point = "" if curves.worlds == 1 else f"a point is the mean of {curves.worlds} episodes; "
    thin = "thin: a replica, " if curves.replicas > 1 else ""
    return f"Curves by episode: {point}{thin}{_bold(curves)}, grey: random play"


def _bold(curves: Curves) -> str:
    return f"bold: mean of {curves.mean_over} episodes"


def _plot(name: str, entities: Sequence[str], *, share: bool = False, has_legend: bool = True) -> Any:
    """A plot over the whole run; None for no lines. The axis of a share is 0..1."""
    if not entities:
        return None
    return rrb.TimeSeriesView(
        name=name,
        contents=[f"+ /{entity}" for entity in entities],
        axis_x=_whole(),
        axis_y=rrb.ScalarAxis(range=(0.0, 1.05)) if share else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=has_legend),
    )


def _whole() -> Any:
    """A time axis of the whole run; Rerun's default is a thousand steps around the cursor."""
    boundary = rrb.TimeRangeBoundary
    return rrb.TimeAxis(view_range=rr.TimeRange(start=boundary.infinite(), end=boundary.infinite()))


def _of(agents: tuple[str, ...], entity: str) -> list[str]:
    return [f"{agent}/{entity}" for agent in agents]
