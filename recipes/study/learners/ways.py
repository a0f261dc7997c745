"""Which ways to learn are compared on two boards, and with which settings?

Each way has four candidates for its settings, the same number for all, and they are chosen on seeds that the
comparison does not use: tuning_BOARD.py beside this file trains every candidate and prints which one won.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Final, Literal

import cprl
from cprl import presets
from cprl.algorithms import (
    DQN,
    IPPO,
    LOLA,
    MADDPG,
    MAPPO,
    PPO,
    PR2,
    QMIX,
    VDN,
    Algorithm,
    DQNSettings,
    LOLASettings,
    RolloutSettings,
    TeamAlgorithm,
)
from cprl.measuring.statistics import estimates
from cprl.population import AgentSpec, Learning, Team
from cprl.studies import StudyTable
from cprl.system.output import say

Board = Literal["two_complex", "commons"]
GAMMA: Final = 0.99
"""The discount factor of all, since it says what agents want and not how they learn."""
STEPS: Final = 1_000_000
"""Environment steps of each replica, at least; look-ahead rollouts are such steps."""
OFF_POLICY: Final = {"learning_rate": (1e-4, 1e-3), "tau": (None, 0.005)}
ON_POLICY: Final = {"learning_rate": (3e-4, 1e-3), "entropy_coeff": (0.01, 0.05)}
WAYS: Final[dict[str, tuple[Any, dict[str, tuple[Any, Any]]]]] = {
    "DQN": (DQN, OFF_POLICY),
    "PPO": (PPO, ON_POLICY),
    "IPPO": (IPPO, ON_POLICY),
    "VDN": (VDN, OFF_POLICY),
    "QMIX": (QMIX, OFF_POLICY),
    "MAPPO": (MAPPO, ON_POLICY),
    "MADDPG": (MADDPG, {"learning_rate": (1e-4, 1e-3), "tau": (0.005, 0.02)}),
    "PR2": (PR2, {"learning_rate": (1e-4, 1e-3), "temperature": (0.02, 0.1)}),
    "LOLA": (LOLA, {"learning_rate": (1e-3, 1e-2), "look_ahead_rate": (0.01, 0.05)}),
}
"""The algorithm of each way, and the two values of each of two settings."""


def candidates(way: str, steps: int) -> dict[str, Algorithm]:
    """Return the four algorithms of a way by name, for a training of so many steps."""
    kind, grid = WAYS[way]
    algorithms = {}
    for values in product(*grid.values()):
        settings = dict(zip(grid, values, strict=True))
        name = ", ".join(f"{field.replace('_', ' ')} {value}" for field, value in settings.items())
        algorithms[name] = _algorithm(kind, steps, **settings)
    return algorithms


def _algorithm(kind: Any, steps: int, *, learning_rate: float, **setting: Any) -> Algorithm:
    """Return an algorithm; exploration in what learns from replay decays over the first half of the
    training."""
    common = {"gamma": GAMMA, "learning_rate": learning_rate}
    if kind is LOLA:
        return LOLA(settings=LOLASettings(**common, **setting))
    if "entropy_coeff" in setting:
        return kind(settings=RolloutSettings(**common), **setting)
    replay = {**common, "buffer_size": 50_000, "epsilon_decay_steps": steps // 2}
    if kind is PR2:  # with an entropy bonus agents are paid for every step that the board lives
        return PR2(settings=DQNSettings(**replay), entropy_bonus=False, **setting)
    return kind(settings=DQNSettings(**replay, **setting))


def agents_of(algorithm: Algorithm, agents: int) -> tuple[AgentSpec, ...]:
    """Return all agents of a game learning by an algorithm; teams that need not share a reward do not."""
    if not isinstance(algorithm, TeamAlgorithm):
        return (Learning(algorithm),) * agents
    reward = "team" if algorithm.shares_reward else "individual"
    return (Team(algorithm, tuple(range(agents)), reward=reward),)


def study(
    board: Board, algorithms: Mapping[str, Algorithm], experiment: Mapping[str, Any], **fields: Any
) -> cprl.Study:
    """Return a study with a condition for each algorithm, by the rules of the published study as run.

    Args:
        algorithms: by the name of the condition.
        experiment: fields of the experiment.
        fields: of the study.
    """
    game = presets.game(board, variant="as_run")
    agents = {name: agents_of(algorithm, game.agents) for name, algorithm in algorithms.items()}
    base = cprl.Experiment(
        name=f"learners_{board}", game=game, agents=next(iter(agents.values())), **experiment
    )
    conditions = {name: {"agents": specs} for name, specs in agents.items()}
    return cprl.Study(base, conditions=conditions, **fields)


def winners(table: StudyTable) -> dict[str, str]:
    """Return the candidate of each way that gets most in fresh worlds, from the table of a tuning.

    Candidates that were not trained are not chosen, which is said.
    """
    best: dict[str, tuple[float, str]] = {}
    harvests = estimates(table.windows("evaluation"), "collective_return", by="condition")
    for condition in table.design.conditions:
        way, _, candidate = condition.partition(": ")
        harvest = harvests.get((condition, "collective_return"))
        if harvest is None:
            say(f"Not evaluated, and not chosen from: {condition}")
        elif way not in best or harvest.value > best[way][0]:
            best[way] = (harvest.value, candidate)
    return {way: candidate for way, (_, candidate) in best.items()}


def print_winners(path: Path) -> None:
    """Print the `winners` of the table of a tuning, if it is there."""
    if path.exists():
        for way, candidate in winners(StudyTable.read(path)).items():
            print(f"{way}: {candidate}")


def tuning(board: Board) -> cprl.Study:
    """Return the study of every candidate of every way, on seeds that no other study has."""
    steps = 150_000
    return study(
        board,
        {
            f"{way}: {candidate}": algorithm
            for way in WAYS
            for candidate, algorithm in candidates(way, steps).items()
        },
        {"seed": 1000, "episodes": steps // 1000, "evaluation_episodes": 20},
        replicas=2,
        name=f"learners_tuning_{board}",
        question="Which settings suit which way to learn?",
        expectation=(
            "The higher learning rates for what learns from replay, since 150,000 steps are few; chosen is, "
            "for each way, the candidate with the highest mean return in the evaluation."
        ),
    )


def comparison(board: Board, chosen: Mapping[str, str], episodes: Mapping[str, int]) -> cprl.Study:
    """Return the study of the chosen candidate of every way, and of the DQN of the published study, whose
    course is known.

    Args:
        chosen: the name of a candidate by way.
        episodes: by way, as many as it takes for a million steps of each replica; "" for all others.
    """
    algorithms = {way: candidates(way, STEPS)[chosen[way]] for way in WAYS}
    algorithms["DQN as run"] = DQN(settings=presets.dqn_settings(board, variant="as_run"))
    short = study(
        board,
        algorithms,
        {"seed": 0, "episodes": episodes[""], "evaluation_episodes": 50},
        replicas=5,
        reference="DQN",
        name=f"learners_{board}",
        question="How do learners that see others do on a commons, beside those that do not?",
        expectation=(
            "Teams that share a reward (VDN, QMIX, MAPPO) harvest most and deplete least; of the others "
            "those with rollouts deplete first. MADDPG, PR2 and LOLA do about as DQN and PPO do: they know "
            "more of the others, but want the same."
        ),
    )
    longer = {
        way: {**changes, "episodes": episodes.get(way, episodes[""])}
        for way, changes in short.conditions.items()
    }
    return replace(short, conditions=longer)
