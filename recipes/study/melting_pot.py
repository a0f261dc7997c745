"""What do agents learn on Melting Pot's open commons? Independent PPO with shared parameters, in many worlds.

    python recipes/study/melting_pot.py --steps 20_000_000

Numbers of SocialJax' IPPO on its harvest_open, as far as they have one here: 256 worlds, a learning rate of
0.0005, 2 epochs, a discount of 0.99, an entropy weight of 0.01; it learns for 1e8 steps with a convolutional
network, this with two layers of 64.
"""

import cprl
from cprl import presets
from cprl.algorithms import IPPO, RolloutSettings
from cprl.population import Team


def experiment() -> cprl.Experiment:
    """Seven agents, each paid what it harvests, that learn one policy from the experience of all."""
    settings = RolloutSettings(
        gamma=0.99,
        learning_rate=5e-4,
        rollout_steps=64,
        minibatch_size=2048,
        epochs=2,
        hidden_cells=(64, 64),
    )
    return cprl.Experiment(
        name="melting_pot",
        game=presets.game("melting_pot/commons_harvest__open-v1"),
        agents=(
            Team(
                IPPO(settings=settings, entropy_coeff=0.01),
                agents=tuple(range(7)),
                reward="individual",
                share_parameters=True,
            ),
        ),
        steps=100_000_000,
        engine="compiled",
        replicas=2,
        worlds=256,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
