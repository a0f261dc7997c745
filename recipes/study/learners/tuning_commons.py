"""Which settings suit which way to learn on `commons`? Four candidates for each of nine ways.

python recipes/study/learners/tuning_commons.py --jobs 2
"""

from ways import print_winners, tuning

import cprl

STUDY = tuning("commons")

if __name__ == "__main__":
    print_winners(cprl.study_main(STUDY) / "table.parquet")
