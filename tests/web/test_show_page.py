"""The page that shows episodes of stored agents in a browser."""

import json
import re
import zlib
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
from stored_runs import CORRIDORS, command, stored
from viewers import browser, wait_until

from cprl import Custom, keys, presets
from cprl.commons.cells import BEAM
from cprl.evaluation.fresh import fresh_episodes, record
from cprl.institutions import Boundaries, Monitoring, Punishment, Quota, Tax
from cprl.measuring.registry import SOCIAL_METRICS
from cprl.pictures.readable import growth_of, legend_of, meaning_of
from cprl.values import trust
from cprl.web.show import show

COMMONS = presets.game("commons")
GOVERNED = replace(
    COMMONS,
    institutions=(
        Boundaries.strips(
            height=COMMONS.map.height, width=COMMONS.map.width, agents=COMMONS.agents, bite_fine=0.5
        ),
        Monitoring(prob=1.0),
    ),
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Greedy agents on the corridors, and agents that act at random under institutions."""
    folder = tmp_path_factory.mktemp("runs")
    stored(folder / "greedy", policy="greedy")
    stored(folder / "governed", GOVERNED, "random")
    return folder


def told(path):
    """What a page is told, its turns unpacked."""
    text = path.read_text(encoding="utf-8")
    data = json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', text)[1])
    for population in data["populations"]:
        population |= json.loads(zlib.decompress(b64decode(population["data"])))
        population["boards"] = [moment["board"] for moment in population["moments"]]
    return data


@pytest.mark.integration
def test_a_page_holds_the_episode_that_a_film_shows(runs, tmp_path):
    path, (first, second) = show(
        runs / "greedy", tmp_path / "own.html", beside=[runs / "governed"], episode=1
    )
    data = told(path)
    greedy, governed = data["populations"]
    filmed = record(*fresh_episodes([runs / "governed"], episode=1))
    cells = [moment.row * governed["width"] + moment.col for moment in filmed.boards]
    assert [board["cells"] for board in governed["boards"]] == [row.tolist() for row in cells]
    harvested = [moment["harvest"] for moment in governed["moments"]]
    assert harvested == [moment.harvested.tolist() for moment in filmed.boards]
    apples = np.array([list(bytes.fromhex(board["apples"])) for board in governed["boards"]], np.uint8)
    stock = np.unpackbits(apples, axis=1)[:, : len(governed["sites"])]
    assert stock.tolist() == [moment.stock.tolist() for moment in filmed.boards]
    assert [moment["stock"] for moment in governed["moments"]] == stock.sum(1).tolist()
    poses = np.array([board["poses"] for board in governed["boards"]])
    violators = [set(np.flatnonzero(row & 8).tolist()) for row in poses]
    broke = filmed.entry("next", *keys.VIOLATED)
    assert violators == [set(), *(set(np.flatnonzero(row).tolist()) for row in broke)]
    assert any(violators)
    assert (poses & 3).tolist() == [moment.heading.tolist() for moment in filmed.boards]
    assert (poses & 4 > 0).tolist() == [moment.in_play.tolist() for moment in filmed.boards]
    lit = [set(board["beams"]) for board in governed["boards"]]
    assert lit == [set(np.flatnonzero(moment.board.reshape(-1) == BEAM).tolist()) for moment in filmed.boards]
    assert any(lit)
    assert governed["fined"][-1] == pytest.approx(second.fines.sum(), abs=1e-3)
    assert second.fines.sum() > 0
    assert governed["equality"][-1] == pytest.approx(second.metrics["equality"], abs=1e-3)
    assert "equality" in SOCIAL_METRICS
    assert len(governed["regions"]) == 4
    assert "fined" not in greedy
    assert (greedy["isDead"], governed["isDead"]) == (True, False)
    assert greedy["outcome"] == f"gone for good at turn {first.steps}: no apple is left"
    text = path.read_text(encoding="utf-8")
    assert "<h1>Different agents, different rules</h1>" in text, "nobody learned"
    assert data["axis"] == second.steps, "the curves of the longest episode fill it"
    assert data["most"] == max(*first.harvest, *second.harvest)


@pytest.mark.integration
def test_a_page_opens_without_a_network_and_is_small(runs, tmp_path):
    path, _ = show(runs / "governed", tmp_path / "own.html", beside=[runs / "governed"], titles=["a", "b"])
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"(?:src|href|url)\s*[=(]|https?://|@import", text)
    assert path.stat().st_size < 400_000


OWN = {
    "transforms": (Custom("own_parts:Gift", {"apples": 0.5}),),
    "metrics": (Custom("own_parts:largest_share"),),
}
OWN_TARGETS = ("own_parts:Gift", "own_parts:largest_share")


def test_rules_and_metrics_of_ones_own_are_named_on_the_page(runs, tmp_path):
    run = stored(tmp_path / "own", **OWN)
    trust(*OWN_TARGETS)
    path, _ = show(run, tmp_path / "own.html", beside=[runs / "greedy"])
    own, plain = told(path)["populations"]
    rule = "Code of its own: transforms: own_parts:Gift (apples 0.5): Adds a part of an apple"
    assert rule in own["about"]
    assert "metrics: own_parts:largest_share: Of all apples" in own["about"]
    assert "none beyond the game" not in own["about"]
    assert plain["about"].endswith("Rules: none beyond the game.")
    assert (own["title"], plain["title"]) == ("Gift", "No rule")
    assert "agents, different rules</h1>" in path.read_text(encoding="utf-8")


def test_rules_are_the_same_where_no_number_of_them_differs(runs, tmp_path):
    slower = replace(CORRIDORS, rules=replace(CORRIDORS.rules, episode_steps=8))
    run = stored(tmp_path / "slower", slower)
    path, _ = show(runs / "greedy", tmp_path / "own.html", beside=[run])
    assert "agents, different rules</h1>" in path.read_text(encoding="utf-8")
    path, _ = show(runs / "greedy", tmp_path / "same.html", beside=[runs / "greedy"])
    assert "agents, the same rules</h1>" in path.read_text(encoding="utf-8")


def test_titles_are_text_and_not_html(runs, tmp_path):
    title = "</script><script>alert(1)</script> $data"
    path, _ = show(runs / "greedy", tmp_path / "own.html", titles=[title])
    assert "<script>alert" not in path.read_text(encoding="utf-8")
    assert told(path)["populations"][0]["title"] == title


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--out", "own.gif"], "own.gif"),
        (["--titles", "a", "b"], "titles"),
        (["--replica", "9"], "replica is 9"),
        (["greedy"] * 6, "at most 5"),
    ],
)
def test_what_cannot_be_shown_is_refused_before_anything_is_written(runs, monkeypatch, capsys, words, said):
    monkeypatch.chdir(runs)
    before = sorted(runs.rglob("*"))
    with pytest.raises(SystemExit, match=said):
        command(monkeypatch, capsys, "show", "greedy", *words)
    assert sorted(runs.rglob("*")) == before


def test_the_command_writes_into_the_run_and_nothing_over(runs, monkeypatch, capsys):
    told = command(monkeypatch, capsys, "show", runs / "greedy")
    assert "3 steps, apples: 2, 3; 0 left" in told
    with pytest.raises(SystemExit, match="exists and is not overwritten"):
        command(monkeypatch, capsys, "show", runs / "greedy")
    (runs / "greedy" / "show-0-0.html").unlink()


@pytest.mark.viewer
@pytest.mark.parametrize("width", [1440, 400])
def test_chromium_plays_a_page_from_the_disk(runs, tmp_path, width):
    path, (greedy, governed) = show(runs / "greedy", tmp_path / "own.html", beside=[runs / "governed"])
    with browser(f"{path.as_uri()}#turn=2", size=(width, 900)) as page:
        page.resize(width, 900)
        wait_until(lambda: page.run("return document.body.dataset.ready"), 20.0, "the page is not ready")

        def numbers():
            return page.run(
                "return [...document.querySelectorAll('.numbers b')].map((own) => own.textContent)"
            )

        def press(key):
            page.run(f"dispatchEvent(new KeyboardEvent('keydown', {{key: {json.dumps(key)}}}))")

        assert page.run("return document.documentElement.scrollWidth <= innerWidth")
        assert page.run("return document.getElementById('now').textContent") == "turn 2"
        press("ArrowRight")
        assert page.run("return document.getElementById('now').textContent") == "turn 3"
        press("End")
        assert numbers()[1] == f"{greedy.harvest.sum():.0f}"
        assert numbers()[4] == f"{governed.harvest.sum():,.0f}"
        assert numbers()[-1] == f"{governed.fines.sum():.1f}"
        press("Home")
        press(" ")
        wait_until(
            lambda: page.run("return Number(document.getElementById('turn').value) > 5"), 20.0, "still"
        )
        lit = "const own = document.querySelectorAll('canvas')[2]; return [...own.getContext('2d')"
        colours = page.run(
            f"{lit}.getImageData(0, 0, own.width, own.height).data].filter((v) => v > 200).length"
        )
        assert colours > 1000, "the board is drawn"
        (tmp_path / "page.png").write_bytes(page())


def test_institutions_say_what_they_do_in_numbers_that_hold_in_the_game():
    quota, watch, tax = Quota(share=0.25, window_steps=50), Monitoring(prob=0.5), Tax(rate=0.3)
    game = replace(COMMONS, institutions=(quota,))
    apples = int(re.search(r"at most (\d+) apples in each window of 50 turns", meaning_of(quota, game))[1])
    assert apples == int(0.25 * game.sustainable_yield * 50 / 4)
    fined = replace(quota, fine=2.0)
    watched = replace(game, institutions=(fined, watch))
    assert "costs 2 apples if it is noticed" in meaning_of(fined, watched)
    assert "50%" in meaning_of(watch, watched)
    assert "30%" in meaning_of(tax, game)
    assert "Each shot costs 1." in meaning_of(Punishment(fine=50.0, cost=0.0, shot_cost=1.0), game)


def test_the_legend_names_only_signs_that_can_appear():
    peaceful = replace(CORRIDORS, rules=replace(CORRIDORS.rules, may_fire=False))
    assert not re.search("beam|diamond|river|Frames", legend_of([peaceful]))
    walled = replace(presets.game("two_complex"), institutions=(Quota(fine=1.0),))
    assert re.search("wall.*hit leaves the board for 25 turns.*diamond", legend_of([peaceful, walled]))
    fined = replace(walled, rules=replace(walled.rules, freeze_steps=0))
    assert "are a beam. " in legend_of([fined])
    assert legend_of([walled, walled]) == legend_of([walled])


def test_what_readers_are_told_of_growth():
    assert "stays bare" in growth_of(presets.game("commons"))
    assert "river" in growth_of(presets.game("ssd/cleanup-v1"))
    lush = replace(CORRIDORS, rules=replace(CORRIDORS.rules, regrow_prob=(0.1, 0.2)))
    assert growth_of(lush) == "Agents pick apples, which grow back."
