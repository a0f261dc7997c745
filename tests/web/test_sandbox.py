"""The page with sliders: what it plays, trains, hands out and refuses."""

import asyncio
import json
import re
import runpy
import socket
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from http.client import HTTPConnection
from typing import get_args
from unittest.mock import Mock

import pytest
from viewers import browser, wait_until

from cprl import maps, presets
from cprl.commons.named_games import Board
from cprl.institutions import GraduatedSanctions, Quota, Tax
from cprl.values import hints_of
from cprl.web.playable import playable
from cprl.web.sandbox import Sandbox, Sliders, sandbox_page, serve_sandbox

MEADOW = "A.A#.\n.A.>A\n<..AA"


class Served:
    """A sandbox that answers in a thread of its own."""

    def __init__(self, folder):
        self.sandbox = Sandbox(folder, episodes=1)
        self.addresses = []
        self._loop = asyncio.new_event_loop()
        self._task = self._loop.create_task(serve_sandbox(self.sandbox, 0, self.addresses.append))
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        wait_until(lambda: self.addresses, 20.0, "nothing is served")
        self.port = int(self.addresses[0].rsplit(":", 1)[1].strip("/"))

    def _run(self):
        with suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._task)

    def close(self):
        self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join()
        self._loop.close()
        self.sandbox.close()

    def ask(self, path, body=None, method="POST", **headers):
        """The status and the text of an answer."""
        connection = HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request(method, path, body if isinstance(body, str) else json.dumps(body or {}), headers)
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, text


@pytest.fixture
def served(tmp_path):
    served = Served(tmp_path / "runs")
    yield served
    served.close()


def game_of(recipe, path):
    path.write_text(recipe, encoding="utf-8")
    return runpy.run_path(str(path))["experiment"]()


def test_the_recipe_is_the_game_that_is_played(tmp_path):
    sliders = Sliders(agents=6, regrowth=2, sight=5, quota=0.25, tax=0.5, sanctions=1)
    experiment = game_of(sliders.recipe(), tmp_path / "mine.py")
    game = experiment.game
    base = presets.game("commons")
    assert game == sliders.game()
    assert game.map == maps.with_agents(base.map, 6)
    assert game.rules.regrow_prob == tuple(2 * prob for prob in base.rules.regrow_prob)
    assert (game.rules.window_rows, game.rules.window_columns) == (5, 11)
    assert [type(one) for one in game.institutions] == [Quota, Tax, GraduatedSanctions]
    assert len(experiment.agents) == 6
    assert Sliders().game() == presets.game("commons"), "sliders begin at the published game"


def test_a_map_of_ones_own_is_played_and_handed_out(tmp_path):
    sliders = Sliders(drawing=MEADOW, agents=3)
    experiment = game_of(sliders.recipe(), tmp_path / "mine.py")
    assert experiment.game == sliders.game()
    assert experiment.game.map == maps.with_agents(maps.parse(MEADOW), 3)


def test_nothing_but_signs_of_cells_gets_from_a_map_into_the_recipe():
    with pytest.raises(ValueError, match="unknown sign"):
        Sliders(drawing='A>"""); open("stolen", "w")  #').recipe()


def test_the_page_plays_what_matters_to_scripted_agents(served):
    status, text = served.ask("/game", {"agents": 3, "quota": 0.25, "tax": 0.5, "sanctions": 1})
    trial = json.loads(text)
    assert status == 200
    assert trial["game"] == json.loads(json.dumps(playable(Sliders(agents=3, quota=0.25).game())))
    assert len(trial["scene"]["colours"]) == 3


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({"agents": 99}, "agents is 99"),
        ({"agents": "x"}, "agents is 'x'"),
        ('{"tax": NaN}', "tax is nan"),
        ({"board": "../mine"}, "board is '../mine'"),
        ({"own": 1}, "own"),
        ("[]", "no JSON object"),
        ("{", "no JSON"),
        ({"drawing": "A.B>"}, "unknown sign 'B'"),
        ({"drawing": "A..."}, "starts"),
        ({"drawing": "A~.>", "agents": 1}, "Map.river"),
        ({"drawing": "AP.>", "agents": 1}, "Map.spawns"),
        ({"drawing": "A>", "agents": 12}, "agents is 12"),
    ],
)
def test_what_no_slider_can_be_is_refused_in_a_sentence(served, body, said):
    for path in ("/game",) if said == "Map.spawns" else ("/game", "/train"):
        status, text = served.ask(path, body)
        assert (status, said in text) == (400, True), text
    assert served.sandbox.state()["state"] == "none"


def test_pages_of_others_are_not_answered(served):
    assert served.ask("/", method="GET")[0] == 200
    assert served.ask("/", method="GET", Host=f"localhost:{served.port}")[0] == 200
    assert served.ask("/", method="GET", Host="evil.example")[0] == 403
    assert served.ask("/train", Origin="http://evil.example")[0] == 403
    assert served.ask("/train", method="GET")[0] == 405, "nobody trains by a link"
    assert served.ask("/game", "x" * 5000)[0] == 413
    assert served.sandbox.state()["state"] == "none"


