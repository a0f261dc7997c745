"""Studies: one experiment under many conditions.

Modules, in the order in which one reads them:
    factors         levels and distributions, by the places of values in an experiment; the same as words
    study           Study: factors, replicas; a value. Its conditions and its directory
    status          what a trial says of itself while it runs
    trials          one run of a study, and the process that makes a finished run of its directory
    executors       where trials are run
    trial_progress  how far every trial is, in the terminal
    run             run_study: every trial of a study
    tables          what came out, as one tidy table; means and differences
    study_figures   figures of a table
    results         write_results: table, summary and figures of a study
"""

from cprl.studies.executors import InProcess, Processes
from cprl.studies.factors import Integers, LogUniform, Uniform
from cprl.studies.run import StudyResult, run_study
from cprl.studies.study import Study, read_study
from cprl.studies.tables.sources import study_table
from cprl.studies.tables.tidy_table import StudyTable

__all__ = [
    "InProcess",
    "Integers",
    "LogUniform",
    "Processes",
    "Study",
    "StudyResult",
    "StudyTable",
    "Uniform",
    "read_study",
    "run_study",
    "study_table",
]
