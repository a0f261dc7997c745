"""What takes more than a second says so, on standard error: a line now and then, or one that vanishes."""

import io
import os
import re
import signal
import subprocess
import sys
from threading import Event
from types import SimpleNamespace

import pytest

from cprl import Game, Rules, maps
from cprl.envs import make_env
from cprl.measuring.playing import evaluate
from cprl.policies.actors import LaneActor
from cprl.policies.joint_policy import JointPolicy
from cprl.runs.checkpoints import MOST_LOST_S, Checkpointer
from cprl.system import output, working
from cprl.system.output import say
from cprl.system.times import CLOCK
from cprl.system.working import note_progress, silent

GAME = Game(map=maps.parse(".A>\n..A"), rules=Rules(window_rows=3, window_columns=3, episode_steps=5))
LONG_S = 10.0
"""Seconds after which a test gives up; none takes that long."""


class Said(io.StringIO):
    """A standard error, which tells when a text has been written."""

    def __init__(self, *, is_terminal=False):
        super().__init__()
        self._is_terminal = is_terminal
        self.waiting = {}

    def isatty(self):
        return self._is_terminal

    def write(self, text):
        written = super().write(text)
        for wanted, event in list(self.waiting.items()):
            if wanted in self.getvalue():
                event.set()
        return written

    def wait_for(self, text):
        event = self.waiting.setdefault(text, Event())
        if text not in self.getvalue():
            assert event.wait(LONG_S), f"{text!r} was not said, but {self.getvalue()!r}"


@pytest.fixture
def said(monkeypatch):
    """What is said, at once and again without a pause."""
    monkeypatch.setattr(working, "FIRST_S", 0.0)
    monkeypatch.setattr(working, "PERIOD_S", 0.01)
    monkeypatch.setattr(working, "LINE_PERIOD_S", 0.01)
    return error(monkeypatch)


def error(monkeypatch, **how):
    stream = Said(**how)
    monkeypatch.setattr(output.ERR, "_stream", lambda: stream)
    return stream


def test_lines_say_again_and_again_what_is_done_and_how_far_it_is(said):
    with working.working("playing an episode"):
        said.wait_for("playing an episode, 0 s so far\n")
        note_progress(412, 1000, "turns")
        said.wait_for("playing an episode, 412 of 1,000 turns\n")
    lines = said.getvalue().splitlines()
    assert set(lines) == {"playing an episode, 0 s so far", "playing an episode, 412 of 1,000 turns"}


def test_nothing_is_said_of_what_ends_within_a_second(monkeypatch):
    stream = error(monkeypatch)
    with working.working("playing an episode"):
        pass
    assert stream.getvalue() == ""


def test_of_parts_that_are_counted_all_are_said_and_of_others_the_innermost(said):
    with working.working("playing mixes"):
        note_progress(3, 14, "populations")
        with working.working("playing 8 episodes"):
            note_progress(7, None, "turns")
            said.wait_for("playing mixes, 3 of 14 populations: playing 8 episodes, 7 turns\n")
            with working.working("compiling"):
                said.wait_for("\ncompiling, 0 s so far\n")


def test_nothing_is_said_beside_a_bar(said):
    with silent(), working.working("playing an episode"):
        with working.working("compiling"):
            pass
        assert said.getvalue() == ""
    with working.working("evaluating"):
        said.wait_for("evaluating")


def test_a_compilation_says_so_while_it_works(said):
    with CLOCK.running():
        said.wait_for("compiling the rules (10 to 20 s, once), ")


def test_a_line_of_a_terminal_gives_way_to_what_is_printed_and_vanishes(said, monkeypatch, capsys):
    stream = error(monkeypatch, is_terminal=True)
    with working.working("evaluating"):
        stream.wait_for("\revaluating, 0 s so far")
        with silent():
            assert stream.getvalue().endswith("\r"), "it is blank, so that others can write there"
            say("a result")
    assert screen(stream.getvalue()) == ""
    assert capsys.readouterr().out == "a result\n"


