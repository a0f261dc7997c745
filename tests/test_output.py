"""Another encoding and a tiny terminal never end a training."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.table import Table

from cprl.system.output import Output, console, printed

HERE = Path(__file__).parent
TRAINS = f"""
import sys; sys.path.insert(0, {str(HERE)!r})
from pathlib import Path
from recordings import GAME
from test_watch import SETTINGS
import cprl
from cprl import Experiment, run
from cprl.population import Learning
from cprl.algorithms import DQN
from cprl.learners.settings import DQNSettings
agents = (Learning(DQN(settings=SETTINGS)),) * 2
experiment = Experiment(
    name="tiny", game=GAME, agents=agents, episodes=3, evaluation_episodes=1, engine="eager"
)
print(run(experiment, Path(sys.argv[1]), watch=sys.argv[2]))
"""


class Ascii(io.TextIOWrapper):
    """An output that has letters, digits and little else."""

    def __init__(self):
        super().__init__(io.BytesIO(), encoding="ascii", newline="")


def test_an_output_that_is_none_takes_everything():
    shown = console(Output(lambda: None))
    shown.print("text")
    assert not shown.is_terminal


def test_what_an_output_cannot_show_is_written_plainly():
    stream = Ascii()
    output = Output(lambda: stream)
    console(output).print("12.0 ± 0.5 \u00d7 3 …  日")
    stream.flush()
    assert stream.buffer.getvalue().decode("ascii") == "12.0 +- 0.5 x 3 ...  ?\n"


def test_square_brackets_and_colons_in_names_and_paths_are_shown_as_they_are():
    stream = io.StringIO()
    table = Table(title="a [b]", caption="c [d]")
    table.add_column("column [e]")
    table.add_row("row [/f] :apple:")
    shown = console(Output(lambda: stream), width=120)
    shown.print(table)
    shown.print("To resume: --out runs/[g]", soft_wrap=True)
    for name in ("a [b]", "c [d]", "column [e]", "row [/f] :apple:", "--out runs/[g]"):
        assert name in stream.getvalue()


def training(folder, *, watch="off", env=None):
    """A small training in a process of its own; its exit code, standard output and standard error."""
    script = folder / "train.py"
    script.write_text(TRAINS, encoding="utf-8")
    given = {name: value for name, value in os.environ.items() if not name.startswith(("LC_", "LANG"))}
    command = f'"{sys.executable}" "{script}" "{folder / "run"}" {watch}'
    ended = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, env={**given, **(env or {})}, check=False
    )
    assert (folder / "run" / "report.json").exists(), ended.stderr
    for error in ("Traceback", "BrokenPipeError", "UnicodeEncodeError", "Exception ignored", "Logging error"):
        assert error not in ended.stderr + ended.stdout
    return ended.returncode, ended.stdout, ended.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "env",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"COLUMNS": "1", "LINES": "1"},
        {"TERM": "dumb"},
        {"FORCE_COLOR": "1", "COLUMNS": "7", "PYTHONIOENCODING": "ascii"},
    ],
)
def test_a_training_runs_in_any_terminal(env, tmp_path):
    code, out, _ = training(tmp_path, watch="serve", env=env)
    assert code == 0
    assert "run" in out


@pytest.mark.parametrize(
    ("platform", "line"),
    [
        ("linux", r"""'C:\my runs\cprl' film 'it'"'"'s' a.gif"""),
        ("darwin", r"""'C:\my runs\cprl' film 'it'"'"'s' a.gif"""),
        ("win32", r""""C:\my runs\cprl" film it's a.gif"""),
    ],
)
def test_a_command_to_be_copied_is_quoted_for_the_shell_of_the_platform(platform, line, monkeypatch):
    monkeypatch.setattr(sys, "platform", platform)
    assert printed([r"C:\my runs\cprl", "film", "it's", "a.gif"]) == line
