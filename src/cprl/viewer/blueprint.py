"""The layout of the Rerun viewer for a recording."""

from typing import Any, Final, Literal

from cprl.commons.colours import WINDOW_CAPTION
from cprl.viewer.scenery import Curves, Scene

_BACKGROUND: Final = (24, 26, 32)
"""The background of boards and windows, which sets their dark cells apart from the viewer's own colour."""


def layout(curves: Curves) -> Any:
    """Board and windows left, plots right, events below, and tabs for the rest; a replay has fewer views.

    Args:
        curves: the numbers that are plotted; a `Scene` if there is a board, else the left shows events only.

    Returns:
        A `rerun.blueprint.Blueprint`.
    """
    import rerun.blueprint as rrb

    if not isinstance(curves, Scene):
        views = rrb.Horizontal(_events(), _numbers(curves), column_shares=[1, 3])
    elif curves.is_replay:
        return _laid_out(_replay(curves.agents), play_state="playing")
    else:
        views = rrb.Horizontal(_board(curves.agents), _numbers(curves), column_shares=[2, 3])
    return _laid_out(views, play_state="following")


def _laid_out(views: Any, *, play_state: Literal["playing", "following"]) -> Any:
    """The views in a blueprint with the viewer's other panels collapsed."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        views,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="step", play_state=play_state, fps=15),
    )


def _replay(agents: tuple[str, ...]) -> Any:
    """A large board, the agents' windows, and the harvest and stock of one episode, turn by turn."""
    import rerun.blueprint as rrb

    return rrb.Horizontal(
        rrb.Vertical(_world(), _events(), row_shares=[7, 2]),
        rrb.Vertical(
            _windows(agents),
            _plot("Harvest so far, apples", *_of(agents, "harvested")),
            _plot("Apples on the board", "turn/stock"),
            row_shares=[4, 3, 2],
        ),
        column_shares=[3, 2],
    )


def _board(agents: tuple[str, ...]) -> Any:
    """The board, the agents' windows, and the events."""
    import rerun.blueprint as rrb

    return rrb.Vertical(_world(), _windows(agents), _events(), row_shares=[9, 9, 5])


def _world() -> Any:
    import rerun.blueprint as rrb

    return rrb.Spatial2DView(name="Board", origin="/world", background=_BACKGROUND)


def _windows(agents: tuple[str, ...]) -> Any:
    import rerun.blueprint as rrb

    seen = "What the agent sees" if len(agents) == 1 else "What each agent sees"
    return rrb.Spatial2DView(name=f"{seen}, {WINDOW_CAPTION}", origin="/windows", background=_BACKGROUND)


def _events() -> Any:
    """The events and the recipe."""
    import rerun.blueprint as rrb

    columns = rrb.TextLogColumns(timeline_columns=["step"], text_log_columns=["Body"])
    return rrb.Tabs(
        rrb.TextLogView(name="Events", origin="/log", columns=columns),
        rrb.TextDocumentView(name="Recipe", origin="/recipe"),
        active_tab="Events",
    )


def _numbers(curves: Curves) -> Any:
    """Returns and social metrics, the phase below them, and tabs for learning and for who tagged whom.

    Metrics that the game does not report are left out.
    """
    import rerun.blueprint as rrb

    agents = curves.agents

    def social(*plots: tuple[str, str]) -> list[Any]:
        """Plots without a legend for several replicas, because it would hide their lines."""
        return [
            _plot(name, f"social/{metric}", share=metric == "equality", legend=curves.replicas == 1)
            for name, metric in plots
            if metric in curves.metrics
        ]

    learning = rrb.Horizontal(
        _plot("Loss", *_of(agents, "loss"), legend=False),
        _plot("Highest Q value", *_of(agents, "q"), legend=False),
        _plot("Epsilon", *_of(agents, "epsilon"), share=True, legend=False),
        _plot("Steps per second", "time/env_steps_per_s", legend=False),
        name="Learning",
    )
    more = social(
        ("Apples per step", "efficiency"),
        ("Mean time of harvest, steps", "sustainability"),
        ("Apples left at the end", "stock_left"),
    )
    tabs: list[Any] = [learning, *([rrb.Horizontal(*more, name="More metrics")] if more else [])]
    if len(agents) > 1 and curves.has_tags:
        tabs.append(rrb.TensorView(name="Who tagged whom", origin="/tags"))
    unit = ", apples" if "collective_return" in curves.metrics else ""
    returns = rrb.Horizontal(
        _plot(f"Return of each agent{unit}", *_of(agents, "return"), "evaluation/greedy_return"),
        *social(("Collective return, apples", "collective_return")),
    )
    outcome = social(
        ("Survival, steps", "survival_steps"),
        ("Equality", "equality"),
        ("Peacefulness, steps in play", "peacefulness"),
    )
    rows: list[tuple[Any, int]] = [(returns, 4), (rrb.Horizontal(*outcome), 3)]
    if curves.has_phases:
        phases = rrb.StateTimelineView(name="Phase", contents=["+ /phase/**"], time_view=_whole())
        rows.append((phases, 1))
    rows.append((rrb.Tabs(*tabs, active_tab=0), 3))
    views, shares = zip(*rows, strict=True)
    return rrb.Vertical(*views, row_shares=list(shares))


def _plot(name: str, *entities: str, share: bool = False, legend: bool = True) -> Any:
    """A plot over the whole run; the axis of a share is 0..1."""
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        name=name,
        contents=[f"+ /{entity}" for entity in entities],
        axis_x=_whole(),
        axis_y=rrb.ScalarAxis(range=(0.0, 1.05)) if share else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )


def _whole() -> Any:
    """A time axis of the whole run; Rerun's default is a thousand steps around the cursor."""
    import rerun as rr
    import rerun.blueprint as rrb

    boundary = rrb.TimeRangeBoundary
    return rrb.TimeAxis(view_range=rr.TimeRange(start=boundary.infinite(), end=boundary.infinite()))


def _of(agents: tuple[str, ...], entity: str) -> list[str]:
    return [f"{agent}/{entity}" for agent in agents]
