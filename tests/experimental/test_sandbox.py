"""The page with sliders: what it plays, trains, hands out and refuses."""

import json
import runpy
import socket
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from unittest.mock import Mock

import pytest
from viewers import browser, wait_until

from cprl import maps, presets
from cprl.experimental.sandbox import Sandbox, Sliders, SupersededError
from cprl.institutions import GraduatedSanctions, Quota, Tax


@pytest.fixture
def sandbox(tmp_path):
    served = Sandbox(tmp_path / "runs", episodes=1)
    thread = threading.Thread(target=served.server.serve_forever, daemon=True)
    thread.start()
    yield served
    served.server.shutdown()
    served.close()
    thread.join()


def asked(sandbox, path, method="GET", **headers):
    """The status and the text of an answer."""
    connection = HTTPConnection("127.0.0.1", sandbox.server.server_port, timeout=60)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def test_the_recipe_is_the_game_that_is_played(tmp_path):
    sliders = Sliders(agents=6, regrowth=2, sight=5, quota=0.25, tax=0.5, sanctions=1)
    path = tmp_path / "mine.py"
    path.write_text(sliders.recipe(), encoding="utf-8")
    experiment = runpy.run_path(str(path))["experiment"]()
    game, base = experiment.game, presets.game("commons")
    assert game == sliders.game()
    assert game.map == maps.with_agents(base.map, 6)
    assert game.rules.regrow_prob == tuple(2 * prob for prob in base.rules.regrow_prob)
    assert (game.rules.window_rows, game.rules.window_columns) == (5, 11)
    assert [type(one) for one in game.institutions] == [Quota, Tax, GraduatedSanctions]
    assert len(experiment.agents) == 6
    assert Sliders().game() == presets.game("commons"), "sliders begin at the published game"


def test_an_episode_has_the_agents_of_the_sliders(sandbox):
    status, text = asked(sandbox, "/data?agents=3&greedy=1&quota=0.25")
    [population] = json.loads(text)["populations"]
    assert status == 200
    assert population["title"] == "1 greedy, 2 restrained"
    assert population["agents"] == 3
    assert "quota (share 0.25" in population["about"]
    assert "trained" not in population["about"]


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("/data?agents=99", "agents is 99"),
        ("/data?agents=x", "x"),
        ("/data?tax=nan", "tax is nan"),
        ("/data?board=../mine", "board"),
        ("/data?own=1", "no slider"),
    ],
)
def test_what_no_slider_can_be_is_refused_in_a_sentence(sandbox, path, said):
    status, text = asked(sandbox, path)
    assert (status, said in text) == (400, True), text


def test_pages_of_others_are_not_answered(sandbox):
    port = sandbox.server.server_port
    assert asked(sandbox, "/")[0] == 200
    assert asked(sandbox, "/", Host=f"localhost:{port}")[0] == 200
    assert asked(sandbox, "/", Host="evil.example")[0] == 403
    assert asked(sandbox, "/train", "POST", Origin="http://evil.example")[0] == 403
    assert asked(sandbox, "/train")[0] == 404, "nobody trains by a link"
    assert sandbox.state()["state"] == "none"


def test_trainings_of_an_earlier_sandbox_are_kept(tmp_path):
    kept = tmp_path / "sandbox-1.py"
    kept.write_text("mine")
    served = Sandbox(tmp_path, episodes=1)
    served.train(Sliders(agents=2))
    served.close()
    assert kept.read_text() == "mine"
    assert (tmp_path / "sandbox-2.py").read_text() == Sliders(agents=2).recipe(1)


def test_of_trainings_that_are_asked_for_at_once_one_begins(tmp_path, monkeypatch):
    begun, running = [], Mock(poll=lambda: None)

    def begin(words, **_):
        time.sleep(0.05)  # in which the others ask
        begun.append(words)
        return running

    served = Sandbox(tmp_path, episodes=1)
    monkeypatch.setattr("cprl.experimental.sandbox.subprocess.Popen", begin)
    with ThreadPoolExecutor(6) as pool:
        answers = [pool.submit(served.train, Sliders()) for _ in range(6)]
        refused = [answer.exception() for answer in answers if answer.exception()]
    served.close()
    assert len(begun) == 1
    assert [str(error) for error in refused] == ["a training runs; wait until it has ended"] * 5
    running.terminate.assert_called_once()


def test_questions_that_are_no_longer_asked_are_not_played(tmp_path, monkeypatch):
    played, may_end = [], threading.Event()

    def play(fresh, titles):
        played.append(titles)
        may_end.wait(20)
        return {"populations": [{}]}, []

    monkeypatch.setattr("cprl.experimental.sandbox.data_of", play)
    served = Sandbox(tmp_path)
    with ThreadPoolExecutor(4) as pool:
        answers = []
        for greedy in (0, 1, 2, 3):
            answers.append(pool.submit(served.play, Sliders(greedy=greedy), trained=False))
            wait_until(lambda: served._asked == len(answers), 20.0, "not asked")
            wait_until(lambda: played, 20.0, "nothing is played")
        may_end.set()
    served.close()
    assert played == [["0 greedy, 4 restrained"], ["3 greedy, 1 restrained"]]
    assert [type(answer.exception()) for answer in answers[1:3]] == [SupersededError] * 2


def test_a_browser_that_leaves_prints_nothing(sandbox, monkeypatch, capfd):
    may_end = threading.Event()

    def play(*_, **__):
        may_end.wait(20)
        return {"text": "long" * 10**6}

    monkeypatch.setattr(sandbox, "play", play)
    connection = socket.create_connection(("127.0.0.1", sandbox.server.server_port))
    host = f"127.0.0.1:{sandbox.server.server_port}"
    connection.sendall(f"GET /data HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closed by a reset
    connection.close()
    may_end.set()
    assert asked(sandbox, "/state")[0] == 200
    time.sleep(0.2)
    assert capfd.readouterr().err == ""


@pytest.mark.integration
def test_agents_are_trained_and_play_beside_the_scripted_ones(sandbox):
    assert asked(sandbox, "/train?agents=2", "POST")[0] == 200
    assert asked(sandbox, "/train?agents=2", "POST") == (400, "a training runs; wait until it has ended")
    deadline = time.monotonic() + 300
    while json.loads(asked(sandbox, "/state")[1])["state"] == "training" and time.monotonic() < deadline:
        time.sleep(0.5)
    assert sandbox.state()["state"] == "trained", (sandbox.folder / "sandbox-1.log").read_text()
    populations = json.loads(asked(sandbox, "/data?agents=2&trained=yes")[1])["populations"]
    assert [one["title"] for one in populations] == [
        "2 greedy, 0 restrained",
        "Trained with 2 agents, no rule, sight 7",
    ]
    assert "2 agents by DQN, trained for 1 episodes" in populations[1]["about"]


@pytest.mark.viewer
@pytest.mark.parametrize("width", [1440, 400])
def test_chromium_plays_by_the_sliders(sandbox, tmp_path, width):
    with browser(sandbox.address, size=(width, 1000)) as page:
        page.resize(width, 1000)

        def title():
            return page.run("return document.querySelector('.population h2')?.firstChild.textContent.trim()")

        wait_until(lambda: title() == "4 greedy, 0 restrained", 60.0, "nothing is played")
        page.run(
            "const own = document.querySelector('[name=greedy]'); own.value = 1;"
            "own.dispatchEvent(new Event('input'))"
        )
        wait_until(lambda: title() == "1 greedy, 3 restrained", 60.0, "the slider does nothing")
        assert page.run("return document.documentElement.scrollWidth <= innerWidth")
        (tmp_path / "sandbox.png").write_bytes(page())
