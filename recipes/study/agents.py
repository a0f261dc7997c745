"""How many can share a commons? 2 to 12 agents, on the same board and with the same board for every four.

python recipes/study/agents.py --jobs 2
"""

from dataclasses import replace

from base import AGENT, EXPERIMENT

import cprl
from cprl import Map

BOARD = EXPERIMENT.game.map


def crowded(agents: int) -> Map:
    """Return the published board with the published agents, then those of the board turned by half, then
    those of its mirror image."""
    low = BOARD.height - 1
    right = BOARD.width - 1
    turned = [(low - row, right - col, (heading + 2) % 4) for row, col, heading in BOARD.starts]
    mirrored = [(low - row, col, 0) for row, col, _ in BOARD.starts]
    return replace(BOARD, starts=(*BOARD.starts, *turned, *mirrored)[:agents])


def in_proportion(agents: int) -> Map:
    """Return as many published boards side by side as there are fours of agents, half a board for two."""
    if agents < 4:
        half = BOARD.width // 2
        sites = tuple((row, col) for row, col in BOARD.sites if col < half)
        return Map(height=BOARD.height, width=half, sites=sites, starts=BOARD.starts[:agents])
    lefts = range(0, BOARD.width * agents // 4, BOARD.width)
    return Map(
        height=BOARD.height,
        width=BOARD.width * len(lefts),
        sites=tuple((row, left + col) for left in lefts for row, col in BOARD.sites),
        starts=tuple((row, left + col, heading) for left in lefts for row, col, heading in BOARD.starts),
    )


def condition(agents: int, board: Map) -> dict[str, object]:
    return {"agents": (AGENT,) * agents, "game.map": board}


STUDY = cprl.Study(
    EXPERIMENT,
    conditions={
        "4": {},
        **{f"{n}, same board": condition(n, crowded(n)) for n in (2, 8, 12)},
        **{f"{n}, same apples for each": condition(n, in_proportion(n)) for n in (2, 8, 12)},
    },
    name="agents",
    question="How does the outcome depend on the number of agents, with and without as many apples for each?",
    expectation=(
        "On the same board harvest and survival fall with every further agent. With as many apples for "
        "each, the harvest of an agent changes little: what counts is how many share a patch, and most "
        "meet only those nearby."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
