"""Executors: where the trials of a study are run. Each calls `cprl.studies.trials.run_task`.

Modules, in the order in which one reads them:
    in_process   Executor, and one trial after the other in this process
    stopping     SIGINT and SIGTERM of the process that runs the study
    attempts     a trial in a worker that may die
    processes    kept worker processes on this machine
    memory       what a trial takes, asked for before it starts
    on_ray       tasks of Ray, on this machine or on a cluster
"""

from cprl.studies.executors.in_process import Executor, InProcess
from cprl.studies.executors.on_ray import Ray
from cprl.studies.executors.processes import Processes

__all__ = ["Executor", "InProcess", "Processes", "Ray"]
