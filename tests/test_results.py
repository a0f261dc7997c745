"""What a run leaves on the disk: its recipe, and a table of episodes that nothing takes away."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from cprl.measuring import Episode, social
from cprl.runs.episodes import COLUMNS, EpisodeTable, read_episodes
from cprl.runs.recipe import git_state, start_run


def an_episode(number: int = 0, *, world: int = 0, **metrics: float) -> Episode:
    """An episode of two agents, told apart by its number."""
    return Episode(
        world=world,
        episode=number,
        steps=100 + number,
        terminated=number % 2 == 1,
        return_=np.array([1.5, -2.0]) + number,
        harvest=np.array([3.0, 1.0]),
        in_play_steps=np.array([90, 100]),
        shots=np.array([7, 0]),
        hits=np.array([5, 0]),
        tagged=np.array([0, 2]),
        tagged_by=np.array([[0, 0], [2, 0]]),
        stock_left=11,
        depletion_step=-1,
        metrics={**dict.fromkeys(social.METRICS, 0.25), "equality": float("nan"), **metrics},
    )


def episode_numbers(table: pa.Table) -> list[int]:
    """The episodes in a table, having seen that each has the rows of both agents."""
    assert table["agent"].to_pylist() == [0, 1] * (len(table) // 2)
    assert table["episode"].to_pylist()[::2] == table["episode"].to_pylist()[1::2]
    return table["episode"].to_pylist()[::2]


@contextmanager
def full_disk(free_bytes: int, file: Path) -> Iterator[None]:
    """No file of this process grows beyond the size of that file and so many bytes."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (file.stat().st_size + free_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def test_each_agent_of_each_episode_has_a_row(tmp_path):
    with EpisodeTable(tmp_path / "episodes.parquet") as table:
        table.add(an_episode(0, world=3))
        table.add(an_episode(1), an_episode(2), replica=8)
    rows = pq.read_table(tmp_path / "episodes.parquet")
    columns = [(name, kind) for name, kind in COLUMNS.items() if name != "wanted_return"]  # of trainings
    assert rows.schema == pa.schema([*columns, *((name, pa.float64()) for name in social.METRICS)])
    assert len(rows) == 6
    assert rows["replica"].to_pylist() == [3, 3, 8, 8, 8, 8]
    second = rows.slice(1, 1).to_pylist()[0]
    assert np.isnan(second.pop("equality"))
    assert second == {
        **dict.fromkeys(set(social.METRICS) - {"equality"}, 0.25),
        "replica": 3,
        "episode": 0,
        "agent": 1,
        "return": -2.0,
        "harvest": 1.0,
        "steps": 100,
        "in_play_steps": 100,
        "shots": 0,
        "hits": 0,
        "tagged": 2,
        "stock_left": 11,
        "depletion_step": -1,
        "terminated": False,
    }
    assert rows["terminated"].to_pylist() == [False, False, True, True, False, False]


