"""Where the time of a training goes, and what it leaves behind in memory."""

import gc
import weakref
from types import SimpleNamespace

import pytest

from cprl.system import compiling, times
from cprl.system.compiling import cleared_up, set_aside
from cprl.system.times import Times


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


def test_what_a_training_leaves_in_cycles_is_freed_at_its_end():
    gc.disable()
    try:
        with cleared_up():
            left = weakref.ref(Learner())
            assert left() is not None
        assert left() is None
    finally:
        gc.enable()


@pytest.mark.integration
def test_a_training_that_compiled_is_freed_when_the_next_one_begins(monkeypatch):
    monkeypatch.setattr(compiling, "_is_set_aside", False)
    with cleared_up():
        learner = Learner()
        left = weakref.ref(learner)
        set_aside()
        del learner
    gc.collect()
    assert left() is not None, "it was set aside with what was compiled"
    with cleared_up():
        assert left() is None
