"""The iterated prisoner's dilemma learned from samples by naive policy gradients, by LOLA and by LOLA-DiCE.

The settings of the gates in tests/test_lola.py: ten replicas, episodes of 20 turns, rollouts of 1,000 turns,
gamma 0.96; policies are tables of logits, as in the paper, or with `--network linear` one linear layer with a
bias.

    python benchmarks/lola_dilemma.py --updates 40
"""

import sys
import time
from pathlib import Path
from typing import Literal

import torch
import tyro

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))


def main(
    *,
    estimator: Literal["policy_gradient", "dice"] = "policy_gradient",
    look_ahead_rate: float = 2.0,
    learning_rate: float = 0.2,
    updates: int = 40,
    network: Literal["table", "linear"] = "table",
) -> None:
    """Prints the mean payoff a turn over the last tenth of training.

    Args:
        estimator: how the others' step is judged.
        look_ahead_rate: their step size; 0 is naive learning.
        learning_rate: of plain gradient descent.
        updates: how many.
        network: of policies and critics.
    """
    from test_lola import course

    torch.set_num_threads(1)
    began = time.perf_counter()
    rates = {"look_ahead_rate": look_ahead_rate, "learning_rate": learning_rate}
    found = course(estimator, updates=updates, is_table=network == "table", **rates)
    took = time.perf_counter() - began
    print(f"{estimator}, {network}, {updates} updates, {rates}, {took:.0f} s:")
    print(f"{found.mean():.3f} (sd {found.std(ddof=1):.3f}), {(found > -1.5).mean():.0%} above -1.5")


if __name__ == "__main__":
    tyro.cli(main)
