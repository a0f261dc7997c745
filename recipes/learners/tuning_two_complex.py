"""Which settings suit which way to learn on `two_complex`? Four candidates for each of nine ways.

python recipes/learners/tuning_two_complex.py --jobs 2
"""

from ways import tuning

import cprl

STUDY = tuning("two_complex")

if __name__ == "__main__":
    cprl.study_main(STUDY)
