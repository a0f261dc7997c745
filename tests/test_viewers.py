"""Real viewers look at a live training, and their pictures show it; `make test-viewer` runs these tests."""

import re
import subprocess
import sys
import time
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from viewers import browser, free_port, native_viewer, steady_picture

from cprl.commons.colours import APPLE, PALETTE, agent_colour
from cprl.viewer.logger import RerunLogger
from cprl.viewer.scenery import SOCIAL, Scene

pytestmark = pytest.mark.viewer

SCRIPT = Path(__file__).with_name("train_and_watch.py")
AGENTS = 4
BOARD = (0.0, 0.0, 0.4, 0.40)
"""Where the layout puts what is looked for, as shares of the picture: left, top, right, bottom."""
RETURNS, SOCIAL_PLOTS = (0.4, 0.0, 1.0, 0.42), (0.4, 0.36, 1.0, 0.66)
PLACES = {
    "social/collective_return": RETURNS,
    "social/survival_steps": SOCIAL_PLOTS,
    "social/equality": SOCIAL_PLOTS,
    "social/peacefulness": SOCIAL_PLOTS,
}
EVERYTHING = ["apples", *(f"agent_{n} on the board" for n in range(AGENTS))]
EVERYTHING += [*(f"line of agent_{n}" for n in range(AGENTS)), *(f"line of {name}" for name in PLACES)]


def spots(picture, place, colour, *, within=40):
    """The (row, col) of all pixels of that colour, nearly, in a part of a PNG."""
    pixels = np.asarray(Image.open(BytesIO(picture)).convert("RGB"), np.int32)
    high, wide = pixels.shape[:2]
    left, top, right, bottom = place
    part = pixels[round(top * high) : round(bottom * high), round(left * wide) : round(right * wide)]
    return np.argwhere(np.abs(part - colour).max(-1) <= within)


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
    lines = {f"agent_{agent}": (RETURNS, agent_colour(agent)) for agent in range(AGENTS)}
    lines |= {name: (place, SOCIAL[name][1]) for name, place in PLACES.items()}
    for name, (place, colour) in lines.items():
        if len(np.unique(spots(picture, place, colour)[:, 1])) < 100:
            lacking.append(f"line of {name}")
    return lacking


@pytest.fixture(scope="module")
def training(tmp_path_factory):
    """A training that goes on, and its two addresses."""
    folder = tmp_path_factory.mktemp("live")
    process = subprocess.Popen(
        [sys.executable, "-u", SCRIPT, folder], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    addresses, heard = {}, []
    try:
        for line in process.stdout:
            heard.append(line)
            if told := re.match(r"ViewerCallback live \((\w+)\): (.*)", line):
                addresses[told[1]] = told[2]
            if len(addresses) == 2:
                break
        assert len(addresses) == 2, "".join(heard)
        yield process, addresses
    finally:
        process.kill()
        process.communicate()


def look_until_all_is_there(take_picture, path, *, limit_s):
    """Takes pictures until one shows everything; the last one is kept in `path`."""
    began = time.monotonic()
    while True:
        picture = take_picture()
        path.write_bytes(picture)
        lacking = missing(picture)
        if not lacking:
            return
        assert time.monotonic() - began < limit_s, f"{path} lacks {lacking}"
        time.sleep(1)


def test_reruns_viewer_shows_a_live_training(training, tmp_path):
    process, addresses = training
    with native_viewer(connect_to=addresses["native"].split()[-1]) as client:
        look_until_all_is_there(client.take_screenshot, tmp_path / "native.png", limit_s=120)
        first = client.get_state()
        time.sleep(5)
        later = client.get_state()
    assert not [report for view in later.views for report in view.reports], "no view complains"
    assert newest_step(later) > newest_step(first), "the viewer follows the training"
    assert process.poll() is None, "the training goes on"


def newest_step(state):
    """The last step that a viewer knows of."""
    (recording,) = state.recordings
    return next(timeline.end for timeline in recording.timelines if timeline.name == "step")


def test_the_web_viewer_in_chromium_shows_a_live_training(training, tmp_path):
    process, addresses = training
    with browser(addresses["browser"]) as take_picture:
        look_until_all_is_there(take_picture, tmp_path / "browser.png", limit_s=400)
    assert process.poll() is None, "the training goes on"


def test_an_empty_viewer_lacks_everything():
    with native_viewer() as client:
        assert missing(steady_picture(client)) == EVERYTHING


def test_a_browser_without_a_recording_lacks_everything(training):
    _, addresses = training
    page = addresses["browser"].split("?")[0]
    nobody = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{free_port()}%2Fproxy"
    with browser(f"{page}?url={nobody}&renderer=webgl&persist=0&theme=dark") as take_picture:
        time.sleep(20)
        assert missing(take_picture()) == EVERYTHING


def test_names_in_the_layout_without_any_data_are_no_lines(tmp_path):
    agents = tuple(f"agent_{agent}" for agent in range(AGENTS))
    scene = Scene(height=12, width=24, walls=(), sites=(), agents=agents, window=(6, 13))
    with RerunLogger("run", tmp_path, scene=scene) as logger:
        for name in [*(f"{agent}/return" for agent in agents), *PLACES]:
            logger.log_scalar(name, 1.0, step=7)
    with native_viewer() as client:
        client.open(str(tmp_path / "run.rrd"))
        time.sleep(2)
        assert missing(steady_picture(client)) == EVERYTHING, "one value has a legend, and makes no line"
