"""The layout of a recording in the viewer, and the styles of its lines.

From top to bottom the viewer shows
    the header, one line in large type
    tabs: the first, for newcomers, has the board (live: that of the current policy) beside the harvest, the
        apples left and the boards of all replicas
    two strips: the label that says how the group does, and whether agents explore

`cprl.measuring.registry` says which plot shows a metric. To add a tab or a view, add a line to `_tabs`.
"""

from collections.abc import Callable, Iterable, Sequence
from math import ceil
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from cprl.commons.cells import APPLE, FIRST_AGENT, Colour, class_colour, class_name
from cprl.measuring.registry import (
    COLLECTIVE_RETURN,
    EQUALITY,
    IN_FORCE_PREFIX,
    INCOME,
    INSTITUTIONS,
    METRICS,
    SHARE_UNIT,
    colour,
    is_custom_metric,
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
from cprl.pictures.readable import capitalised
from cprl.viewer.board import OUT_LINE_RADIUS_CELLS, board_format, board_styles, image_format
from cprl.viewer.names import (
    BOARD_BACKGROUND,
    EMPTY_SITE,
    EVALUATION_FOLDER,
    EXPLORATION_STRIP,
    GIVEN,
    HEADER,
    JOINT,
    LABEL_STRIP,
    PAID,
    RANDOM_PLAY_FOLDER,
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

_OVERVIEW: Final = (COLLECTIVE_RETURN, "stock_left")
"""The metrics that the first tab shows; other tabs leave them out."""


def _classes(curves: Curves, colour_of: Callable[[int], Colour] = picture_colour) -> Any:
    """Return the names and colours of the classes in images of boards or windows.

    Args:
        colour_of: returns the colour of a class; windows have other colours than boards.
    """
    classes = [
        rr.AnnotationInfo(id=kind, label=class_name(kind), color=colour_of(kind))
        for kind in range(FIRST_AGENT + len(curves.agents))
    ]
    empty = rr.AnnotationInfo(id=EMPTY_SITE, label="no apple", color=EMPTY_SITE_COLOUR)
    unseen = rr.AnnotationInfo(id=UNSEEN, label="", color=(0, 0, 0, 0))
    return rr.AnnotationContext([*classes, empty, unseen])


def styles(curves: Curves) -> dict[str, Any]:
    """Return the names, colours and widths of all plotted lines, and the colours of strips, by entity."""
    replicas = curves.replicas
    lines = _summary_styles(curves) | _metric_styles(curves) | _agent_styles(curves)
    for ballot, decided in enumerate(curves.in_force):
        hue = (ORANGE, BLUE, GREEN, PURPLE)[ballot % 4]
        lines[f"{IN_FORCE_PREFIX}{ballot}"] = _running_mean(decided, hue, replicas)
    if curves.joint:
        count = len(curves.joint)
        hues = (GREEN, BLUE, ORANGE, VERMILION) if count == 4 else tuple(map(line_colour, range(count)))
        lines[JOINT] = rr.SeriesLines(names=list(curves.joint), colors=list(hues), widths=[2.5] * count)
    rgba = [red << 24 | green << 16 | blue << 8 | 255 for red, green, blue in STATES.values()]
    states = rr.StateConfiguration(
        values=list(STATES),
        labels=list(STATES),
        colors=np.array(rgba, np.uint32),  # 0xRRGGBBAA
        visible=[state != SETTLED for state in STATES],
    )
    return lines | {LABEL_STRIP: states, EXPLORATION_STRIP: states}


def _summary_styles(curves: Curves) -> dict[str, Any]:
    """Return the styles of lines that every recording may have, beside metrics and agents."""
    lines = {
        SPEED: _line("steps per second", GREY),
        f"{EVALUATION_FOLDER}/greedy_return": _line("greedy, evaluated", ORANGE),
        f"{EVALUATION_FOLDER}/return": _line("sum of all, evaluated", ORANGE),
        "turn/stock": _line("apples", PALETTE[APPLE]),
        "turn/rule": _line("in force", PURPLE),
    }
    if curves.unit == "return":
        lines[INCOME] = _running_mean(curves.mean, ORANGE, curves.replicas)
        lines[f"{RANDOM_PLAY_FOLDER}/{INCOME}"] = _line("random play", GREY)
    return lines


def _metric_styles(curves: Curves) -> dict[str, Any]:
    """Return the styles of metrics, each with its lines of random play and of evaluations."""
    lines = {}
    for metric in curves.metrics:
        is_alone = bool(metric in METRICS and METRICS[metric].plot)
        name = curves.mean
        if is_alone or metric.startswith(INSTITUTIONS):
            name = METRICS[metric].words
        lines[logged(metric)] = _running_mean(name, colour(metric), curves.replicas, is_alone=is_alone)
        lines[f"{RANDOM_PLAY_FOLDER}/{metric}"] = _line("random play", GREY)
        lines[f"{EVALUATION_FOLDER}/{metric}"] = _line("greedy, evaluated", ORANGE)
    return lines


def _agent_styles(curves: Curves) -> dict[str, Any]:
    """Return the styles of the lines of single agents, in their colours."""
    lines = {}
    for agent, name in enumerate(curves.agents):
        hue = line_colour(agent)
        for entity in ("loss", "q", "harvested"):
            lines[f"{name}/{entity}"] = _line(name, hue)
        # Equal epsilons of several agents are visible as stripes of different widths.
        lines[f"{name}/epsilon"] = _line(name, hue, width=1.0 + 2.0 * ((len(curves.agents) - 1 - agent) % 4))
        for entity in ("return", *curves.agent_amounts):
            lines[f"{name}/{entity}"] = _running_mean(name, hue, replicas=1, is_alone=len(curves.agents) > 4)
    return lines


def static_parts(curves: Curves) -> dict[str, list[Any]]:
    """Return the parts of a recording without a time, by entity.

    They are the names and colours of classes and lines; with a `Scene` also the sizes of images, and the
    frames around the agents' windows.
    """
    parts = {
        "/": [_classes(curves)],
        **{entity: [style] for entity, style in styles(curves).items()},
        HEADER: [rr.TextDocument.from_fields(media_type=rr.MediaType.MARKDOWN)],
    }
    if not isinstance(curves, Scene):
        return parts
    for name, archetypes in board_styles().items():
        parts[f"world/{name}"] = archetypes
    parts["world/board"].append(rr.SegmentationImage.from_fields(format=board_format(curves)))
    agents = len(curves.agents)
    rows, columns = curves.window
    windows = windows_of(agents, curves.window)
    corners = windows.corners[:, ::-1]
    parts["windows"] = [
        _classes(curves, class_colour),
        rr.SegmentationImage.from_fields(format=image_format(windows.shape), opacity=1.0),
    ]
    parts["windows/frames"] = [
        rr.Boxes2D(
            mins=corners - 0.2,
            sizes=np.full((agents, 2), (columns + 0.4, rows + 0.4)),
            colors=[agent_colour(agent) for agent in range(agents)],
            radii=2 * OUT_LINE_RADIUS_CELLS,
            labels=list(curves.agents),
            show_labels=False,
        )
    ]
    return parts


def _line(name: str, colour: Colour, *, width: float = 1.0) -> Any:
    return rr.SeriesLines(names=[name], colors=[colour], widths=[width])


def _running_mean(name: str, colour: Colour, replicas: int, *, is_alone: bool = False) -> Any:
    """Return the style of a plot's lines: a thin, dark line for each of several replicas, a faint line of the
    episodes, and a bold line of the running mean.

    Args:
        is_alone: whether only the bold line is visible, because several metrics share the plot.
    """
    replica_lines = replicas if replicas > 1 else 0
    dark = tuple(round(0.35 * channel) for channel in colour)
    faint = tuple(round(0.6 * channel) for channel in colour)
    visible = [*[False] * (replica_lines + 1), True] if is_alone else None
    return rr.SeriesLines(
        names=[*["replicas"] * replica_lines, "episodes", name],
        colors=[*[dark] * replica_lines, faint, colour],
        widths=[*[0.7] * replica_lines, 1.0, 2.5],
        visible_series=visible,
    )


def _drawn_plot(name: str, origin: str) -> Any:
    """Return the view of a plot that is not over time, see `cprl.viewer.pictures.Axes`."""
    return _flat(name, origin, x=(-24.0, PLOT_WIDE + 16.0), y=(TITLE[1], PLOT_HIGH + 34.0))


def _flat(
    name: str, origin: str, *, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None
) -> Any:
    """Return a view of images and drawings, of the area from x[0] to x[1] and from y[0] to y[1]."""
    bounds = rrb.VisualBounds2D(x_range=x, y_range=y) if x and y else None
    return rrb.Spatial2DView(
        name=name, origin=f"/{origin}", background=BOARD_BACKGROUND, visual_bounds=bounds
    )


_HEADER_PIXELS: Final = 90
"""The height of the header in a window of 1280 x 720; in other windows these heights are proportional."""
_VIEWS_PIXELS: Final = 462
"""The height of the tabs."""
_STRIPS_PIXELS: Final = 102
"""The height of the two strips with their ruler."""


def layout(curves: Curves, *, live: bool = False) -> Any:
    """Return the layout of a recording.

    The plots of a training are over episodes, and those of a replay over steps. The boards of a training are
    played back on the timeline `frame`, which counts only recorded frames.

    Args:
        curves: the numbers that are plotted; a `Scene` if the game has a board.
        live: whether it is the layout for live viewers, which also has the exhibition of the current policy.
    """
    if isinstance(curves, Scene) and curves.is_replay:
        views = _replay(curves)
        time = rrb.TimePanel(state="collapsed", timeline="step", play_state="playing", fps=15)
    else:
        views = rrb.Vertical(
            rrb.TextDocumentView(name="Now", origin=f"/{HEADER}", titlebar=False),
            rrb.Tabs(*_tabs(curves, live=live), active_tab=0),
            _strips(),
            row_shares=[_HEADER_PIXELS, _VIEWS_PIXELS, _STRIPS_PIXELS],
        )
        time = rrb.TimePanel(state="collapsed", timeline="episode", play_state="following", fps=15)
    panels = (rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))
    return rrb.Blueprint(views, *panels, time)


def _replay(scene: Scene) -> Any:
    """Return the views of a single episode.

    They are a large board, the agents' windows and action values, and for each turn the harvest, the stock,
    and the payments of institutions.
    """
    bars = decision_panels(len(scene.agents), scene.actions, scene.window)
    payments: list[str] = []
    if scene.has_institutions:
        payments = [*_entities(scene.agents, PAID), *_entities(scene.agents, GIVEN)]
    right = _without_none(
        [
            _flat(f"What agents see: {scene.caption}", "windows"),
            _panels(bars, "What policies say (L, R turn, B beam, S stay), taken: white", "decisions"),
            _plot("Harvest so far, apples", _entities(scene.agents, "harvested")),
            _plot("Apples on the board", ["turn/stock"]),
            _plot("In force", ["turn/rule"] if scene.in_force else []),
            _plot("Fined (down) and given (up) in the turn, apples", payments),
        ]
    )
    left = [_board("Board", scene), rrb.Tabs(_events(), _recipe(), active_tab=0)]
    return rrb.Horizontal(
        rrb.Vertical(*left, row_shares=[7, 2]),
        rrb.Vertical(*right, row_shares=[4, 4, 2, 2, 2, 2][: len(right)]),
        column_shares=[3, 2],
    )


def _panels(panels: Panels, name: str, origin: str) -> Any:
    """Return the view of an image of several boards."""
    rows, columns = panels.shape
    return _flat(name, origin, x=(-0.5, columns + 0.5), y=(-0.5, rows + 0.5))


def _board(name: str, scene: Scene, *, origin: str = "world", below: float = 2.6) -> Any:
    """Return the view of a board.

    Args:
        below: the room below the board for the bar of its stock and for texts, in cells.
    """
    return _flat(name, origin, x=(-0.2, scene.width + 2.2), y=(-0.2, scene.height + 2.0 + below))


def _events() -> Any:
    """Return the view of events. It hides the viewer's column of steps, which is too narrow for the numbers;
    the texts of events say their episode or step."""
    hidden = [TimelineColumn("step", visible=False)]
    columns = rrb.TextLogColumns(timeline_columns=hidden, text_log_columns=["Body"])
    return rrb.TextLogView(name="Events", origin="/log", columns=columns)


def _strips() -> Any:
    """Return the view of the label of the group, and below it whether agents explore, over episodes."""
    contents = [f"+ /{strip}" for strip in (LABEL_STRIP, EXPLORATION_STRIP)]
    return rrb.StateTimelineView(name="Strips", contents=contents, time_view=_whole_run(), titlebar=False)


def _overview(curves: Curves, *, live: bool) -> Any:
    """Return the first tab: a large board, and beside it the income, the stock left, and all boards."""
    if curves.unit == "apples":
        income = _metric(curves, COLLECTIVE_RETURN, is_explained=True)
    else:
        entities = [INCOME, f"{RANDOM_PLAY_FOLDER}/{INCOME}", f"{EVALUATION_FOLDER}/return"]
        income = _plot(f"Income of all agents together; bold: {curves.mean}", entities, has_legend=False)
    if not isinstance(curves, Scene):
        columns = [rrb.Vertical(income, _returns(curves))]
        if curves.joint:
            columns.append(_plot("Joint actions, share of turns; agent 0 first", [JOINT], share=True))
        return rrb.Horizontal(*columns, name="Overview")
    board = _board("Live board", curves, origin="exhibition", below=4.2) if live else _board("Board", curves)
    boards = _metric(curves, "survival_steps")
    boards_share = 1.0
    if curves.worlds > 1:
        boards = _stock_over_turn()
        boards_share = 1.4
    elif curves.boards > 1:
        boards = _wall(curves)
    plots = _without_none([income, _metric(curves, "stock_left"), boards])
    rows = rrb.Vertical(*plots, row_shares=[1.0, 1.0, boards_share][-len(plots) :])
    return rrb.Horizontal(board, rows, column_shares=[3, 2], name="Overview")


def _tabs(curves: Curves, *, live: bool) -> list[Any]:
    """Return the tabs; a tab without any view in this game is left out."""
    agents = curves.agents
    recorded = None
    windows = None
    visits = None
    stock = None
    wall = None
    if isinstance(curves, Scene):
        recorded = _board("Recorded episodes", curves) if live else None
        windows = _flat(f"Recorded windows: {curves.caption}", "windows")
        if curves.worlds == 1:
            stock = _stock_over_turn()
        else:
            wall = _wall(curves)
        maps = boards_of(curves, len(agents))
        visits = _panels(maps, "Where agents go in the first replica, by episodes", "visits")
    user_metrics = list(filter(is_custom_metric, curves.metrics))
    cprl_metrics = [metric for metric in curves.metrics if metric not in user_metrics]
    institution_metrics = [metric for metric in cprl_metrics if METRICS[metric].is_of_institutions]
    shown_elsewhere = [*institution_metrics, *_OVERVIEW]
    if len(agents) == 1:
        shown_elsewhere.append(EQUALITY)  # a single agent has nobody to be equal to
    decided = [f"{IN_FORCE_PREFIX}{ballot}" for ballot in range(len(curves.in_force))]
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
            *(_amounts(curves, name) for name in curves.agent_amounts),
            *_metrics(curves, institution_metrics),
            _plot(f"In force: {', '.join(curves.in_force)}", decided),
        ],
        "Learning": [
            _plot("Loss", _entities(agents, "loss")),
            _plot(f"Highest Q value, {_rewards(curves)}", _entities(agents, "q")),
            _plot("Epsilon, 0 to 1", _entities(agents, "epsilon"), share=True),
            _plot("Steps per second", [SPEED]),
        ],
        "More metrics": [
            stock,
            *_metrics(curves, [metric for metric in cprl_metrics if metric not in shown_elsewhere]),
        ],
        "Your metrics": _metrics(curves, user_metrics),
    }
    grids = []
    for name, tab in tabs.items():
        views = _without_none(tab)
        if views:
            columns = len(views) if len(views) < 4 else ceil(len(views) / 2)
            grids.append(rrb.Grid(*views, grid_columns=columns, name=name))
    return [_overview(curves, live=live), *grids, _recipe()]


