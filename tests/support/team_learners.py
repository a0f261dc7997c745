"""Algorithms of teams in small."""

from small_learners import REPLAY, ROLLOUTS

from cprl.algorithms import IPPO, MADDPG, MAPPO, QMIX, VDN

TEAMS = {
    "VDN": VDN(settings=REPLAY),
    "QMIX": QMIX(settings=REPLAY, mixing_cells=6),
    "MAPPO": MAPPO(settings=ROLLOUTS),
    "IPPO": IPPO(settings=ROLLOUTS),
    "MADDPG": MADDPG(settings=REPLAY),
}
FOUR = tuple(range(4))
