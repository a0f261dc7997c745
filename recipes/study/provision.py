"""Does what helps appropriation help provision, too, a commons that must be kept up?

    python recipes/study/provision.py --jobs 1

The cleanup of sequential_social_dilemma_games: apples grow only while somebody cleans the river, which pays
nobody. Five PPO agents learn from half a million steps of 16 worlds, without institutions, and under those
that help on the commons: a quota, a tax shared equally, graduated sanctions for being tagged, the fines of
the original; and, for what is possible, with the reward of the whole team.
"""

from dataclasses import replace
from typing import Any, Final

import cprl
from cprl import presets
from cprl.algorithms import PPO, RolloutSettings
from cprl.institutions import GraduatedSanctions, Punishment, Quota, Tax
from cprl.population import Learning

SETTINGS: Final = RolloutSettings(
    gamma=0.99, learning_rate=1e-3, rollout_steps=64, minibatch_size=512, epochs=4
)
AGENT: Final = Learning(PPO(settings=SETTINGS, entropy_coeff=0.02))
ORIGINAL: Final = presets.game("ssd/cleanup-v1")
GAME: Final = replace(ORIGINAL, institutions=())

CONDITIONS: Final[dict[str, dict[str, Any]]] = {
    "nothing": {},
    "quota": {"game.institutions": (Quota(share=0.25, window_steps=50),)},
    "shared tax": {"game.institutions": (Tax(rate=0.5, redistribution="equal"),)},
    "graduated sanctions": {"game.institutions": (GraduatedSanctions(on="tags"),)},
    "fines": {"game.institutions": (Punishment(fine=50.0, cost=0.0, shot_cost=1.0),)},
    "team reward": {"agents": (replace(AGENT, reward="team"),) * 5},
}

STUDY: Final = cprl.Study(
    cprl.Experiment(
        name="provision",
        game=GAME,
        agents=(AGENT,) * 5,
        steps=500_000,
        replicas=8,
        worlds=16,
        evaluation_episodes=20,
    ),
    conditions=CONDITIONS,
    replicas=8,
    block=8,
    reference="nothing",
    question="Do institutions that help appropriation help provision, too?",
    expectation=(
        "With nothing, agents learn to pick and nobody to clean, so the harvest falls below that of random "
        "play, about 21 apples. A quota and graduated sanctions do not help, since they change what picking "
        "pays and not what cleaning does. A shared tax helps a little, since the cleaner gets a part of what "
        "others pick. The fines of the original teach agents not to fire, and nothing else. With the reward "
        "of the team agents learn to clean, and harvest several times as much as with nothing."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
