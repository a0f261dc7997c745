"""What networks cost: one turn and one rollout's updates of agents that learn by PPO, beside the default.

CPU time of one thread; windows of `commons` (3 x 7 x 15), 8 actions; rollouts of 250 steps, minibatches of
50, 4 epochs. All networks in one run, one after the other and again, the best of several repeats. "eager" so
that none is compiled: a recurrent update never is.

    python benchmarks/networks.py
"""

import time
from collections.abc import Callable

import torch
import tyro
from rich.console import Console
from rich.table import Table

from cprl import CommonsEnv, presets
from cprl.algorithms import PPO, RolloutSettings
from cprl.collectors import StepCollector
from cprl.learners.base import Learner
from cprl.networks import GRU, MLP, Conv
from cprl.networks.specification import Network
from cprl.policies.assignment import AgentPolicies

NETWORKS: dict[str, Network] = {
    "MLP (32, 32)": MLP(hidden_cells=(32, 32)),
    "MLP (128, 128)": MLP(hidden_cells=(128, 128)),
    "Conv (16, 16), (32,)": Conv(),
    "GRU 32 after (32,)": GRU(),
    "GRU 32 after Conv": GRU(encoder=Conv()),
}
SETTINGS = RolloutSettings()


def best(act: Callable[[], object], times: int) -> float:
    """Milliseconds of CPU time of the fastest of so many calls."""
    spent = []
    for _ in range(times):
        began = time.thread_time()
        act()
        spent.append(1000 * (time.thread_time() - began))
    return min(spent)


def prepared(network: Network, replicas: int) -> tuple[Learner, Callable[[], object]]:
    """A learner of all agents, and what plays and stores a turn."""
    env = CommonsEnv(presets.game("commons", variant="as_run"), replicas, seed=0)
    agents = tuple(range(env.game.agents))
    learner = PPO(settings=SETTINGS, network=network).make_learner(
        env.game.spaces, agents=agents, replicas=replicas, engine="eager"
    )
    turns = iter(StepCollector(env, AgentPolicies({agents: learner.actor})))
    return learner, lambda: learner.store(next(turns))


def main(*, replicas: int = 8, repeats: int = 2) -> None:
    """Prints a table: ms of a turn, of the updates after a rollout, and of both per turn.

    Args:
        replicas: trained side by side.
        repeats: rollouts of each network; the best counts.
    """
    torch.set_num_threads(1)
    learners = {name: prepared(network, replicas) for name, network in NETWORKS.items()}
    turn, update = dict.fromkeys(NETWORKS, float("inf")), dict.fromkeys(NETWORKS, float("inf"))
    for _ in range(repeats):
        for name, (learner, play) in learners.items():
            turn[name] = min(turn[name], best(play, SETTINGS.rollout_steps))
            update[name] = min(update[name], best(learner.update, 1))
    first = next(iter(NETWORKS))
    table = Table(title=f"{replicas} replicas of 4 agents; ms of CPU time")
    for column in ("network", "turn", "ratio", "updates", "ratio", "sum", "ratio"):
        table.add_column(column, justify="left" if column == "network" else "right")
    total = {name: turn[name] + update[name] / SETTINGS.rollout_steps for name in NETWORKS}
    for name in NETWORKS:
        cells = (
            f"{own[name]:.3g}" if kind == "ms" else f"{own[name] / own[first]:.2f}"
            for own in (turn, update, total)
            for kind in ("ms", "ratio")
        )
        table.add_row(name, *cells)
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
