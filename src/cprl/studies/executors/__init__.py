"""Executors: where the trials of a study are run. Each calls `cprl.studies.trials.run_task`.

Modules:
    processes    Executor; one trial after the other in this process, or kept worker processes
    on_ray       tasks of Ray, on this machine or on a cluster; what a trial takes in memory
"""

from cprl.studies.executors.on_ray import Ray
from cprl.studies.executors.processes import Executor, InProcess, Processes

__all__ = ["Executor", "InProcess", "Processes", "Ray"]
