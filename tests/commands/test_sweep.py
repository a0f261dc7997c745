"""`cprl sweep`, `search` and `study_main`: studies from a command line."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from contextlib import ExitStack
from itertools import takewhile
from pathlib import Path

import pytest
from places import ROOT, SUPPORT
from same_runs import written_at
from tiny_study import FREEZE, GAMMA, TINY

from cprl import Study
from cprl.commands import main as cli
from cprl.commands.experimental_commands import search as search_words
from cprl.commands.studies import (
    StudyOptions,
    carry_out,
    executor_of,
    recipe_of,
    study_main,
    sweep as sweep_words,
)
from cprl.experimental.ray_executor import Ray
from cprl.runs.files import RunLockedError
from cprl.runs.recipe import start_run
from cprl.studies import InProcess, Integers, Processes, read_study
from cprl.studies.run import shared
from cprl.studies.trials import trials_of
from cprl.system.shipped import cprl_command

RECIPE = '''
"""A recipe of two agents."""
from dataclasses import replace
from tiny_study import TINY
import cprl

def experiment(*, turns: int = 20) -> cprl.Experiment:
    """Two agents on a tiny board.

    Args:
        turns: of an episode.
    """
    rules = replace(TINY.game.rules, episode_steps=turns)
    return replace(TINY, game=replace(TINY.game, rules=rules))

if __name__ == "__main__":
    raise AssertionError("imported, not run")
'''


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """A working directory with a recipe; figures of studies, which tests/studies looks at, are left out."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cprl.studies.results.draw_figures", lambda table, out: [])
    monkeypatch.setattr(sys, "path", [*sys.path])
    Path("mine.py").write_text(RECIPE)
    return tmp_path


def sweep(line):
    sweep_words(shlex.split(line))


@pytest.mark.integration
def test_a_recipe_is_run_under_every_combination_and_the_same_line_does_nothing_again(capsys):
    line = (
        f"mine.py --vary game.rules.freeze-steps=2,5 --vary {GAMMA}=0.5 --turns 7 --episodes 1 --replicas 2 "
        "--block 1 --out here"
    )
    sweep(line)
    study = read_study(Path("here"))
    names = [condition.name for condition in study.all_conditions]
    assert names == ["freeze_steps=2, gamma=0.5", "freeze_steps=5, gamma=0.5"]
    assert study.experiment.game.rules.episode_steps == 7
    assert (study.replicas, study.block, study.experiment.episodes) == (2, 1, 1)
    assert all(trial.state() == "finished" for trial in trials_of(study, "here/runs"))
    assert "tiny: freeze_steps=2, gamma=0.5, replica 1 finished (3 of 4)" in capsys.readouterr().out
    before = written_at("here/runs")
    sweep(line)
    assert written_at("here/runs") == before
    assert "tiny: 4 of 4 trials finished" in capsys.readouterr().out


@pytest.mark.integration
def test_the_end_of_the_training_that_is_compared_may_be_longer():
    line = f"mine.py --vary {FREEZE}=2,5 --turns 5 --episodes 20 --out here"
    for last in (10, 20):
        sweep(f"{line} --last {last}")
        summary = Path("here/summary.md").read_text()
        assert f"The last {last} episodes of training; means" in summary
        if last == 10:
            before = written_at("here/runs")
    assert "95% intervals over replicas by Student's t" in summary
    assert "Bold: not 0 by Holm's method for" in summary
    assert written_at("here/runs") == before
    with pytest.raises(ValueError, match="last is 9"):
        sweep(f"{line.replace('here', 'elsewhere')} --last 9")
    assert not Path("elsewhere").exists()


def test_a_dry_run_lists_all_trials_drawn_ones_too_and_writes_nothing(here, capsys):
    sweep(f"mine.py --vary {FREEZE}=integers(1,8) --draws 8 --design latin_hypercube --dry-run")
    said = capsys.readouterr().out
    assert all(f"freeze_steps={steps}, replica 0  waiting" in said for steps in range(1, 9))
    sweep(f"mine.py --vary {FREEZE}=2,5 --dry-run")
    said = capsys.readouterr().out
    assert "freeze_steps=5, replica 0  waiting" in said
    assert "2 conditions (game.rules.freeze_steps), 1 replicas each, in studies/tiny/runs" in said
    assert sorted(path.name for path in here.iterdir()) == ["mine.py"]


