"""What a run leaves on the disk: its recipe, a table of episodes that nothing takes away, listed files."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from study_runs import an_episode as episode_of
from written_episodes import an_episode

from cprl.measuring.registry import OPTIONAL_ENTRIES, metrics_for
from cprl.runs.episodes import COLUMNS, EpisodeTable, read_episodes, read_table
from cprl.runs.files import remove_listed, rename_listed, verify, write_listed
from cprl.runs.journal import read_journal
from cprl.runs.recipe import git_state, start_run

WHOLE = ["episodes.parquet", "manifest.json"]

STORED = metrics_for(OPTIONAL_ENTRIES)[:-1]


class LeftError(Exception):
    """Leaves a table as it is, as whatever ends a process does."""


@contextmanager
def opened(path, rows=None):
    """A table, from so many rows of its journal on."""
    with suppress(LeftError), EpisodeTable(path, resumable=True) as table:
        if rows is not None:
            table.load_state_dict({"rows": rows})
        yield table
        raise LeftError


@pytest.fixture
def table(tmp_path):
    with opened(tmp_path / "episodes.parquet") as table:
        yield table


def numbers(table):
    """The episodes in a table, having seen that each has the rows of both agents."""
    assert table["agent"].to_pylist() == [0, 1] * (len(table) // 2)
    assert table["episode"].to_pylist()[::2] == table["episode"].to_pylist()[1::2]
    return table["episode"].to_pylist()[::2]


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


@contextmanager
def full_disk(free_bytes, file):
    """No file of this process grows beyond the size of that file and so many bytes."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (file.stat().st_size + free_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def test_each_agent_of_each_episode_has_a_row(table):
    of_agents = {
        "return_": np.array([1.5, -2.0]),
        "in_play_steps": np.array([90, 100]),
        "shots": np.array([7, 0]),
        "hits": np.array([5, 0]),
        "tagged": np.array([0, 2]),
    }
    first = replace(episode_of(0, 3, 4.0, equality=float("nan")), **of_agents)
    with table:
        table.add(first)
        table.add(replace(an_episode(1), terminated=True, replica=8), replace(an_episode(2), replica=8))
    rows = pq.read_table(table.path)
    columns = [
        (name, kind) for name, kind in COLUMNS.items() if name not in ("wanted_return", "world")
    ]  # of trainings
    assert rows.schema == pa.schema([*columns, *((name, pa.float64()) for name in STORED)])
    assert rows["replica"].to_pylist() == [3, 3, 8, 8, 8, 8]
    assert rows["terminated"].to_pylist() == [False, False, True, True, False, False]
    second = rows.slice(1, 1).to_pylist()[0]
    assert np.isnan(second.pop("equality"))
    assert second == {
        **dict.fromkeys(set(STORED) - {"equality"}, 0.5),
        "collective_return": 4.0,
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
        "stock_left": 1,
        "depletion_step": -1,
        "terminated": False,
    }


def test_what_was_added_can_be_read_while_the_run_goes_on_and_when_it_is_over(table, tmp_path):
    with table:
        for number in range(3):
            table.add(an_episode(number))
            assert numbers(read_episodes(tmp_path)) == list(range(number + 1))
        before = read_episodes(tmp_path)
    assert names_in(tmp_path) == WHOLE
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
    assert numbers(read_episodes(tmp_path)) in (list(range(added)), list(range(added + 1)))


def test_a_journal_cut_at_any_byte_keeps_every_whole_episode_and_one_beside_its_table_has_no_row_twice(
    table, tmp_path
):
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
        assert numbers(read_episodes(cut)) == list(range(sum(size >= end for end in sizes))), size
    table.journal.write_bytes(whole)  # as after a kill while it was closed
    assert numbers(read_episodes(tmp_path)) == [0, 1, 2]


@pytest.mark.integration
def test_damage_hides_a_batch_with_those_behind_it_or_changes_values_but_nothing_else(table):
    for number in range(4):
        table.add(an_episode(number))
    data = table.journal.read_bytes()
    for place in range(0, len(data), 3):
        flipped = bytearray(data)
        flipped[place] ^= 64
        table.journal.write_bytes(flipped)
        assert read_journal(table.journal, pa.schema([])).num_rows <= 8


