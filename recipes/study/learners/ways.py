"""Nine ways to learn on two boards: what is compared, and with which settings.

Each way has four candidates for its settings, the same number for all, and they are chosen on seeds that the
comparison does not use: tuning_BOARD.py beside this file trains every candidate and prints which one won.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product
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


def replay(learning_rate: float, *, steps: int, **more: Any) -> DQNSettings:
    """Settings of whatever learns from replay; exploration decays over the first half of the training."""
    return DQNSettings(
        gamma=GAMMA,
        learning_rate=learning_rate,
        buffer_size=50_000,
        epsilon_decay_steps=steps // 2,
        **more,
    )


def rollouts(learning_rate: float) -> RolloutSettings:
    """Settings of whatever learns from rollouts."""
    return RolloutSettings(gamma=GAMMA, learning_rate=learning_rate)


@dataclass(frozen=True)
class Way:
    """A way to learn: the two values of each of two settings, and the algorithm with one of each."""

    grid: dict[str, tuple[Any, Any]]
    make: Callable[..., Algorithm]

    def candidates(self, steps: int) -> dict[str, Algorithm]:
        """The four algorithms by name, for a training of so many steps."""
        made = {}
        for values in product(*self.grid.values()):
            chosen = dict(zip(self.grid, values, strict=True))
            name = ", ".join(f"{field.replace('_', ' ')} {value}" for field, value in chosen.items())
            made[name] = self.make(steps=steps, **chosen)
        return made


REPLAY_GRID: Final = {"learning_rate": (1e-4, 1e-3), "tau": (None, 0.005)}
ROLLOUT_GRID: Final = {"learning_rate": (3e-4, 1e-3), "entropy_coeff": (0.01, 0.05)}


def off_policy(kind: Callable[..., Algorithm]) -> Way:
    """DQN, VDN or QMIX."""
    return Way(
        REPLAY_GRID,
        lambda *, steps, learning_rate, tau: kind(settings=replay(learning_rate, steps=steps, tau=tau)),
    )


def on_policy(kind: Callable[..., Algorithm]) -> Way:
    """PPO, IPPO or MAPPO."""
    return Way(
        ROLLOUT_GRID,
        lambda *, steps, learning_rate, entropy_coeff: kind(
            settings=rollouts(learning_rate), entropy_coeff=entropy_coeff
        ),
    )


WAYS: Final[dict[str, Way]] = {
    "DQN": off_policy(DQN),
    "PPO": on_policy(PPO),
    "IPPO": on_policy(IPPO),
    "VDN": off_policy(VDN),
    "QMIX": off_policy(QMIX),
    "MAPPO": on_policy(MAPPO),
    "MADDPG": Way(
        {"learning_rate": (1e-4, 1e-3), "tau": (0.005, 0.02)},
        lambda *, steps, learning_rate, tau: MADDPG(settings=replay(learning_rate, steps=steps, tau=tau)),
    ),
    "PR2": Way(
        {"learning_rate": (1e-4, 1e-3), "temperature": (0.02, 0.1)},
        lambda *, steps, learning_rate, temperature: PR2(
            settings=replay(learning_rate, steps=steps),
            temperature=temperature,
            entropy_bonus=False,  # with it agents are paid for every step that the board lives
        ),
    ),
    "LOLA": Way(
        {"learning_rate": (1e-3, 1e-2), "look_ahead_rate": (0.01, 0.05)},
        lambda *, steps, learning_rate, look_ahead_rate: LOLA(
            settings=LOLASettings(gamma=GAMMA, learning_rate=learning_rate, look_ahead_rate=look_ahead_rate)
        ),
    ),
}


def agents_of(algorithm: Algorithm, agents: int) -> tuple[AgentSpec, ...]:
    """All agents of a game learning by an algorithm; teams that need not share a reward do not."""
    if not isinstance(algorithm, TeamAlgorithm):
        return (Learning(algorithm),) * agents
    reward = "team" if algorithm.shares_reward else "individual"
    return (Team(algorithm, tuple(range(agents)), reward=reward),)


def study(board: Board, algorithms: dict[str, Algorithm], **how: Any) -> cprl.Study:
    """A study with a condition for each algorithm, by the rules of the published study as run.

    Args:
        board: its board.
        algorithms: by the name of the condition.
        how: the rest of the experiment and of the study.
    """
    game = presets.game(board, variant="as_run")
    fields = {"seed", "episodes", "evaluation_episodes"}
    first, *_ = algorithms.values()
    base = cprl.Experiment(
        name=f"learners_{board}",
        game=game,
        agents=agents_of(first, game.agents),
        **{name: how.pop(name) for name in fields & set(how)},
    )
    conditions = {name: {"agents": agents_of(own, game.agents)} for name, own in algorithms.items()}
    return cprl.Study(base, conditions=conditions, **how)


def winners(table: StudyTable) -> dict[str, str]:
    """The candidate of each way that gets most in fresh worlds, from the table of a tuning.

    Candidates that were not trained are not chosen, which is said.
    """
    best: dict[str, tuple[float, str]] = {}
    harvests = estimates(table.windows("evaluation"), "collective_return", by="condition")
    for condition in table.design.conditions:
        way, _, candidate = condition.partition(": ")
        harvest = harvests.get((condition, "collective_return"))
        if harvest is None:
            say(f"Not evaluated, and not chosen from: {condition}")
        else:
            best[way] = max(best.get(way, (float("-inf"), "")), (harvest.value, candidate))
    return {way: candidate for way, (_, candidate) in best.items()}


def tuning(board: Board) -> cprl.Study:
    """Every candidate of every way, on seeds of its own."""
    steps = 150_000
    return study(
        board,
        {
            f"{way}: {candidate}": algorithm
            for way, own in WAYS.items()
            for candidate, algorithm in own.candidates(steps).items()
        },
        seed=1000,
        replicas=2,
        episodes=steps // 1000,
        evaluation_episodes=20,
        name=f"learners_tuning_{board}",
        question="Which settings suit which way to learn?",
        expectation=(
            "The higher learning rates for what learns from replay, since 150,000 steps are few; chosen is, "
            "for each way, the candidate with the highest mean return in the evaluation."
        ),
    )


AS_RUN: Final = "DQN as run"


def comparison(board: Board, chosen: Mapping[str, str], episodes: Mapping[str, int]) -> cprl.Study:
    """The chosen candidate of every way, and the DQN of the published study, whose course is known.

    Args:
        board: its board.
        chosen: the name of a candidate by way.
        episodes: by way, as many as it takes for a million steps of each replica; "" for all others.
    """
    algorithms = {way: own.candidates(STEPS)[chosen[way]] for way, own in WAYS.items()}
    algorithms[AS_RUN] = DQN(settings=presets.dqn_settings(board, variant="as_run"))
    made = study(
        board,
        algorithms,
        seed=0,
        episodes=episodes[""],
        evaluation_episodes=50,
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
        way: {**own, "episodes": episodes.get(way, episodes[""])} for way, own in made.conditions.items()
    }
    return replace(made, conditions=longer)
