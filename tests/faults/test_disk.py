"""A disk that is full or read-only, and a run that is deleted: a sentence, and what was kept stays."""

import contextlib
import os
import pwd
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import pytest

from .conftest import SMALL
from .driver import Workshop, alive, differences, lived, tree
from .sentences import assert_refused

pytestmark = pytest.mark.slow

LATER = ("weights", "evaluation", "figures")


def fill(disk):
    """Leaves not a byte free."""
    with open(disk / "ballast", "ab", buffering=0) as ballast:
        for size in (2**16, 2**12, 1):
            with contextlib.suppress(OSError):
                while True:
                    ballast.write(b"\0" * size)
    assert os.statvfs(disk).f_bavail == 0


def free(disk):
    (disk / "ballast").unlink()


@pytest.mark.parametrize("nth", [1, 3, 40, 77])
def test_a_disk_that_is_full_at_a_checkpoint_ends_the_run_resumably(nth, shop, disk, twin):
    run = disk / "run"
    with alive(shop.started("run", run=run, pause=("training", nth))) as process:
        assert process.paused()
        fill(disk)
        process.resume()
        ended = process.end()
    assert_refused(ended, "No space left on device", str(run))
    free(disk)
    assert lived(shop.resumed("run", run=run)).code == 0
    assert differences(run, twin[0]) == []


def test_a_disk_that_is_full_when_an_episode_ends_ends_the_run_resumably(shop, disk, twin):
    run = disk / "run"
    with alive(shop.started("run", run=run, pause=("training", 20))) as process:
        assert process.paused()
    with alive(shop.resumed("run", run=run, every_s=1000)) as process:
        process.at("start")
        time.sleep(0.3)
        fill(disk)
        ended = process.end()
    assert_refused(ended, "No space left on device", "episodes.arrows")
    free(disk)
    assert lived(shop.resumed("run", run=run)).code == 0
    assert differences(run, twin[0]) == []


@pytest.mark.parametrize("stage", LATER)
def test_a_disk_that_is_full_after_the_training_loses_nothing(stage, shop, disk, trained, twin):
    whole, before = twin
    wrong = {}
    for nth in range(1, before.operations[stage] + 1):
        run = disk / "run"
        shutil.copytree(trained, run)
        with alive(shop.resumed("run", run=run, pause=(stage, nth))) as process:
            paused = process.paused()
            fill(disk)
            if paused:
                process.resume()
            ended = process.end()
        free(disk)
        try:
            if ended.code != 0:  # an operation may need no space
                assert_refused(ended, "No space left on device")
            resumed = lived(shop.resumed("run", run=run))
            assert resumed.code == 0, resumed.err
            assert differences(run, whole) == []
        except AssertionError as error:
            wrong[f"{nth}: {paused}"] = str(error)
        shutil.rmtree(run)
    assert not wrong, "\n".join(f"{what}: {error}" for what, error in wrong.items())


def test_a_run_on_a_full_disk_is_refused_and_leaves_nothing(shop, disk):
    fill(disk)
    assert_refused(lived(shop.started("run", run=disk / "run")), "No space left on device")
    assert {path.name for path in disk.iterdir()} == {"ballast"}


def test_a_read_only_file_system_refuses_root_too_and_changes_nothing(shop, disk, twin):
    run = disk / "run"
    with alive(shop.started("run", run=run, pause=("training", 60))) as process:
        assert process.paused()
    before = tree(run)
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    assert_refused(lived(shop.resumed("run", run=run)), "Read-only file system", str(run))
    assert_refused(lived(shop.started("new", run=disk / "new")), "Read-only file system", str(disk / "new"))
    assert tree(run) == before
    subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
    assert lived(shop.resumed("run", run=run)).code == 0
    assert differences(run, twin[0]) == []
    assert [path.name for path in disk.iterdir()] == ["run"]


@pytest.fixture(scope="module")
def somebody():
    """A workshop, a folder in it that is theirs, and what makes a process that of a user: nobody for root."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "theirs"
        folder.mkdir()
        how = {}
        if os.geteuid() == 0:
            how = {"user": pwd.getpwnam("nobody").pw_uid, "cache": folder / "cache"}
            Path(name).chmod(0o755)
            os.chown(folder, how["user"], how["user"])
        yield Workshop(Path(name), SMALL), folder, how


def test_a_read_only_directory_refuses_a_user_and_keeps_everything(somebody, twin):
    shop, theirs, how = somebody
    run = theirs / "run"
    with alive(shop.started("run", run=run, pause=("training", 60), **how)) as process:
        assert process.paused()
    before = tree(run)
    subprocess.run(["chmod", "-R", "a-w", str(theirs)], check=True)
    resumed, new = (
        lived(life)
        for life in (shop.resumed("run", run=run, **how), shop.started("new", run=theirs / "new", **how))
    )
    assert_refused(resumed, "Permission denied", str(run))
    assert_refused(new, "Permission denied", str(theirs / "new"))
    assert tree(run) == before
    subprocess.run(["chmod", "-R", "u+w", str(theirs)], check=True)
    resumed = lived(shop.resumed("run", run=run, **how))
    assert resumed.code == 0, resumed.said
    assert differences(run, twin[0]) == []


def test_a_directory_that_becomes_read_only_ends_the_run_of_a_user_resumably(somebody, twin):
    shop, theirs, how = somebody
    run = theirs / "another"
    with alive(shop.started("run", run=run, pause=("training", 40), **how)) as process:
        assert process.paused()
        (run / "checkpoints").chmod(0o555)
        process.resume()
        assert_refused(process.end(), "Permission denied", str(run))
    (run / "checkpoints").chmod(0o755)
    assert lived(shop.resumed("run", run=run, **how)).code == 0
    assert differences(run, twin[0]) == []


@pytest.mark.parametrize(
    ("stage", "nth"),
    [("training", 1), ("training", 30), *[(stage, nth) for stage in LATER for nth in (1, 2, 5)]],
)
def test_a_run_whose_directory_is_deleted_ends_and_recreates_nothing(stage, nth, shop, twin):
    run = shop.folder / "run"
    with alive(shop.started("run", pause=(stage, min(nth, twin[1].operations[stage])))) as process:
        assert process.paused()
        shutil.rmtree(run)
        process.resume()
        ended = process.end(deadline_s=30)
    assert_refused(ended, str(run))
    assert not run.exists()


def test_a_run_that_is_deleted_between_checkpoints_ends_at_the_next(shop):
    run = shop.folder / "run"
    with alive(shop.started("run", every_s=0.3)) as process:
        process.at("training")
        shutil.rmtree(run.rename(shop.folder / "deleted"))
        ended = process.end(deadline_s=30)
    assert_refused(ended, str(run))
    assert "weights" not in ended.stages
    assert not run.exists()
