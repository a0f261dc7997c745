"""Images of the worlds of an environment, the same that the adapters for one world render."""

import numpy as np

from cprl import arguments
from cprl.commons.batch import Batch
from cprl.commons.picture import LARGEST_CELL_PIXELS, world_image
from cprl.commons.world import Bytes, StepOutput
from cprl.system.memory import check_memory

SMALLEST_CELL_PIXELS = 8


def images(batch: Batch, output: StepOutput, *, world: int | None, cell_pixels: int) -> Bytes:
    """Images of all worlds, uint8 [B, rows, columns, 3], or of one, uint8 [rows, columns, 3]; RGB.

    Raises:
        ValueError: if a number is out of range, or the worlds have not begun.
        MemoryError: if the images do not fit into memory.
    """
    if not batch.has_begun:
        raise ValueError("the worlds have not begun; allowed: reset() or load() before the first render()")
    board, size = batch.game.map, batch.size
    cell_pixels = arguments.integer("cell_pixels", cell_pixels, SMALLEST_CELL_PIXELS, LARGEST_CELL_PIXELS)
    if world is not None:
        return world_image(board, batch.show(output, world=world), cell_pixels=cell_pixels)
    pixels = size * (board.height * cell_pixels + 1) * (board.width * cell_pixels + 1)
    check_memory(f"images of {size:,} worlds", 6 * pixels, "one world (world=0) or fewer cell_pixels")
    shown = (batch.show(output, world=own) for own in range(size))
    return np.stack([world_image(board, own, cell_pixels=cell_pixels) for own in shown])
