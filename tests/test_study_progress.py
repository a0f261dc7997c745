"""How far the trials of a study are: from their directories and what they say of themselves."""

import io
import json
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
from rich.console import Console
from tiny_study import FREEZE, TINY

from cprl import Study, run_study
from cprl.runs.files import write_json
from cprl.studies import progress
from cprl.studies.progress import Overview, Progress, table_of
from cprl.studies.status import Status, StatusFile
from cprl.studies.trials import Outcome, trials_of

TRIALS = trials_of(Study(replace(TINY, episodes=10, replicas=2), {FREEZE: [2, 5, 9]}))


@pytest.fixture
def says(tmp_path):
    """Writes what a trial says of itself, by its place."""
    folder = tmp_path / "status"
    folder.mkdir()

    def write(place, **status):
        path = Status(folder, TRIALS[place].name).path
        write_json(path, {"pid": 7, "host": "here", "of": 20, **status})

    return write


@pytest.fixture
def look(tmp_path, says):
    """Looks at all trials; gives the snapshot, and its row of a trial."""
    overview = Overview(TRIALS, tmp_path / "runs", tmp_path / "status")

    def look(place=0):
        snapshot = overview.look()
        return snapshot, next(row for row in snapshot.rows if row.trial is TRIALS[place])

    return look


def test_the_time_left_is_that_of_the_speed_at_which_trials_say_they_play(says, look):
    says(0, beat=1, episodes=0, steps=0, compiling_s=0.0)
    says(1, beat=9, episodes=0, steps=0)
    look()
    says(1, beat=10, episodes=0, steps=0, compiling_s=31.0, is_compiling=True)
    snapshot, row = look(1)
    assert (row.state, row.note) == ("compiling", "for 31 s")
    assert snapshot.left_s is None, "nothing is known yet"
    says(0, beat=19, episodes=5, steps=99, episodes_per_s=0.5)
    snapshot, row = look(0)
    # 15 of this trial are left, and with those of the other two 55
    assert (row.state, row.note) == ("running", "30 s left")
    assert snapshot.left_s == pytest.approx(110.0)
    assert snapshot.line == (
        "0 of 3 trials finished, 2 running, 5 of 60 episodes, 1 compiling, 2 min left"
    )  # 110 s in words


def test_a_trial_says_its_speed_without_compiling_and_what_it_had_done_before(tmp_path, monkeypatch):
    now, clock = SimpleNamespace(s=0.0), SimpleNamespace(total_s=0.0, is_running=False)
    monkeypatch.setattr("cprl.studies.status.time", SimpleNamespace(monotonic=lambda: now.s))
    monkeypatch.setattr("cprl.studies.status.CLOCK", clock)
    file = StatusFile(Status(tmp_path, "trial"), TRIALS[0].experiment)

    def speed():
        file.write()
        return json.loads((tmp_path / "trial.json").read_text())["episodes_per_s"]

    now.s = 5.0
    file.on_start(SimpleNamespace(steps=200, episodes_played=10))
    assert speed() is None
    now.s, clock.total_s = 39.0, 30.0
    for _ in range(2):
        file.on_episode(None, {})
    assert speed() == pytest.approx(0.5), "2 episodes in 4 s of work"


def test_a_trial_runs_while_it_says_something_new_whatever_the_clock_says(says, look, monkeypatch):
    says(0, beat=500, episodes=4, steps=9)
    assert look()[1].state == "missing", "perhaps the last words of a dead process"
    says(0, beat=501, episodes=4, steps=9)
    assert look()[1].state == "running"
    monkeypatch.setattr(progress, "SILENT_S", 0.0)
    assert look()[1].state == "missing"


def test_all_episodes_played_is_not_finished_yet(says, look):
    says(0, beat=1, episodes=20, steps=9)
    assert look()[1].state == "evaluating"


def test_failures_have_their_reason_and_stand_before_those_that_are_missing(look, tmp_path):
    Status(tmp_path / "status", TRIALS[2].name).fail("ValueError: of | chance", "trace")
    snapshot, row = look(2)
    assert snapshot.rows[0] is row
    assert row.note == "ValueError: of | chance"


@pytest.mark.integration
def test_a_table_is_never_higher_than_a_screen_and_counts_the_rest(tmp_path):
    many = trials_of(Study(TINY, {FREEZE: range(1, 101)}))
    Status(tmp_path, many[77].name).fail("ValueError: no", "")
    snapshot = Overview(many, tmp_path, tmp_path).look()
    screen = Console(file=io.StringIO(), width=80, height=24)
    screen.print(table_of(snapshot, title="mine", most=16))
    lines = screen.file.getvalue().splitlines()
    assert len(lines) == 19
    assert lines[2].split() == ["freeze_steps=78,", "replica", "0", "failed", "0/2", "ValueError:", "no"]
    assert lines[-2].strip() == "and 85 missing"
    assert lines[-1].startswith("0 of 100 trials finished, 1 failed, 0 of 200 episodes")


def test_what_trials_print_does_not_disturb_it(tmp_path, capsys, monkeypatch):
    printed = io.StringIO()
    with Progress(TRIALS, tmp_path, tmp_path, title="mine") as table:
        monkeypatch.setattr(sys, "stdout", printed)
        print("noise")
        Status(tmp_path, TRIALS[0].name).fail("ValueError: no", "")
        table.ended(Outcome(TRIALS[0].name, "failed", "ValueError: no", True))
        table.ended(Outcome(TRIALS[1].name, "finished"))
    assert printed.getvalue() == "noise\n"
    assert capsys.readouterr().out.splitlines() == [
        "mine: 0 of 3 trials finished, 0 of 60 episodes",
        "mine: freeze_steps=2, replicas 0-1 failed: ValueError: no (1 of 3)",
        "mine: 0 of 3 trials finished, 1 failed, 0 of 60 episodes",
    ]


def test_lines_come_while_trials_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("cprl.studies.progress._TABLE_PERIOD_S", 0.01)
    monkeypatch.setattr("cprl.studies.progress._LINE_PERIOD_S", 0.05)
    with Progress(TRIALS, tmp_path, tmp_path, title="mine"):
        time.sleep(0.5)
    assert 3 <= len(capsys.readouterr().out.splitlines()) <= 14


@pytest.mark.integration
@pytest.mark.parametrize("wanted", [True, False])
def test_in_a_terminal_one_table_is_drawn_again_and_again_where_progress_is_wanted(
    wanted, tmp_path, monkeypatch
):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    screen = Terminal()
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setenv("TERM", "xterm")
    study = Study(replace(TINY, episodes=1), {FREEZE: [2]})
    run_study(study, tmp_path / "out", results=False, progress=wanted)
    printed = screen.getvalue()
    if wanted:
        assert "\x1b[" in printed
        assert "freeze_steps=2, replica 0" in printed
        assert "1 of 1 trials finished, 1 of 1 episodes" in printed.splitlines()[-2]
    else:
        assert printed == ""
