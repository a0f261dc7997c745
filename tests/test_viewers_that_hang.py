"""A viewer that stands still, or accepts a connection and never reads, is dropped; the run does not wait."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from test_rerun_logger import column
from test_watch import VIEWER, Doing, course, receiving

from cprl.viewer import deadline
from cprl.viewer.deadline import Sender, within
from cprl.viewer.logger import RerunLogger
from cprl.viewer.page import free_port

HERE = Path(__file__).parent
LISTENS = """
import socket, sys, threading
server = socket.create_server(("127.0.0.1", 0))
print(server.getsockname()[1], flush=True)
def read(client, left):
    while left > 0 and (data := client.recv(left)):
        left -= len(data)
clients = []
while True:
    clients.append(server.accept()[0])
    threading.Thread(target=read, args=(clients[-1], int(sys.argv[1])), daemon=True).start()
"""


@pytest.fixture
def stalling():
    """Starts servers that accept connections and read so many bytes of each; returns their addresses."""
    started = []

    def start(reads):
        process = subprocess.Popen(
            [sys.executable, "-c", LISTENS, str(reads)], stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        return f"rerun+http://127.0.0.1:{int(process.stdout.readline())}/proxy"

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def short(monkeypatch):
    """Deadlines of a third of a second."""
    for name in ("CONNECT_S", "STALL_S", "CLOSE_S"):
        monkeypatch.setattr(deadline, name, 0.3)


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
    for number in range(3 * deadline.QUEUED_CALLS):
        sender.put(lambda number=number: made.append(number))
    sender.close()
    assert made == list(range(3 * deadline.QUEUED_CALLS))


def fill(sender):
    """More calls that never return than the queue holds."""
    for _ in range(deadline.QUEUED_CALLS + 2):
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


@pytest.mark.integration
@pytest.mark.parametrize("reads", [0, pytest.param(5_000, marks=pytest.mark.slow)])
def test_a_viewer_that_never_answers_harms_neither_the_training_nor_the_file(
    reads, stalling, short, tmp_path, recwarn
):
    unwatched = course()
    address, started = stalling(reads), time.monotonic()
    assert course(tmp_path, live=f"connect {address}") == unwatched
    assert time.monotonic() - started < 10
    (told,) = [str(own.message) for own in recwarn if own.category is RuntimeWarning]
    assert told.startswith(f"the Rerun viewer at {address}")
    assert "the run continues without it" in told
    episodes, _ = column(tmp_path / "run.rrd", "social/equality", "Scalars:scalars", "episode")
    assert episodes == list(range(8)), "the file has it all"


def process_with(address, folder, *, closes):
    """A process of its own that logs to a viewer and ends; its seconds without imports, and what it says."""
    script = f"""
import atexit, sys, time
started = time.monotonic()
atexit.register(lambda: print(time.monotonic() - started, flush=True))
from pathlib import Path
import numpy as np
from cprl.viewer.logger import RerunLogger
from cprl.viewer.page import free_port
started = time.monotonic()
logger = RerunLogger("run", Path({str(folder)!r}), live={address!r})
for step in range(20):
    logger.at(step=step, episode=step)
    logger.log_matrix("m", np.zeros((300, 300)), ("a", "b"))
if {closes}: logger.close()
"""
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=90, check=True
    )
    return float(ended.stdout.splitlines()[-1]), ended.stderr


IN_ALL_S = deadline.CONNECT_S + deadline.CLOSE_S + deadline.STALL_S + 1
"""The most that a viewer may cost a process."""


@pytest.mark.slow
@pytest.mark.parametrize("closes", [True, False])
@pytest.mark.parametrize("reads", [0, 5_000, 1_000_000])
def test_a_process_ends_in_time_though_its_viewer_never_answers(reads, closes, stalling, tmp_path):
    spent, told = process_with(f"connect {stalling(reads)}", tmp_path, closes=closes)
    assert spent < IN_ALL_S
    if closes:
        assert told.count("the run continues without it") == 1


@pytest.mark.slow
@pytest.mark.parametrize("closes", [True, False])
def test_a_process_ends_in_time_though_its_viewer_was_stopped_before(closes, tmp_path):
    with receiving() as (process, address):
        os.kill(process.pid, signal.SIGSTOP)
        spent, told = process_with(f"connect {address}", tmp_path, closes=closes)
        os.kill(process.pid, signal.SIGCONT)
    assert spent < IN_ALL_S
    if closes:
        assert told.count("the run continues without it") == 1


@pytest.mark.slow
def test_a_viewer_that_is_stopped_half_way_changes_nothing(tmp_path, recwarn):
    unwatched = course()
    with receiving() as (process, address):
        stop = Doing(60, lambda: os.kill(process.pid, signal.SIGSTOP))
        started = time.monotonic()
        assert course(tmp_path, live=f"connect {address}", others=[stop]) == unwatched
        assert time.monotonic() - started < 20
        os.kill(process.pid, signal.SIGCONT)
    assert [own for own in recwarn if "the run continues without it" in str(own.message)]
    episodes, _ = column(tmp_path / "run.rrd", "social/equality", "Scalars:scalars", "episode")
    assert episodes == list(range(8)), "the file has it all"


@pytest.mark.slow
def test_a_served_recording_does_not_wait_for_a_viewer_that_stands_still(tmp_path):
    """Rerun's own receiver connects as a viewer does, and is stopped."""
    logger = RerunLogger("run", tmp_path, live="serve")
    address = logger.addresses["native"].split()[-1]
    viewer = subprocess.Popen(
        [VIEWER, address, "--save", tmp_path / "got.rrd", "--bind", "127.0.0.1", "--port", str(free_port())],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        ports = set()
        while urlsplit(address).port not in ports:  # until it is connected
            time.sleep(0.2)
            connections = psutil.Process(viewer.pid).net_connections()
            ports = {own.raddr.port for own in connections if own.status == psutil.CONN_ESTABLISHED}
        time.sleep(1)
        os.kill(viewer.pid, signal.SIGSTOP)
        slowest, random = 0.0, np.random.default_rng(0)
        for step in range(700):  # 700 MB: more than the server and its connections hold
            logger.at(step=step, episode=step)
            started = time.monotonic()
            logger.log_matrix("m", random.random((500, 500), np.float32), ("a", "b"))
            slowest = max(slowest, time.monotonic() - started)
        started = time.monotonic()
        with pytest.warns(RuntimeWarning, match="live view failed, the run continues without it"):
            logger.close()
        assert slowest < deadline.STALL_S + 1
        assert time.monotonic() - started < deadline.CLOSE_S + 1
    finally:
        viewer.kill()
        viewer.wait()
