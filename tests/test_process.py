"""prepare_process: freed memory stays with the process, compiled code with the user."""

import ctypes
import os
import platform
import subprocess
import sys

import numpy as np
import pytest

from cprl.system.process import _M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD, prepare_process

resource = pytest.importorskip("resource", reason="page faults are counted by Unix")


def faults_of_rounds():
    """Page faults of ten rounds that allocate 40 MB in pieces of one, and free them."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        pieces = [np.ones(2**17) for _ in range(40)]
        del pieces
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def faults_before_and_after():
    """Page faults with glibc's initial settings, and with ours from the second time on."""
    libc = ctypes.CDLL(None)
    for setting in (_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD):
        libc.mallopt(setting, 2**17)  # glibc's initial value
    before = faults_of_rounds()
    prepare_process(0)
    faults_of_rounds()
    return before, faults_of_rounds()


@pytest.mark.integration
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_memory_freed_in_one_round_is_reused_in_the_next():
    # In a process of its own: one that has run other tests has free memory that needs no new pages.
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    pages_of_a_round = 40 * 2**20 // 4096
    assert before > pages_of_a_round
    assert after < pages_of_a_round / 10


@pytest.mark.parametrize("own", [None, "elsewhere"])
def test_compiled_code_is_kept_between_runs_unless_the_user_says_where(tmp_path, monkeypatch, own):
    monkeypatch.setenv("CPRL_CACHE", str(tmp_path))
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    if own:
        monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", own)
    prepare_process(0)
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == (own or str(tmp_path / "torch"))
    assert (tmp_path / "torch").is_dir()


if __name__ == "__main__":
    print(*faults_before_and_after())
