"""Random play of the games of the literature beside that of their originals, as a Markdown table.

    python benchmarks/originals/compare.py > docs/results/games/random_play.md

The other scripts of this folder wrote the originals' episodes into docs/results/games. z is the difference of
the means in standard errors.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cprl import Game, maps, presets
from cprl.commons.batch import Batch

STORED = Path(__file__).parents[2] / "docs" / "results" / "games"
ORIGINALS = {
    "melting_pot_open": "melting_pot/commons_harvest__open-v1",
    "melting_pot_closed": "melting_pot/commons_harvest__closed-v1",
    "melting_pot_partnership": "melting_pot/commons_harvest__partnership-v1",
    "ssd_harvest": "ssd/harvest-v1",
    "ssd_cleanup": "ssd/cleanup-v1",
    "socialjax_harvest": "socialjax/harvest_open-v1",
    "socialjax_harvest_walls": "socialjax/harvest_open-v1",
}


def play(game: Game, *, episodes: int = 400, seed: int = 0) -> dict[str, Any]:
    """Return each measure of random play of a first episode in so many worlds, float [episodes]."""
    batch = Batch(game, episodes, seed=seed)
    rng = np.random.default_rng(seed)
    output = batch.begin()
    names = ("harvest", "regrown", "tags", "steps", "reward", "waste")
    sums = {name: np.zeros(episodes) for name in names}
    is_over = np.zeros(episodes, np.bool_)
    while not is_over.all():
        output = batch.play(rng.integers(len(game.actions), size=(episodes, game.agents)), output)
        waste = output.waste.sum(1) / game.rules.episode_steps
        rows = (
            output.harvest.sum(1),
            output.regrown[:, 0],
            output.tagged_by.any(2).sum(1),
            1,
            output.reward.sum(1),
            waste,
        )
        for name, row in zip(names, rows, strict=True):
            sums[name] += row * ~is_over
        is_over |= output.done[:, 0]
    return sums


def game_beside(name: str) -> Game:
    game = presets.game(ORIGINALS[name])
    if not name.endswith("_walls"):
        return game
    board = game.map
    rows = ("#" * (board.width + 2), *(f"#{row}#" for row in board.drawing().splitlines()))
    walled = maps.parse("\n".join((*rows, rows[0])))
    shifted = tuple((row + 1, col + 1) for row, col in board.spawns)
    return replace(game, map=replace(walled, spawns=shifted))


if __name__ == "__main__":
    print("| original | episodes | measure | original's mean | ours, 400 episodes | z |")
    print("|---|---:|---|---:|---:|---:|")
    for name in ORIGINALS:
        theirs = json.loads((STORED / f"{name}.json").read_text())
        ours = play(game_beside(name))
        for measure in theirs:
            first = np.array(theirs[measure], float)
            second = ours[measure]
            error = np.hypot(*(values.std(ddof=1) / len(values) ** 0.5 for values in (first, second)))
            z = (second.mean() - first.mean()) / error if error > 0 else 0.0
            means = f"{first.mean():,.1f} | {second.mean():,.1f}"
            print(f"| {name} | {len(first)} | {measure} | {means} | {z:+.1f} |")
