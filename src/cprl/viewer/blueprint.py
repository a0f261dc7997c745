"""The layout of the Rerun viewer for a recording: of the file, and of the live view.

    header: one line in large type, and how to read the lines of plots
    board (live: "Present policy" first) | windows of the agents | events
    the live label and, at the end, the phases, as strips
    plots in tabs, three to a tab

A new tab is a function of `Curves` that returns a view or None, named in `_TABS`.
"""

from collections.abc import Callable
from typing import Any, Final, Literal

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from cprl.commons.colours import WINDOW_CAPTION
from cprl.viewer import institutions
from cprl.viewer.panels import BOUNDS, Panels, decision_panels, row
from cprl.viewer.scenery import BACKGROUND, EVALUATION, RANDOM_PLAY, Curves, Scene, has_lorenz, has_wall


def fates(curves: Curves) -> Any:
    """All boards at once, and how long each replica's apples lasted."""
    if not isinstance(curves, Scene):
        return None
    wall = _panels("All replicas; framed: died in its last episode", "wall", curves, curves.replicas)
    stock = _flat("Apples on the board, over the turn", "turn", BOUNDS)
    return row("Replicas", wall if has_wall(curves) else None, stock)


def places(curves: Curves) -> Any:
    """Where agents go, and how evenly they share."""
    name = "Where agents go in the first replica, by episodes"
    return row(
        "Places and shares",
        _panels(name, "visits", curves, len(curves.agents)) if isinstance(curves, Scene) else None,
        _flat("Lorenz curve: harvest in %", "lorenz", BOUNDS) if has_lorenz(curves) else None,
    )


def _panels(name: str, origin: str, scene: Scene, count: int) -> Any:
    """A view of several boards."""
    bounds = Panels(count, (scene.height + 2, scene.width + 2)).bounds
    return _flat(name, origin, bounds)


def _flat(name: str, origin: str, bounds: tuple[tuple[float, float], tuple[float, float]]) -> Any:
    visible = rrb.VisualBounds2D(x_range=bounds[0], y_range=bounds[1])
    return rrb.Spatial2DView(name=name, origin=f"/{origin}", background=BACKGROUND, visual_bounds=visible)


def decisions(scene: Scene) -> Any:
    """What the agents choose by, arranged as their windows."""
    bounds = decision_panels(len(scene.agents), scene.actions, scene.window).bounds
    return _flat("What policies say (L, R turn, B beam, S stay), taken: white", "decisions", bounds)


_HEADER, _STRIP, _VIEW = 97, 40, 207
"""Heights in a window of 1280 x 720, in pixels: the header, a strip, boards or plots. The rows share out any
other height as they do this one."""


def layout(curves: Curves, *, live: bool = False, ended: bool = False) -> Any:
    """The layout of a recording; a replay has fewer views, and a game without a board none of the board.

    Args:
        curves: the numbers that are plotted; a `Scene` if there is a board.
        live: whether it is the layout of the live view, which has the present policy's exhibition
            (`/exhibition`, in the live stream alone), and no room for phases before they are there.
    """
    if isinstance(curves, Scene) and curves.is_replay:
        return _laid_out(_replay(curves), timeline="step", play_state="playing")
    strips = 3 if curves.has_phases and (ended or not live) else 1
    return _laid_out(
        rrb.Vertical(
            rrb.TextDocumentView(name="Now", origin="/header", titlebar=False),
            _top(curves, live=live),
            _strip(),
            _plots(curves),
            row_shares=[_HEADER, _VIEW, (0.5 + strips) * _STRIP, _VIEW],
        ),
        timeline="episode",
        play_state="following",
    )


def _laid_out(views: Any, *, timeline: str, play_state: Literal["playing", "following"]) -> Any:
    """The views in a blueprint with the viewer's other panels collapsed.

    The timeline of the time panel is the axis of every plot: episodes, and in a replay, which records all
    its steps, steps. Boards of a run are played back on `frame`, which counts recorded frames alone.
    """
    return rrb.Blueprint(
        views,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state=play_state, fps=15),
    )


