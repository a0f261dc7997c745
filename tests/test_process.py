"""prepare_process: what a training wants of its process."""

import platform
import subprocess
import sys

import pytest

FAULTS_OF_ROUNDS = """
import resource
import numpy as np
from cprl.process import prepare_process

def faults_of_rounds():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        arrays = [np.ones(2**17) for _ in range(40)]
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults_of_rounds()
as_it_is = faults_of_rounds()
prepare_process(0)
faults_of_rounds()
print(as_it_is, faults_of_rounds())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_memory_freed_in_one_round_is_there_in_the_next():
    ran = subprocess.run(
        [sys.executable, "-c", FAULTS_OF_ROUNDS], capture_output=True, text=True, check=True, timeout=100
    )
    as_it_is, prepared = map(int, ran.stdout.split())
    pages_of_a_round = 40 * 2**20 // 4096
    assert as_it_is > pages_of_a_round
    assert prepared < pages_of_a_round / 10
