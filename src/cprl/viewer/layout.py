"""What a recording shows: the numbers and boards, their names and colours, and the layout of the viewer.

    header: one line in large type, and how to read the lines of plots
    board (live: "Present policy" first) | windows of the agents | events
    the live label and, at the end, the phases, as strips
    plots in tabs, three to a tab

A new tab is a line of `_tabs`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
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
    FIRST_AGENT,
    PALETTE,
    WINDOW_CAPTION,
    Colour,
    agent_colour,
    class_name,
    picture_colour,
)
from cprl.commons.decoding import UNSEEN
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring import institutions, now, phases
from cprl.measuring.episodes import decisions_of, metrics_of, yield_of
from cprl.measuring.metrics import FIELDS, METRICS, available, is_own, left_out
from cprl.measuring.series import OF_AGENTS

ORANGE, BLUE, GREEN = (230, 160, 0), (86, 180, 233), (0, 158, 115)
VERMILION, PURPLE, GREY = (213, 94, 0), (204, 121, 167), (150, 150, 150)
"""M. Okabe and K. Ito's colours, which are apart for the colour-blind too, and a grey."""

SOCIAL: Final = {
    "social/collective_return": ("collective return", ORANGE),
    "social/efficiency": ("apples per step", ORANGE),
    "social/equality": ("equality", BLUE),
    "social/sustainability": ("sustainability", GREEN),
    "social/survival_steps": ("survival", (230, 120, 0)),
    "social/peace": ("peace", PURPLE),
    "social/peacefulness": ("peacefulness", PURPLE),
    "social/stock_left": ("apples left", PALETTE[APPLE]),
    "social/yield_share": ("yield share of the steps played", GREEN),
}
"""The name and colour of each line, because viewers assign different colours; agents have their own."""
OTHERS: Final = {
    "time/env_steps_per_s": ("steps per second", GREY),
    "evaluation/greedy_return": ("greedy, evaluated", ORANGE),
    "turn/stock": ("apples", PALETTE[APPLE]),
}
INSTITUTIONAL: Final = {
    "violations": VERMILION,
    "violations_per_step": VERMILION,
    "own_share_of_bites": GREEN,
    "detection_rate": ORANGE,
    "recidivism": PURPLE,
    "unjust_share_of_tags": BLUE,
    "net_equality": BLUE,
    "net_equality_within": GREEN,
    "net_equality_between": ORANGE,
}
"""The colours of the lines of institutions; those that no tab shows have a grey."""
SHARES: Final = (
    "violations_per_step",
    "own_share_of_bites",
    "detection_rate",
    "recidivism",
    "unjust_share_of_tags",
)
"""The metrics of institutions that share a plot; only their running means are shown there."""
PAYMENTS: Final = {
    "violations": "Violations of each, turns",
    "fines": "Fines of each, apples",
    "transfers": "Transfers to each, apples",
}
"""The plots of what each agent breaks, pays and gets, by the name of their lines."""
PAID, GIVEN = "paid", "given"
"""The lines of each agent in a replay: what institutions take in a turn, downwards, and give, upwards."""
RANDOM_PLAY: Final = "random_play"
"""The folder of the lines of random play; each has the name of its metric."""
EVALUATION: Final = "evaluation"
"""The folder of the lines of evaluations while agents are trained, likewise."""
ANOTHER: Final = "another"
"""The name of a phase that matches no pattern of the study."""
BACKGROUND: Final = (24, 26, 32)
"""The background of boards and windows, which sets their dark cells apart from the viewer's own colour."""
STATES: Final = {
    "exploration": BLUE,
    "tragedy": VERMILION,
    "combat": PURPLE,
    "cultivation": GREEN,
    ANOTHER: (120, 120, 120),
    now.BEGINS: (80, 80, 80),
    now.EXPLORING: BLUE,
    now.HARVESTING: GREY,
    now.DECLINE: VERMILION,
    now.RECOVERY: GREEN,
}
"""The colours of phases and live labels, which share one where they mean the same."""
STRIPS: Final = ("now", "phase/found", "phase/as_published")
"""The entities of states: the live label, and the phases that are logged when a long run ends."""


