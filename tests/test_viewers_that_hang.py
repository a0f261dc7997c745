"""A viewer that stands still is dropped; the run does not wait."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from test_watch import connected

from cprl.viewer import streams
from cprl.viewer.streams import Sender, within


@pytest.fixture
def short(monkeypatch):
    """Deadlines of a third of a second."""
    for name in ("STALL_S", "CLOSE_S"):
        monkeypatch.setattr(streams, name, 0.3)


def test_what_takes_too_long_is_not_waited_for():
    started = time.monotonic()
    with pytest.raises(TimeoutError, match=r"no answer within 0\.05 s"):
        within(0.05, threading.Event().wait)
    assert time.monotonic() - started < 1
    assert within(1, lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        within(1, lambda: 1 / 0)


def test_calls_are_made_in_their_order_and_all_before_the_end():
    made, sender = [], Sender()
    for number in range(3 * streams.QUEUED_CALLS):
        sender.put(lambda number=number: made.append(number))
    sender.close()
    assert made == list(range(3 * streams.QUEUED_CALLS))


def fill(sender):
    """More calls that never return than the queue holds."""
    for _ in range(streams.QUEUED_CALLS + 2):
        sender.put(threading.Event().wait)


def test_a_queue_that_stays_full_is_refused_and_the_end_has_a_deadline(short):
    sender, started = Sender(), time.monotonic()
    with pytest.raises(TimeoutError, match=r"taken no data for 0\.3 s and the queue is full"):
        fill(sender)
    sender = Sender()
    sender.put(threading.Event().wait)
    with pytest.raises(TimeoutError, match=r"has not taken the last data within 0\.3 s"):
        sender.close()
    assert time.monotonic() - started < 2


SERVES = """
import sys, time
from pathlib import Path
import numpy as np
from cprl.viewer.logger import RerunLogger
logger = RerunLogger("run", Path(sys.argv[1]), live="serve")
print(logger.addresses["native"].split()[-1], flush=True)
sys.stdin.readline()
slowest, random = 0.0, np.random.default_rng(0)
for step in range(700):  # 700 MB: more than the server and its connections hold
    logger.at(step=step, episode=step)
    started = time.monotonic()
    logger.log_matrix("m", random.random((500, 500), np.float32), ("a", "b"))
    slowest = max(slowest, time.monotonic() - started)
started = time.monotonic()
if sys.argv[2] == "closes": logger.close()
print(slowest, time.monotonic() - started, flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("end", ["closes", "leaves"])
def test_a_served_recording_does_not_wait_for_a_viewer_that_stands_still(end, tmp_path):
    """Rerun's own receiver connects as a viewer does, and is stopped."""
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", SERVES, tmp_path, end], stdin=pipe, stdout=pipe, stderr=pipe, text=True
    ) as process:
        lines = iter(process.stdout.readline, "")
        address = next(line for line in lines if line.startswith("rerun+http")).strip()
        viewer = connected(address, tmp_path)
        try:
            time.sleep(1)
            os.kill(viewer.pid, signal.SIGSTOP)
            process.stdin.write("\n")
            process.stdin.flush()
            slowest, closing = map(float, next(lines).split())
            started = time.monotonic()
            _, errors = process.communicate(timeout=60)
            assert slowest < streams.STALL_S + 1
            assert closing < streams.CLOSE_S + 1
            assert time.monotonic() - started < streams.CLOSE_S + streams.STALL_S + 1
            assert process.returncode == 0
            if end == "closes":
                assert errors.count("live view failed, the run continues without it") == 1
        finally:
            process.kill()
            viewer.kill()
            viewer.wait()
