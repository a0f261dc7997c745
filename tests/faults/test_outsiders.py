"""Who looks on does no harm: a reader of the output who leaves, a viewer that does not answer."""

import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from dataclasses import replace

import pytest

from .driver import differences, lived

pytestmark = pytest.mark.slow


def test_a_closed_standard_output_loses_nothing(shop, twin):
    life = shop.started("run")
    program = [sys.executable, "-c", "from cprl.cli import main; main()", *life.argv[1:]]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        said = process.stderr.read()
    assert "Traceback" not in said
    assert "output" in said
    assert lived(shop.resumed("run")).code == 0
    assert differences(life.run, twin[0]) == []


@contextmanager
def silent_viewer(*, accepts):
    """The address of somebody who lets others connect, reads nothing and answers nothing."""
    with socket.create_server(("127.0.0.1", 0), backlog=8) as server:
        held = []

        def accept():
            while True:
                try:
                    held.append(server.accept()[0])
                except OSError:
                    return

        if accepts:
            threading.Thread(target=accept, daemon=True).start()
        yield f"rerun+http://127.0.0.1:{server.getsockname()[1]}/proxy"
        for one in held:
            one.close()
        server.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize("accepts", [True, False], ids=["accepts", "does not accept"])
def test_a_viewer_that_never_answers_holds_nothing_up(accepts, shop, twin):
    with silent_viewer(accepts=accepts) as address:
        watched = replace(shop, watch=f"connect {address}")
        ended = lived(watched.started("run"), deadline_s=90)
    assert ended.code == 0, ended.said
    assert "the run continues without it" in " ".join(ended.err.split())
    assert differences(shop.folder / "run", twin[0]) == []
