"""The page about a run or a study."""

import re
import shutil
from dataclasses import replace
from functools import partial

import pytest
from matrix_games import prisoners_dilemma
from places import RESULTS
from stored_runs import CORRIDORS, command, stored
from told_courses import LENGTHS, RISE_AND_FALL, told_of
from viewers import browser, wait_until

from cprl import Custom, presets
from cprl.evaluation import Fresh, evaluate_run
from cprl.institutions import Quota
from cprl.terminal.summary import comparison_table
from cprl.training.stored import load
from cprl.values import trust
from cprl.web.report import report
from cprl.web.show import show

STUDY = RESULTS / "studies" / "exploration"
GOVERNED = replace(CORRIDORS, institutions=(Quota(share=0.5, window_steps=2),))


def cells_of(page):
    return re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", page)


def test_a_report_of_a_run_has_its_numbers_rules_episode_and_recipe(tmp_path):
    run = stored(tmp_path / "governed", GOVERNED, replicas=3)
    text = report(run, episodes=4, seed=5).read_text(encoding="utf-8")
    table = comparison_table(evaluate_run(run, Fresh(episodes=4, seed=5)), "")
    for row in table.rows:
        assert [*map(str, row)][1:] == cells_of(text)[cells_of(text).index(row[0]) + 1 :][: len(row) - 1], row
    assert "<strong>quota (share 0.5" in text
    assert "<code>regrow_prob</code>" in text
    shown, _ = show(run)
    episode = re.search(r'"data":"([^"]+)"', shown.read_text(encoding="utf-8"))[1]
    assert episode in text, "it is the episode of cprl show"
    assert "cprl evaluate RUN --episodes 4 --seed 5" in text
    assert "&quot;kind&quot;: &quot;Quota&quot;" in text
    assert "<h2>Training</h2>" not in text, "no episode was played"
    assert not re.search(r"(?:src|href)=\"(?!data:)|https?://", text)


def test_a_report_names_what_is_of_ones_own_and_says_what_a_tag_does(tmp_path):
    game = presets.game("two_complex", variant="as_run")
    game = replace(game, rules=replace(game.rules, episode_steps=5))
    own = Custom("own_parts:largest_share"), Custom("own_parts:Gift", {"apples": 0.5})
    run = stored(tmp_path / "run", game, metrics=own[:1], transforms=own[1:])
    trust(*[one.target for one in own])
    text = report(run, episodes=2).read_text(encoding="utf-8")
    assert "Code of its own: transforms: own_parts:Gift (apples 0.5): Adds a part" in text
    assert "metrics: own_parts:largest_share" in text
    assert "<p>After 2 hits an agent leaves the board for 24 turns.</p>" in text


def test_a_report_of_a_training_says_what_happened_and_draws_it(tmp_path):
    run = stored(tmp_path / "run")
    told = told_of(run, RISE_AND_FALL, LENGTHS, agents=load(run).specs)
    text = report(run, tmp_path / "own.html", episodes=2).read_text(encoding="utf-8")
    *facts, meaning = told.splitlines()
    assert all(fact in text for fact in facts)
    assert f"<strong>{meaning}</strong>" in text
    assert '<img src="data:image/svg+xml;base64,' in text


def test_a_report_of_a_study_has_question_expectation_answer_figure_and_tables(tmp_path):
    folder = shutil.copytree(STUDY, tmp_path / "exploration")
    text = report(folder).read_text(encoding="utf-8")
    summary = (folder / "summary.md").read_text(encoding="utf-8")
    question = re.search(r"\*\*Question\.\*\* (.*)", summary)[1]
    assert f"<strong>Question.</strong> {question}" in text
    assert "<strong>Expected before it was run.</strong>" in text
    answer = text[text.index("<strong>Answer.</strong>") : text.index("<h2>Training</h2>")]
    assert re.search(r"In 50 fresh episodes of the trained agents, beside .* Holm", answer)
    assert "<li>collective return, apples:" in answer
    assert text.count('<img src="data:image/png;base64,') == len(re.findall(r"!\[", summary)) > 0
    numbers = [row for row in summary.splitlines() if row.startswith("| ")]
    first = numbers[1].split("|")[2:4]
    assert all(number.strip() in cells_of(text) for number in first)
    for flag in ("episodes", "seed"):
        with pytest.raises(ValueError, match=f"{flag} is 2, .* is a study"):
            report(folder, tmp_path / "new.html", **{flag: 2})


def test_pictures_of_other_places_are_no_part_of_a_report(tmp_path):
    folder = shutil.copytree(STUDY, tmp_path / "exploration")
    (tmp_path / "secret.png").write_bytes(b"secret")
    summary = folder / "summary.md"
    summary.write_text(summary.read_text() + "\n![a](../secret.png)\n\n<script>alert(1)</script>\n")
    text = report(folder).read_text(encoding="utf-8")
    assert "c2VjcmV0" not in text
    assert "<script>alert" not in text


def test_a_game_without_a_board_has_a_report_without_an_episode(tmp_path):
    run = stored(tmp_path / "matrix", prisoners_dilemma(turns=2), "random")
    trust("matrix_games:MatrixGame")
    text = report(run, episodes=2).read_text(encoding="utf-8")
    assert '"populations":[]' in text
    assert any(cell.startswith("agent 0") for cell in cells_of(text))


def test_the_command_writes_a_page_once(tmp_path, monkeypatch, capsys):
    run = stored(tmp_path / "greedy")
    reported = partial(command, monkeypatch, capsys, "report", run)
    assert f"{run / 'report.html'}: " in reported("--episodes", 2)
    for words, said in ([], "exists"), (["--out", "own.pdf"], "html"):
        with pytest.raises(SystemExit, match=said):
            reported(*words)


@pytest.mark.viewer
@pytest.mark.parametrize("width", [1440, 400])
def test_chromium_shows_reports_without_scrolling_sideways(tmp_path, width):
    run = stored(tmp_path / "governed", GOVERNED)
    pages = [report(run, episodes=2), report(shutil.copytree(STUDY, tmp_path / "exploration"))]
    with browser(pages[0].as_uri(), size=(width, 900)) as window:
        window.resize(width, 900)
        for number, page in enumerate(pages):
            window.open(page.as_uri())
            wait_until(lambda: window.run("return document.readyState === 'complete'"), 20.0, "not ready")
            assert window.run("return document.documentElement.scrollWidth <= innerWidth")
            assert window.run("return [...document.images].every((own) => own.naturalWidth > 0)")
            (tmp_path / f"{number}.png").write_bytes(window())
