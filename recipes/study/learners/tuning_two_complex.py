"""Which settings suit which way to learn on `two_complex`? Four candidates for each of nine ways.

python recipes/study/learners/tuning_two_complex.py --jobs 2
"""

from ways import print_winners, tuning

import cprl

STUDY = tuning("two_complex")

if __name__ == "__main__":
    print_winners(cprl.study_main(STUDY) / "table.parquet")
