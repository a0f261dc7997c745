"""What networks cost: a turn and the updates of agents that learn by PPO, and by DQN, beside the default.

CPU time of one thread; windows of `commons` (3 x 7 x 15), 8 actions. PPO has rollouts of 250 steps,
minibatches of 50, 4 epochs, "eager", so that none is compiled: a recurrent update of PPO never is. DQN has
one update a turn, of 8 transitions or 8 sequences, compiled as by default. All networks of an algorithm are
measured in one run, one after the other and again, and the best of several repeats counts.

    python benchmarks/networks.py
"""

import time
from collections.abc import Callable

import torch
import tyro
from rich.console import Console
from rich.table import Table

from cprl import CommonsEnv, presets
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.algorithms.base import Algorithm, TrainingEngine
from cprl.collectors import StepCollector
from cprl.learners.base import Learner
from cprl.learners.recurrent import COMPILED_STEPS
from cprl.networks import GRU, LSTM, MLP, Conv
from cprl.networks.specification import Network
from cprl.policies.assignment import AgentPolicies

NETWORKS: dict[str, Network] = {
    "MLP (32, 32)": MLP(hidden_cells=(32, 32)),
    "MLP (128, 128)": MLP(hidden_cells=(128, 128)),
    "Conv (16, 16), (32,)": Conv(),
    "GRU 32 after (32,)": GRU(),
    "LSTM 32 after (32,)": LSTM(),
    "GRU 32 after Conv": GRU(encoder=Conv()),
}
OF_DQN: dict[str, tuple[Network, int]] = {
    "MLP (32, 32)": (MLP(hidden_cells=(32, 32)), 1),
    "GRU, 8 turns": (GRU(), 8),
    f"GRU, {COMPILED_STEPS} turns": (GRU(), COMPILED_STEPS),
    f"GRU, {2 * COMPILED_STEPS} turns": (GRU(), 2 * COMPILED_STEPS),
    "LSTM, 8 turns": (LSTM(), 8),
}
"""Networks, and the turns of their sequences."""
SETTINGS = RolloutSettings()


def best(act: Callable[[], object], times: int) -> float:
    """Milliseconds of CPU time of the fastest of so many calls."""
    spent = []
    for _ in range(times):
        began = time.thread_time()
        act()
        spent.append(1000 * (time.thread_time() - began))
    return min(spent)


def prepared(
    algorithm: Algorithm, replicas: int, engine: TrainingEngine
) -> tuple[Learner, Callable[[], object]]:
    """A learner of all agents, and what plays and stores a turn."""
    env = CommonsEnv(presets.game("commons", variant="as_run"), replicas, seed=0)
    agents = tuple(range(env.game.agents))
    learner = algorithm.make_learner(env.game.spaces, agents=agents, replicas=replicas, engine=engine)
    turns = iter(StepCollector(env, AgentPolicies({agents: learner.actor})))
    return learner, lambda: learner.store(next(turns))


def measured(
    algorithms: dict[str, Algorithm],
    *,
    engine: TrainingEngine,
    replicas: int,
    repeats: int,
    turns: int,
    updates: int,
) -> None:
    """Prints the table of some algorithms.

    Args:
        algorithms: by the name of their network.
        engine: see `cprl.algorithms.base`.
        replicas: trained side by side.
        repeats: of which the best counts.
        turns: played in each.
        updates: after these turns.
    """
    learners = {name: prepared(own, replicas, engine) for name, own in algorithms.items()}
    turn, update = dict.fromkeys(algorithms, float("inf")), dict.fromkeys(algorithms, float("inf"))
    for _ in range(repeats):
        for name, (learner, play) in learners.items():
            turn[name] = min(turn[name], best(play, turns))
            update[name] = min(update[name], best(learner.update, updates))
    first = next(iter(algorithms))
    title = f"{type(algorithms[first]).__name__}, {replicas} replicas of 4 agents; ms of CPU time"
    table = Table(title=title)
    for column in ("network", "turn", "ratio", "updates", "ratio", "sum", "ratio"):
        table.add_column(column, justify="left" if column == "network" else "right")
    total = {name: turn[name] + update[name] * updates / turns for name in algorithms}
    for name in algorithms:
        cells = (
            f"{own[name]:.3g}" if kind == "ms" else f"{own[name] / own[first]:.2f}"
            for own in (turn, update, total)
            for kind in ("ms", "ratio")
        )
        table.add_row(name, *cells)
    Console().print(table)


def main(*, replicas: int = 8, repeats: int = 2) -> None:
    """Prints two tables: ms of a turn, of the updates after a rollout or a turn, and of both per turn.

    Args:
        replicas: trained side by side.
        repeats: of each network; the best counts.
    """
    torch.set_num_threads(1)
    sizes = {"replicas": replicas, "repeats": repeats}
    ppo = {name: PPO(settings=SETTINGS, network=network) for name, network in NETWORKS.items()}
    measured(ppo, **sizes, turns=SETTINGS.rollout_steps, updates=1, engine="eager")
    dqn = {
        name: DQN(
            settings=DQNSettings(buffer_size=20_000, learning_starts=64, sequence_steps=steps),
            network=network,
        )
        for name, (network, steps) in OF_DQN.items()
    }
    measured(dqn, **sizes, turns=100, updates=100, engine="compiled")


if __name__ == "__main__":
    tyro.cli(main)
