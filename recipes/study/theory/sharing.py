"""Do independent learners end at the equilibrium? The herders' game and appropriation, repeated.

    python recipes/study/theory/sharing.py --kind appropriation --learner tables --watch off

Agents know only what they were paid: they do not observe what was taken (`memory=0`), and count the present
turn alone (`gamma=0`), so that theory has one answer, the equilibrium of the game of one turn. With
`--memory 1` they see the last turn, with a higher gamma the future counts, and both let them answer each
other. recipes/study/theory/where_learners_end.py plays all of them, measures what they take and draws it.
"""

from typing import Literal

from sharing_games import SharingGame, appropriation, herders
from taking_games import TakingGame

import cprl
from cprl.algorithms import PPO, Algorithm, RolloutSettings, Tabular, TabularSettings
from cprl.population import Learning

Kind = Literal["herders", "appropriation"]
Learner = Literal["tables", "PPO"]
TURNS = 50
EPISODES = 150


def sharing_of(kind: Kind, herd: int) -> SharingGame:
    """Return the game of so many agents."""
    return herders(herd) if kind == "herders" else appropriation(herd)


def algorithm_of(learner: Learner, gamma: float) -> Algorithm:
    """Return how an agent learns; exploration ends after 5,000 of 7,500 turns."""
    if learner == "tables":
        return Tabular(
            settings=TabularSettings(
                gamma=gamma,
                epsilon_hold_steps=0,
                epsilon_decay_steps=5000,
                epsilon_end=0.02,
                epsilon_evaluation=0.0,
            )
        )
    settings = RolloutSettings(gamma=gamma, rollout_steps=TURNS, minibatch_size=25, learning_rate=3e-3)
    return PPO(settings=settings, entropy_coeff=0.001)


def experiment(
    *,
    kind: Kind = "herders",
    herd: int = 5,
    learner: Learner = "tables",
    wants: Literal["individual", "team"] = "individual",
    memory: int = 0,
    gamma: float = 0.0,
) -> cprl.Experiment:
    """Return independent learners who choose, turn after turn, how much they take of what they share.

    Args:
        kind: herders on a pasture, or appropriation as in the laboratory.
        herd: how many agents there are.
        learner: tables of action values, or PPO.
        wants: what an agent is paid, or what all are paid together.
        memory: how many of the last turns they see.
        gamma: how much the next turn counts.
    """
    return cprl.Experiment(
        name=f"{kind}_{herd}_{learner}_{wants}",
        game=TakingGame(sharing_of(kind, herd), turns=TURNS, memory=memory),
        agents=(Learning(algorithm_of(learner, gamma), reward=wants),) * herd,
        episodes=EPISODES,
        replicas=8,
        evaluation_episodes=1,
        engine="eager",
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
