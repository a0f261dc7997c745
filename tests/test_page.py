"""The web viewer's page, and recordings for it, are served on 127.0.0.1 alone and end with the process."""

import re
import socket
import subprocess
import sys
import time
from contextlib import suppress
from subprocess import PIPE
from types import SimpleNamespace
from urllib.parse import urlsplit
from urllib.request import urlopen

import psutil
import pytest
from recordings import SCENE, column, frames, static
from test_watch import connected

from cprl.commands import main as cli
from cprl.viewer import page
from cprl.viewer.logger import RerunLogger
from cprl.viewer.page import LOCALHOST, WebViewer


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


def test_the_page_is_on_this_machine_alone_until_it_is_closed():
    served = WebViewer()
    try:
        wait(lambda: listens(served.port))
        assert b"re_viewer_bg.wasm" in urlopen(served.address("rerun+http://127.0.0.1:9/proxy")).read()
        own = [one.address for all_ in psutil.net_if_addrs().values() for one in all_ if one.family == 2]
        for address in set(own) - {LOCALHOST}:
            assert not listens(served.port, address)
    finally:
        served.close()
    wait(lambda: not listens(served.port))
    served.close()


def test_a_process_that_is_killed_leaves_no_page():
    script = "from cprl.viewer.page import WebViewer; print(WebViewer().port, flush=True); input()"
    process = subprocess.Popen([sys.executable, "-c", script], stdin=PIPE, stdout=PIPE, text=True)
    port = int(process.stdout.readline())
    wait(lambda: listens(port))
    process.kill()
    process.communicate()
    wait(lambda: not listens(port))


@pytest.mark.parametrize("serve", [True, False])
def test_without_a_display_or_on_request_a_run_is_served_until_it_is_interrupted(
    serve, tmp_path, monkeypatch, capsys
):
    with RerunLogger("run", tmp_path, curves=SCENE) as logger:
        logger.log_frames(frames(3)[0])
        for episode, text in enumerate(("# Episode 1", "# Finished")):
            logger.at(step=episode, episode=episode)
            logger.log_document("header", text)
    (tmp_path / "film.rrd").write_bytes(b"half a recording")
    monkeypatch.setattr(page, "has_display", lambda: serve)
    got, said = tmp_path / "got", []

    def interrupted(seconds):
        said.append(capsys.readouterr().out)
        got.mkdir()
        address = re.search(r"--connect (\S+)", said[0])[1]
        wait(lambda: listens(urlsplit(address).port))
        client = connected(address, got)
        try:
            wait(lambda: column(got / "got.rrd", "world/board", "SegmentationImage:buffer")[0])
        finally:
            client.terminate()
            client.wait()
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "time", SimpleNamespace(sleep=interrupted))
    cli.watch(tmp_path, serve=serve)
    assert said[0].endswith("served on 127.0.0.1 until Ctrl-C\n")
    assert ("There is no display" in said[0]) != serve
    assert static(got / "got.rrd", "header", "TextDocument:text") == ["# Finished"], "before the history"
    assert column(got / "got.rrd", "world/board", "SegmentationImage:buffer")[0] == [1, 2, 3]


def test_a_run_without_a_recording_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no recording"):
        cli.watch(tmp_path, serve=True)
