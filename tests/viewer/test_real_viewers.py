"""Real viewers look at a live training, and their pictures show it; `make test-viewer` runs these tests."""

import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from functools import partial
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from places import SUPPORT
from recordings import SCENE, frames, headers
from viewers import browser, native_viewer, wait_until
from watched import ALONE, population_of

from cprl.commons.cells import APPLE
from cprl.experimental.exhibition import exhibition
from cprl.measuring.registry import colour
from cprl.pictures.colours import PALETTE, agent_colour
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.live import served
from cprl.viewer.logger import RerunLogger

pytestmark = pytest.mark.viewer

SCRIPT = SUPPORT / "train_and_watch.py"
AGENTS = 4
BOARD = (0.0, 0.17, 0.6, 0.8)
"""Where the layout puts what is looked for, as shares of the picture: left, top, right, bottom."""
HEADER = (0.0, 0.04, 1.0, 0.12)
PLACES = {"collective_return": (0.62, 0.17, 1.0, 0.36), "stock_left": (0.62, 0.39, 1.0, 0.58)}
LIMIT_S = 900.0
"""The longest wait, on a machine with much other work; as a rule it takes seconds."""


def spots(picture, place, colour, *, within=40):
    """The (row, col) of all pixels of that colour, nearly, in a part of a PNG."""
    return np.argwhere(np.abs(part(picture, place) - colour).max(-1) <= within)


def part(picture, place):
    """The pixels of a part of a PNG, int32 [rows, columns, 3]."""
    pixels = np.asarray(Image.open(BytesIO(picture)).convert("RGB"), np.int32)
    high, wide = pixels.shape[:2]
    left, top, right, bottom = place
    return pixels[round(top * high) : round(bottom * high), round(left * wide) : round(right * wide)]


def missing(picture):
    """What a picture of the viewer ought to show of the training, and does not.

    An apple or agent is an area on the board. A line goes on for a hundred pixels, which no entry of a legend
    does.
    """
    lacking = []
    if len(spots(picture, BOARD, PALETTE[APPLE], within=4)) < 5000:
        lacking.append("apples")
    for agent in range(AGENTS):
        if len(spots(picture, BOARD, agent_colour(agent), within=4)) < 60:
            lacking.append(f"agent_{agent} on the board")
    for name, place in PLACES.items():
        if len(np.unique(spots(picture, place, colour(name))[:, 1])) < 100:
            lacking.append(f"line of {name}")
    return lacking


