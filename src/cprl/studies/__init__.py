"""Studies: one experiment under many conditions.

Modules, in the order in which one reads them:
    paths        places of values in an experiment, as texts
    factors      levels, and distributions of random draws
    naming       what conditions and levels are called
    conditions   one experiment of a study, and the checksum that names its runs
    study        Study: factors, replicas, pairing; a value
    status       what a trial says of itself while it runs
    trials       one run of a study, run or resumed, whatever was there
    executors    where trials are run
    execution    run_study: every trial of a study
"""

from cprl.studies.execution import StudyResult, read_study, run_study
from cprl.studies.executors import InProcess, Processes, Ray
from cprl.studies.factors import Integers, LogUniform, Uniform
from cprl.studies.study import Study

__all__ = [
    "InProcess",
    "Integers",
    "LogUniform",
    "Processes",
    "Ray",
    "Study",
    "StudyResult",
    "Uniform",
    "read_study",
    "run_study",
]
