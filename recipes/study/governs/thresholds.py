"""At which tax does greed stop to pay? The margins of scripted agents, as a tax changes them.

    python recipes/study/governs/thresholds.py

Restrained agents ("sustainable") and greedy ones play `commons` in all mixes. A tax at the rate t of each
bite, shared by N agents, leaves an agent (1 - t) of its harvest and gives it t of the mean. So both are where
a line crosses 0: greed, where a lone greedy agent among restrained ones gets what it would get by
restraint, and fear, where a lone restrained agent among greedy ones gets what it would get by greed. Writes
docs/results/governs/thresholds.md, to be run in the root of the repository; half a minute of a core.
"""

from pathlib import Path
from typing import Final

import tyro
from asking import GAME
from page import table

from cprl import Fresh
from cprl.experimental.schelling import payoffs_of, schelling
from cprl.measuring.statistics import Estimate, estimate

EPISODES: Final = 20
"""Of each replica and mix."""


def thresholds() -> dict[str, Estimate]:
    """Return the rates above which greed does not pay, by the agents that are around, over 8 replicas."""
    payoffs = payoffs_of(schelling(GAME, Fresh(episodes=EPISODES), greedy="greedy"))
    agents = GAME.agents
    restrained, greedy, mean = payoffs.cooperators, payoffs.defectors, payoffs.group / agents
    gain = greedy[:, -1] - restrained[:, -1]
    share = greedy[:, -1] - mean[:, agents - 1]
    loss = greedy[:, 0] - restrained[:, 0]
    compensation = mean[:, 1] - restrained[:, 0]
    return {
        "among restrained agents": estimate(gain / share),
        "among greedy agents": estimate(loss / compensation),
    }


def main(*, out: Path = Path("docs", "results", "governs", "thresholds.md")) -> None:
    """Write the table.

    Args:
        out: the file.
    """
    rows = [[around, f"{rate:.2f}"] for around, rate in thresholds().items()]
    head = ["greed stops to pay", "above a rate of"]
    lines = [
        "By `python recipes/study/governs/thresholds.py`, which says how.",
        "",
        *table(head, rows, numbers=1),
    ]
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