def test_the_sliders_of_the_page_have_the_ranges_of_the_settings():
    page = sandbox_page()
    inputs = [dict(re.findall(r'(\w+)="([^"]*)"', text)) for text in re.findall(r"<input ([^>]+)>", page)]
    numbers = {
        part["name"]: (float(part["min"]), float(part["max"]), float(part["value"])) for part in inputs
    }
    assert numbers.pop("hold") == (0, 4, 0)
    for name, (low, high, value) in numbers.items():
        (bounds,) = hints_of(Sliders)[name].__metadata__
        assert (low, high, value) == (bounds.low, bounds.high, getattr(Sliders(), name)), name
    assert set(numbers) == set(vars(Sliders())) - {"board", "drawing"}
    boards = re.findall(r"<option>([^<]+)</option>", page)
    assert (boards[0], set(boards)) == (Sliders().board, {*get_args(Board), "your own map"})


def test_agents_that_are_not_trained_are_not_shown(served):
    assert served.ask("/trained") == (400, "no agents are trained; press Train these first")


def test_trainings_of_an_earlier_sandbox_are_kept(tmp_path):
    kept = tmp_path / "sandbox-1.py"
    kept.write_text("mine")
    sandbox = Sandbox(tmp_path, episodes=1)
    sandbox.train(Sliders(agents=2))
    sandbox.close()
    assert kept.read_text() == "mine"
    assert (tmp_path / "sandbox-2.py").read_text() == Sliders(agents=2).recipe(1)


def test_of_trainings_that_are_asked_for_at_once_one_begins(tmp_path, monkeypatch):
    begun = []
    running = Mock(poll=lambda: None)

    def begin(words, **_):
        time.sleep(0.05)  # in which the others ask
        begun.append(words)
        return running

    sandbox = Sandbox(tmp_path, episodes=1)
    monkeypatch.setattr("cprl.web.sandbox.subprocess.Popen", begin)
    with ThreadPoolExecutor(6) as pool:
        answers = [pool.submit(sandbox.train, Sliders()) for _ in range(6)]
        refused = [answer.exception() for answer in answers if answer.exception()]
    sandbox.close()
    assert len(begun) == 1
    assert [str(error) for error in refused] == ["a training runs; wait until it has ended"] * 5
    running.terminate.assert_called_once()


def test_a_browser_that_leaves_prints_nothing(served, monkeypatch, capfd):
    may_end = threading.Event()

    def state():
        may_end.wait(20)
        return {"text": "long" * 10**6}

    monkeypatch.setattr(served.sandbox, "state", state)
    connection = socket.create_connection(("127.0.0.1", served.port))
    host = f"127.0.0.1:{served.port}"
    connection.sendall(f"POST /state HTTP/1.1\r\nHost: {host}\r\nContent-Length: 0\r\n\r\n".encode())
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closed by a reset
    connection.close()
    may_end.set()
    monkeypatch.undo()
    assert served.ask("/state")[0] == 200
    time.sleep(0.2)
    assert capfd.readouterr().err == ""


@pytest.mark.integration
def test_agents_are_trained_and_their_course_and_an_episode_are_shown(served):
    status, text = served.ask("/train", {"agents": 2})
    assert (status, json.loads(text)["state"]) == (200, "training")
    assert served.ask("/train", {"agents": 2}) == (400, "a training runs; wait until it has ended")
    deadline = time.monotonic() + 300
    while served.sandbox.state()["state"] == "training" and time.monotonic() < deadline:
        time.sleep(0.5)
    state = json.loads(served.ask("/state")[1])
    log = (served.sandbox.folder / "sandbox-1.log").read_text()
    assert (state["state"], len(state["course"])) == ("trained", 1), log
    trained = json.loads(served.ask("/trained")[1])
    assert state["sliders"] == vars(Sliders(agents=2))
    assert trained["turns"] > 0
    assert trained["data"]
    assert len(trained["colours"]) == 2


@pytest.mark.viewer
@pytest.mark.parametrize("width", [1280, 400])
def test_chromium_plays_by_the_sliders(served, tmp_path, width):
    with browser(served.addresses[0], size=(width, 900)) as page:
        page.resize(width, 900)

        def name():
            return page.run("return stage.isCounted && stage.tries.at(-1).name")

        def move(slider, value):
            page.run(
                f"const moved = document.querySelector('#own [name={slider}]');"
                f"moved.value = {json.dumps(value)}; moved.dispatchEvent(new Event('input'))"
            )

        wait_until(lambda: name() == "4 greedy", 60.0, "nothing is played")
        move("hold", 3)
        assert page.run("return element('board').style.opacity") == "0.3", "the old board is grey at once"
        wait_until(lambda: name() == "3 of 4 hold back", 60.0, "the slider does nothing")
        move("tax", 0.5)
        assert "Nothing changes" in page.run("return element('said').textContent")
        assert name() == "3 of 4 hold back"
        for agents in (12, 9, 2):
            move("agents", agents)
        wait_until(lambda: name() == "2 of 2 hold back", 60.0, "the newest question does not win")
        tried = page.run("return stage.tries.map((found) => found.name)")
        assert tried == ["4 greedy", "3 of 4 hold back", "2 of 2 hold back"]
        move("board", "your own map")
        wait_until(lambda: name() == "2 of 2 hold back, your own map", 60.0, "the map is not played")
        move("drawing", MEADOW + "\nx")
        wait_until(
            lambda: "unknown sign 'x'" in page.run("return element('answer').textContent"), 60.0, "no refusal"
        )
        page.run("element('recipe').click()")
        wait_until(lambda: "unknown sign" in page.run("return element('said').textContent"), 60.0, "no word")
        assert page.run("return document.documentElement.scrollWidth <= innerWidth")
