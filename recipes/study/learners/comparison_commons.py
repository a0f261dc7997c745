"""How do learners that see others do on `commons`? Nine ways to learn, and the study's own.

    python recipes/study/learners/comparison_commons.py --jobs 2

Every replica plays a million environment steps or more. Who exploits whom is the question of cross_play.py,
on the runs of this study.
"""

from ways import comparison

import cprl

CHOSEN = {
    "DQN": "learning rate 0.001, tau 0.005",
    "PPO": "learning rate 0.001, entropy coeff 0.05",
    "IPPO": "learning rate 0.0003, entropy coeff 0.05",
    "VDN": "learning rate 0.001, tau None",
    "QMIX": "learning rate 0.0001, tau None",
    "MAPPO": "learning rate 0.0003, entropy coeff 0.01",
    "MADDPG": "learning rate 0.001, tau 0.02",
    "PR2": "learning rate 0.001, temperature 0.1",
    "LOLA": "learning rate 0.001, look ahead rate 0.01",
}
"""The candidates that tuning_commons.py chose; its table is in docs/results/learners."""

EPISODES = {
    "": 1100,
    "DQN": 1600,
    "PPO": 2000,
    "IPPO": 2000,
    "QMIX": 1010,
    "MADDPG": 1180,
    "PR2": 1200,
    "DQN as run": 1050,
}
"""So many that a replica reaches its million: more where boards were drained early in the tuning."""

STUDY = comparison("commons", CHOSEN, EPISODES)

if __name__ == "__main__":
    cprl.study_main(STUDY)