def _replay(scene: Scene) -> Any:
    """A large board, the agents' windows, and the harvest and stock of one episode, turn by turn, and what
    institutions take and give."""
    paid = [*_of(scene.agents, institutions.PAID), *_of(scene.agents, institutions.GIVEN)]
    payments = (
        [_plot("Fined (down) and given (up) in the turn, apples", *paid)]
        if institutions.has_institutions(scene)
        else []
    )
    return rrb.Horizontal(
        rrb.Vertical(
            _board("Board", "world"), rrb.Tabs(_events(), _recipe(), active_tab=0), row_shares=[7, 2]
        ),
        rrb.Vertical(
            _board(f"What agents see, {WINDOW_CAPTION}", "windows"),
            decisions(scene),
            _plot("Harvest so far, apples", *_of(scene.agents, "harvested")),
            _plot("Apples on the board", "turn/stock"),
            *payments,
            row_shares=[4, 4, 2, 2, *[2] * len(payments)],
        ),
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


def _plots(curves: Curves) -> Any:
    tabs = [tab for make in _TABS if (tab := make(curves)) is not None]
    tabs[2:2] = institutions.tabs(curves, _plot)
    return rrb.Tabs(*tabs, active_tab=0)


def _outcome(curves: Curves) -> Any:
    """What the group harvests, how long its board lives, and how evenly it shares."""
    return row(
        "Outcome",
        _social(curves, "Harvest of all, apples", "collective_return"),
        _social(curves, "Survival, steps", "survival_steps"),
        _social(curves, "Equality, 0 to 1", "equality", share=True),
    )


def _agents(curves: Curves) -> Any:
    """Each agent's return, time in play and who tagged whom."""
    unit = "apples" if "collective_return" in curves.metrics else "sum of rewards"
    tags = rrb.TensorView(name="Who tagged whom", origin="/tags")
    return row(
        "Agents",
        _plot(f"Return of each, {unit}", *_of(curves.agents, "return"), "evaluation/greedy_return"),
        _social(curves, "Peacefulness, steps in play", "peacefulness"),
        tags if curves.has_tags and len(curves.agents) > 1 else None,
    )


def _learning(curves: Curves) -> Any:
    return row(
        "Learning",
        _plot("Loss", *_of(curves.agents, "loss")),
        _plot("Highest Q value, apples", *_of(curves.agents, "q")),
        _plot("Epsilon, 0 to 1", *_of(curves.agents, "epsilon"), share=True),
    )


def _more(curves: Curves) -> Any:
    return row(
        "More metrics",
        _social(curves, "Apples per step", "efficiency"),
        _social(curves, "Mean time of harvest, steps", "sustainability"),
        _social(curves, "Apples left at the end", "stock_left"),
        _social(curves, "Yield share of the steps played", "yield_share"),
    )


def _speed(curves: Curves) -> Any:
    return _plot("Steps per second", "time/env_steps_per_s")


def _recipe(curves: Curves | None = None) -> Any:
    return rrb.TextDocumentView(name="Recipe", origin="/recipe")


_TABS: Final[tuple[Callable[[Curves], Any], ...]] = (
    _outcome,
    _agents,
    fates,
    places,
    _learning,
    _more,
    _speed,
    _recipe,
)
"""The tabs, each a function of `Curves` that returns its view, or None if it has nothing to show."""


def _social(curves: Curves, name: str, metric: str, *, share: bool = False) -> Any:
    """The plot of a metric with the lines of random play and of evaluations; None if the game does not report
    it."""
    if metric not in curves.metrics:
        return None
    return _plot(name, *(f"{of}/{metric}" for of in ("social", RANDOM_PLAY, EVALUATION)), share=share)


def _plot(name: str, *entities: str, share: bool = False) -> Any:
    """A plot over the whole run, without a legend, which would hide its lines: they are named where the
    pointer is, and `header` says which is which. The axis of a share is 0..1."""
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