def test_a_line_of_a_terminal_is_no_wider_than_it(said, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    stream = error(monkeypatch, is_terminal=True)
    with working.working("playing an episode of many words"):
        stream.wait_for("\rplaying an episode ")
    assert max(map(len, re.split(r"[\r\n]", stream.getvalue()))) < 20


def screen(written):
    """What a line of a terminal shows in the end."""
    shown = []
    for part in written.split("\r"):
        shown = [*part, *shown[len(part) :]]
    return "".join(shown).rstrip()


def test_a_notebook_has_one_block_which_is_written_over_and_empty_in_the_end(said, monkeypatch):
    shown = []

    class Handle:
        def update(self, content, *, raw):
            shown.append(content["text/plain"])

    def display(content, *, raw, display_id):
        assert not shown, "a second block"
        shown.append(content["text/plain"])
        return Handle()

    monkeypatch.setattr(output, "in_notebook", lambda: True)
    monkeypatch.setattr("IPython.display.display", display)
    done = Event()
    monkeypatch.setattr(said, "isatty", done.is_set)
    with working.working("playing"):
        while len(shown) < 3:
            done.wait(0.01)
    assert shown[0].startswith("playing, ")
    assert shown[-1] == ""
    assert said.getvalue() == ""


def test_episodes_that_are_evaluated_say_their_turns(said):
    env = make_env(GAME, worlds=2)
    walker = JointPolicy({(0,): LaneActor(None, 8, seeds=[(0,)], agents=1, worlds=2)})

    def policy(moment):
        if policy.turns == 3:
            said.wait_for("playing 2 episodes, 3 of 5 turns\n")
        policy.turns += 1
        return walker(moment)

    policy.turns = 0
    evaluate(env, policy)


FIRST_GAME = """
import sys
from cprl import Game, Rules, maps
from cprl.envs import make_env
print("begins", file=sys.stderr, flush=True)
make_env(Game(map=maps.parse(".A>"), rules=Rules())).reset()
print("began", file=sys.stderr, flush=True)
"""


def started(words, cache):
    """A process that has compiled nothing yet."""
    surroundings = {**os.environ, "CPRL_CACHE": str(cache)}
    return subprocess.Popen(
        [sys.executable, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=surroundings,
    )


@pytest.mark.integration
def test_the_first_game_of_an_empty_cache_says_that_it_compiles_before_it_has(tmp_path):
    with started(["-c", FIRST_GAME], tmp_path) as process:
        lines = [line.strip() for line in process.stdout]
    said = lines[lines.index("begins") + 1 : lines.index("began")]
    assert said[0] == "compiling the rules (10 to 20 s, once), 1 s so far"
    seconds = [int(re.search(r"(\d+) s so far", line)[1]) for line in said]
    assert seconds == sorted(seconds)


@pytest.mark.integration
def test_ctrl_c_stops_a_compilation_and_leaves_no_process_behind(tmp_path):
    with started(["-c", FIRST_GAME], tmp_path) as process:
        lines = []
        for line in process.stdout:
            lines.append(line.strip())
            if line.startswith("compiling"):
                process.send_signal(signal.SIGINT)
    # The end of its output is also that of its children, which have inherited none of it.
    assert lines[-1] == "KeyboardInterrupt"
    assert "began" not in lines
    assert not list(tmp_path.rglob("*.nbi")), "it was stopped while the first of the rules was compiled"


RUN = """
import sys
import cprl
from cprl import Game, Rules, maps
from cprl.population import Scripted
game = Game(map=maps.parse(".A>"), rules=Rules(episode_steps=5))
experiment = cprl.Experiment(name="stopped", game=game, agents=(Scripted("random"),), episodes=3)
with cprl.commands.recipe_command.exit_with_message("test"):
    cprl.run(experiment, sys.argv[1], watch="off")
"""


@pytest.mark.integration
def test_one_ctrl_c_while_a_run_compiles_ends_it_with_the_line_that_resumes(tmp_path):
    with started(
        ["-c", f"import cprl.commands.recipe_command\n{RUN}", str(tmp_path / "run")], tmp_path
    ) as process:
        lines = []
        for line in process.stdout:
            lines.append(line.strip())
            if "compiling" in line:
                process.send_signal(signal.SIGINT)
                break
        rest = process.stdout.read()
    assert process.returncode == 130, rest
    assert "Stopped while code was compiled" in rest
    assert "To resume: " in rest
    assert not list((tmp_path / "run").glob("checkpoints/*"))


def test_a_signal_before_a_training_has_begun_is_not_delayed(tmp_path):
    with pytest.raises(KeyboardInterrupt), Checkpointer(tmp_path / "run"):
        signal.raise_signal(signal.SIGINT)


def test_a_signal_while_code_is_compiled_is_not_delayed_unless_much_would_be_lost(tmp_path, capsys):
    training = SimpleNamespace()
    with Checkpointer(tmp_path / "run") as checkpointer, CLOCK.running():
        checkpointer.restore(training)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert "Stopped while code was compiled" in capsys.readouterr().out
    with Checkpointer(tmp_path / "run") as checkpointer:
        checkpointer.restore(training)
        checkpointer._saved -= 2 * MOST_LOST_S
        with CLOCK.running():
            signal.raise_signal(signal.SIGINT)
    assert "Stopping after this step" in capsys.readouterr().out
