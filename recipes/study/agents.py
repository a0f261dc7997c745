"""How many can share a commons? 2 to 12 agents, on the same board and with the same board for every four.

python recipes/study/agents.py --jobs 2
"""

from base import AGENT, EXPERIMENT

import cprl
from cprl import Map

BOARD = EXPERIMENT.game.map


def crowded(agents: int) -> Map:
    """The published board with other agents: the published ones, then those of the board turned by half."""
    low, right = BOARD.height - 1, BOARD.width - 1
    turned = tuple((low - row, right - col, (at + 2) % 4) for row, col, at in BOARD.starts)
    lower = tuple((low - row, col, 0) for row, col, _ in BOARD.starts)
    starts = (*BOARD.starts, *turned, *lower)
    return Map(height=BOARD.height, width=BOARD.width, sites=BOARD.sites, starts=starts[:agents])


def in_proportion(agents: int) -> Map:
    """As many published boards side by side as there are fours of agents; half a board for two."""
    if agents < 4:
        half = BOARD.width // 2
        sites = tuple((row, col) for row, col in BOARD.sites if col < half)
        return Map(height=BOARD.height, width=half, sites=sites, starts=BOARD.starts[:agents])
    boards = range(agents // 4)
    return Map(
        height=BOARD.height,
        width=BOARD.width * len(boards),
        sites=tuple((row, col + BOARD.width * nth) for nth in boards for row, col in BOARD.sites),
        starts=tuple((row, col + BOARD.width * nth, at) for nth in boards for row, col, at in BOARD.starts),
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