@dataclass(frozen=True, kw_only=True)
class Curves:
    """The numbers that a recording plots; a game without a board has nothing else."""

    agents: tuple[str, ...]
    """The names of the agents, agent 0 first."""
    replicas: int = 1
    """The number of replicas: each is a thin line, and their mean a thick one."""
    metrics: tuple[str, ...] = tuple(name.removeprefix("social/") for name in SOCIAL)
    """The metrics that the game reports, without the prefix `social/`."""
    has_phases: bool = True
    """Whether phases are found when the run ends: it is long enough, and these metrics tell."""
    has_tags: bool = True
    """Whether the game reports who tagged whom."""
    institutions: tuple[str, ...] = ()
    """The metrics of institutions that the game reports, without the prefix `institutions/`."""
    in_force: tuple[str, ...] = ()
    """What is decided in an episode, in words, e.g. "the tax rate"."""

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
    own: Sequence[str] = (),
) -> Curves:
    """The numbers of an environment that are plotted, and metrics of the user's own by their names."""
    metrics = available({**METRICS, "stock_left": FIELDS["stock_left"]}, reported)
    metrics += ("yield_share",) if yield_of(env) and "harvest" in reported else ()
    metrics += tuple(own)
    return Curves(
        agents=agents,
        replicas=env.batch_size.numel(),
        metrics=metrics,
        has_phases=episodes in phases.EPISODES and set(phases.METRICS) <= set(metrics),
        has_tags="tagged_by" in reported,
        institutions=metrics_of(env, reported),
        in_force=decisions_of(env) if "in_force" in reported else (),
    )


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
        actions=len(env.game.actions),
        is_replay=is_replay,
    )


_SHOWN: Final[Mapping[str, tuple[str, ...]]] = {
    "phases and new bests": tuple(dict.fromkeys(entry for name in phases.METRICS for entry in METRICS[name])),
    "who tagged whom": ("tagged_by",),
    "the Lorenz curve": ("harvest",),
    "all boards side by side": ("board",),
    "where agents go": ("board",),
    "the stock over the turn": ("board",),
    "the board and what agents see": ("board",),
}
"""The views of a recording besides metrics, and the entries that each needs."""


def missing_in(reported: Sequence[str], *, has_board: bool) -> str:
    """One line that names what the recording lacks, and why; "" if it lacks nothing."""
    return left_out([*reported, *(["board"] if has_board else [])], more=_SHOWN)


def classes(curves: Curves, colour_of: Callable[[int], Colour] = picture_colour) -> Any:
    """Names and colours of the classes on boards, or by another function in windows."""
    known = [
        rr.AnnotationInfo(id=kind, label=class_name(kind), color=colour_of(kind))
        for kind in range(FIRST_AGENT + len(curves.agents))
    ]
    return rr.AnnotationContext([*known, rr.AnnotationInfo(id=UNSEEN, label="", color=(0, 0, 0, 0))])


def styles(curves: Curves) -> dict[str, Any]:
    """The names, colours and widths of each plot's lines, and the colours of states, by entity."""
    replicas = curves.replicas
    lines = {entity: line(name, colour, width=None) for entity, (name, colour) in OTHERS.items()}
    for metric in curves.metrics:
        name, colour = SOCIAL.get(f"social/{metric}", (metric, ORANGE))
        lines[f"social/{metric}"] = running(name, colour, replicas)
        lines[f"{RANDOM_PLAY}/{metric}"] = line("random play", GREY)
        lines[f"{EVALUATION}/{metric}"] = line("greedy, evaluated", ORANGE)
    for name in curves.institutions:
        lines[f"{RANDOM_PLAY}/institutions/{name}"] = line("random play", GREY)
        lines[f"institutions/{name}"] = running(
            institutions.METRICS[name].words,
            INSTITUTIONAL.get(name, GREY),
            replicas,
            alone=name in SHARES,
        )
    for ballot, title in enumerate(curves.in_force):
        colour = (ORANGE, BLUE, GREEN, PURPLE)[ballot % 4]
        lines[f"institutions/in_force_{ballot}"] = running(title, colour, replicas)
    for agent, name in enumerate(curves.agents):
        colour = agent_colour(agent)
        for entity in ("loss", "epsilon", "q", "harvested"):
            lines[f"{name}/{entity}"] = line(name, colour)
        for entity in ("return", *(kind for kind in OF_AGENTS if kind in curves.institutions)):
            lines[f"{name}/{entity}"] = running(name, colour, replicas=1)
    packed = [red << 24 | green << 16 | blue << 8 | 255 for red, green, blue in STATES.values()]
    names, colours = list(STATES), np.array(packed, np.uint32)  # 0xRRGGBBAA
    states = rr.StateConfiguration(values=names, labels=names, colors=colours)
    return lines | dict.fromkeys(STRIPS if curves.has_phases else STRIPS[:1], states)


def line(name: str, colour: Colour, *, width: float | None = 1.0) -> Any:
    return rr.SeriesLines(names=[name], colors=[colour], widths=None if width is None else [width])


