"""Does what governs the commons do so elsewhere? In many worlds, by PPO, on Melting Pot's map, and at length.

    python recipes/study/elsewhere.py --jobs 2

The changes that had the strongest effects on a short schedule (docs/governs.md of commit e2b73286) in four
settings: four DQN agents on `commons` as run that learn from sixteen worlds (TRAGEDY of base.py), four PPO
agents that learn from 256 (the settings of recipes/study/many_worlds.py), seven DQN agents on Melting Pot's
open commons, in sixteen, and experiment 5 as run, on its full schedule of 4,800 episodes in one world, which
takes most of the time. recipes/study/contrasts.py makes tables of what each change adds.
"""

from dataclasses import replace
from itertools import product
from typing import Any, Final

import numpy as np
from base import PUBLISHED, TRAGEDY
from many_worlds import ppo

import cprl
from cprl import Game, Map, maps, presets
from cprl.algorithms import DQN, PPO
from cprl.institutions import Quota
from cprl.population import Learning

COMMONS: Final = TRAGEDY.game
OPEN: Final = presets.game("melting_pot/commons_harvest__open-v1")
QUOTA: Final = Quota(share=0.25, window_steps=50)
PENALTY: Final = replace(QUOTA, fine=2.0)
"""A fine that is certain, and twice what the bite brings."""

SHORT: Final = TRAGEDY.agents[0].algorithm
SETTINGS: Final[dict[str, tuple[Game, DQN | PPO, dict[str, Any]]]] = {
    "DQN, 16 worlds": (COMMONS, SHORT, {"worlds": 16, "steps": 400_000}),
    "PPO, 256 worlds": (COMMONS, ppo(256), {"worlds": 256, "steps": 1_000_000}),
    "DQN, Melting Pot": (OPEN, SHORT, {"worlds": 16, "steps": 400_000}),
    "DQN, full schedule": (
        COMMONS,
        PUBLISHED.agents[0].algorithm,
        {"worlds": 1, "steps": None, "episodes": PUBLISHED.episodes},
    ),
}
"""By name: the game, how each agent learns, and from how much."""


def scattered(board: Map) -> Map:
    """Return a random board of this size with twice the sites."""
    density = 2 * len(board.sites) / (board.height * board.width)
    return maps.random(board.height, board.width, agents=len(board.starts), density=density, seed=0)


def denser(board: Map) -> Map:
    """Return the board with as many further sites as it has, on free ground by chance."""
    starts = {(row, col) for row, col, _ in board.starts}
    taken = {*board.sites, *board.walls, *board.spawns, *starts}
    free = [cell for cell in product(range(board.height), range(board.width)) if cell not in taken]
    drawn = np.random.default_rng(0).choice(len(free), len(board.sites), replace=False)
    return replace(board, sites=(*board.sites, *(free[at] for at in drawn)))


def games(game: Game) -> dict[str, Game]:
    """Return the game under each change of it."""
    half = game.agents // 2
    fewer = replace(game.map, starts=game.map.starts[:half])
    richer = scattered(game.map) if game is COMMONS else denser(game.map)
    regrow = tuple(min(1.0, 2 * prob) for prob in game.rules.regrow_prob)
    return {
        "nothing changed": game,
        "twice the apples": replace(game, map=richer),
        "regrowth x 2": replace(game, rules=replace(game.rules, regrow_prob=regrow)),
        "half the agents": replace(game, map=fewer),
        "networks of 2 units": game,
        "quota": replace(game, institutions=(QUOTA,)),
        "penalty that is certain": replace(game, institutions=(PENALTY,)),
    }


def conditions() -> dict[str, dict[str, Any]]:
    """Return each change in each setting."""
    table = {}
    for setting, (game, algorithm, length) in SETTINGS.items():
        for change, changed in games(game).items():
            cells = (2, 2) if change == "networks of 2 units" else (32, 32)
            learner = replace(algorithm, settings=replace(algorithm.settings, hidden_cells=cells))
            agents = (Learning(learner),) * changed.agents
            table[f"{setting}: {change}"] = {"game": changed, "agents": agents, **length}
    return table


STUDY = cprl.Study(
    cprl.Experiment(
        name="elsewhere",
        game=COMMONS,
        agents=TRAGEDY.agents,
        steps=400_000,
        worlds=TRAGEDY.worlds,
        evaluation_episodes=50,
    ),
    conditions=conditions(),
    replicas=4,
    block=4,
    name="elsewhere",
    question="Does what governs the commons do so for other learners, in many worlds, and on another map?",
    expectation=(
        "All six changes raise the harvest after fines in all three settings, with one exception: on Melting "
        "Pot's map, where seven agents need longer to strip the board and an episode goes on when it is "
        "empty, half the agents harvest less than all. Twice the apples raises it most everywhere, and the "
        "quota more than the penalty. Networks of two units help DQN in sixteen worlds, less than in one, "
        "and PPO little, since its agents have not learned to strip the board in a million steps. On the "
        "full schedule, expected when the others were known: unchanged agents end at 489 apples there, so "
        "twice the apples and the regrowth add hundreds, the quota, under which four agents get some 470, "
        "and the penalty nothing sure, and half the agents and networks of two units harvest less."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
