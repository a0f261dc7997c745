"""The page of five steps: what it plays, what it quotes, and how it looks in Chromium."""

import json
import math
import re
from dataclasses import replace

import pytest
from places import RESULTS
from viewers import browser, wait_until

from cprl import presets
from cprl.institutions import Quota
from cprl.web.explorable import GROWTHS, LEARNERS, RANDOM_PLAY, explorable_page, grown, parts
from cprl.web.playable import playable

STUDY = RESULTS / "studies" / "changes" / "institutions.md"


def data_on_the_page():
    [text] = re.findall(r'<script id="data" type="application/json">(.*?)</script>', explorable_page())
    return json.loads(text)


def test_the_numbers_of_learners_are_those_of_the_committed_study():
    lines = [line.strip("| ").split(" | ") for line in STUDY.read_text(encoding="utf-8").splitlines()]
    rows = {line[0]: line[1:] for line in reversed(lines)}  # the first table of two
    for learner, condition in zip(LEARNERS, ["nothing changed", "quota (2)"], strict=True):
        frozen, _, learning, _, survival, *_ = rows[condition]
        assert (learner["income"], learner["learning"]) == (frozen, learning)
        assert f"{learner['turns']:,}" == survival.split(" [")[0]
    assert f"Random play harvests {RANDOM_PLAY} apples without a rule." in rows
    assert json.loads(json.dumps(LEARNERS)) == data_on_the_page()["learners"]


def test_growth_on_the_page_is_growth_of_the_game():
    base = presets.game("commons")
    assert grown(base, 1) == base
    data = data_on_the_page()
    assert data["game"] == json.loads(json.dumps(playable(base)))
    assert [growth["times"] for growth in data["growths"]] == list(GROWTHS)
    for growth in data["growths"]:
        game = replace(grown(base, growth["times"]), institutions=(Quota(share=1.0),))
        assert growth["regrow_below"] == playable(game)["regrow_below"]
        assert growth["unit"] == playable(game)["quota"]["unit"]


def test_the_quota_of_learners_is_the_limit_of_six_that_the_page_names():
    [growth] = [growth for growth in data_on_the_page()["growths"] if growth["times"] == 1]
    assert math.floor(0.25 * growth["unit"]) == 6
    assert "the limit of six" in explorable_page()


def test_the_page_is_one_small_file_that_asks_no_network():
    page = explorable_page()
    assert len(page.encode()) < 90_000
    assert "http" not in page.replace("http-equiv", "")
    assert re.findall(r"\b(?:src|href)=", page) == []
    assert "$" not in re.sub(r"\$\{", "", page)
    assert "innerHTML" not in page
    assert parts()["more"] == ""


@pytest.mark.viewer
@pytest.mark.parametrize(("width", "height"), [(1280, 900), (400, 800)])
def test_chromium_plays_the_five_steps(tmp_path, width, height):
    path = tmp_path / "explorable.html"
    path.write_text(explorable_page(), encoding="utf-8")
    with browser(path.as_uri(), size=(width, height)) as page:
        page.resize(width, height)

        def counted():
            wait_until(lambda: page.run("return stage.isCounted"), 60.0, "no episode is counted")

        def move(name, value):
            page.run(
                f"const slider = document.querySelector('[name={name}]'); slider.value = {value};"
                "slider.dispatchEvent(new Event('input'))"
            )
            counted()

        counted()
        page.run("stage.playTo(1000)")
        assert page.run("return element('answer').textContent").startswith("Gone for good at turn 1")
        assert page.run("return element('answer').className") == "dead"
        page.run("element('next').click()")
        move("hold", 4)
        assert "0 fields died. Before (4 greedy)" in page.run("return element('mean').textContent")
        page.run("scrollTo(0, 150)")
        top = page.run("return element('board').getBoundingClientRect().top")
        assert top >= 0, "the board stays in view"
        page.run("openStep(2)")
        counted()
        move("quota", 3)
        page.run("stage.playTo(1000)")
        assert page.run("return element('answer').textContent").startswith("Still alive after 1,000 turns")
        page.run("openStep(3)")
        move("growth", 0)
        page.run("openStep(4)")
        counted()
        tried = page.run("return stage.tries.map((found) => found.name)")
        assert tried[:3] == ["4 greedy", "4 hold back", "4 greedy, limit 12"]
        assert tried[-1] == "4 greedy, limit 3, growth x 0.25"
        assert "262 [184, 340]" in page.run("return element('idea').textContent")
        assert page.run("return element('list').children.length") == len(tried) + len(LEARNERS)
        assert page.run("return document.documentElement.scrollWidth <= innerWidth")