def test_a_stream_that_pyarrow_writes_is_a_journal(tmp_path):
    path, rows = tmp_path / "episodes.arrows", pa.record_batch({"replica": [1, 1], "equality": [0.5, -1.25]})
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, rows.schema) as stream:
        stream.write_batch(rows, custom_metadata={"crc32": "0"})
    assert read_journal(path, rows.schema).to_batches() == [rows]


def test_a_run_that_crashes_closes_its_table(tmp_path):
    with suppress(LeftError), EpisodeTable(tmp_path / "episodes.parquet") as table:
        table.add(an_episode())
        raise LeftError
    assert len(pq.read_table(table.path)) == 2


def test_a_full_disk_is_named_and_loses_nothing_that_was_added(table, tmp_path):
    table.add(an_episode(0))
    with full_disk(700, table.journal), pytest.raises(OSError, match=r"the 2 earlier rows are in .*arrows"):
        table.add(an_episode(1))
    assert numbers(read_episodes(tmp_path)) == [0]
    table.add(an_episode(1))
    with full_disk(-1000, table.journal), pytest.raises(OSError, match=r"all episodes are in .*arrows"):
        table.close()
    assert names_in(tmp_path) == ["episodes.arrows"]
    assert numbers(read_episodes(tmp_path)) == [0, 1]
    table.close()
    assert names_in(tmp_path) == WHOLE


def test_a_journal_that_lost_rows_is_never_deleted_and_a_deleted_one_is_missed(table, tmp_path):
    table.add(an_episode(0))
    table.add(an_episode(1))
    os.truncate(table.journal, table.journal.stat().st_size - 1)
    with pytest.raises(OSError, match="holds 2 rows of the 4 that were added"):
        table.close()
    assert names_in(tmp_path) == ["episodes.arrows"]
    table.journal.unlink()
    with pytest.raises(FileNotFoundError, match=r"was .*episodes\.arrows deleted\?"):
        table.close()


@pytest.mark.parametrize("close", [True, False], ids=["finished", "going on"])
def test_a_table_that_exists_is_not_written_over(table, tmp_path, close):
    table.add(an_episode())
    if close:
        table.close()
    with pytest.raises(FileExistsError, match="exists and is not overwritten"):
        EpisodeTable(table.path)
    assert len(read_episodes(tmp_path)) == 2


def test_a_run_without_episodes_leaves_an_empty_table_and_a_directory_without_one_is_named(table, tmp_path):
    table.add()
    assert len(read_episodes(tmp_path)) == 0
    table.close()
    assert read_episodes(tmp_path)["equality"].to_pylist() == []
    with pytest.raises(FileNotFoundError, match="is this a run"):
        read_episodes(tmp_path.parent)


def test_the_metrics_of_a_table_are_those_of_its_first_episode(table, tmp_path):
    with table:
        table.add(an_episode(0, yield_share=0.5))
        with pytest.raises(ValueError, match=r"the extra columns \[\] and lacks \['yield_share'\]"):
            table.add(an_episode(1))
    assert read_episodes(tmp_path)["yield_share"].to_pylist() == [0.5, 0.5]


def test_a_table_continues_behind_as_many_rows_as_a_checkpoint_has(table):
    table.add(*map(an_episode, range(2)))
    table.add(*map(an_episode, range(2, 4)))
    whole = table.journal.read_bytes()
    for rows, message in ((6, "holds 8 rows up to there; the checkpoint has 6"), (9, "holds 8 rows")):
        with pytest.raises(ValueError, match=message), opened(table.path, rows):
            pass
    assert table.journal.read_bytes() == whole, "one that cannot be continued is left as it is"
    with opened(table.path, 4) as again:
        again.add(*map(an_episode, range(2, 4)))
    assert table.journal.read_bytes() == whole
    with opened(table.path, 0):
        assert table.journal.read_bytes() == b""


def test_a_finished_table_that_is_resumed_continues_behind_any_episode(table, tmp_path):
    with table:
        table.add(*map(an_episode, range(5)))
    rows = read_episodes(tmp_path)
    with opened(table.path, 4) as again:
        again.add(*map(an_episode, range(2, 5)))
        again.close()
    assert str(read_episodes(tmp_path).to_pylist()) == str(rows.to_pylist())
    assert read_episodes(tmp_path).schema.equals(rows.schema, check_metadata=True)
    assert names_in(tmp_path) == WHOLE


