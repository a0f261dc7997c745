"""Studies: one experiment under many conditions.

Modules, in the order in which one reads them:
    factors      levels and distributions, by the places of values in an experiment; the same as words
    study        Study: factors, replicas; a value. Its conditions and its directory
    status       what a trial says of itself while it runs
    trials       one run of a study, and the process that makes a finished run of its directory
    executors    where trials are run
    progress     how far every trial is, in the terminal
    run          run_study: every trial of a study
    search       run_search: points that Optuna proposes, each run as a condition
    tables       what came out, as one tidy table; means and differences
    figures      drawn of a table
    results      write_results: table, summary and figures of a study
    report       an HTML page about a run or a study
    exploit      exploitability: trains best responses, a study; play_responses, response_gains, mean_gains:
                 what they gain over the agents whose place they take
"""

from cprl.studies.executors import InProcess, Processes, Ray
from cprl.studies.factors import Integers, LogUniform, Uniform
from cprl.studies.run import StudyResult, run_study
from cprl.studies.search import Search, SearchResult, run_search
from cprl.studies.study import Study, read_study
from cprl.studies.tables.sources import study_table
from cprl.studies.tables.table import StudyTable

__all__ = [
    "InProcess",
    "Integers",
    "LogUniform",
    "Processes",
    "Ray",
    "Search",
    "SearchResult",
    "Study",
    "StudyResult",
    "StudyTable",
    "Uniform",
    "read_study",
    "run_search",
    "run_study",
    "study_table",
]
