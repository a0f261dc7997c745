"""Random play of SocialJax' harvest_open, for docs/games.md.

    PYTHONPATH=path/to/SocialJax python benchmarks/originals/socialjax_harvest.py --out socialjax.json

It runs where SocialJax does, on the CPU; of `cprl` it needs nothing. Each of the seven agents draws one of
the eight actions in every step. With `--walls` its board stands in a ring of walls, so that no beam reaches
over an edge. With `--trace` it writes 200 steps on that board, without growth, for
`tests/commons/test_games.py`.
"""

import argparse
import inspect
import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from socialjax.environments.common_harvest.harvest_open import Harvest_open, Items

AGENTS = 7
STEPS = 1000
ACTIONS = 8


def environment(*, walls: bool) -> Harvest_open:
    board: dict[str, Any] = {}
    if walls:
        rows = inspect.signature(Harvest_open.__init__).parameters["map_ASCII"].default
        edge = "W" * (len(rows[0]) + 2)
        rows = [edge, *(f"W{row}W" for row in rows), edge]
        board = {"map_ASCII": rows, "grid_size": (len(rows), len(edge))}
    return Harvest_open(num_inner_steps=STEPS + 1, num_agents=AGENTS, shared_rewards=False, **board)


def play(episodes: int, seed: int, *, walls: bool = False) -> dict[str, list[int]]:
    env = environment(walls=walls)
    step = jax.jit(jax.vmap(lambda key, state, actions: env.step_env(key, state, actions)[1:3]))
    drawn = jax.jit(jax.vmap(lambda key: jax.random.randint(key, (AGENTS,), 0, ACTIONS)))
    keys = jax.random.split(jax.random.PRNGKey(seed), episodes)
    _, state = jax.jit(jax.vmap(env.reset))(keys)
    sums = {name: np.zeros(episodes) for name in ("harvest", "tags")}

    def apples(state: object) -> np.ndarray:
        return np.asarray((state.grid == Items.apple).sum((1, 2)))

    first = apples(state)
    for turn in range(STEPS):
        split = jax.vmap(lambda key, turn=turn: jax.random.split(jax.random.fold_in(key, turn)))(keys)
        state, rewards = step(split[:, 0], state, drawn(split[:, 1]))
        sums["harvest"] += np.asarray(rewards).sum(1) / AGENTS
        moved = jnp.any(state.reborn_locs[:, :, :2] != state.agent_locs[:, :, :2], -1)
        sums["tags"] += np.asarray(moved.sum(1))
    table = {name: values.round().astype(int).tolist() for name, values in sums.items()}
    regrown = sums["harvest"].round().astype(int) + apples(state) - first
    return table | {"regrown": regrown.tolist(), "steps": [STEPS] * episodes}


DIRECTIONS = {5: 0, 2: 1, 4: 2, 3: 3}
"""The heading of each move, to the north, east, south and west; moves do not depend on that of the agent."""
WALKS = (0, 3, 1, 2)
"""The action of cprl for a move, by right turns from the heading."""
OTHERS = {0: 4, 1: 5, 6: 7, 7: 6}
"""The action of cprl for each of the others."""
STEPS_TO = ((-1, 0), (0, 1), (1, 0), (0, -1))


def trace(seed: int, steps: int = 200) -> dict[str, list[Any]]:
    """Return random play without growth: states, actions, rewards, and the steps in which agents may be in
    each other's way, or in that of a beam."""
    jax.random.uniform = lambda key, shape: jnp.full(shape, 0.9)
    env = environment(walls=True)
    rng = np.random.default_rng(seed)
    key = jax.random.PRNGKey(seed)
    _, state = env.reset(key)
    held: dict[str, list[Any]] = defaultdict(list)

    def hold() -> None:
        row, col, heading = np.asarray(state.reborn_locs).T
        held["row"].append(row - 1)
        held["col"].append(col - 1)
        held["heading"].append(np.array((2, 1, 0, 3))[heading])
        held["apples"].append(np.asarray(state.grid == Items.apple)[1:-1, 1:-1])

    hold()
    for turn in range(steps):
        drawn = rng.choice(8, size=AGENTS, p=(0.1, 0.1, 0.17, 0.17, 0.17, 0.17, 0.04, 0.08))
        grid = np.asarray(state.grid)
        actions = []
        cells = []
        before = list(zip(held["row"][-1].tolist(), held["col"][-1].tolist(), strict=True))
        for (row, col), heading, action in zip(before, held["heading"][-1], map(int, drawn), strict=True):
            if action in DIRECTIONS:
                down, right = STEPS_TO[DIRECTIONS[action]]
                actions.append(WALKS[(DIRECTIONS[action] - heading) % 4])
                is_wall = grid[row + down + 1, col + right + 1] == Items.wall
                cell = (row, col) if is_wall else (row + down, col + right)
                cells.append(cell)
            else:
                actions.append(OTHERS[action])
                cells.append((row, col))
        beams = any(grid[row + 1, col + 1] == Items.interact for row, col in cells)
        enters = [cell != start and cell in before for cell, start in zip(cells, before, strict=True)]
        held["is_contested"].append(beams or len({*cells}) < AGENTS or any(enters))
        _, state, rewards, _, _ = env.step_env(jax.random.fold_in(key, turn), state, jnp.asarray(drawn))
        held["actions"].append(actions)
        held["reward"].append(np.asarray(rewards) / AGENTS)
        hold()
    return held


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--walls", action="store_true")
    parser.add_argument("--trace", action="store_true")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    if options.trace:
        np.savez_compressed(options.out, **trace(options.seed))
        sys.exit()
    table = play(options.episodes, options.seed, walls=options.walls)
    options.out.write_text(json.dumps(table) + "\n")
    print({measure: float(np.mean(values).round(2)) for measure, values in table.items()})
