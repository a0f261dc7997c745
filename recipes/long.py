"""A long training: four PPO agents on `commons` learn from a hundred million steps of 256 worlds.

    python recipes/long.py                           4 replicas, about five hours on one core
    python recipes/long.py --replicas 1              about 70 minutes
    python recipes/long.py --resume --out runs/...   after a stop, bit for bit as if there had been none

The study trained its agents for 4.8 million steps of one world. A step is a turn of one world, in which all
four agents act; each replica learns from all of its worlds.
"""

import cprl
from cprl import presets
from cprl.algorithms import PPO, RolloutSettings
from cprl.population import Learning


def experiment() -> cprl.Experiment:
    """Train four independent PPO agents on `commons`, by the rules of the study as run."""
    settings = RolloutSettings(rollout_steps=64, minibatch_size=2048, epochs=4)
    return cprl.Experiment(
        name="long",
        game=presets.game("commons", variant="as_run"),
        agents=(Learning(PPO(settings=settings)),) * 4,
        steps=100_000_000,
        engine="compiled",
        replicas=4,
        worlds=256,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