@pytest.mark.integration
def test_a_part_of_a_study_is_run_by_the_levels_that_its_conditions_have(here, capsys):
    """Levels are whole words: freeze_steps=2 is not freeze_steps=25."""
    line = f"mine.py --vary {FREEZE}=2,25 --vary {GAMMA}=0.5,0.55 --episodes 1 --out here"
    sweep(f"{line} --only freeze_steps=2 --dry-run")
    said = capsys.readouterr().out
    assert "freeze_steps=2, gamma=0.55" in said
    assert "freeze_steps=25" not in said
    assert not Path("here").exists()
    sweep(f'{line} --only "gamma=0.5, freeze_steps=2" --only "freeze_steps=25, gamma=0.55"')
    states = {trial.condition.name: trial.state() for trial in trials_of(read_study("here"), "here/runs")}
    assert [name for name, state in states.items() if state == "finished"] == [
        "freeze_steps=2, gamma=0.5",
        "freeze_steps=25, gamma=0.55",
    ]
    assert len(states) == 4
    again = f"This line runs what is lacking: `cprl sweep {shlex.join(shlex.split(line))}`"
    assert again in Path("here/summary.md").read_text()
    with pytest.raises(ValueError, match=r"only is 'gamma=0.9'"):
        sweep(f"{line.replace('here', 'elsewhere')} --only gamma=0.9")
    assert not Path("elsewhere").exists()


@pytest.mark.integration
def test_a_failed_condition_does_not_end_the_study_and_is_listed_with_what_tries_it_again(
    capsys, monkeypatch
):
    from cprl.training import running

    def fails_at_5(experiment, *arguments, **options):
        if experiment.game.rules.freeze_steps == 5:
            raise RuntimeError("out of luck")
        return run(experiment, *arguments, **options)

    run = running.run
    monkeypatch.setattr(running, "run", fails_at_5)
    line = f"mine.py --vary {FREEZE}=5,2 --episodes 1"
    with pytest.raises(SystemExit) as ended:
        sweep(line)
    assert ended.value.code == 1
    said = capsys.readouterr().out
    assert "1 of 2 trials failed; the others are kept:" in said
    assert "  freeze_steps=5, replica 0: RuntimeError: out of luck\n    studies/tiny/status/" in said
    assert f"To try them again: {' '.join(cprl_command())} sweep {line}" in said
    sweep(f"{line} --dry-run")
    assert re.search(r"replica 0  failed +0/1  RuntimeError: out of luck", capsys.readouterr().out)
    monkeypatch.setattr(running, "run", run)
    sweep(line)
    assert "2 of 2 trials finished" in capsys.readouterr().out


