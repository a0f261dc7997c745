"""Tabs of the layout that hold images and drawn plots: all replicas, places and shares, decisions."""

from typing import Any

from cprl.viewer.axes import BOUNDS
from cprl.viewer.panels import Panels, decision_panels
from cprl.viewer.scenery import BACKGROUND, Curves, Scene, has_lorenz, has_wall


def row(name: str, *views: Any) -> Any:
    """The views that are there side by side, as a tab; None if there is none."""
    import rerun.blueprint as rrb

    there = [view for view in views if view is not None]
    return rrb.Horizontal(*there, name=name) if there else None


def fates(curves: Curves) -> Any:
    """All boards at once, and how long each replica's apples lasted."""
    if not isinstance(curves, Scene):
        return None
    wall = _panels("All replicas; framed: died in its last episode", "wall", curves, curves.replicas)
    return row(
        "Replicas",
        wall if has_wall(curves) else None,
        _drawn("Apples on the board, over the turn", "turn"),
    )


def places(curves: Curves) -> Any:
    """Where agents go, and how evenly they share."""
    name = "Where agents go in the first replica, by episodes"
    return row(
        "Places and shares",
        _panels(name, "visits", curves, len(curves.agents)) if isinstance(curves, Scene) else None,
        _drawn("Lorenz curve: harvest in %", "lorenz") if has_lorenz(curves) else None,
    )


def _panels(name: str, origin: str, scene: Scene, count: int) -> Any:
    """A view of several boards."""
    bounds = Panels(count, (scene.height + 2, scene.width + 2)).bounds
    return _flat(name, origin, bounds)


def _drawn(name: str, origin: str) -> Any:
    """A view of a plot that is drawn with `Axes`."""
    return _flat(name, origin, BOUNDS)


def _flat(name: str, origin: str, bounds: tuple[tuple[float, float], tuple[float, float]]) -> Any:
    import rerun.blueprint as rrb

    visible = rrb.VisualBounds2D(x_range=bounds[0], y_range=bounds[1])
    return rrb.Spatial2DView(name=name, origin=f"/{origin}", background=BACKGROUND, visual_bounds=visible)


def decisions(scene: Scene) -> Any:
    """What the agents choose by, arranged as their windows."""
    bounds = decision_panels(len(scene.agents), scene.actions, scene.window).bounds
    return _flat("What policies say (L, R turn, B beam, S stay), taken: white", "decisions", bounds)
