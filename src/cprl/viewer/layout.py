"""How a recording looks: the styles of its lines, and where the viewer shows what.

    header: one line in large type
    tabs, of which the first has the board (live: the current policy's) beside the harvest, the apples left
    and the boards of all replicas, or the apples on the board over the turn in all worlds of one
    the live label and whether agents explore, as strips

Metrics have the plots that `cprl.measuring.registry` says. A new tab is a line of `_tabs`, and a new view a
line in one of them.
"""

from collections.abc import Callable, Iterable, Sequence
from math import ceil
from typing import Any, Final, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from cprl.commons.cells import APPLE, FIRST_AGENT, Colour, class_colour, class_name
from cprl.measuring.registry import (
    COLLECTIVE_RETURN,
    EQUALITY,
    IN_FORCE,
    INCOME,
    INSTITUTIONS,
    METRICS,
    SHARE,
    colour,
    is_own,
    title,
)
from cprl.measuring.series import SPEED, logged
from cprl.pictures.colours import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALETTE,
    PURPLE,
    VERMILION,
    agent_colour,
    line_colour,
    picture_colour,
)
from cprl.pictures.decoding import UNSEEN
from cprl.pictures.image import EMPTY_SITE_COLOUR
from cprl.viewer.board import OUT_STROKE_CELLS, board_form, board_styles, image_form
from cprl.viewer.names import (
    BACKGROUND,
    EMPTY_SITE,
    EVALUATION,
    EXPLORING,
    GIVEN,
    HEADER,
    JOINT,
    NOW,
    PAID,
    RANDOM_PLAY,
    SETTLED,
    STATES,
)
from cprl.viewer.scene import (
    PLOT_HIGH,
    PLOT_WIDE,
    TITLE,
    Curves,
    Panels,
    Scene,
    boards_of,
    decision_panels,
    windows_of,
)

OVERVIEW: Final = (COLLECTIVE_RETURN, "stock_left")
"""The metrics that the first tab shows."""


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
    """Return the names, colours and widths of each plot's lines, and the colours of states, by entity."""
    replicas = curves.replicas
    mean = f"mean of {curves.mean_over} episodes"
    lines = {
        SPEED: line("steps per second", GREY),
        f"{EVALUATION}/greedy_return": line("greedy, evaluated", ORANGE),
        f"{EVALUATION}/return": line("sum of all, evaluated", ORANGE),
        "turn/stock": line("apples", PALETTE[APPLE]),
    }
    if curves.unit == "return":
        lines[INCOME] = running(mean, ORANGE, replicas)
        lines[f"{RANDOM_PLAY}/{INCOME}"] = line("random play", GREY)
    for metric in curves.metrics:
        is_alone = bool(metric in METRICS and METRICS[metric].plot)
        words = METRICS[metric].words if is_alone or metric.startswith(INSTITUTIONS) else mean
        lines[logged(metric)] = running(words, colour(metric), replicas, is_alone=is_alone)
        lines[f"{RANDOM_PLAY}/{metric}"] = line("random play", GREY)
        lines[f"{EVALUATION}/{metric}"] = line("greedy, evaluated", ORANGE)
    for ballot, decided in enumerate(curves.in_force):
        hue = (ORANGE, BLUE, GREEN, PURPLE)[ballot % 4]
        lines[f"{IN_FORCE}{ballot}"] = running(decided, hue, replicas)
    for agent, name in enumerate(curves.agents):
        hue = line_colour(agent)
        for entity in ("loss", "q", "harvested"):
            lines[f"{name}/{entity}"] = line(name, hue)
        # Equal ones are seen as stripes.
        lines[f"{name}/epsilon"] = line(name, hue, width=1.0 + 2.0 * ((len(curves.agents) - 1 - agent) % 4))
        for entity in ("return", *curves.of_agents):
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
    return lines | {NOW: states, EXPLORING: states}


def fixed(curves: Curves) -> dict[str, list[Any]]:
    """Return the static parts of a recording, by entity: names and colours of what it shows, and of a `Scene`
    also sizes of images and the agents' frames."""
    parts = {
        "/": [classes(curves)],
        **{entity: [style] for entity, style in styles(curves).items()},
        HEADER: [rr.TextDocument.from_fields(media_type=rr.MediaType.MARKDOWN)],
    }
    if not isinstance(curves, Scene):
        return parts
    for name, styles_of_part in board_styles().items():
        parts[f"world/{name}"] = styles_of_part
    parts["world/board"].append(rr.SegmentationImage.from_fields(format=board_form(curves)))
    agents, (rows, columns) = len(curves.agents), curves.window
    windows = windows_of(agents, curves.window)
    corners = windows.corners[:, ::-1]
    parts["windows"] = [
        classes(curves, class_colour),
        rr.SegmentationImage.from_fields(format=image_form(windows.shape), opacity=1.0),
    ]
    parts["windows/frames"] = [
        rr.Boxes2D(
            mins=corners - 0.2,
            sizes=np.full((agents, 2), (columns + 0.4, rows + 0.4)),
            colors=[agent_colour(agent) for agent in range(agents)],
            radii=2 * OUT_STROKE_CELLS,
            labels=list(curves.agents),
            show_labels=False,
        )
    ]
    return parts


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