@pytest.mark.integration
def test_a_study_whose_runs_lost_their_content_says_so_and_what_to_do(capsys):
    line = f"mine.py --vary {FREEZE}=5,2 --turns 5 --episodes 10 --out here"
    sweep(line)
    first, second = (trial.directory for trial in trials_of(read_study("here"), "here/runs"))
    (first / "episodes.parquet").write_bytes(b"PAR1")
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        sweep(line)
    assert ended.value.code == 1
    said, summary = capsys.readouterr().out, Path("here/summary.md").read_text()
    assert "1 of 2 trials cannot be read and are not in these results, in here/runs:" in said
    assert f"freeze_steps=5: {first.name}, 1 replica, is damaged, remove or restore its directory" in said
    assert "damaged runs once their directories are removed: `cprl sweep" in summary
    for run in (first, second):
        (run / "evaluation/trained.parquet").unlink()
    with pytest.raises(SystemExit):
        sweep(line)
    said = capsys.readouterr().out
    assert "tiny: 0 of 2 trials finished, 2 failed" in said
    assert "2 of 2 trials failed:" in said


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("mine.py", "nothing is varied"),
        ("--vary x=1", "the first word after cprl sweep is --vary"),
        ("nowhere.py --vary x=1", "the recipe is nowhere.py"),
        ("nowhere --vary x=1", "nowhere is not the directory of a run: there is no such directory"),
        (f"mine.py --vary {FREEZE}=integers(1,9)", "with draws=N"),
        (f"mine.py --vary {FREEZE}=2 --reference best", "reference is 'best'"),
        (f"mine.py --vary {FREEZE}=2 --jobs 0", "--jobs is 0"),
        (f"mine.py --vary {FREEZE}=2 --jobs 2 --on here", "--jobs is 2 with --on here"),
        (f"mine.py --vary {FREEZE}=2 --address auto", "--address is for --on ray"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_before_anything_is_written(here, line, message):
    with pytest.raises(ValueError) as refused:  # noqa: PT011  (the message is the point)
        sweep(line)
    assert message in str(refused.value)
    assert sorted(path.name for path in here.iterdir() if path.name != "__pycache__") == ["mine.py"]


def test_flags_of_other_commands_are_unknown(capsys):
    for command, flag in ((sweep_words, "--resume"), (sweep_words, "--points=3"), (search_words, "--only=a")):
        with pytest.raises(SystemExit, match="2"):
            command(["mine.py", "--vary", f"{FREEZE}=2,3", flag])
        assert flag.partition("=")[0] in "".join(capsys.readouterr())


def test_a_search_is_a_command_of_its_own(monkeypatch, capsys, here):
    line = f"mine.py --vary {FREEZE}=integers(1,9) --vary {GAMMA}=0.5,0.9 --turns 7 --points 7 --metric peace"
    words = f"{line} --direction minimise --at-once 2 --block 3".split()
    search_words([*words, "--dry-run"])
    assert "7 points of game.rules.freeze_steps: Integers(low=1, high=9)" in capsys.readouterr().out
    assert sorted(path.name for path in here.iterdir() if path.name != "__pycache__") == ["mine.py"]

    def searched(search, out, *, last, **options):
        factors = {FREEZE: Integers(1, 9), GAMMA: (0.5, 0.9)}
        assert (search.points, search.metric, search.direction) == (7, "peace", "minimise")
        assert (search.at_once, search.block, search.factors, last) == (2, 3, factors, 30)
        assert search.experiment.game.rules.episode_steps == 7
        raise KeyboardInterrupt

    monkeypatch.setattr("cprl.experimental.search.run_search", searched)
    with pytest.raises(KeyboardInterrupt) as interrupted:
        search_words(words)
    assert "search mine.py --vary 'game.rules.freeze_steps=integers(1,9)'" in interrupted.value.__notes__[0]


@pytest.mark.integration
def test_a_search_says_its_best_points(capsys):
    pytest.importorskip("optuna")
    search_words(f"mine.py --vary {FREEZE}=2,5 --points 2 --episodes 1 --out here".split())
    said = capsys.readouterr().out.partition("tiny: 2 points; the highest collective_return, means over rep")
    assert "freeze_steps=" in said[2]


@pytest.mark.parametrize("command", [sweep_words, search_words])
@pytest.mark.parametrize("words", ["", "--help", "mine.py --help-all"])
def test_help_says_how_values_are_written_and_what_a_command_line_cannot_change(command, words, capsys):
    with pytest.raises(SystemExit) as ended:
        command(shlex.split(words))
    assert ended.value.code == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "commas stand between values" in said
    assert "loguniform(LOW,HIGH)" in said
    if words.startswith("mine"):
        assert "--turns INT" in said
        assert "cannot be changed on the command line" in said
        assert "the kind of an agent (Learning, Scripted and so on), of its algorithm" in said


@pytest.mark.integration
def test_stored_and_shipped_recipes_are_varied_too_and_a_study_is_not(tmp_path, capsys):
    run = start_run(tmp_path / "old.py", TINY.name, TINY.to_recipe)
    for source in (run, run / "recipe.json"):
        sweep(f"{source} --vary {FREEZE}=2,5 --dry-run")
        assert "freeze_steps=5, replica 0  waiting" in capsys.readouterr().out
    assert recipe_of(run)() == TINY
    for name in ("commons", "tragedy", "mixed", "swap_the_loss", "two_complex"):
        sweep(f"{ROOT / 'recipes' / name}.py --vary {FREEZE}=5,25 --replicas 4 --dry-run")
        assert "freeze_steps=25, replicas 0-3" in capsys.readouterr().out
    Path("study.py").write_text("STUDY = 1")
    with pytest.raises(ValueError, match=r"describes a study"):
        sweep(f"study.py --vary {FREEZE}=1")


def test_cprl_lists_sweep_among_its_commands(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["cprl", "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    assert "sweep" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["cprl", "run", "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    said = capsys.readouterr().out
    assert "--trial" not in said, "by which a study starts its runs"
    assert "--allow module:Class" in said
    monkeypatch.setattr(sys, "argv", ["cprl", "sweep", "mine.py"])
    with pytest.raises(SystemExit, match="cprl sweep: nothing is varied"):
        cli.main()


STUDY = Study(TINY, {FREEZE: [2, 5]}, name="tiny_study", question="What if?", expectation="Nothing.")


@pytest.mark.integration
def test_a_study_has_a_command_line(capsys):
    line = ["recipes/mine.py", "--replicas", "2", "--block", "1", "--runs", "pool"]
    out = study_main(STUDY, line)
    assert out == Path("studies/tiny_study")
    assert len(list(Path("pool").iterdir())) == 4
    assert read_study(out).replicas == 2
    assert study_main(STUDY, [*line, "--dry-run"]) == out
    assert "4 of 4 trials finished" in capsys.readouterr().out.splitlines()[-2]


@pytest.mark.integration
def test_a_study_is_run_with_fewer_episodes_unless_they_are_what_it_varies():
    out = study_main(STUDY, ["recipes/mine.py", "--episodes", "1", "--no-figures", "--out", "short"])
    assert read_study(out).experiment.episodes == 1
    assert [condition.experiment.episodes for condition in read_study(out).all_conditions] == [1, 1]
    varied = Study(TINY, {"episodes": [2, 3]}, name="tiny_study")
    with pytest.raises(SystemExit, match=r"--episodes is 1, and the study's condition .* says 2"):
        study_main(varied, ["recipes/mine.py", "--episodes", "1", "--out", "varied"])
    assert not Path("varied").exists()


def test_help_of_a_study_says_what_it_asks_and_a_refusal_is_a_line(capsys):
    with pytest.raises(SystemExit):
        study_main(STUDY, ["recipes/mine.py", "--help"])
    asked = "What if? Expected: Nothing. 2 conditions: freeze_steps=2, freeze_steps=5; 1 replicas of each."
    assert asked in " ".join(capsys.readouterr().out.split())
    with pytest.raises(SystemExit, match=r"^mine\.py: .*replicas is 0"):
        study_main(STUDY, ["recipes/mine.py", "--replicas", "0"])


def test_where_trials_are_run_is_said_by_jobs_and_on():
    assert executor_of(StudyOptions()) == executor_of(StudyOptions(jobs=1)) == InProcess()
    assert executor_of(StudyOptions(jobs=2)) == Processes(2)
    assert executor_of(StudyOptions(jobs=1, on="processes")) == Processes(1)
    pytest.importorskip("ray")
    assert executor_of(StudyOptions(on="ray")) == Ray()
    assert executor_of(StudyOptions(on="ray", address="auto", jobs=3)) == Ray("auto", jobs=3)


@pytest.mark.parametrize(
    ("command", "typed", "published"),
    [
        (["cprl", "sweep", "mine.py"], "/bin/py -m cprl sweep mine.py", "cprl sweep mine.py"),
        (
            ["cprl run study/exploration"],
            "/bin/py -m cprl run study/exploration",
            "cprl run study/exploration",
        ),
        (["my study.py"], "/bin/py 'my study.py'", "py 'my study.py'"),
    ],
)
def test_what_continues_a_study_can_be_typed_here_and_its_summary_names_no_place(
    command, typed, published, monkeypatch
):
    def interrupted(study, out, *, again, **options):
        summary.append(again)
        raise KeyboardInterrupt

    summary = []
    monkeypatch.setattr(sys, "executable", "/bin/py")
    monkeypatch.setattr("cprl.system.shipped.which", lambda *_, **__: None)
    monkeypatch.setattr("cprl.studies.run_study", interrupted)
    with pytest.raises(KeyboardInterrupt) as stopped:
        carry_out(Study(TINY), StudyOptions(only=("x=1",)), [*command, "--only", "x=1"])
    assert stopped.value.__notes__ == [f"To continue: {typed} --only x=1"]
    assert summary == [published]


@pytest.mark.integration
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_study_that_is_interrupted_says_what_is_kept_and_how_to_continue(number, capsys):
    Path("study.py").write_text(
        "import os, signal\n"
        "from tiny_study import FREEZE, TINY\n"
        "import cprl\n"
        "from cprl.training import running\n"
        "run = running.run\n"
        "def stopped(experiment, *given, **options):\n"
        "    if experiment.game.rules.freeze_steps == 5 and os.environ.get('STOP'):\n"
        "        os.kill(os.getpid(), int(os.environ['STOP']))\n"
        "    return run(experiment, *given, **options)\n"
        "running.run = stopped\n"
        "cprl.study_main(cprl.Study(TINY, {FREEZE: [2, 5]}, name='short'))\n"
    )
    paths = os.pathsep.join([str(ROOT / "src"), str(SUPPORT)])
    environment = {**os.environ, "PYTHONPATH": paths, "STOP": str(int(number))}
    command = [sys.executable, "study.py", "--out", "kept"]
    stopped = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100)
    assert stopped.returncode == 128 + number, stopped.stderr
    assert "1 of 2 trials are finished and 1 begun; all of it is kept in kept/runs" in stopped.stdout
    assert f"To continue: {shlex.join(command)}" in stopped.stdout
    assert json.loads(Path("kept/study.json").read_text())["name"] == "short"
    assert study_main(STUDY, ["study.py", "--out", "kept"]) == Path("kept")
    assert "tiny_study: 1 of 2 trials finished" in capsys.readouterr().out


BESIDE = """
import json
import sys
import cprl
from tiny_study import FREEZE, TINY
for line in sys.stdin:
    study = cprl.Study(TINY, {FREEZE: json.loads(line)}, name="short")
    try:
        cprl.run_study(study, sys.argv[1], results=False)
    except Exception as error:
        print(f"{type(error).__name__}: {error}")
    print("ended", flush=True)
"""


@pytest.mark.integration
def test_the_same_study_is_shared_and_another_one_is_refused_while_anybody_runs_it(tmp_path, capsys):
    out = tmp_path / "out"
    study = Study(TINY, {FREEZE: [2, 5]}, name="short")
    command = [sys.executable, "-c", BESIDE, str(out)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:

        def beside(*levels):
            print(json.dumps(levels), file=process.stdin, flush=True)
            return "".join(takewhile(lambda line: line != "ended\n", process.stdout))

        with ExitStack() as stack:
            stack.enter_context(driven(study, out))
            assert capsys.readouterr().out == ""
            before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
            refusal = f"RunLockedError: {out} is run as another study by process {os.getpid()} on"
            assert beside(2, 9).startswith(refusal)
            assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
            said = beside(2, 5)
            assert f"is run by somebody else too, process {os.getpid()} on" in said
            assert "2 of 2 trials finished" in said
            stack.enter_context(driven(study, out))
            assert "is run by somebody else too" in capsys.readouterr().out
        assert "2 of 2 trials finished" in beside(2, 9), "nobody runs it now"
    assert process.returncode == 0
    assert not (out / "run.lock").exists()


def test_who_shares_a_study_keeps_another_one_out_when_the_first_has_left(tmp_path, capsys, monkeypatch):
    study, other = (Study(TINY, {FREEZE: [2, level]}, name="short") for level in (5, 9))
    first = ExitStack()
    first.enter_context(driven(study, tmp_path))
    with driven(study, tmp_path):
        first.close()
        with pytest.raises(RunLockedError, match=str(tmp_path)), driven(other, tmp_path):
            raise AssertionError
    capsys.readouterr()
    with driven(other, tmp_path):
        assert capsys.readouterr().out == ""
    monkeypatch.setattr("cprl.runs.files.fcntl", None)  # where nothing can be locked
    with driven(other, tmp_path):
        assert capsys.readouterr().out == ""


def driven(study, out):
    """In which a study is run."""
    return shared(study, out, progress=True)
