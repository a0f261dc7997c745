"""Random play of sequential_social_dilemma_games' harvest and cleanup, for docs/games.md.

    PYTHONPATH=path/to/its/source python benchmarks/originals/ssd.py harvest --out ssd.json

It needs numpy and that program's source alone, which draws from numpy's global generator: of Ray, Gym and
Matplotlib, which the source imports, random play uses nothing, so stand-ins take their places. Each of the
five agents draws one of the actions in every step. With `--trace` it writes 200 steps with growth by no
chance for `tests/commons/test_games.py`.
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
from unittest.mock import MagicMock

import numpy as np

AGENTS = 5
STEPS = 1000


class _Base:
    """A base class that does nothing."""


for name in ("matplotlib", "matplotlib.pyplot", "gym", "gym.spaces", "gym.utils", "ray", "ray.rllib"):
    sys.modules[name] = MagicMock()
for name, kind in (("ray.rllib.agents.callbacks", "DefaultCallbacks"), ("ray.rllib.env", "MultiAgentEnv")):
    sys.modules[name] = type(sys)(name)
    setattr(sys.modules[name], kind, _Base)
sys.modules["gym.spaces"].Discrete = _Base


def environment(name: str, agents: int = AGENTS) -> Any:
    module = importlib.import_module(f"social_dilemmas.envs.{name}")
    return getattr(module, f"{name.title()}Env")(num_agents=agents)


def hits(env: Any) -> set[str]:
    """Return the agents that a fining beam of the last step covers."""
    covered = {(row, col) for row, col, sign in env.beam_pos if sign == b"F"}
    return {name for name, agent in env.agents.items() if tuple(agent.pos) in covered}


def episodes(name: str, count: int, seed: int) -> Iterator[dict[str, float]]:
    np.random.seed(seed)  # noqa: NPY002
    rng = np.random.default_rng(seed)
    env = environment(name)
    actions = 8 if name == "harvest" else 9
    for _ in range(count):
        env.reset()
        first = int((env.world_map == b"A").sum())
        harvest = reward = tags = waste = 0
        for _ in range(STEPS):
            drawn = {agent: int(rng.integers(actions)) for agent in env.agents}
            before = env.world_map == b"A"
            _, rewards, _, _ = env.step(drawn)
            harvest += sum(bool(before[tuple(agent.pos)]) for agent in env.agents.values())
            reward += sum(rewards.values())
            tags += len(hits(env))
            waste += int((env.world_map == b"H").sum())
        left = int((env.world_map == b"A").sum())
        yield {
            "harvest": harvest,
            "regrown": harvest + left - first,
            "tags": tags,
            "steps": STEPS,
            "reward": float(reward),
            **({"waste": waste / STEPS} if name == "cleanup" else {}),
        }


OURS = {2: 0, 3: 1, 0: 2, 1: 3, 6: 4, 5: 5, 7: 6, 4: 7, 8: 8}
"""The action of cprl for each of that program's."""
HEADINGS = {"UP": 0, "RIGHT": 1, "DOWN": 2, "LEFT": 3}


def trace(name: str, seed: int, *, steps: int = 200, growth: bool) -> dict[str, list[Any]]:
    """Return random play in which an apple grows wherever it can, or no apple and no waste ever comes:
    states, actions, rewards, and the turns in which agents may be in each other's way."""
    np.random.seed(seed)  # noqa: NPY002
    rng = np.random.default_rng(seed)
    env = environment(name)
    draw = 0.0 if growth else 1.0
    sys.modules[f"social_dilemmas.envs.{name}"].rand = lambda count: np.full(count, draw)
    env.reset()
    agents = list(env.agents.values())

    held: dict[str, list[Any]] = defaultdict(list)

    def hold() -> None:
        held["row"].append([int(agent.pos[0]) for agent in agents])
        held["col"].append([int(agent.pos[1]) for agent in agents])
        held["heading"].append([HEADINGS[agent.get_orientation()] for agent in agents])
        held["apples"].append(env.world_map == b"A")
        held["waste"].append(env.world_map == b"H")

    hold()
    for _ in range(steps):
        probs = (0.1, 0.1, 0.3, 0.1, 0.05, 0.1, 0.1, 0.15)
        if name == "cleanup":
            probs = (0.15, 0.1, 0.25, 0.1, 0.05, 0.1, 0.1, 0.05, 0.1)
        actions = rng.choice(len(probs), size=AGENTS, p=probs)
        before = [tuple(agent.pos) for agent in agents]
        cells = list(before)
        for place, (agent, action) in enumerate(zip(agents, actions, strict=True)):
            move = env.all_actions[agent.action_map(action)]
            if len(np.shape(move)) == 1:
                step = env.rotate_action(move, agent.get_orientation())
                cells[place] = tuple(agent.return_valid_pos(agent.pos + step))
        _, rewards, _, _ = env.step(dict(zip(env.agents, map(int, actions), strict=True)))
        held["actions"].append([OURS[int(action)] for action in actions])
        enters = [cell != start and cell in before for cell, start in zip(cells, before, strict=True)]
        held["is_contested"].append(len({*cells}) < AGENTS or any(enters))
        held["reward"].append([rewards[name] for name in env.agents])
        hold()
    return held


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=("harvest", "cleanup"))
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--trace", choices=("growth", "none"))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    if options.trace:
        np.savez_compressed(
            options.out, **trace(options.name, options.seed, growth=options.trace == "growth")
        )
        sys.exit()
    rows = list(episodes(options.name, options.episodes, options.seed))
    table = {measure: list(map(itemgetter(measure), rows)) for measure in rows[0]}
    options.out.write_text(json.dumps(table) + "\n")
    print({measure: float(np.mean(values).round(2)) for measure, values in table.items()})
