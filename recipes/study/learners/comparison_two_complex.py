"""How do learners that see others do on `two_complex`? Nine ways to learn, and the study's own.

    python recipes/study/learners/comparison_two_complex.py --jobs 2

Every replica plays a million environment steps or more; all take some four core hours. Who exploits whom is
the question of cross_play.py, on the runs of this study.
"""

from ways import comparison

import cprl

CHOSEN = {
    "DQN": "learning rate 0.0001, tau 0.005",
    "PPO": "learning rate 0.001, entropy coeff 0.05",
    "IPPO": "learning rate 0.0003, entropy coeff 0.01",
    "VDN": "learning rate 0.0001, tau 0.005",
    "QMIX": "learning rate 0.0001, tau 0.005",
    "MAPPO": "learning rate 0.001, entropy coeff 0.01",
    "MADDPG": "learning rate 0.001, tau 0.02",
    "PR2": "learning rate 0.001, temperature 0.1",
    "LOLA": "learning rate 0.01, look ahead rate 0.01",
}
"""The candidates that tuning_two_complex.py chose; its table is in docs/results/learners."""

EPISODES = {
    "": 1500,
    "DQN": 1800,
    "PPO": 2200,
    "IPPO": 3700,
    "QMIX": 1300,
    "MAPPO": 1700,
    "MADDPG": 3300,
    "LOLA": 1300,
}
"""More where boards were drained early, in the tuning or in first tries, in which replicas of IPPO (3,400
episodes), MAPPO (1,300) and MADDPG (1,600) stayed below a million steps."""

STUDY = comparison("two_complex", CHOSEN, EPISODES)

if __name__ == "__main__":
    cprl.study_main(STUDY)
