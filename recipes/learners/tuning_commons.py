"""Which settings suit which way to learn on `commons`? Four candidates for each of nine ways.

python recipes/learners/tuning_commons.py --jobs 2
"""

from ways import tuning

import cprl

STUDY = tuning("commons")

if __name__ == "__main__":
    cprl.study_main(STUDY)
