"""Studies: one experiment under many conditions.

Modules, in the order in which one reads them:
    paths        places of values in an experiment, as texts
    factors      levels, and distributions of random draws
    naming       what conditions and levels are called
    conditions   one experiment of a study: what levels make of it, and the checksum that names its runs
    study        Study: factors, replicas; a value
    status       what a trial says of itself while it runs
    extending    runs that go on from shorter ones
    trials       one run of a study, run or resumed, whatever was there
    executors    where trials are run
    overview     how far every trial is
    progress     the same in the terminal
    directory    a study's directory: what it is, its runs, how far its trials are
    driver       runs trials, and shows how far they are
    execution    run_study: every trial of a study
    points       Search: values of factors at which a metric is best
    search       run_search: points that Optuna proposes, each run as a condition
    words        factors as words of a command line
    tables       what came out, as one tidy table; means and differences; cprl table
    figures      drawn of it
    results      write_results: table, summary and figures of a study
"""

from cprl.studies.directory import read_study
from cprl.studies.execution import StudyResult, run_study
from cprl.studies.executors import InProcess, Processes, Ray
from cprl.studies.factors import Integers, LogUniform, Uniform
from cprl.studies.points import Search
from cprl.studies.search import SearchResult, run_search
from cprl.studies.study import Study
from cprl.studies.tables.table import StudyTable, study_table

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