def test_what_was_added_can_be_read_while_the_run_goes_on_and_when_it_is_over(tmp_path):
    with EpisodeTable(tmp_path / "episodes.parquet") as table:
        for number in range(3):
            table.add(an_episode(number))
            assert episode_numbers(read_episodes(tmp_path)) == list(range(number + 1))
        before = read_episodes(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["episodes.parquet", "manifest.json"]
    assert str(read_episodes(tmp_path).to_pylist()) == str(before.to_pylist())


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_run_killed_at_any_moment_keeps_every_episode_it_added(tmp_path):
    heard, say = os.pipe()
    child = os.fork()
    if child == 0:  # writes until it is killed, and says after each episode that it is added
        table = EpisodeTable(tmp_path / "episodes.parquet")
        for number in range(1_000_000):
            table.add(an_episode(number))
            os.write(say, b".")
        os._exit(0)
    os.close(say)
    time.sleep(0.15)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    with os.fdopen(heard, "rb") as pipe:
        added = len(pipe.read())
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert added > 0
    # It may die between adding and saying so.
    assert episode_numbers(read_episodes(tmp_path)) in (list(range(added)), list(range(added + 1)))


def test_a_journal_cut_at_any_byte_keeps_every_whole_episode(tmp_path):
    table = EpisodeTable(tmp_path / "episodes.parquet")
    sizes = []
    for number in range(3):
        table.add(an_episode(number))
        sizes.append(table.journal.stat().st_size)
    whole = table.journal.read_bytes()
    table.close()
    cut = tmp_path / "cut"
    cut.mkdir()
    for size in [*range(0, len(whole), 13), *sizes]:
        (cut / "episodes.arrows").write_bytes(whole[:size])
        assert episode_numbers(read_episodes(cut)) == list(range(sum(size >= end for end in sizes))), size


def test_a_run_killed_while_it_was_closed_has_no_row_twice(tmp_path):
    table = EpisodeTable(tmp_path / "episodes.parquet")
    table.add(an_episode(0), an_episode(1))
    journal = table.journal.read_bytes()
    table.close()
    table.journal.write_bytes(journal)
    assert episode_numbers(read_episodes(tmp_path)) == [0, 1]


def test_a_run_that_crashes_closes_its_table(tmp_path):
    def crash():
        with EpisodeTable(tmp_path / "episodes.parquet") as table:
            table.add(an_episode())
            raise KeyError("the training")

    with pytest.raises(KeyError, match="the training"):
        crash()
    assert len(pq.read_table(tmp_path / "episodes.parquet")) == 2


def test_a_full_disk_is_named_and_loses_nothing_that_was_added(tmp_path):
    table = EpisodeTable(tmp_path / "episodes.parquet")
    table.add(an_episode(0))
    with full_disk(700, table.journal), pytest.raises(OSError, match=r"the 2 earlier rows are in .*arrows"):
        table.add(an_episode(1))
    assert episode_numbers(read_episodes(tmp_path)) == [0]
    table.add(an_episode(1))
    table.close()
    assert episode_numbers(read_episodes(tmp_path)) == [0, 1]


def test_a_disk_that_is_full_at_the_end_keeps_the_journal_and_closing_can_be_tried_again(tmp_path):
    table = EpisodeTable(tmp_path / "episodes.parquet")
    table.add(an_episode(0))
    with full_disk(-1000, table.journal), pytest.raises(OSError, match=r"all episodes are in .*arrows"):
        table.close()
    assert [path.name for path in tmp_path.iterdir()] == ["episodes.arrows"]
    assert episode_numbers(read_episodes(tmp_path)) == [0]
    table.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["episodes.parquet", "manifest.json"]


def test_a_journal_that_lost_rows_is_never_deleted(tmp_path):
    table = EpisodeTable(tmp_path / "episodes.parquet")
    table.add(an_episode(0))
    table.add(an_episode(1))
    os.truncate(table.journal, table.journal.stat().st_size - 1)
    with pytest.raises(OSError, match="holds 2 rows of the 4 that were added"):
        table.close()
    assert [path.name for path in tmp_path.iterdir()] == ["episodes.arrows"]


@pytest.mark.parametrize("close", [True, False], ids=["finished", "going on"])
def test_a_table_that_exists_is_not_written_over(tmp_path, close):
    table = EpisodeTable(tmp_path / "episodes.parquet")
    table.add(an_episode())
    if close:
        table.close()
    with pytest.raises(FileExistsError, match="exists and is not overwritten"):
        EpisodeTable(tmp_path / "episodes.parquet")
    assert len(read_episodes(tmp_path)) == 2
    table.close()


def test_a_run_without_episodes_leaves_an_empty_table_and_a_directory_without_one_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="is this a run"):
        read_episodes(tmp_path)
    table = EpisodeTable(tmp_path / "episodes.parquet")
    table.add()
    assert len(read_episodes(tmp_path)) == 0
    table.close()
    assert read_episodes(tmp_path)["equality"].to_pylist() == []


def test_the_metrics_of_a_table_are_those_of_its_first_episode(tmp_path):
    with EpisodeTable(tmp_path / "episodes.parquet") as table:
        table.add(an_episode(0, yield_share=0.5))
        with pytest.raises(
            ValueError, match=r"the episode has the extra columns \[\] and lacks \['yield_share'\]"
        ):
            table.add(an_episode(1))
    assert read_episodes(tmp_path)["yield_share"].to_pylist() == [0.5, 0.5]


