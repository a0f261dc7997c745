"""A class at three browsers, one of them a phone's: lobby, practice, two rounds under two rules, the end."""

import json

import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hosted_process import hosted_process, person

from cprl.runs.journal import batches_in

DESK = (1280, 800)
PHONE = (400, 780)
WORDS = (
    *("commons", "--people", "3", "--agents", "greedy", "--rounds", "none", "quota", "--turns", "120"),
    *("--practice-turns", "16", "--turns-a-second", "4", "--pause-seconds", "40", "--chat"),
)


def played(folder):
    """The turns in the journal of a round, in which nothing is lost when the server is killed."""
    journal = folder / "turns.arrows"
    if not journal.exists():
        return []
    return [batch["turn"][0].as_py() for batch, _ in batches_in(journal)]


@pytest.mark.docs
def test_three_people_play_two_rounds_though_one_reloads_one_leaves_and_the_server_is_killed(tmp_path):
    pictures = tmp_path / "pictures"
    consent = tmp_path / "consent.txt"
    consent.write_text("This is a study of how people share a field.\n\nYou may leave at any time.")
    out = tmp_path / "out"
    with (
        hosted_process(out, *WORDS, "--consent", str(consent)) as process,
        person(process.link, DESK) as first,
        person(process.link, DESK) as second,
    ):
        with person(process.link, PHONE) as third:
            people = [first, second, third]
            for number, one in enumerate(people):
                one.sees("consent").picture(pictures / f"1 consent {number}.png")
            for one in (first, second):
                one.click("#go").sees("lobby")
            first.until("state.stage.here === 2").picture(pictures / "2 lobby.png")
            third.click("#go")
            for number, one in enumerate(people):
                one.sees("instructions").picture(pictures / f"3 instructions {number}.png")
                one.click("#go")

            third.sees("practice").until("!document.getElementById('view').hidden")
            before = third.value("state.turn.board.cells[state.me]")
            third.picture(pictures / "4 practice 2.png")
            for button in ("up", "right", "left", "down"):
                third.touch(f"#pad [aria-label={button}]", 0.6)
            third.until(f"state.turn.board.cells[state.me] !== {before}", 20.0)
            first.picture(pictures / "4 practice 0.png")

            for number, one in enumerate(people):
                one.sees("between").picture(pictures / f"5 between {number}.png")
            first.click("#line").value("document.getElementById('line').value = '<b>leave</b> some'")
            first.click("#chat button")
            second.until("document.querySelectorAll('#lines li').length === 1")
            assert second.text("#lines") == "person 0<b>leave</b> some"
            for one in people:
                one.click("#go")
            second.sees("playing").until("state.turn?.turn > 3")
            before = second.value("state.turn.board.cells[state.me]")
            for key in ("ArrowUp", "ArrowRight", "ArrowDown", "ArrowLeft"):
                second.hold(key, 0.6)
            second.until("state.turn.turn > 12")
            assert (
                second.value("state.turn.board.cells[state.me]") != before or second.value("state.number") > 3
            )
            code = second.text("#code")
            second.window.run("location.reload()")
            second.until("document.body.dataset.connection === 'open' && state.turn?.turn > 12")
            assert second.text("#code") == code
            for number, one in enumerate(people):
                one.hold("ArrowUp", 0.3).picture(pictures / f"6 round one {number}.png")

            for number, one in enumerate(people):
                one.sees("between").picture(pictures / f"7 between {number}.png")
                one.click("#go")
            first.until("state.round.round === 2 && state.turn?.turn > 8")

        first.until("state.turn.turn > 30")
        first.picture(pictures / "8 the phone has left 0.png")
        process.kill()
        kept = played(out / "round-2")
        seen = first.value("state.turn.turn")
        assert kept[-1] >= seen, "a turn is stored before anybody sees it"
        for number, one in enumerate((first, second)):
            one.until("document.getElementById('said').innerText.includes('trying again')")
            one.picture(pictures / f"9 killed {number}.png")
        process.start()
        for number, one in enumerate((first, second)):
            one.until(f"document.body.dataset.connection === 'open' && state.turn?.turn > {kept[-1]}")
            one.picture(pictures / f"10 goes on {number}.png")
        for number, one in enumerate((first, second)):
            one.sees("end").until("state.end").picture(pictures / f"11 end {number}.png")
            assert len(one.value("state.end.rounds")) == 2
            assert len(one.text(".code")) == 8

    for number in (1, 2):
        turns = pq.read_table(out / f"round-{number}" / "turns.parquet")
        last = pc.max(turns["turn"]).as_py()
        assert turns["turn"].to_pylist() == [turn for turn in range(1, last + 1) for _ in range(4)]
    left = [row for row in turns.to_pylist() if row["agent"] == 2]
    assert not left[-1]["person"], "the person at the phone has left"
    stored = json.loads((out / "session.json").read_text())
    assert [seat["consented"] != "" for seat in stored["seats"]] == [True] * 3