def test_a_table_syncs_its_journal_before_a_checkpoint_counts_its_rows(table, monkeypatch):
    table.add(an_episode())
    synced = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_ino))
    assert table.state_dict() == {"rows": 2}
    assert synced == [table.journal.stat().st_ino]


def test_a_listed_file_is_checked_by_its_path_wherever_it_is_moved_to(tmp_path):
    write_listed(tmp_path, "evaluation/random.bin", lambda file: file.write(b"one"))
    rename_listed(tmp_path, "evaluation", "evaluation-5")
    path = tmp_path / "evaluation-5" / "random.bin"
    verify(path)
    path.write_bytes(b"two")
    with pytest.raises(ValueError, match=r"random\.bin is damaged or was changed: its checksum is"):
        verify(path)
    remove_listed(tmp_path, "evaluation-5/random.bin")
    path.write_bytes(b"two")
    verify(path)  # what no manifest lists is not checked
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(ValueError, match=r"manifest\.json is not the manifest of a run"):
        verify(path)


def test_what_is_no_table_is_refused_by_name(tmp_path):
    (tmp_path / "a.parquet").write_bytes(b"PAR1 and no more")
    os.mkfifo(tmp_path / "b.parquet")
    for name, message in (("a", r"a\.parquet is not a table"), ("b", r"b\.parquet is not a file")):
        with pytest.raises(ValueError, match=message):
            read_table(tmp_path / f"{name}.parquet")


def begin(out):
    def recipe(directory):
        return {"format": 2, "recipe": "tragedy", "experiment": {"seed": 3, "in": directory.name}}

    run = start_run(out, "tragedy", recipe)
    return run, json.loads((run / "recipe.json").read_text())


def test_a_run_begins_with_its_recipe(tmp_path):
    run, written = begin(tmp_path / "deep" / "run")
    assert names_in(run) == ["recipe.json"]
    assert written["recipe"] == "tragedy"
    assert written["experiment"] == {"seed": 3, "in": "run"}
    assert written["versions"]["torch"] == torch.__version__
    assert set(written["versions"]) == {
        "python", "cprl", "torch", "torchrl", "tensordict", "numpy", "numba", "rerun-sdk",
    }  # fmt: skip
    assert written["started"].startswith(time.strftime("%Y-"))


@pytest.mark.parametrize(
    ("script", "command"),
    [
        ("here/recipes/commons.py", "recipes/commons.py --name 'a b'"),
        ("elsewhere.py", "elsewhere.py --name 'a b'"),
    ],
)
def test_the_command_of_a_recipe_does_not_say_where_on_this_machine_things_are(
    script, command, tmp_path, monkeypatch
):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    out = ["--out", "a place", f"--out={tmp_path}/run"]
    monkeypatch.setattr(sys, "argv", [str(tmp_path / script), "--name", "a b", *out])
    run, written = begin(tmp_path / "run")
    assert written["command"] == command
    assert str(tmp_path) not in (run / "recipe.json").read_text()


def test_runs_without_a_place_get_one_each(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = {begin(None)[0] for _ in range(3)}
    assert len(runs) == 3
    assert all(run.parent == Path("runs") and run.name.startswith("tragedy-20") for run in runs)


def test_a_directory_that_holds_something_and_a_name_that_is_none_are_refused(tmp_path):
    with pytest.raises(ValueError, match="name"):
        start_run(tmp_path / "run", "../tragedy", dict)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(FileExistsError, match="is not empty"):
        begin(tmp_path)
    assert names_in(tmp_path) == ["thesis.txt"]


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
    assert begin(tmp_path / "run")[1]["git"] == here, "that of cprl, wherever the process stands"


def test_a_wheel_says_from_which_commit_it_was_built(tmp_path):
    built = {"commit": "0" * 40, "dirty": False}
    (tmp_path / "commit.json").write_text(json.dumps(built))
    assert git_state(tmp_path) == built
    (tmp_path / "commit.json").unlink()
    assert git_state(tmp_path) is None
