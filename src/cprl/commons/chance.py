"""Counter-based random numbers, each computed from seed, world, episode, step, site and purpose alone.

So a world plays the same episodes in any batch, on any number of threads and on any device. The generator is
Philox4x32-10 (Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011). Its key
is the seed, and its counter identifies the number: purpose and site, step, episode, world.
"""

from typing import TYPE_CHECKING, Annotated, Final

import numpy as np

from cprl.values import Where

if TYPE_CHECKING:
    from cprl.commons.world import Worlds

SMALLEST_PROBABILITY: Final = 2**-32
"""The smallest probability above 0, since random words have 32 bits: a smaller one would be rounded."""
Probability = Annotated[
    float,
    Where(
        lambda value: value == 0 or SMALLEST_PROBABILITY <= value <= 1,
        "a number that is 0, or 2**-32 (2.3e-10) to 1",
    ),
]

MULTIPLIER_0 = np.uint64(0xD2511F53)
MULTIPLIER_1 = np.uint64(0xCD9E8D57)
KEY_STEP_0 = np.uint64(0x9E3779B9)
KEY_STEP_1 = np.uint64(0xBB67AE85)
LOW_WORD = np.uint64(0xFFFFFFFF)
WORD_SIZE = 32
WORD_BITS = np.uint64(WORD_SIZE)
ROUNDS = 10

LOW_BYTE = 0xFF
BYTE_BITS = 8
REST_BITS = 24
SITES_PER_DRAW = 16
"""The number of sites that share one draw for the first bytes of their random words."""

REGROWTH_FIRST_BYTE = 0 << 28
REGROWTH_REST = 1 << 28
STARTS = 2 << 28
DETECTION = 3 << 28
BALLOT = 4 << 28
SPAWNS = 5 << 28
FIRST_STOCK = 6 << 28
END = 7 << 28
ORDER = 8 << 28
POLLUTION = 9 << 28
"""The purposes of draws: the upper four bits of the first counter word. The lower bits number the draws of a
purpose, e.g. by site."""


def philox4x32(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Return four uniform random 32-bit words, computed from a counter of four words and a key of two.

    Words are held in uint64, so that no product overflows and plain Python (the CUDA simulator) gives the
    same result.
    """
    for _ in range(ROUNDS):
        p0 = MULTIPLIER_0 * c0
        p1 = MULTIPLIER_1 * c2
        c0 = (p1 >> WORD_BITS) ^ c1 ^ k0
        c1 = p1 & LOW_WORD
        c2 = (p0 >> WORD_BITS) ^ c3 ^ k1
        c3 = p0 & LOW_WORD
        k0 = (k0 + KEY_STEP_0) & LOW_WORD
        k1 = (k1 + KEY_STEP_1) & LOW_WORD
    return c0, c1, c2, c3


def draw(world: "Worlds", number: int) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Draw four random 32-bit words for the current world, episode and step.

    `number` identifies the draw among those of this step: a purpose plus e.g. the index of a site or agent.
    """
    return philox4x32(
        np.uint64(number),
        np.uint64(world.step[0]),
        np.uint64(world.episode[0]),
        world.number[0],
        world.seed[0] & LOW_WORD,
        world.seed[0] >> WORD_BITS,
    )
