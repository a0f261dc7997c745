"""The exhibited board, as viewers get it: static entities, so that they keep the newest frame alone."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.compat import send_chunk
from cprl.viewer.batches import components
from cprl.viewer.scenery import BACKGROUND, Scene
from cprl.viewer.stage import RIM_CELLS, board_columns, fixed

_BOARD: Final = "world"
"""Where the entities of the recorded board are."""

_CAPTION_CELLS, _ROOM_CELLS = 0.4, 2.4
"""The distances from the board to the caption and to the line that gives it room, in cells."""
_THIN: Final = 0.01


def send_fixed(recording: Any, *, scene: Scene) -> None:
    """Sends what never changes, to the server that keeps it for viewers that come later."""
    import rerun as rr

    for entity, parts in fixed(scene).items():
        if entity.startswith(f"{_BOARD}/"):
            recording.log(_renamed(entity), *parts, static=True)
    low = scene.height + 2 * RIM_CELLS + _ROOM_CELLS
    line = [(0.0, low), (scene.width + 2 * RIM_CELLS, low)]  # hidden; the view makes room for what it shows
    room = rr.LineStrips2D([line], radii=_THIN, colors=[BACKGROUND])
    recording.log("exhibition/room", room, static=True)
    place = (scene.width / 2 + RIM_CELLS, scene.height + 2 * RIM_CELLS + _CAPTION_CELLS)
    caption = rr.Points2D([place], show_labels=True, radii=_THIN, colors=[(255, 255, 255)])
    recording.log("exhibition/caption", caption, static=True)


def send_frames(
    recording: Any,
    *,
    scene: Scene,
    frames: Mapping[str, NDArray[Any]],
    caption: str,
    wait: Callable[[float], bool],
    lasting_s: float,
) -> None:
    """Sends frames one by one.

    Whatever is done here in Python keeps the training from going on: columns are converted and cut once for
    all frames, and rows go to Rerun's native part as they are.

    Args:
        recording: the stream.
        scene: the contents of the board.
        frames: of `FrameRecorder.take`, [T, ...].
        caption: the text below the board.
        wait: waits so many seconds; returns whether to leave out the rest.
        lasting_s: seconds over which they are spread.
    """
    import rerun as rr

    text = rr.Points2D.columns(labels=np.array([caption]))
    send_chunk(recording, "exhibition/caption", {}, components(text))
    count = len(frames["step"])
    shown: list[list[tuple[str, dict[Any, Any]]]] = [[] for _ in range(count)]
    for entity, (rows, columns) in board_columns(scene, frames).items():
        name, converted = _renamed(entity), components(columns)
        for row, at in enumerate(rows.tolist()):
            shown[at].append((name, {kind: own.slice(row, 1) for kind, own in converted.items()}))
    for at, parts in enumerate(shown):
        for name, own in parts:
            send_chunk(recording, name, {}, own)
        if at + 1 < count and wait(lasting_s / count):
            return


def _renamed(entity: str) -> str:
    """The name in the exhibition of an entity of the recorded board."""
    return "exhibition" + entity.removeprefix(_BOARD)
