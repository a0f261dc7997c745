"""Which settings suit which way to learn on `two_complex`? Four candidates for each of nine ways.

python recipes/study/learners/tuning_two_complex.py --jobs 2
"""

from ways import tuning, winners

import cprl
from cprl.studies import StudyTable

STUDY = tuning("two_complex")

if __name__ == "__main__":
    TABLE = cprl.study_main(STUDY) / "table.parquet"
    for way, candidate in winners(StudyTable.read(TABLE)).items() if TABLE.exists() else ():
        print(f"{way}: {candidate}")
