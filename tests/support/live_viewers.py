"""Recordings that are served live, and programs that read them."""

import socket
import subprocess
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import psutil
import rerun_cli
from recordings import column
from study_runs import an_episode

from cprl.viewer.page import LOCALHOST, free_port

VIEWER = Path(rerun_cli.__path__[0]) / "rerun"


def connected(address, folder):
    """Start a process of Rerun's that reads a served recording as a viewer does; it is connected."""
    viewer = subprocess.Popen(
        [VIEWER, address, "--save", folder / "got.rrd", "--bind", "127.0.0.1", "--port", str(free_port())],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    ports = set()
    while urlsplit(address).port not in ports:
        time.sleep(0.2)
        connections = psutil.Process(viewer.pid).net_connections()
        ports = {each.raddr.port for each in connections if each.status == psutil.CONN_ESTABLISHED}
    return viewer


def received(folder, *of_column):
    """A column of what a viewer has got so far; empty while its file holds no recording."""
    try:
        return column(folder / "got.rrd", *of_column)
    except (RuntimeError, ValueError):
        return [], []


def fake(number, world, *, returned, tagged):
    """An episode of two agents with as many apples and tags as are said."""
    lived = {"survival_steps": min(1000.0, 2 * returned), "peacefulness": returned}
    both = np.array([returned / 2, returned / 2])
    return replace(
        an_episode(number, world, returned, **lived),
        terminated=number == 5,
        return_=both,
        harvest=both,
        tagged_by=np.array([[0, 0], [tagged, 0]]),
        depletion_step=7 if number == 5 else -1,
    )


def listens(port, address=LOCALHOST):
    with suppress(ConnectionRefusedError):
        socket.create_connection((address, port), timeout=5).close()
        return True
    return False


def wait(is_so):
    ends = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < ends
        time.sleep(0.05)
