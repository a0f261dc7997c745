"""The page of a person in a hosted game, in Chromium, against a host that says what the test makes it say."""

import re

import pytest
from scripted_host import WELCOME, round_and_turn, scripted_host, stage
from viewers import browser, wait_until

from cprl.commons import maps
from cprl.commons.game import Game
from cprl.commons.rules import Rules
from cprl.web.static_pages import page_of

GAME = Game(
    map=maps.parse(
        """
        v.A.A..
        .AAA..<
        ..A...#
        """
    ),
    rules=Rules(episode_steps=240),
)
"""Agent 0 heads down; agent 1, the person, heads left."""
SIZES = [(1280, 800), (420, 800)]


def test_the_page_is_one_file_that_asks_no_other_server_and_runs_no_other_script():
    page = page_of("host.html", "host.css", "board.js", "host.js", title="A commons")
    assert not re.search(r"(?:src|href|url)\s*[=(]|https?://|@import|innerHTML|\$\w+", page)
    assert "default-src 'none'" in page
    assert re.search(r"script-src 'sha256-[\w+/]{43}='\"", page)
    other = page_of("host.html", "host.css", "board.js", title="A commons")
    assert re.search("sha256-[^']+", other)[0] != re.search("sha256-[^']+", page)[0]


@pytest.fixture(scope="module")
def window():
    with browser("about:blank", size=(1280, 900)) as page:
        yield page


@pytest.fixture
def host():
    with scripted_host() as host:
        yield host


def open_page(window, host, *messages, size=(1280, 800)):
    """Opens the link in a window without a seat, and greets it."""
    host.greeting = [WELCOME, *messages]
    window.resize(*size)
    window.open(f"{host.address}elsewhere")
    window.run("sessionStorage.clear()")
    window.open(f"{host.address}#JOIN")
    wait_for(window, "document.body.dataset.connection === 'open'")


def wait_for(window, condition):
    wait_until(lambda: window.run(f"return {condition}"), 20.0, condition)


def text(window, name):
    return window.run(f"return document.getElementById('{name}').innerText")


def press(window, key, kind="keydown"):
    window.run(f"dispatchEvent(new KeyboardEvent('{kind}', {{key: '{key}'}}))")


def actions(host):
    return [message["action"] for message in host.received if message["type"] == "action"]


@pytest.mark.viewer
@pytest.mark.parametrize("size", SIZES)
def test_every_stage_fits_the_screen(window, host, size):
    round_, turn = round_and_turn(GAME, chat=True, options=["tax: 0", "tax: 0.5"])
    ended = {"round": 1, "harvest": [3, 5], "income": [2.5, 5.5], "survival_steps": 90, "ended": "time"}
    results = [{"rule": "none", **ended, "trained": {"harvest": 7.25, "survival_steps": 200.0}}]
    line = {"type": "chat", "from": "you", "text": "x" * 200}
    open_page(window, host, stage("lobby"), size=size)
    stages = {
        "consent": [{**WELCOME, "consent": "A study.\n\n" * 40}, stage("consent")],
        "lobby": [stage("lobby")],
        "between": [round_, stage("between", seconds=30.0)],
        "playing": [round_, turn, stage("playing"), *[line] * 9],
        "ended": [{"type": "round_end", **ended}],
        "end": [{"type": "end", "completion_code": "ABCD2345", "rounds": results}, stage("end")],
    }
    for name, messages in stages.items():
        host.say(*messages)
        shown = "playing" if name == "ended" else name
        wait_for(window, f"document.body.dataset.stage === '{shown}'")
        page = "document.documentElement"
        assert window.run(f"return [{page}.scrollWidth, {page}.scrollHeight]") == [*size], name
    assert text(window, "text").split() == ["Your", "completion", "code:", "ABCD2345"]
    rows = text(window, "results").splitlines()
    assert rows[1:3] == ["person 0\t3 (2.5)", "you\t5 (5.5)"]
    assert rows[-2:] == ["trained agents: each, on average\t7.3", "trained agents: turns, on average\t200"]


@pytest.mark.viewer
def test_what_others_write_is_text(window, host):
    round_, _ = round_and_turn(GAME, chat=True)
    open_page(window, host, round_, stage("instructions"))
    host.say({"type": "chat", "from": "person 0", "text": "<img src=x onerror=alert(1)>"})
    wait_for(window, "document.querySelectorAll('#lines li').length === 1")
    assert "<img src=x" in text(window, "lines")
    assert "Pick <b>apples</b>." in text(window, "text")
    assert window.run("return document.querySelectorAll('img').length") == 0


