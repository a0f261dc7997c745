"""How far the trials of a study are: from their directories and what they say of themselves."""

import io
import sys
import time
from dataclasses import replace

import pytest
from rich.console import Console
from tiny_study import FREEZE, TINY

from cprl import Study, run_study
from cprl.runs.files import write_json
from cprl.studies import progress
from cprl.studies.progress import Overview, Progress, table_of
from cprl.studies.trials import Outcome, Status, trials_of

STUDY = Study(replace(TINY, episodes=10, replicas=2), {FREEZE: [2, 5, 9]})


@pytest.fixture
def looked(tmp_path):
    """The trials of a study, how they say how far they are, and who looks."""
    trials = trials_of(STUDY)
    folder = tmp_path / "status"
    folder.mkdir()

    def says(nth, **what):
        write_json(Status(folder, trials[nth].name).path, {"pid": 7, "host": "here", "of": 20, **what})

    return trials, says, Overview(trials, runs=tmp_path / "runs", status=folder)


def row(snapshot, trial):
    return next(own for own in snapshot.rows if own.trial is trial)


def test_speed_is_measured_without_compiling_and_gives_the_time_left(looked):
    trials, says, own = looked
    says(0, beat=1, episodes=0, steps=0, running_s=0.1, compiling_s=0.0)
    says(1, beat=1, episodes=0, steps=0, running_s=0.1, compiling_s=0.0)
    own.look()
    says(0, beat=9, episodes=0, steps=3, running_s=31.0, compiling_s=30.0)
    says(1, beat=9, episodes=0, steps=0, running_s=31.0, compiling_s=31.0, is_compiling=True)
    now = own.look()
    assert (row(now, trials[0]).state, row(now, trials[1]).state) == ("running", "compiling")
    assert row(now, trials[1]).note == "for 31 s"
    assert now.left_s is None, "nothing is known yet"
    says(0, beat=19, episodes=5, steps=99, running_s=41.0, compiling_s=30.0)
    now = own.look()
    # 5 episodes in 10 s; 15 of this trial are left, and with those of the other two 55
    assert row(now, trials[0]).left_s == pytest.approx(30.0)
    assert row(now, trials[0]).note == "30 s left"
    assert now.left_s == pytest.approx(110.0)
    assert now.line == (
        "0 of 3 trials finished, 2 running, 5 of 60 episodes, 1 compiling, 2 min left"
    )  # 110 s in words


def test_what_a_resumed_trial_had_done_before_is_not_its_speed(looked):
    trials, says, own = looked
    says(0, beat=1, episodes=0, steps=0, running_s=0.0, compiling_s=0.0)
    own.look()
    says(0, beat=2, episodes=10, steps=200, running_s=2.0, compiling_s=0.0)
    own.look()
    says(0, beat=4, episodes=12, steps=240, running_s=4.0, compiling_s=0.0)
    assert row(own.look(), trials[0]).left_s == pytest.approx(8.0)  # 8 episodes at 1 a second


def test_a_trial_runs_while_it_says_something_new_whatever_the_clock_says(looked, monkeypatch):
    trials, says, own = looked
    says(0, beat=500, episodes=4, steps=9)
    assert row(own.look(), trials[0]).state == "missing", "perhaps the last words of a dead process"
    says(0, beat=501, episodes=4, steps=9)
    assert row(own.look(), trials[0]).state == "running"
    monkeypatch.setattr(progress, "SILENT_S", 0.0)
    assert row(own.look(), trials[0]).state == "missing"


def test_all_episodes_played_is_not_finished_yet(looked):
    trials, says, own = looked
    says(0, beat=1, episodes=20, steps=9)
    assert row(own.look(), trials[0]).state == "evaluating"


def test_failures_have_their_reason(looked, tmp_path):
    trials, _, own = looked
    Status(tmp_path / "status", trials[2].name).fail("ValueError: of | chance", "trace")
    now = own.look()
    assert now.rows[0].trial is trials[2], "failed ones stand before those that are missing"
    assert now.rows[0].reason == "ValueError: of | chance"


@pytest.mark.integration
def test_a_table_is_never_higher_than_a_screen_and_counts_the_rest(tmp_path):
    study = Study(TINY, {FREEZE: range(1, 101)})
    trials = trials_of(study)
    failures = {trials[77].name: "ValueError: no"}
    own = Overview(trials, runs=tmp_path, status=tmp_path, failures=failures)
    screen = Console(file=io.StringIO(), width=80, height=24)
    screen.print(table_of(own.look(), title="mine", most=16))
    lines = screen.file.getvalue().splitlines()
    assert len(lines) == 19
    assert lines[2].split() == ["freeze_steps=78,", "replica", "0", "failed", "0/2", "ValueError:", "no"]
    assert lines[-2].strip() == "and 85 missing"
    assert lines[-1].startswith("0 of 100 trials finished, 1 failed, 0 of 200 episodes")


def test_what_trials_print_does_not_disturb_it(tmp_path, capsys, monkeypatch):
    trials = trials_of(STUDY)
    shown = Progress(trials, runs=tmp_path, status=tmp_path, title="mine")
    stolen = io.StringIO()
    with shown:
        monkeypatch.setattr(sys, "stdout", stolen)
        print("noise")
        shown.ended(Outcome(trials[0].name, "failed", "ValueError: no", True))
        shown.ended(Outcome(trials[1].name, "finished"))
    assert stolen.getvalue() == "noise\n"
    assert capsys.readouterr().out.splitlines() == [
        "mine: 0 of 3 trials finished, 0 of 60 episodes",
        "mine: freeze_steps=2, replicas 0-1 failed: ValueError: no (1 of 3)",
        "mine: 0 of 3 trials finished, 1 failed, 0 of 60 episodes",
    ]


def test_lines_come_while_trials_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("cprl.studies.progress._TABLE_PERIOD_S", 0.01)
    monkeypatch.setattr("cprl.studies.progress._LINE_PERIOD_S", 0.05)
    with Progress(trials_of(STUDY), runs=tmp_path, status=tmp_path, title="mine"):
        time.sleep(0.5)
    assert 3 <= len(capsys.readouterr().out.splitlines()) <= 14


@pytest.mark.integration
def test_in_a_terminal_one_table_is_drawn_again_and_again(tmp_path, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    screen = Terminal()
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setenv("TERM", "xterm")
    run_study(Study(replace(TINY, episodes=1), {FREEZE: [2]}), tmp_path / "out", results=False)
    said = screen.getvalue()
    assert "\x1b[" in said
    assert "freeze_steps=2, replica 0" in said
    assert "1 of 1 trials finished, 1 of 1 episodes" in said.splitlines()[-2]


@pytest.mark.integration
def test_nothing_is_printed_where_no_progress_is_wanted(tmp_path, capsys):
    run_study(
        Study(replace(TINY, episodes=1), {FREEZE: [2]}), tmp_path / "out", progress=False, results=False
    )
    assert capsys.readouterr().out == ""
    with pytest.raises(ValueError, match="progress is 'no'"):
        run_study(STUDY, tmp_path / "other", progress="no")
    assert not (tmp_path / "other").exists()
