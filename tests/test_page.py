"""The web viewer's page and recordings for it are served on 127.0.0.1 alone."""

import re
import socket
import subprocess
import sys
from http.client import HTTPConnection
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest
from recordings import SCENE, column, frames
from rerun.chunk import RrdReader
from test_story import headers

from cprl.commands import main as cli
from cprl.viewer import page
from cprl.viewer.logger import RerunLogger
from cprl.viewer.page import LOCALHOST, Page

FILES = {name: f"the content of {name}".encode() for name in page._FILES}


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A page with two recordings of one name, without the viewer's own files."""
    monkeypatch.setattr(page, "web_viewer", lambda: FILES)
    recordings = [tmp_path / "run.rrd", tmp_path / "2" / "run.rrd"]
    for number, path in enumerate(recordings):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"rows %d" % number)
    (tmp_path / "secret").write_text("secret")
    own = Page(recordings)
    yield own
    own.close()


def answer(port, path, *, host=None):
    """The status and body of an answer."""
    connection = HTTPConnection(LOCALHOST, port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", host or f"{LOCALHOST}:{port}")
    connection.endheaders()
    reply = connection.getresponse()
    return reply.status, reply.read()


def test_the_page_and_its_recordings_are_served(served):
    assert answer(served.port, "/?url=x&theme=dark") == (200, FILES["index.html"])
    for name, content in FILES.items():
        assert answer(served.port, f"/{name}") == (200, content)
    urls = parse_qs(urlsplit(served.address()).query)["url"]
    assert [answer(served.port, urlsplit(url).path)[1] for url in urls] == [b"rows 0", b"rows 1"]
    assert urlsplit(served.address("rerun+http://127.0.0.1:9/proxy")).port == served.port


@pytest.mark.parametrize("path", ["/secret", "/../secret", "/recordings/0/secret", "/recordings/2/run.rrd"])
def test_nothing_else_is_served(path, served):
    assert answer(served.port, path)[0] == 404


def test_a_page_of_another_name_that_leads_here_is_refused(served):
    assert answer(served.port, "/", host="evil.example:80")[0] == 403
    assert answer(served.port, "/", host="localhost:8080")[0] == 200


def own_addresses():
    """The machine's own addresses but 127.0.0.1."""
    found = [
        one.address for own in psutil.net_if_addrs().values() for one in own if one.family == socket.AF_INET
    ]
    return [address for address in found if not address.startswith("127.")]


def test_the_machines_other_addresses_are_refused(served):
    addresses = own_addresses()
    if not addresses:
        pytest.skip("the machine has no other address")
    for address in addresses:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((address, served.port), timeout=5)


def test_a_viewer_that_cannot_be_read_is_said_to_the_browser(served, monkeypatch):
    def fails():
        raise OSError("no space left")

    monkeypatch.setattr(page, "web_viewer", fails)
    status, text = answer(served.port, "/")
    assert (status, b"no space left" in text) == (503, True)


@pytest.mark.parametrize("serve", [True, False])
def test_without_a_display_or_on_request_a_run_is_served_until_it_is_interrupted(
    serve, tmp_path, monkeypatch, capsys
):
    with RerunLogger("run", tmp_path, scene=SCENE) as logger:
        logger.log_frames(frames(3)[0])
        for episode, text in enumerate(("# Episode 1", "# Finished")):
            logger.at(step=episode, episode=episode)
            logger.log_document("header", text)
    (tmp_path / "film.rrd").write_bytes(b"half a recording")
    monkeypatch.setattr(page, "has_display", lambda: serve)
    told = []

    def interrupted(seconds):
        told.append(capsys.readouterr().out)
        port = int(re.search(r"http://127\.0\.0\.1:(\d+)/\?", told[0])[1])
        assert answer(port, "/recordings/1/film.rrd") == (200, b"half a recording")
        assert answer(port, "/recordings/2/run.rrd") == (200, (tmp_path / "run.rrd").read_bytes())
        (tmp_path / "light.rrd").write_bytes(answer(port, "/recordings/0/header-1.rrd")[1])
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.time, "sleep", interrupted)
    cli.watch(tmp_path, serve=serve)
    assert told[0].endswith("served on 127.0.0.1 until Ctrl-C\n")
    assert ("There is no display" in told[0]) != serve
    assert headers(tmp_path / "light.rrd")[-1] == (1, "# Finished"), "without the rest before it"
    whole, light = (RrdReader(tmp_path / name).recordings() for name in ("run.rrd", "light.rrd"))
    assert [store.recording_id for store in light] == [store.recording_id for store in whole]
    assert not column(tmp_path / "light.rrd", "world/board", "SegmentationImage:buffer")[0]
    assert RrdReader(tmp_path / "light.rrd").blueprints(), "of the two a viewer may load this one first"


def test_a_run_without_a_recording_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no recording"):
        cli.watch(tmp_path, serve=True)


@pytest.mark.viewer
def test_the_installed_rerun_has_the_files_and_its_process_ends():
    served = Page()
    try:
        for name in page._FILES:
            status, content = answer(served.port, f"/{name}")
            assert (status, len(content) > 400) == (200, True), name
        assert b"re_viewer_bg.wasm" in answer(served.port, "/")[1]
    finally:
        served.close()
    started = [own.name() for own in psutil.Process().children(recursive=True)]
    assert not [name for name in started if "rerun" in name]


@pytest.mark.viewer
def test_a_process_that_is_killed_leaves_no_process_and_no_page(tmp_path):
    """The viewer's files have been read; nothing of Rerun's runs any more."""
    script = """
import time
from cprl.viewer.page import Page
print(Page().port, flush=True)
time.sleep(1000)
"""
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    port = int(process.stdout.readline())
    assert answer(port, "/sw.js")[0] == 200
    assert psutil.Process(process.pid).children(recursive=True) == []
    process.kill()
    process.communicate()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((LOCALHOST, port), timeout=5)
