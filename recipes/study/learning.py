"""How strongly do results depend on how agents learn? Replay size, batch size and learning rate.

python recipes/study/learning.py --jobs 2
"""

from base import EXPERIMENT

import cprl

BY = "agents.*.algorithm.settings"

STUDY = cprl.Study(
    EXPERIMENT,
    conditions={
        "as it is": {},
        **{f"replay of {size:,}": {f"{BY}.buffer_size": size} for size in (1_000, 10_000)},
        **{f"batch of {size}": {f"{BY}.batch_size": size} for size in (2, 32)},
        **{f"learning rate {rate:g}": {f"{BY}.learning_rate": rate} for rate in (1e-5, 3e-5, 3e-4, 1e-3)},
    },
    name="learning",
    question=(
        "The published study says that results vary strongly with replay, batch and learning rate. "
        "How strongly?"
    ),
    expectation=(
        "Most with the learning rate: at 1e-5 two hundred episodes are too few for any tragedy, at 3e-4 "
        "it comes earlier and as deep. A larger batch acts like a higher learning rate, more weakly. The "
        "size of the replay buffer changes little, since all fit a good part of what was played."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