def _amounts(curves: Curves, total: str) -> Any:
    """Return the plot of an amount of each agent, such as its fines.

    Args:
        total: the name of the amount, which is also that of the metric of all agents together.
    """
    title = METRICS[f"{INSTITUTIONS}{total}"].title.replace(" all,", " each,")
    return _plot(capitalised(title), _entities(curves.agents, total))


def _metrics(curves: Curves, names: Sequence[str]) -> list[Any]:
    """Return the plots of metrics. The registry says whether a metric has its own plot, shares one, or has
    none."""
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


def _without_none(views: Iterable[Any]) -> list[Any]:
    return [view for view in views if view is not None]


def _wall(scene: Scene) -> Any:
    """Return the view of all boards side by side."""
    owners = "All replicas" if scene.worlds == 1 else "Worlds of the first replica, number: turn"
    wall = boards_of(scene, scene.boards)
    return _panels(wall, f"{owners}; orange: the episode before ended without an apple", "wall")


def _stock_over_turn() -> Any:
    return _drawn_plot("Apples on the board, over the turn", "turn")


def _tags(agents: int) -> Any:
    """Return the view of the matrix of tags."""
    bounds = (-1.0, agents + 0.5)
    return _flat("Tags in an episode: who (row) was tagged by whom (column)", "tags", x=bounds, y=bounds)