@pytest.mark.viewer
def test_keys_move_as_the_screen_shows_and_a_held_one_is_played_in_each_turn(window, host):
    round_, turn = round_and_turn(GAME)
    open_page(window, host, round_, stage("instructions", seconds=60.0))
    press(window, "ArrowUp")
    window.run("document.getElementById('go').click()")
    host.say(turn, stage("playing"))
    wait_for(window, "!document.getElementById('view').hidden")
    for key in ("ArrowLeft", "w", "D", "s", "q", "f", " ", "z"):
        press(window, key)
        press(window, key, "keyup")
    wait_until(lambda: len(actions(host)) == 7, 20.0, "keys were not sent")
    assert actions(host) == ["forward", "right", "backward", "left", "turn_left", "beam", "beam"]
    press(window, "a")
    host.say({**turn, "turn": 1}, {**turn, "turn": 2})
    wait_until(lambda: len(actions(host)) == 10, 20.0, "the held key was not played")
    press(window, "a", "keyup")
    host.say({**turn, "turn": 3})
    wait_for(window, "document.getElementById('time').value === 3")
    assert actions(host)[7:] == ["forward"] * 3
    numbers = [message["number"] for message in host.received if message["type"] == "action"]
    assert numbers == [*range(1, 11)]
    assert host.received[0] == {"type": "ready"}, "a key before the round is not sent"


@pytest.mark.viewer
def test_fingers_hold_buttons_and_the_window_is_drawn(window, host):
    round_, turn = round_and_turn(GAME, view="window")
    open_page(window, host, round_, turn, stage("playing"), size=(420, 800))
    wait_for(window, "!document.getElementById('pad').hidden")
    down = """
        const right = document.querySelector('#pad [aria-label=right]');
        right.setPointerCapture = () => {{}};
        right.dispatchEvent(new PointerEvent('{}', {{pointerId: 1}}))"""
    window.run(down.format("pointerdown"))
    host.say({**turn, "turn": 1})
    wait_until(lambda: len(actions(host)) == 2, 20.0, "the held button was not played")
    window.run(down.format("pointerup"))
    assert actions(host) == ["right"] * 2, "in the window the person heads up"
    pixels = "document.getElementById('board').getContext('2d').getImageData(0, 0, 390, 150).data"
    assert window.run(f"return {pixels}.filter((value) => value > 200).length") > 100


@pytest.mark.viewer
def test_turns_without_a_clock_wait_for_a_choice_and_a_vote_is_sent(window, host):
    round_, turn = round_and_turn(GAME, turns_a_second=None, options=["tax: 0", "tax: 0.5"])
    open_page(window, host, round_, stage("between"))
    window.run("document.querySelectorAll('#ballot button')[1].click()")
    host.say(turn, stage("playing"))
    wait_for(window, "document.getElementById('said').innerText.startsWith('Choose')")
    press(window, "x")
    wait_for(window, "document.getElementById('said').innerText.startsWith('You chose: stay')")
    host.say({**turn, "turn": 1})
    wait_for(window, "document.getElementById('said').innerText.startsWith('Choose')")
    assert [message["type"] for message in host.received] == ["vote", "action"]
    assert host.received[0]["option"] == 1


@pytest.mark.viewer
def test_a_page_that_is_loaded_again_or_loses_its_host_has_the_same_seat(window, host):
    round_, turn = round_and_turn(GAME)
    open_page(window, host, round_, turn, stage("playing"))
    host.say({"type": "chat", "from": "person 0", "text": "Hello"})
    wait_for(window, "document.querySelectorAll('#lines li').length === 1")
    assert window.run("return location.href") == host.address, "the token is not in the address"
    joined = len(host.joined)
    window.run("location.reload()")
    wait_until(lambda: len(host.joined) == joined + 1, 20.0, "it did not join again")
    secret = host.joined[-1]["seat_token"]
    wait_for(window, "document.getElementById('lines').textContent.includes('Hello')")
    wait_for(window, "document.body.dataset.connection === 'open'")
    host.close()
    wait_until(lambda: len(host.joined) == joined + 2, 20.0, "it did not try again")
    wait_for(window, "document.body.dataset.connection === 'open'")
    assert host.joined[-1] == {"token": "JOIN", "seat_token": secret}
    host.refusal = 503
    host.close()
    wait_for(window, "document.getElementById('said').innerText.includes('trying again')")
    host.refusal = None
    wait_for(window, "document.body.dataset.connection === 'open'")


@pytest.mark.viewer
def test_a_refused_seat_is_told_apart_from_a_lost_connection(window, host):
    open_page(window, host, stage("lobby"))
    host.refusal = 409
    host.close()
    wait_for(window, "document.getElementById('said').innerText.includes('all 2 seats are taken')")
    joined = len(host.joined)
    assert window.run("return document.body.dataset.connection") == "refused"
    host.refusal = None
    open_page(window, host, stage("lobby"))
    host.close(4001)
    wait_for(window, "document.querySelector('#said button') !== null")
    assert len(host.joined) == joined + 1, "it does not take the seat back by itself"
    window.run("document.querySelector('#said button').click()")
    wait_for(window, "document.body.dataset.connection === 'open'")
    window.open(f"{host.address}elsewhere")
    window.run("sessionStorage.clear()")
    window.open(host.address)
    wait_for(window, "document.getElementById('said').innerText.includes('by the link')")