@contextmanager
def training_of(episodes, folder):
    """A training of so many episodes, its addresses, and its further output."""
    command = [sys.executable, "-u", SCRIPT, folder / "run", str(episodes)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    addresses, heard = {}, []
    reader = threading.Thread(target=lambda: heard.extend(process.stdout))
    try:
        for line in process.stdout:
            heard.append(line)
            if told := re.match(r"Watch live \((\w+)\): (.*)", line):
                addresses[told[1]] = told[2]
            if len(addresses) == 2:
                break
        assert len(addresses) == 2, "".join(heard)
        reader.start()
        yield process, addresses, heard
    finally:
        process.kill()
        if reader.ident:
            reader.join()
        process.stdout.close()
        process.wait()


@pytest.fixture(scope="module")
def training(tmp_path_factory):
    """A training that goes on for hours."""
    with training_of(100_000, tmp_path_factory.mktemp("live")) as (process, addresses, _):
        yield process, addresses


def sources(addresses):
    """The addresses of the recording and of the exhibition."""
    return addresses["native"].split("--connect ")[1].split()


def look_until(is_there, take_picture, path, *, limit_s=LIMIT_S):
    """Takes pictures until one shows what it should; the last one is kept in `path`."""

    def shows():
        path.write_bytes(take_picture())
        return is_there(path.read_bytes())

    wait_until(shows, limit_s, f"{path} does not show it", every_s=1.0)


def shows_all(picture):
    return not missing(picture)


class Moves:
    """Whether a part of the picture has changed so many times."""

    def __init__(self, place, times):
        self.place, self.left, self.last = place, times, None

    def __call__(self, picture):
        seen = part(picture, self.place).tobytes()
        self.left -= self.last is not None and seen != self.last
        self.last = seen
        return self.left <= 0


@pytest.mark.parametrize("size", [(1600, 1000), (1280, 720)])
def test_the_board_is_there_before_the_first_step_is_played(size, tmp_path):
    env, population = population_of(ALONE)
    exhibit = partial(exhibition, ALONE, population)
    with ViewerCallback(tmp_path, env, title="run", episodes=3, live="serve", exhibit=exhibit) as viewer:
        with native_viewer(connect_to=sources(viewer.logger.addresses), size=size) as client:
            look_until(
                lambda picture: len(spots(picture, BOARD, PALETTE[APPLE], within=4)) > 3000,
                client.take_screenshot,
                tmp_path / "first.png",
                limit_s=60,
            )
        assert viewer.exhibition.steps == 0


def test_reruns_viewer_shows_a_live_training(training, tmp_path):
    process, addresses = training
    with native_viewer(connect_to=sources(addresses)) as client:
        look_until(shows_all, client.take_screenshot, tmp_path / "native.png")
        first = client.get_state()
        assert not [report for view in first.views for report in view.reports], "no view complains"
        wait_until(
            lambda: newest_step(client.get_state()) > newest_step(first),
            LIMIT_S,
            "the viewer does not follow the training",
        )
    assert process.poll() is None, "the training goes on"


def newest_step(state):
    """The last step that a viewer knows of."""
    (recording,) = state.recordings
    return next(timeline.end for timeline in recording.timelines if timeline.name == "step")


def test_the_exhibition_moves_while_the_training_goes_on_and_keeps_to_one_recording(training, tmp_path):
    process, addresses = training
    with native_viewer(connect_to=sources(addresses)) as client:
        look_until(Moves(BOARD, 3), client.take_screenshot, tmp_path / "moving.png")
        assert len(client.get_state().recordings) == 1, "two servers, one recording"
        client.set_time("episode", sequence=0, play_state="paused")
        look_until(Moves(BOARD, 3), client.take_screenshot, tmp_path / "paused.png")
    assert process.poll() is None


def test_the_end_of_a_run_is_seen_and_the_trained_policy_plays_on(tmp_path):
    with training_of(3, tmp_path) as (process, addresses, heard):
        with native_viewer(connect_to=sources(addresses)) as client:
            look_until(Moves(BOARD, 1), client.take_screenshot, tmp_path / "begins.png")
            running = part((tmp_path / "begins.png").read_bytes(), HEADER).tobytes()
            wait_until(
                lambda: process.poll() is not None or any("stays served" in line for line in heard),
                LIMIT_S,
                "the run does not end",
            )
            assert process.poll() is None, "".join(heard)
            changed = Moves(HEADER, 1)
            changed.last = running
            look_until(changed, client.take_screenshot, tmp_path / "ended.png")
            look_until(Moves(BOARD, 3), client.take_screenshot, tmp_path / "plays_on.png")
            ended = part((tmp_path / "plays_on.png").read_bytes(), HEADER).tobytes()
            client.set_time("episode", sequence=0, play_state="paused")
            time.sleep(2)
            assert part(client.take_screenshot(), HEADER).tobytes() == ended, "wherever the cursor is"
        assert "Finished" in headers(tmp_path / "run" / "run.rrd")[-1][1]
        process.send_signal(signal.SIGINT)
        assert process.wait(LIMIT_S) == 0


def test_the_web_viewer_in_chromium_shows_a_live_training(training, tmp_path):
    process, addresses = training
    with browser(addresses["browser"]) as take_picture:
        look_until(shows_all, take_picture, tmp_path / "browser.png")
        look_until(Moves(BOARD, 1), take_picture, tmp_path / "browser_moves.png")
    assert process.poll() is None, "the training goes on"


def test_the_web_viewer_shows_a_recording_that_is_served_from_its_file(tmp_path):
    """It is no replay: of a page that plays Chromium's driver gets no picture where it is drawn on a CPU."""
    with RerunLogger("run", tmp_path, curves=SCENE) as logger:
        logger.log_frames(frames(3)[0])
        logger.log_header("# Finished")
    with served([tmp_path / "run.rrd"]) as page, browser(page.addresses["browser"]) as take_picture:
        look_until(
            lambda picture: len(spots(picture, BOARD, PALETTE[APPLE], within=4)) > 500,
            take_picture,
            tmp_path / "served.png",
        )