def running(name: str, colour: Colour, replicas: int, *, alone: bool = False) -> Any:
    """Thin, dark lines for each of several replicas, a faint one for their mean, and on top a bold one for
    its running mean; `alone` shows that one alone, where others share the plot."""
    singles = replicas if replicas > 1 else 0
    raw = name if replicas == 1 else f"{name}, mean"
    dark, faint = (tuple(round(share * part) for part in colour) for share in (0.35, 0.6))
    return rr.SeriesLines(
        names=[*(f"replica {replica}" for replica in range(singles)), raw, f"{name}, running mean"],
        colors=[*[dark] * singles, faint, colour],
        widths=[*[0.7] * singles, 1.0, 2.5],
        visible_series=[*[False] * (singles + 1), True] if alone else None,
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

    def labels(self) -> Any:
        """The points at which texts stand, as Rerun's static part of `Points2D`; their labels vary."""
        tops = self.corners[:, ::-1] + (self.size[1] / 2, 0.1 - self._label)
        return rr.Points2D.from_fields(
            positions=tops.astype(np.float32), radii=[0.0], colors=[(220, 220, 220)], show_labels=True
        )

    def frames(self) -> Any:
        """A frame around each board, as Rerun's static part of `Boxes2D`; colours vary."""
        return rr.Boxes2D.from_fields(
            centers=(self.corners[:, ::-1] + np.array(self.size[::-1]) / 2).astype(np.float32),
            half_sizes=np.tile(np.array(self.size[::-1], np.float32) / 2, (len(self.corners), 1)),
            radii=[0.25],
            show_labels=False,
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
TITLE: Final = PLOT_WIDE / 2, -16.0
"""Where its title hangs."""


def _drawn_plot(name: str, origin: str) -> Any:
    """The view of a plot that is not over time, with room for its texts."""
    return flat(name, origin, x=(-24.0, PLOT_WIDE + 16.0), y=(TITLE[1], PLOT_HIGH + 26.0))


def flat(name: str, origin: str, *, x: tuple[float, float], y: tuple[float, float]) -> Any:
    bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
    return rrb.Spatial2DView(name=name, origin=f"/{origin}", background=BACKGROUND, visual_bounds=bounds)


_HEADER, _STRIP, _VIEW = 97, 40, 207
"""Heights in a window of 1280 x 720, in pixels: the header, a strip, boards or plots. The rows share out any
other height as they do this one."""


def layout(curves: Curves, *, live: bool = False, ended: bool = False) -> Any:
    """The layout of a recording; a replay has fewer views, and a game without a board none of the board.

    The timeline of the time panel is the axis of every plot: episodes, and in a replay, which records all
    its steps, steps. Boards of a run are played back on `frame`, which counts recorded frames alone.

    Args:
        curves: the numbers that are plotted; a `Scene` if there is a board.
        live: whether it is the layout of the live view, which has the present policy's exhibition
            (`/exhibition`, in the live stream alone), and no room for phases before they are there.
    """
    is_replay = isinstance(curves, Scene) and curves.is_replay
    strips = 3 if curves.has_phases and (ended or not live) else 1
    views = (
        _replay(curves)
        if isinstance(curves, Scene) and is_replay
        else rrb.Vertical(
            rrb.TextDocumentView(name="Now", origin="/header", titlebar=False),
            _top(curves, live=live),
            _strip(),
            rrb.Tabs(*_tabs(curves), active_tab=0),
            row_shares=[_HEADER, _VIEW, (0.5 + strips) * _STRIP, _VIEW],
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
            _board(f"What agents see, {WINDOW_CAPTION}", "windows"),
            bars.view("What policies say (L, R turn, B beam, S stay), taken: white", "decisions"),
            _plot("Harvest so far, apples", _of(scene.agents, "harvested")),
            _plot("Apples on the board", ["turn/stock"]),
            _plot("Fined (down) and given (up) in the turn, apples", paid),
        ]
    )
    left = [_board("Board", "world"), rrb.Tabs(_events(), _recipe(), active_tab=0)]
    return rrb.Horizontal(
        rrb.Vertical(*left, row_shares=[7, 2]),
        rrb.Vertical(*right, row_shares=[4, 4, 2, 2, 2][: len(right)]),
        column_shares=[3, 2],
    )


def _top(curves: Curves, *, live: bool) -> Any:
    """The board, the agents' windows and the events side by side; without a board the events alone."""
    if not isinstance(curves, Scene):
        return _events()
    boards, windows = _board("Board", "world"), _board("Windows: self blue, others red", "windows")
    if live:
        present = _board("Present policy", "exhibition")
        boards = rrb.Tabs(present, _board("Recorded episodes", "world"), active_tab=0)
        windows = _board("Recorded: self blue, others red", "windows")
    return rrb.Horizontal(boards, windows, _events(), column_shares=[5, 3, 3])


def _board(name: str, origin: str) -> Any:
    return rrb.Spatial2DView(name=name, origin=f"/{origin}", background=BACKGROUND)


def _events() -> Any:
    """The events, whose texts say when; the viewer's own column is so narrow that it cuts the numbers."""
    hidden = [TimelineColumn("step", visible=False)]
    columns = rrb.TextLogColumns(timeline_columns=hidden, text_log_columns=["Body"])
    return rrb.TextLogView(name="Events", origin="/log", columns=columns)


def _strip() -> Any:
    """The live label, below it the phases found at the end and the published ones, as bands over episodes."""
    contents = ["+ /now", "+ /phase/**"]
    return rrb.StateTimelineView(name="Phases", contents=contents, time_view=_whole(), titlebar=False)


def _tabs(curves: Curves) -> list[Any]:
    """The tabs, with up to three views each; those of which the game has nothing are left out."""
    agents, social = curves.agents, partial(_social, curves)
    unit = "apples" if "collective_return" in curves.metrics else "sum of rewards"
    shares, equalities = (
        [f"institutions/{name}" for name in names if name in curves.institutions]
        for names in (SHARES, [name for name in INSTITUTIONAL if "equality" in name])
    )
    equalities += [f"{RANDOM_PLAY}/institutions/net_equality"] if equalities else []
    decided = [f"institutions/in_force_{ballot}" for ballot in range(len(curves.in_force))]
    lorenz = _drawn_plot("Lorenz curve: harvest in %", "lorenz") if curves.has_lorenz else None
    tags = rrb.TensorView(name="Who tagged whom", origin="/tags") if curves.has_tags_between else None
    wall, visits, stock = None, None, None
    if isinstance(curves, Scene):
        stock = _drawn_plot("Apples on the board, over the turn", "turn")
        visits = boards_of(curves, len(agents)).view(
            "Where agents go in the first replica, by episodes", "visits"
        )
        if curves.replicas > 1:
            wall = boards_of(curves, curves.replicas).view(
                "All replicas; framed: died in its last episode", "wall"
            )
    tabs = {
        "Outcome": [
            social("Harvest of all, apples", "collective_return"),
            social("Survival, steps", "survival_steps"),
            social("Equality, 0 to 1", "equality", share=True),
        ],
        "Agents": [
            _plot(f"Return of each, {unit}", [*_of(agents, "return"), "evaluation/greedy_return"]),
            social("Peacefulness, steps in play", "peacefulness"),
            tags,
        ],
        "Institutions": [
            _plot(title, _of(agents, name)) for name, title in PAYMENTS.items() if name in curves.institutions
        ],
        "Rules kept": [
            _plot("Shares of violations, bites, tags", shares, share=True),
            _plot("Equality of net incomes", equalities, share=True),
            _plot(f"In force: {', '.join(curves.in_force)}", decided),
        ],
        "Replicas": [wall, stock],
        "Places and shares": [visits, lorenz],
        "Learning": [
            _plot("Loss", _of(agents, "loss")),
            _plot("Highest Q value, apples", _of(agents, "q")),
            _plot("Epsilon, 0 to 1", _of(agents, "epsilon"), share=True),
        ],
        "More metrics": [
            social("Apples per step", "efficiency"),
            social("Mean time of harvest, steps", "sustainability"),
            social("Apples left at the end", "stock_left"),
            social("Yield share of the steps played", "yield_share"),
        ],
        "Your metrics": [social(name, name) for name in filter(is_own, curves.metrics)],
    }
    rows = [rrb.Horizontal(*views, name=name) for name, tab in tabs.items() if (views := _present(tab))]
    return [*rows, _plot("Steps per second", ["time/env_steps_per_s"]), _recipe()]


def _recipe() -> Any:
    return rrb.TextDocumentView(name="Recipe", origin="/recipe")


def _present(views: Iterable[Any]) -> list[Any]:
    return [view for view in views if view is not None]


def _social(curves: Curves, name: str, metric: str, *, share: bool = False) -> Any:
    """The plot of a metric with the lines of random play and of evaluations; None if the game does not report
    it."""
    folders = ("social", RANDOM_PLAY, EVALUATION) if metric in curves.metrics else ()
    return _plot(name, [f"{folder}/{metric}" for folder in folders], share=share)


def _plot(name: str, entities: Sequence[str], *, share: bool = False) -> Any:
    """A plot over the whole run, without a legend, which would hide its lines: they are named where the
    pointer is, and `header` says which is which. The axis of a share is 0..1. None for no lines."""
    if not entities:
        return None
    return rrb.TimeSeriesView(
        name=name,
        contents=[f"+ /{entity}" for entity in entities],
        axis_x=_whole(),
        axis_y=rrb.ScalarAxis(range=(0.0, 1.05)) if share else None,
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _whole() -> Any:
    """A time axis of the whole run; Rerun's default is a thousand steps around the cursor."""
    boundary = rrb.TimeRangeBoundary
    return rrb.TimeAxis(view_range=rr.TimeRange(start=boundary.infinite(), end=boundary.infinite()))


def _of(agents: tuple[str, ...], entity: str) -> list[str]:
    return [f"{agent}/{entity}" for agent in agents]
