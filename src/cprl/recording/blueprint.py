"""How the Rerun viewer is laid out when a recording is opened."""

from collections.abc import Sequence
from typing import Any


def layout(agents: Sequence[str]) -> Any:
    """Board and windows left; returns, social metrics and learning right; events and recipe below.

    Args:
        agents: their names.

    Returns:
        A `rerun.blueprint.Blueprint`.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    boundary = rrb.TimeRangeBoundary
    whole = rrb.TimeAxis(view_range=rr.TimeRange(start=boundary.infinite(), end=boundary.infinite()))

    def plot(name: str, *entities: str, share: bool = False) -> Any:
        """A plot over the whole run; a share has the axis 0..1."""
        return rrb.TimeSeriesView(
            name=name,
            contents=[f"+ /{entity}" for entity in entities],
            axis_x=whole,
            axis_y=rrb.ScalarAxis(range=(0.0, 1.05)) if share else None,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        )

    def of_agents(entity: str) -> list[str]:
        return [f"{agent}/{entity}" for agent in agents]

    seen = "What the agent sees" if len(agents) == 1 else "What each agent sees, the first one left"
    left = rrb.Vertical(
        rrb.Spatial2DView(name="Board", origin="/world"),
        rrb.Spatial2DView(name=seen, origin="/windows"),
        row_shares=[3, 2],
    )
    right = rrb.Vertical(
        plot("Return of each episode, apples", *of_agents("return"), "evaluation/greedy_return"),
        rrb.Horizontal(
            plot("Survival, sustainability, steps", "social/survival_steps", "social/sustainability"),
            plot("Equality", "social/equality", share=True),
            plot("Peacefulness, steps in play", "social/peacefulness"),
        ),
        rrb.Horizontal(
            plot("Loss", *of_agents("loss")),
            plot("Epsilon", *of_agents("epsilon"), share=True),
            plot("Steps per second", "time/env_steps_per_s"),
        ),
        rrb.Tabs(
            rrb.TextLogView(name="Events", origin="/log"),
            rrb.TextDocumentView(name="Recipe", origin="/recipe"),
            active_tab="Events",
        ),
        row_shares=[4, 3, 3, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="step", play_state="following", fps=15),
    )
