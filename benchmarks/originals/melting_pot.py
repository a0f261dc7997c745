"""Random play of Melting Pot's commons_harvest substrates, for docs/games.md.

    PYTHONPATH=path/to/meltingpot python benchmarks/originals/melting_pot.py open --out open.json

It runs where Melting Pot does, with `dmlab2d` (1.0.2 from the package index) and Melting Pot's own source; of
`cprl` it needs nothing. Each of the seven players draws one of the eight actions in every frame.
"""

import argparse
import importlib
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

PLAYERS = 7
MOVES = (0, 1, 3, 4, 2, 0, 0, 0)
TURNS = (0, 0, 0, 0, 0, -1, 1, 0)
"""By action: stay, forward, backward, left, right, turn left, turn right, zap."""
ZAP = 7
SPRITE = 8
"""Pixels a cell."""
APPLE = (214, 88, 88)
BEAM = (252, 252, 106)
"""The colours that only apples and beams have."""
STEPS = ((-1, 0), (0, 1), (1, 0), (0, -1))
"""By heading: north, east, south, west."""


def environment(name: str, seed: int, change: Any = None) -> Any:
    """Return a substrate; `change` may alter its settings before it is built."""
    from meltingpot.utils.substrates import builder

    module = importlib.import_module(f"meltingpot.configs.substrates.commons_harvest__{name}")
    module._ENABLE_DEBUG_OBSERVATIONS = True
    settings = module.build(("default",) * PLAYERS, module.get_config())
    if change is not None:
        change(settings)
    return builder.builder(settings, env_seed=seed)


def environment_actions(actions: Any) -> dict[str, int]:
    """Return the actions of all players as the environment takes them."""
    return {
        f"{player + 1}.{word}": value
        for player, action in enumerate(actions)
        for word, value in (
            ("move", MOVES[action]),
            ("turn", TURNS[action]),
            ("fireZap", int(action == ZAP)),
        )
    }


def stock(observation: Any) -> Any:
    """Return the cells that show an apple, bool [rows, columns]; an avatar hides the one under it."""
    is_apple = (observation["WORLD.RGB"] == APPLE).all(-1)
    rows, columns = (side // SPRITE for side in is_apple.shape)
    return is_apple.reshape(rows, SPRITE, columns, SPRITE).any((1, 3))


def hidden(observation: Any) -> Any:
    """Return the cells that a beam covers, bool [rows, columns]."""
    is_beam = (observation["WORLD.RGB"] == BEAM).all(-1)
    rows, columns = (side // SPRITE for side in is_beam.shape)
    return is_beam.reshape(rows, SPRITE, columns, SPRITE).any((1, 3))


def zaps(env: Any) -> list[tuple[int, int]]:
    """Return who hit whom in the last frame, counted from 0."""
    return [(int(zap[2]) - 1, int(zap[4]) - 1) for name, zap in env.events() if name == "zap"]


def episodes(name: str, count: int, seed: int) -> Iterator[dict[str, int]]:
    rng = np.random.default_rng(seed)
    for episode in range(count):
        env = environment(name, seed + 1 + episode)
        timestep = env.reset()
        first = stock(timestep.observation).sum()
        harvest = 0.0
        tags = steps = 0
        while not timestep.last():
            timestep = env.step(environment_actions(rng.integers(8, size=PLAYERS)))
            harvest += sum(timestep.observation[f"{player + 1}.REWARD"] for player in range(PLAYERS))
            tags += len({hit for _, hit in zaps(env)})
            steps += 1
        left = stock(timestep.observation).sum()
        yield {
            "harvest": int(harvest),
            "regrown": int(harvest + left - first),
            "tags": tags,
            "steps": steps,
        }
        env.close()


OURS = (7, 0, 1, 2, 3, 4, 5, 6)
"""The action of cprl for each of these."""


def trace(name: str, seed: int, *, growth: bool, frames: int = 300) -> dict[str, list[Any]]:
    """Return random play in which an apple grows wherever it can, or never: states, actions, rewards, zaps,
    and the frames in which players may be in each other's way or come back."""

    def certain(settings: Any) -> None:
        for part in settings["simulation"]["prefabs"]["apple"]["components"]:
            if part["component"] == "DensityRegrow":
                part["kwargs"]["regrowthProbabilities"] = [0.0, 1.0] if growth else [0.0]

    rng = np.random.default_rng(seed)
    env = environment(name, seed + 1, certain)
    held: dict[str, list[Any]] = defaultdict(list)

    def hold(observation: Any) -> None:
        places = [observation[f"{player + 1}.POSITION"] for player in range(PLAYERS)]
        held["row"].append([int(place[1]) for place in places])
        held["col"].append([int(place[0]) for place in places])
        held["heading"].append([int(observation[f"{player + 1}.ORIENTATION"]) for player in range(PLAYERS)])
        held["apples"].append(stock(observation))
        held["hidden"].append(hidden(observation))
        for row, col in zip(held["row"][-1], held["col"][-1], strict=True):
            if row < len(board) and col < len(board[0]):  # players out of play walk over the edge
                held["hidden"][-1][row, col] = True

    def next_cells(actions: Any) -> list[tuple[int, int]]:
        """Return the cell that each player wants, if no wall is there."""
        cells = []
        for player, action in enumerate(actions):
            row = held["row"][-1][player]
            col = held["col"][-1][player]
            if MOVES[action] > 0:
                down, right = STEPS[(held["heading"][-1][player] + MOVES[action] - 1) % 4]
                inside = 0 <= row + down < len(board) and 0 <= col + right < len(board[0])
                if inside and board[row + down][col + right] != "W":
                    row += down
                    col += right
            cells.append((row, col))
        return cells

    board = importlib.import_module(f"meltingpot.configs.substrates.commons_harvest__{name}").ASCII_MAP
    board = board.strip("\n").splitlines()
    hold(env.reset().observation)
    for _ in range(frames):
        actions = rng.choice(8, size=PLAYERS, p=(0.05, 0.35, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1))
        cells = next_cells(actions)
        before = list(zip(held["row"][-1], held["col"][-1], strict=True))
        enters = [cell != start and cell in before for cell, start in zip(cells, before, strict=True)]
        held["is_contested"].append(len({*cells}) < PLAYERS or any(enters))
        timestep = env.step(environment_actions(actions))
        held["actions"].append([OURS[action] for action in actions])
        held["reward"].append(
            [float(timestep.observation[f"{player + 1}.REWARD"]) for player in range(PLAYERS)]
        )
        tagged = np.zeros((PLAYERS, PLAYERS), bool)
        for shooter, hit in zaps(env):
            tagged[hit, shooter] = True
        held["tagged_by"].append(tagged)
        hold(timestep.observation)
    return held


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=("open", "closed", "partnership"))
    parser.add_argument("--episodes", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--trace", choices=("growth", "none"))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    if options.trace:
        held = trace(options.name, options.seed, growth=options.trace == "growth")
        np.savez_compressed(options.out, **held)
        sys.exit()
    rows = list(episodes(options.name, options.episodes, options.seed))
    table = {measure: list(map(itemgetter(measure), rows)) for measure in rows[0]}
    options.out.write_text(json.dumps(table) + "\n")
    print({measure: np.mean(values).round(2) for measure, values in table.items()})
