"""The page that plays committed replays: `make docs-live`."""

import re
import signal
import subprocess
import sys
import time
from io import BytesIO
from pathlib import Path
from threading import Thread
from urllib.error import HTTPError
from urllib.parse import parse_qs, urlsplit
from urllib.request import Request, urlopen

import numpy as np
import pytest
import replay_page
from PIL import Image
from rerun.chunk import RrdReader
from viewers import browser

from cprl.commons.colours import APPLE, FIRST_AGENT

PAGE = Path(replay_page.__file__)
ASSETS = {name: name.encode() for name in replay_page.VIEWER_FILES}


@pytest.fixture
def address(monkeypatch):
    """Where the page is served, with a viewer of a few bytes."""
    monkeypatch.setattr(replay_page, "web_viewer", lambda: ASSETS)
    with replay_page.Server((replay_page.LOCALHOST, 0), replay_page.Handler) as server:
        thread = Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def got(address, **headers):
    with urlopen(Request(address, headers=headers), timeout=20) as answer:
        return answer.read(), answer.headers


def refused(address, **headers):
    with pytest.raises(HTTPError) as error:
        got(address, **headers)
    error.value.close()
    return error.value.code


def test_the_page_names_every_committed_replay_and_embeds_one(address):
    text = got(address)[0].decode()
    results = replay_page.RESULTS
    committed = sorted(path.parent.relative_to(results).as_posix() for path in results.rglob("replay*.rrd"))
    assert re.findall(r'href="/\?replay=([^"]+)"', text) == committed
    assert "class=shown>commons</a>" in text
    assert "class=shown>two_complex</a>" in got(f"{address}/?replay=two_complex")[0].decode()
    assert refused(f"{address}/?replay=chess") == 404


def test_the_viewer_that_is_embedded_loads_the_replay_from_here(address):
    (source,) = re.findall(r'iframe src="([^"]+)"', got(f"{address}/?replay=commons")[0].decode())
    query = parse_qs(urlsplit(source.replace("&amp;", "&")).query)
    assert got(f"{address}/viewer/")[0] == b"index.html"
    replay, headers = got(query["url"][0])
    assert query["url"][0].startswith(address)
    assert replay == (replay_page.RESULTS / "commons" / "replay-0-0.rrd").read_bytes()
    assert int(headers["Content-Length"]) == len(replay)
    nested = replay_page.RESULTS / "institutions" / "monitoring" / "replay-0-0.rrd"
    assert got(f"{address}/replays/institutions/monitoring.rrd")[0] == nested.read_bytes()


def test_nothing_else_is_served_and_nothing_of_another_server_may_be_loaded(address):
    for path in ("/replays/../recipe.rrd", "/viewer/sw.js", "/README.md", "/replays/commons/recipe.json"):
        assert refused(address + path) == 404
    assert refused(address, Host="example.org") == 403
    for path in ("", "/viewer/"):
        allowed = got(address + path)[1]["Content-Security-Policy"]
        assert "default-src" in allowed
        assert not re.search(r"https?:|\*", allowed)


def test_ctrl_c_ends_it_without_a_traceback(monkeypatch, capsys):
    def interrupted(server, *_):
        raise KeyboardInterrupt

    monkeypatch.setattr(replay_page.Server, "serve_forever", interrupted)
    replay_page.main()
    told = capsys.readouterr().out
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/  \(Ctrl-C ends it\)\n\nEnded\.\n", told)


def test_a_port_that_is_taken_is_said_if_it_was_asked_for(address):
    with pytest.raises(SystemExit, match=r"port \d+ of 127\.0\.0\.1: .*; --port takes another"):
        replay_page.main(port=urlsplit(address).port)


def colours_of(replay):
    """The colours of apples and agents in a recording, by the name of the class."""
    component = "AnnotationContext:context"
    found = {}
    for chunk in RrdReader(replay).stream():
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            for entry in batch.column(component)[0].as_py()[0]:
                info = entry["class_description"]["info"]
                value = info["color"]
                found[info["id"]] = (value >> 24 & 255, value >> 16 & 255, value >> 8 & 255)
    return {name: found[kind] for name, kind in (("apple", APPLE), ("agent_0", FIRST_AGENT))}


@pytest.mark.viewer
def test_chromium_shows_a_board_and_ctrl_c_ends_the_server(tmp_path):
    replay = replay_page.RESULTS / "commons" / "replay-0-0.rrd"
    colours = colours_of(replay)
    server = subprocess.Popen(
        [sys.executable, PAGE, "--port", "0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        address = server.stdout.readline().split()[0]
        with browser(f"{address}?replay=commons", size=(900, 600)) as take_picture:  # it draws on a CPU
            began, shown = time.monotonic(), {}
            while min(shown.values(), default=0) < 60 and time.monotonic() - began < 400:
                picture = take_picture()
                (tmp_path / "page.png").write_bytes(picture)
                pixels = np.asarray(Image.open(BytesIO(picture)).convert("RGB"), np.int32)
                shown = {
                    name: int((np.abs(pixels - colour).max(-1) <= 4).sum())
                    for name, colour in colours.items()
                }
                time.sleep(1)
            assert min(shown.values()) >= 60, f"{tmp_path / 'page.png'} shows {shown}"
        server.send_signal(signal.SIGINT)
        told, errors = server.communicate(timeout=30)
        assert (server.returncode, errors) == (0, "")
        assert told.endswith("Ended.\n")
    finally:
        server.kill()
        server.communicate()
