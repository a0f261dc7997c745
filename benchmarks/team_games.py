"""MADDPG, independent DQN and independent PPO on matrix games: what agents get by their policies in the end.

Every game is played once a turn. An agent's return is that of its policy against those of the others: sampled
actions of MADDPG and PPO, the best action of DQN. "agree" is the game of proposition 1 of Lowe et al. (2017)
for six agents: 1 if all do the same; "penalty" and "climbing" are those of Claus and Boutilier (1998), with
k = 0; "stag hunt" that of Leibo et al. (2017).

    python benchmarks/team_games.py
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from cprl.agents import Population
from cprl.algorithms import DQN, MADDPG, PPO, DQNSettings, RolloutSettings
from cprl.envs import make_env
from cprl.envs.matrix import MatrixGame, stag_hunt
from cprl.population import AgentSpec, Learning, Team

REPLAY = DQNSettings(
    buffer_size=5000,
    batch_size=32,
    learning_starts=100,
    hidden_cells=(64, 64),
    gamma=0.95,
    learning_rate=3e-3,
    tau=0.01,
    epsilon_hold_steps=0,
    epsilon_decay_steps=1000,
    epsilon_end=0.05,
    epsilon_evaluation=0.0,
)
ROLLOUTS = RolloutSettings(
    rollout_steps=100, minibatch_size=50, hidden_cells=(64, 64), learning_rate=1e-3, gamma=0.95
)


def cooperative(table: Any, agents: int = 2) -> MatrixGame:
    """A game that pays all agents the same."""
    return MatrixGame(np.repeat(np.asarray(table, float)[..., None], agents, -1))


def agree(agents: int) -> MatrixGame:
    """Pays 1 if all of N agents choose the same of two actions."""
    table = np.zeros((2,) * agents)
    table[(0,) * agents] = table[(1,) * agents] = 1.0
    return cooperative(table, agents)


GAMES = {
    "agree": (agree(6), 1.0),
    "penalty": (cooperative([[10, 0, 0], [0, 2, 0], [0, 0, 10]]), 10.0),
    "climbing": (cooperative([[11, -30, 0], [-30, 7, 6], [0, 0, 5]]), 11.0),
    "stag hunt": (stag_hunt(), 4.0),
}
"""Each with the best return."""


def specs(name: str, agents: int) -> list[AgentSpec]:
    """All agents of a game by one algorithm."""
    if name == "MADDPG":
        return [Team(MADDPG(settings=REPLAY), tuple(range(agents)), reward="individual")]
    return [Learning(DQN(settings=REPLAY) if name == "DQN" else PPO(settings=ROLLOUTS))] * agents


def returns(game: MatrixGame, name: str, *, turns: Sequence[int], replicas: int, seed: int) -> list[Any]:
    """The return of the first agent in each replica, after each number of turns."""
    env = make_env(game, worlds=replicas, seed=seed)
    (learner,) = Population(env, specs(name, game.agents), seed=seed, engine="eager").learners.values()
    moment, found = env.reset(), []
    for turn in range(1, max(turns) + 1):
        moment["agents", "action"] = learner.actor.choose(moment["agents", "observation"])
        now, moment = env.step_and_maybe_reset(moment)
        learner.store(now)
        learner.update()
        if turn in turns:
            found.append([_value(game, own) for own in _policies(learner, moment, name)])
    return found


def _policies(learner: Any, moment: Any, name: str) -> Any:
    """The probabilities of actions, [R, N, A]."""
    given = learner.evaluation_actor(1).preferences(moment["agents", "observation"])
    best = torch.nn.functional.one_hot(given.argmax(-1), given.shape[-1]).float()
    return (best if name == "DQN" else given).numpy()


def _value(game: MatrixGame, policies: Any) -> float:
    """What the first agent gets on average."""
    value = np.asarray(game.payoffs)
    for own in policies:
        value = np.tensordot(own, value, 1)
    return float(value[0])


def main(
    *,
    turns: tuple[int, ...] = (500, 1500, 3000),
    replicas: int = 10,
    seed: int = 1,
    only: tuple[str, ...] = (),
) -> None:
    """Prints the mean return over replicas, and how many replicas have at least 0.9 of the best.

    Args:
        turns: after how many turns.
        replicas: independent trainings.
        seed: of all.
        only: which games; by default all.
    """
    torch.set_num_threads(1)
    table = Table("game", "best", "algorithm", *(f"{count:,} turns" for count in turns))
    for name in only or GAMES:
        game, best = GAMES[name]
        for algorithm in ("MADDPG", "DQN", "PPO"):
            found = returns(game, algorithm, turns=turns, replicas=replicas, seed=seed)
            good = [sum(own >= 0.9 * best for own in each) for each in found]
            cells = (f"{np.mean(own):.2f} ({count})" for own, count in zip(found, good, strict=True))
            table.add_row(name, f"{best:g}", algorithm, *cells)
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
