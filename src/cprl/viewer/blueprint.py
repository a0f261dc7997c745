"""How the Rerun viewer is laid out when a recording is opened."""

from typing import Any, Final, Literal

from cprl.viewer.scenery import Scene

_BACKGROUND: Final = (24, 26, 32)
"""Behind boards and windows, so that their dark ground is told from the viewer's."""


def layout(scene: Scene | None) -> Any:
    """Board and windows left, what is measured right, events below, and tabs for the rest; a replay has less.

    Args:
        scene: what is on the board; None for a recording without one.

    Returns:
        A `rerun.blueprint.Blueprint`.
    """
    import rerun.blueprint as rrb

    if scene and scene.is_replay:
        return _laid_out(_replay(scene.agents), play_state="playing")
    agents, replicas = (scene.agents, scene.replicas) if scene else ((), 1)
    return _laid_out(
        rrb.Horizontal(_board(agents), _numbers(agents, replicas), column_shares=[2, 3]),
        play_state="following",
    )


def _laid_out(views: Any, *, play_state: Literal["playing", "following"]) -> Any:
    """The views, and as little else as can be."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        views,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="step", play_state=play_state, fps=15),
    )


def _replay(agents: tuple[str, ...]) -> Any:
    """A large board, what agents see, and the harvest and the stock of one episode, turn by turn."""
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
    """The board, what agents see, and what happened."""
    import rerun.blueprint as rrb

    return rrb.Vertical(_world(), _windows(agents), _events(), row_shares=[9, 9, 5])


def _world() -> Any:
    import rerun.blueprint as rrb

    return rrb.Spatial2DView(name="Board", origin="/world", background=_BACKGROUND)


def _windows(agents: tuple[str, ...]) -> Any:
    import rerun.blueprint as rrb

    seen = "What the agent sees" if len(agents) == 1 else "What each agent sees, in a frame of its colour"
    return rrb.Spatial2DView(name=seen, origin="/windows", background=_BACKGROUND)


def _events() -> Any:
    """What happened, and what is run."""
    import rerun.blueprint as rrb

    columns = rrb.TextLogColumns(timeline_columns=["step"], text_log_columns=["Body"])
    return rrb.Tabs(
        rrb.TextLogView(name="Events", origin="/log", columns=columns),
        rrb.TextDocumentView(name="Recipe", origin="/recipe"),
        active_tab="Events",
    )


def _numbers(agents: tuple[str, ...], replicas: int) -> Any:
    """Returns and social metrics, the phase under them, and tabs for learning and for who tagged whom."""
    import rerun.blueprint as rrb

    def social(name: str, entity: str, *, share: bool = False) -> Any:
        """A line for each of many replicas would make a legend that hides them all."""
        return _plot(name, f"social/{entity}", share=share, legend=replicas == 1)

    learning = rrb.Horizontal(
        _plot("Loss", *_of(agents, "loss"), legend=False),
        _plot("Highest Q value", *_of(agents, "q"), legend=False),
        _plot("Epsilon", *_of(agents, "epsilon"), share=True, legend=False),
        _plot("Steps per second", "time/env_steps_per_s", legend=False),
        name="Learning",
    )
    more = rrb.Horizontal(
        social("Apples per step", "efficiency"),
        social("Mean time of harvest, steps", "sustainability"),
        social("Apples left at the end", "stock_left"),
        name="More metrics",
    )
    tags = rrb.TensorView(name="Who tagged whom", origin="/tags")
    return rrb.Vertical(
        rrb.Horizontal(
            _plot("Return of each agent, apples", *_of(agents, "return"), "evaluation/greedy_return"),
            social("Collective return, apples", "collective_return"),
        ),
        rrb.Horizontal(
            social("Survival, steps", "survival_steps"),
            social("Equality", "equality", share=True),
            social("Peacefulness, steps in play", "peacefulness"),
        ),
        rrb.StateTimelineView(name="Phase", contents=["+ /phase/**"], time_view=_whole()),
        rrb.Tabs(learning, more, *([tags] if len(agents) > 1 else []), active_tab=0),
        row_shares=[4, 3, 1, 3],
    )


def _plot(name: str, *entities: str, share: bool = False, legend: bool = True) -> Any:
    """A plot over the whole run; a share has the axis 0..1."""
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        name=name,
        contents=[f"+ /{entity}" for entity in entities],
        axis_x=_whole(),
        axis_y=rrb.ScalarAxis(range=(0.0, 1.05)) if share else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )


def _whole() -> Any:
    """A time axis that shows everything; by default it shows a thousand steps around the cursor."""
    import rerun as rr
    import rerun.blueprint as rrb

    boundary = rrb.TimeRangeBoundary
    return rrb.TimeAxis(view_range=rr.TimeRange(start=boundary.infinite(), end=boundary.infinite()))


def _of(agents: tuple[str, ...], entity: str) -> list[str]:
    return [f"{agent}/{entity}" for agent in agents]