def recipe(directory: Path) -> dict[str, object]:
    return {"format": 2, "recipe": "tragedy", "experiment": {"seed": 3, "in": directory.name}}


def test_a_run_begins_with_its_recipe(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["train.py", "--name", "a b", "--out", "a place"])
    run = start_run(tmp_path / "deep" / "run", "tragedy", recipe)
    written = json.loads((run / "recipe.json").read_text())
    assert [path.name for path in run.iterdir()] == ["recipe.json"]
    assert written["recipe"] == "tragedy"
    assert written["experiment"] == {"seed": 3, "in": "run"}
    assert written["versions"]["torch"] == torch.__version__
    assert set(written["versions"]) == {
        "python", "cprl", "torch", "torchrl", "tensordict", "numpy", "numba", "rerun-sdk",
    }  # fmt: skip
    assert written["started"].startswith(time.strftime("%Y-"))
    assert written["command"] == "train.py --name 'a b'"


@pytest.mark.parametrize(
    ("script", "shown_as"), [("recipes/commons.py", "recipes/commons.py"), ("elsewhere.py", "elsewhere.py")]
)
def test_the_command_of_a_recipe_does_not_say_where_on_this_machine_things_are(
    script, shown_as, tmp_path, monkeypatch
):
    here = tmp_path / "checkout"
    here.mkdir()
    monkeypatch.chdir(here)
    absolute = here / script if "/" in script else tmp_path / script
    monkeypatch.setattr(sys, "argv", [str(absolute), "--seed", "3", f"--out={tmp_path}/run"])
    run = start_run(tmp_path / "run", "commons", recipe)
    assert json.loads((run / "recipe.json").read_text())["command"] == f"{shown_as} --seed 3"
    assert str(tmp_path) not in (run / "recipe.json").read_text()


def test_runs_without_a_place_get_one_each(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = {start_run(None, "tragedy", recipe) for _ in range(3)}
    assert len(runs) == 3
    assert all(run.parent == Path("runs") and run.name.startswith("tragedy-20") for run in runs)


def test_a_directory_that_holds_something_and_a_name_that_is_none_are_refused(tmp_path):
    with pytest.raises(ValueError, match="name"):
        start_run(tmp_path / "run", "../tragedy", recipe)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(FileExistsError, match="is not empty"):
        start_run(tmp_path, "tragedy", recipe)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def a_checkout(folder, *names):
    """A git folder with these files, committed by nobody in particular."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("A..")
    me = ["-c", "user.name=me", "-c", "user.email=me@example.org"]
    for command in (["init", "-q"], ["add", *names], [*me, "commit", "-q", "--allow-empty", "-m", "a map"]):
        subprocess.run(["git", *command], check=True, cwd=folder)


def test_the_commit_of_the_code_is_known_and_whether_a_tracked_file_was_changed(tmp_path):
    a_checkout(tmp_path, "src/cprl/__init__.py", "map.txt")
    clean = git_state(tmp_path / "src" / "cprl")
    assert len(clean["commit"]) == 40
    assert clean["dirty"] is False
    (tmp_path / "map.txt").write_text("A.A")
    assert git_state(tmp_path / "src" / "cprl") == {**clean, "dirty": True}


def test_somebody_elses_git_folder_says_nothing_of_the_code(tmp_path, monkeypatch):
    a_checkout(tmp_path, "theirs.py")
    installed = tmp_path / ".venv" / "site-packages" / "cprl"
    installed.mkdir(parents=True)
    (installed / "__init__.py").write_text("")
    assert git_state(installed) is None, "git does not track it, though it lies in a git folder"
    here = git_state()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GIT_DIR", str(tmp_path / ".git"))
    written = json.loads((start_run(tmp_path / "run", "tragedy", recipe) / "recipe.json").read_text())
    assert written["git"] == here, "that of cprl, wherever the process stands"


def test_a_wheel_says_from_which_commit_it_was_built(tmp_path):
    built = {"commit": "0" * 40, "dirty": False}
    (tmp_path / "commit.json").write_text(json.dumps(built))
    assert git_state(tmp_path) == built
    (tmp_path / "commit.json").unlink()
    assert git_state(tmp_path) is None
