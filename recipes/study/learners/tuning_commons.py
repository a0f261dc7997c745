"""Which settings suit which way to learn on `commons`? Four candidates for each of nine ways.

python recipes/study/learners/tuning_commons.py --jobs 2
"""

from ways import tuning, winners

import cprl
from cprl.studies import StudyTable

STUDY = tuning("commons")

if __name__ == "__main__":
    TABLE = cprl.study_main(STUDY) / "table.parquet"
    for way, candidate in winners(StudyTable.read(TABLE)).items() if TABLE.exists() else ():
        print(f"{way}: {candidate}")
