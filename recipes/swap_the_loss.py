"""Two agents on `two_complex` that learn by one of six losses of TorchRL's; another loss is another line.

    python recipes/swap_the_loss.py --loss dqn              5 replicas of 1000 episodes
    python recipes/swap_the_loss.py --loss ppo
    PYTHONPATH=examples/own_algorithm python recipes/swap_the_loss.py --loss cql

"cql" and "iql" are algorithms of one's own; examples/own_loss.py has losses, DQN(settings=REPLAY, loss=...).
"""

from dataclasses import replace
from typing import Literal

import cprl
from cprl import Custom, presets
from cprl.algorithms import DQN, PPO, SAC, RolloutSettings
from cprl.population import Learning

REPLAY = replace(presets.dqn_settings("two_complex"), learning_rate=1e-4, epsilon_decay_steps=100_000)
"""The published settings, but for a schedule that fits 1000 episodes: ten times the step, a fifth of the
decay."""

LOSSES = {
    "dqn": DQN(settings=REPLAY),
    "double_dqn": DQN(settings=REPLAY, double=True),
    "cql": Custom("cql:CQL", arguments={"settings": REPLAY, "conservative_weight": 0.1}),
    "sac": SAC(settings=REPLAY),
    "iql": Custom("iql:IQL", arguments={"settings": REPLAY, "expectile": 0.7, "temperature": 3.0}),
    "ppo": PPO(settings=RolloutSettings()),
}


def experiment(*, loss: Literal["dqn", "double_dqn", "cql", "sac", "iql", "ppo"] = "dqn") -> cprl.Experiment:
    """Train two agents on `two_complex` by the same loss.

    Args:
        loss: by which both learn.
    """
    return cprl.Experiment(
        name=f"swap_the_loss_{loss}",
        game=presets.game("two_complex"),
        agents=(Learning(LOSSES[loss]),) * 2,
        episodes=1000,
        replicas=5,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