def _drawn_plot(name: str, origin: str) -> Any:
    """Return the view of a plot that is not over time, with room for its texts."""
    return flat(name, origin, x=(-24.0, PLOT_WIDE + 16.0), y=(TITLE[1], PLOT_HIGH + 34.0))


def flat(
    name: str, origin: str, *, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None
) -> Any:
    bounds = rrb.VisualBounds2D(x_range=x, y_range=y) if x and y else None
    return rrb.Spatial2DView(name=name, origin=f"/{origin}", background=BACKGROUND, visual_bounds=bounds)


_HEADER, _RULER, _STRIP, _VIEWS = 90, 22, 40, 462
"""Heights in a window of 1280 x 720, in pixels: the header, the ruler above strips, a strip, and all else.
Rows share out any other height as they do this one."""


def layout(curves: Curves, *, live: bool = False) -> Any:
    """Return the layout of a recording; a replay has fewer views, and a game without a board none of the
    board.

    The timeline of the time panel is the axis of every plot: episodes, and in a replay, which records all
    its steps, steps. Boards of a run are played back on `frame`, which counts recorded frames alone.

    Args:
        curves: the numbers that are plotted; a `Scene` if there is a board.
        live: whether it is the layout of the live view, which has the current policy's exhibition
            (`/exhibition`, in the live stream alone).
    """
    is_replay = isinstance(curves, Scene) and curves.is_replay
    views = (
        _replay(curves)
        if isinstance(curves, Scene) and is_replay
        else rrb.Vertical(
            rrb.TextDocumentView(name="Now", origin=f"/{HEADER}", titlebar=False),
            rrb.Tabs(*_tabs(curves, live=live), active_tab=0),
            _strips(),
            row_shares=[_HEADER, _VIEWS, _RULER + 2 * _STRIP],
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
    """Return a large board, the agents' windows, what their policies say, and the harvest and stock of one
    episode, turn by turn, and what institutions take and give."""
    bars = decision_panels(len(scene.agents), scene.actions, scene.window)
    paid = [*_of(scene.agents, PAID), *_of(scene.agents, GIVEN)] if scene.has_institutions else []
    right = _present(
        [
            flat(f"What agents see: {scene.caption}", "windows"),
            _panels(bars, "What policies say (L, R turn, B beam, S stay), taken: white", "decisions"),
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


def _panels(panels: Panels, name: str, origin: str) -> Any:
    rows, columns = panels.shape
    return flat(name, origin, x=(-0.5, columns + 0.5), y=(-0.5, rows + 0.5))


def _board(name: str, scene: Scene, *, origin: str = "world", below: float = 2.6) -> Any:
    """Return the view of a board with room for what stands below it, in cells."""
    return flat(name, origin, x=(-0.2, scene.width + 2.2), y=(-0.2, scene.height + 2.0 + below))


def _events() -> Any:
    """Return the events, whose texts say when; the viewer's own column is so narrow that it cuts the
    numbers."""
    hidden = [TimelineColumn("step", visible=False)]
    columns = rrb.TextLogColumns(timeline_columns=hidden, text_log_columns=["Body"])
    return rrb.TextLogView(name="Events", origin="/log", columns=columns)


def _strips() -> Any:
    """Return the live label, and below it whether agents explore, as bands over episodes."""
    contents = [f"+ /{strip}" for strip in (NOW, EXPLORING)]
    return rrb.StateTimelineView(name="Strips", contents=contents, time_view=_whole(), titlebar=False)


def _overview(curves: Curves, *, live: bool) -> Any:
    """Return what a newcomer sees: the board large, and beside it what the group gets and leaves."""
    if curves.unit == "apples":
        gets = _metric(curves, COLLECTIVE_RETURN, is_explained=True)
    else:
        entities = [INCOME, f"{RANDOM_PLAY}/{INCOME}", f"{EVALUATION}/return"]
        gets = _plot(f"Income of all agents together; {curves.bold}", entities, has_legend=False)
    if not isinstance(curves, Scene):
        title = "Joint actions, share of turns; agent 0 first"
        joint = _plot(title, [JOINT] if curves.joint else [], share=True)
        return rrb.Horizontal(rrb.Vertical(gets, _returns(curves)), *_present([joint]), name="Overview")
    board = _board("Live board", curves, origin="exhibition", below=4.2) if live else _board("Board", curves)
    boards = _metric(curves, "survival_steps")
    high = 1.0
    if curves.worlds > 1:
        boards = _turns()
        high = 1.4
    elif curves.boards > 1:
        boards = _wall(curves)
    beside = _present([gets, _metric(curves, "stock_left"), boards])
    rows = rrb.Vertical(*beside, row_shares=[1.0, 1.0, high][-len(beside) :])
    return rrb.Horizontal(board, rows, column_shares=[3, 2], name="Overview")


def _tabs(curves: Curves, *, live: bool) -> list[Any]:
    """Return the tabs; what the game has nothing of is left out."""
    agents = curves.agents
    several = len(curves.agents) > 1
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
        visits = _panels(places, "Where agents go in the first replica, by episodes", "visits")
    of_users = list(filter(is_own, curves.metrics))
    of_law = [name for name in curves.metrics if name not in of_users and METRICS[name].is_of_institutions]
    elsewhere = (*of_users, *of_law, *OVERVIEW, *([] if several else [EQUALITY]))
    decided = [f"{IN_FORCE}{ballot}" for ballot in range(len(curves.in_force))]
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
            *(_of_each(curves, name) for name in curves.of_agents),
            *_metrics(curves, of_law),
            _plot(f"In force: {', '.join(curves.in_force)}", decided),
        ],
        "Learning": [
            _plot("Loss", _of(agents, "loss")),
            _plot(f"Highest Q value, {_rewards(curves)}", _of(agents, "q")),
            _plot("Epsilon, 0 to 1", _of(agents, "epsilon"), share=True),
            _plot("Steps per second", [SPEED]),
        ],
        "More metrics": [
            stock,
            *_metrics(curves, [name for name in curves.metrics if name not in elsewhere]),
        ],
        "Your metrics": _metrics(curves, of_users),
    }
    grids = [
        rrb.Grid(*views, grid_columns=len(views) if len(views) < 4 else ceil(len(views) / 2), name=name)
        for name, tab in tabs.items()
        if (views := _present(tab))
    ]
    return [_overview(curves, live=live), *grids, _recipe()]


def _of_each(curves: Curves, total: str) -> Any:
    """Return the plot of what each agent pays, gets or breaks."""
    words = METRICS[f"{INSTITUTIONS}{total}"].title.replace(" all,", " each,")
    return _plot(_sentence(words), _of(curves.agents, total))


def _metrics(curves: Curves, names: Sequence[str]) -> list[Any]:
    """Return the plots of metrics that the registry says: one of its own, one with others, or none."""
    plots: dict[str, list[str]] = {}
    for name in names:
        plot = METRICS[name].plot if name in METRICS else ""
        if plot is not None:
            plots.setdefault(plot or name, []).append(logged(name))
    return [
        _metric(curves, plot) if plot in names else _plot(plot, entities, share=True)
        for plot, entities in plots.items()
    ]


def _recipe() -> Any:
    return rrb.TextDocumentView(name="Recipe", origin="/recipe")


def _present(views: Iterable[Any]) -> list[Any]:
    return [view for view in views if view is not None]


def _wall(scene: Scene) -> Any:
    whose = "All replicas" if scene.worlds == 1 else "Worlds of the first replica, number: turn"
    wall = boards_of(scene, scene.boards)
    return _panels(wall, f"{whose}; orange: the episode before ended without an apple", "wall")


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


def _metric(curves: Curves, metric: str, *, is_explained: bool = False) -> Any:
    """Return the plot of a metric with the lines of random play and of evaluations, whose name says what the
    bold line is if it is explained; None if the game does not report it."""
    entities = [logged(metric), f"{RANDOM_PLAY}/{metric}", f"{EVALUATION}/{metric}"]
    name = title(metric) if is_own(metric) else _sentence(title(metric))
    name += f"; {curves.bold}" if is_explained else ""
    is_share = metric in METRICS and METRICS[metric].unit == SHARE
    return _plot(name, entities if metric in curves.metrics else [], share=is_share, has_legend=False)


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:]


def _plot(name: str, entities: Sequence[str], *, share: bool = False, has_legend: bool = True) -> Any:
    """Return a plot over the whole run; None for no lines. The axis of a share is 0..1."""
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
    """Return a time axis of the whole run; Rerun's default is a thousand steps around the cursor."""
    boundary = rrb.TimeRangeBoundary
    return rrb.TimeAxis(view_range=rr.TimeRange(start=boundary.infinite(), end=boundary.infinite()))


def _of(agents: tuple[str, ...], entity: str) -> list[str]:
    return [f"{agent}/{entity}" for agent in agents]
