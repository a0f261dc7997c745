"""Scenery: what a recording shows of one world, as Rerun's archetypes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.colours import FIRST_AGENT, agent_colour, class_colour, class_name
from cprl.recording.frames import RIM_CELLS, UNSEEN, board_with_rim, mosaic

SOCIAL: Final = {
    "social/collective_return": ("collective return", (230, 160, 0)),
    "social/efficiency": ("apples per step", (230, 160, 0)),
    "social/equality": ("equality", (86, 180, 233)),
    "social/sustainability": ("sustainability", (0, 158, 115)),
    "social/survival_steps": ("survival", (230, 120, 0)),
    "social/peace": ("peace", (204, 121, 167)),
    "social/peacefulness": ("peacefulness", (204, 121, 167)),
    "social/stock_left": ("apples left", (0, 200, 0)),
}
"""The name and colour of a line, since the viewers' own colours differ; agents have theirs."""
OTHERS: Final = {
    "time/env_steps_per_s": ("steps per second", (150, 150, 150)),
    "evaluation/greedy_return": ("greedy, evaluated", (230, 160, 0)),
}
OF_AGENTS: Final = ("return", "loss", "epsilon", "q")
PHASE_COLOURS: Final = {
    "exploration": (86, 180, 233),
    "tragedy": (213, 94, 0),
    "combat": (204, 121, 167),
    "cultivation": (0, 158, 115),
    "another": (120, 120, 120),
}

_MEAN_WIDTH, _SINGLE_WIDTH, _SINGLE_SHARE = 2.5, 0.7, 0.45
AGENT_RADIUS_CELLS: Final = 0.48
_ARROW_CELLS: Final = 0.9
_OUT_OF_PLAY_ALPHA: Final = 60


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What is on the board that a recording shows."""

    height: int
    width: int
    agents: tuple[str, ...]
    """Names of the agents, agent 0 first."""
    window: tuple[int, int]
    """(X, Y) of a window."""
    replicas: int = 1
    """How many replicas' metrics are drawn: their mean, and thinner each of them."""


def classes(scene: Scene | None) -> Any:
    """Names and colours of the classes on boards and in windows."""
    import rerun as rr

    known = [
        rr.AnnotationInfo(id=kind, label=class_name(kind), color=class_colour(kind))
        for kind in range(FIRST_AGENT + (len(scene.agents) if scene else 0))
    ]
    return rr.AnnotationContext([*known, rr.AnnotationInfo(id=UNSEEN, label="", color=(0, 0, 0, 0))])


def lines(scene: Scene | None) -> dict[str, Any]:
    """The names, colours and widths of each plot's lines, by entity."""
    import rerun as rr

    replicas = scene.replicas if scene else 1
    styles = {entity: _mean_and_singles(name, colour, replicas) for entity, (name, colour) in SOCIAL.items()}
    for entity, (name, colour) in OTHERS.items():
        styles[entity] = rr.SeriesLines(names=[name], colors=[colour])
    for agent, name in enumerate(scene.agents if scene else ()):
        for entity in OF_AGENTS:
            styles[f"{name}/{entity}"] = rr.SeriesLines(names=[name], colors=[agent_colour(agent)])
    return styles


def _mean_and_singles(name: str, colour: tuple[int, int, int], replicas: int) -> Any:
    """A thick line for the mean of several replicas, and a thin, darker one for each."""
    import rerun as rr

    if replicas == 1:
        return rr.SeriesLines(names=[name], colors=[colour])
    dark = tuple(round(_SINGLE_SHARE * part) for part in colour)
    return rr.SeriesLines(
        names=[f"{name}, mean", *(f"replica {replica}" for replica in range(replicas))],
        colors=[colour, *[dark] * replicas],
        widths=[_MEAN_WIDTH, *[_SINGLE_WIDTH] * replicas],
    )


def phase_states() -> Any:
    """The colours of phases."""
    import rerun as rr

    packed = [red << 24 | green << 16 | blue << 8 | 255 for red, green, blue in PHASE_COLOURS.values()]
    return rr.StateConfiguration(
        values=list(PHASE_COLOURS), labels=list(PHASE_COLOURS), colors=np.array(packed, np.uint32)
    )


def image_forms(scene: Scene) -> dict[str, Any]:
    """The sizes of the board's and the windows' images, by entity."""
    import rerun as rr

    rows, columns = scene.window
    sizes = {
        "world/board": (scene.width + 2 * RIM_CELLS, scene.height + 2 * RIM_CELLS),
        "windows": (len(scene.agents) * (columns + 1) - 1, rows),
    }
    return {
        entity: rr.SegmentationImage.from_fields(
            format=rr.components.ImageFormat(
                width=width, height=height, channel_datatype=rr.ChannelDatatype.U8
            )
        )
        for entity, (width, height) in sizes.items()
    }


def frame_columns(scene: Scene, frames: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """The board, agents, headings and windows of T frames, as columns by entity.

    Args:
        scene: what is on the board.
        frames: as `FrameBuffer.take` gives them, [T, ...] each.
    """
    import rerun as rr

    count, agents = len(frames["step"]), len(scene.agents)
    places = np.stack([frames["col"], frames["row"]], -1).reshape(-1, 2) + RIM_CELLS + 0.5
    rgb = np.array([agent_colour(agent) for agent in range(agents)], np.uint8)
    colours = np.concatenate([np.tile(rgb, (count, 1)), np.full((count * agents, 1), 255, np.uint8)], 1)
    colours[~frames["in_play"].reshape(-1), 3] = _OUT_OF_PLAY_ALPHA
    ahead = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)], np.float32) * _ARROW_CELLS
    each = [agents] * count
    return {
        "world/board": rr.SegmentationImage.columns(
            buffer=board_with_rim(frames["board"]).reshape(count, -1)
        ),
        "windows": rr.SegmentationImage.columns(buffer=mosaic(frames["windows"]).reshape(count, -1)),
        "world/agents": rr.Points2D.columns(
            positions=places,
            colors=colours,
            radii=[AGENT_RADIUS_CELLS] * len(places),
            labels=list(scene.agents) * count,
        ).partition(each),
        "world/headings": rr.Arrows2D.columns(
            origins=places,
            vectors=ahead[frames["heading"].reshape(-1)],
            colors=[(255, 255, 255)] * len(places),
        ).partition(each),
    }
