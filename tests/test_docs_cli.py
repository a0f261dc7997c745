"""`cprl docs`: the built documentation and its replays, served on 127.0.0.1."""

import re
from http.client import HTTPConnection
from threading import Thread
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import pytest

from cprl.commands import docs as docs_cli
from cprl.commands import main as cli
from cprl.viewer import page

VIEWER = {name: name.encode() for name in page._FILES}
RECORDING = b"RRF2"


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A built site of a few bytes, and a web viewer likewise."""
    folder = tmp_path / "docs_site"
    (folder / "recordings" / "institutions").mkdir(parents=True)
    (folder / "index.html").write_text("the first page")
    (folder / "game.html").write_text("the game")
    (folder / "recordings" / "institutions" / "monitoring.rrd").write_bytes(RECORDING)
    (folder / "notes.py").write_text("not a kind that is served")
    (tmp_path / "secret.html").write_text("beside the site")
    monkeypatch.setattr(docs_cli, "SITE", folder)
    monkeypatch.setattr(docs_cli.Handler, "site", folder)
    monkeypatch.setattr(page, "web_viewer", lambda: VIEWER)
    return folder


@pytest.fixture
def address(site):
    with docs_cli.Server((page.LOCALHOST, 0), docs_cli.Handler) as server:
        thread = Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def got(address, **named):
    with urlopen(Request(address, **named), timeout=20) as answer:
        return answer.read(), answer.headers


def refused(address, **headers):
    with pytest.raises(HTTPError) as error:
        got(address, headers=headers)
    error.value.close()
    return error.value.code


def test_pages_recordings_and_the_viewer_are_served_with_their_types(address):
    assert got(address)[0] == b"the first page"
    text, headers = got(f"{address}/game.html?q=a#b")
    assert (text, headers["Content-Type"]) == (b"the game", "text/html; charset=utf-8")
    recording, headers = got(f"{address}/recordings/institutions/monitoring.rrd")
    assert (recording, int(headers["Content-Length"])) == (RECORDING, len(RECORDING))
    wasm, headers = got(f"{address}/viewer/re_viewer_bg.wasm")
    assert (wasm, headers["Content-Type"]) == (VIEWER["re_viewer_bg.wasm"], "application/wasm")
    assert got(f"{address}/viewer/")[0] == VIEWER["index.html"]


def test_a_page_may_ask_whether_something_is_there_without_its_content(address):
    for path in ("viewer/index.html", "recordings/institutions/monitoring.rrd"):
        assert got(f"{address}/{path}", method="HEAD")[0] == b""
    with pytest.raises(HTTPError, match="404"):
        got(f"{address}/recordings/chess.rrd", method="HEAD")


def test_nothing_beside_the_site_is_served_and_nothing_of_another_server_may_be_loaded(address):
    for path in ("/notes.py", "/none.html", "/viewer/none.js", "/recordings/", "/%00.html", "/" + "a" * 5000):
        assert refused(address + path) == 404, path
    for path in ("/../secret.html", "/..%2fsecret.html", "//secret.html", "/recordings/../../secret.html"):
        connection = HTTPConnection(urlsplit(address).netloc, timeout=20)
        connection.request("GET", path)  # as it is: urlopen would resolve the dots
        assert connection.getresponse().status == 404, path
        connection.close()
    assert refused(address, Host="example.org") == 403
    for path in ("", "/viewer/"):
        allowed = got(address + path)[1]["Content-Security-Policy"]
        assert "default-src 'self'" in allowed
        assert not re.search(r"https?:|\*", allowed)


def test_a_viewer_that_cannot_be_read_is_said_and_the_pages_stay(address, monkeypatch):
    def fails():
        raise OSError("no space left")

    monkeypatch.setattr(page, "web_viewer", fails)
    assert refused(f"{address}/viewer/") == 503
    assert got(address)[0] == b"the first page"


def test_it_prints_the_address_opens_the_browser_and_ctrl_c_ends_it(site, monkeypatch, capsys):
    def interrupted(server, *_):
        raise KeyboardInterrupt

    opened = []
    monkeypatch.setattr(docs_cli.Server, "serve_forever", interrupted)
    monkeypatch.setattr(docs_cli.webbrowser, "open", opened.append)
    monkeypatch.setattr(docs_cli, "has_display", lambda: True)
    docs_cli.docs()
    told = capsys.readouterr().out
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/  \(Ctrl-C ends it\)\n\nEnded\.\n", told)
    assert opened == [told.split()[0]]
    docs_cli.docs(browser=False)
    assert len(opened) == 1


def test_without_a_site_a_sentence_says_what_builds_it(site, monkeypatch):
    (site / "index.html").unlink()
    monkeypatch.setattr("sys.argv", ["cprl", "docs"])
    with pytest.raises(SystemExit, match="has not been built here; in a checkout, make docs builds it"):
        cli.main()


def test_a_port_that_is_taken_is_said_if_it_was_asked_for(address):
    with pytest.raises(ValueError, match=r"port \d+ of 127\.0\.0\.1: .*; --port takes another"):
        docs_cli.docs(port=urlsplit(address).port)
    with pytest.raises(ValueError, match="--port is 65536"):
        docs_cli.docs(port=65536)
