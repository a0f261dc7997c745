"""Does combat stay under other discounts, losses and optimisers? The study's claim, over 24 versions of it.

    python recipes/study/combat.py --jobs 2 --runs studies/runs

Every version that the study's program of April 2019 could have been, by the published rules as run and the
published schedule of exploration: squared error first, by Adam under all discounts and target periods, then
by RMSprop, then log-cosh likewise. A study that is stopped has run its conditions in this order.

Each trial, 4 replicas of 2,600 episodes, takes up to an hour of a core and 0.8 GB: 1.4 ms of a core a step,
measured over 21,000 steps by Adam and 8,000 by RMSprop with log-cosh while other trainings ran, and at most
2.6 million steps, fewer where boards die early. All 24 take 17 to 24 core hours. Those of gamma 0.997 are the
first four replicas of `experiment_5.py`, which finds them finished in the same directory of runs.
"""

from dataclasses import replace

from base import PUBLISHED

import cprl

BY = "agents.*.algorithm"

STUDY = cprl.Study(
    replace(PUBLISHED, episodes=2600),
    {
        f"{BY}.loss_function": ["l2", "log_cosh"],
        f"{BY}.settings.optimizer": ["adam", "keras_rmsprop"],
        f"{BY}.settings.gamma": [0.997, 0.995, 0.99],
        f"{BY}.settings.target_every_episodes": [3, 10],
    },
    replicas=4,
    block=4,
    name="combat",
    question="Does combat follow the tragedy under other discounts, losses, optimisers and target periods?",
    expectation=(
        "The tragedy comes in every cell. Combat after it, a volatile harvest that climbs while many are "
        "out of play, is the exception in each: at most two of four replicas, more often with targets "
        "every 3 episodes than every 10, and more often with 0.995 and 0.997 than with 0.99, whose agents "
        "fall deepest and have not recovered by episode 2,600. The loss changes nothing that four "
        "replicas can show, since errors are small and both optimisers divide by the size of gradients. "
        "RMSprop, which forgets that size a hundred times faster than Adam and averages no gradients, "
        "moves the fall earlier or later by less than 200 episodes, and makes curves more volatile. So "
        "the claim, that combat stays, will hold in the sense that some replica of most cells shows it, "
        "not as the usual course of any."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