def _rewards(curves: Curves) -> str:
    return "apples" if curves.unit == "apples" else "rewards"


def _returns(curves: Curves) -> Any:
    """Return the plot of the agents' returns, with the returns of evaluations."""
    summed = [
        f"{EVALUATION_FOLDER}/greedy_return",
        *([f"{EVALUATION_FOLDER}/return"] if curves.unit == "apples" else []),
    ]
    entities = [*_entities(curves.agents, "return"), *summed]
    return _plot(f"Return of each, {_rewards(curves)}", entities)


def _metric(curves: Curves, metric: str, *, is_explained: bool = False) -> Any:
    """Return the plot of a metric, with its lines of random play and of evaluations.

    Return None if the game does not report the metric.

    Args:
        is_explained: whether the plot's name says what the bold line shows.
    """
    if metric not in curves.metrics:
        return None
    entities = [logged(metric), f"{RANDOM_PLAY_FOLDER}/{metric}", f"{EVALUATION_FOLDER}/{metric}"]
    name = title(metric) if is_custom_metric(metric) else capitalised(title(metric))
    if is_explained:
        name += f"; bold: {curves.mean}"
    is_share = metric in METRICS and METRICS[metric].unit == SHARE_UNIT
    return _plot(name, entities, share=is_share, has_legend=False)


def _plot(name: str, entities: Sequence[str], *, share: bool = False, has_legend: bool = True) -> Any:
    """Return a plot over the whole run; None if it has no lines.

    Args:
        entities: the entities whose lines it shows.
        share: whether its axis goes from 0 to 1.
        has_legend: whether the viewer shows the names of the lines.
    """
    if not entities:
        return None
    zero_to_one = rrb.ScalarAxis(range=(0.0, 1.05)) if share else None
    return rrb.TimeSeriesView(
        name=name,
        contents=[f"+ /{entity}" for entity in entities],
        axis_x=_whole_run(),
        axis_y=zero_to_one,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=has_legend),
    )


def _whole_run() -> Any:
    """Return a time axis over the whole run; Rerun's default shows a thousand steps around the cursor."""
    boundary = rrb.TimeRangeBoundary
    return rrb.TimeAxis(view_range=rr.TimeRange(start=boundary.infinite(), end=boundary.infinite()))


def _entities(agents: tuple[str, ...], entity: str) -> list[str]:
    """Return the entity of each agent: "agent_0/loss", "agent_1/loss" and so on."""
    return [f"{agent}/{entity}" for agent in agents]
