"""The process: freed memory stays with it, compiled code with the user; where the time of a training goes."""

import ctypes
import gc
import os
import platform
import subprocess
import sys
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from cprl.system import compiling, times
from cprl.system.compiling import freed_after_training, freeze_objects
from cprl.system.process import _M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD, prepare_process
from cprl.system.times import Times


def faults_of_rounds():
    """Page faults of ten rounds that allocate 40 MB in pieces of one, and free them; Unix counts them."""
    import resource

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


# Where the time of a training goes, and what it leaves behind in memory


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass only when a test says so, and those of compiling."""
    now = SimpleNamespace(seconds=100.0, total_s=7.0)
    monkeypatch.setattr(times, "time", SimpleNamespace(monotonic=lambda: now.seconds))
    monkeypatch.setattr(times, "CLOCK", now)
    return now


def test_acting_storing_and_updating_is_told_apart_from_compiling(clock):
    run = Times()
    clock.seconds, clock.total_s = 101.0, 7.5  # half a second of compiling before the training
    training = Times()
    clock.seconds, clock.total_s = 111.0, 9.5
    training.busy_s = 8.0
    clock.seconds = 112.0
    # 8 s of acting, storing and updating, of which 9.5 - 7.5 = 2 s are compiling; in all 112 - 101 = 11 s
    assert (training.spent_s, training.compiling_s, training.acting_storing_updating_s) == (11.0, 2.0, 6.0)
    assert run.report(training) == {
        "training_s": 11.0,
        "acting_storing_updating_s": 6.0,
        "compiling_s": 2.5,
        "wall_s": 12.0,
    }


def test_a_training_that_goes_on_counts_what_it_took_before(clock):
    first = Times()
    clock.seconds, clock.total_s, first.busy_s = 110.0, 10.0, 9.0
    state = first.state_dict()
    clock.seconds, clock.total_s = 500.0, 0.0  # another process
    run, second = Times(), Times()
    second.load_state_dict(state)
    clock.seconds, clock.total_s, second.busy_s = 504.0, 1.0, second.busy_s + 3.0
    # 10 + 4 s, of them busy 9 + 3, of which compiling 3 + 1
    assert run.report(second) == {
        "training_s": 14.0,
        "acting_storing_updating_s": 8.0,
        "compiling_s": 4.0,
        "wall_s": 14.0,
    }


class Learner:
    """Something in a cycle, as learners and buffers are."""

    def __init__(self):
        self.own = self


@pytest.mark.integration
def test_what_a_training_leaves_in_cycles_is_freed_at_its_end():
    gc.disable()
    try:
        with freed_after_training():
            left = weakref.ref(Learner())
            assert left() is not None
        assert left() is None
    finally:
        gc.enable()


@pytest.mark.integration
def test_a_training_that_compiled_is_freed_when_the_next_one_begins(monkeypatch):
    monkeypatch.setattr(compiling, "_is_set_aside", False)
    with freed_after_training():
        learner = Learner()
        left = weakref.ref(learner)
        freeze_objects()
        del learner
    gc.collect()
    assert left() is not None, "it was set aside with what was compiled"
    with freed_after_training():
        assert left() is None


if __name__ == "__main__":
    print(*faults_before_and_after())
