"""What tests of faults share: a small training, its undisturbed run, and a small file system."""

import subprocess
from dataclasses import replace

import pytest

from .driver import Workshop, alive, lived
from .experiments import experiment

SMALL = replace(experiment("dqn"), episodes=24)


@pytest.fixture(scope="session")
def twin(tmp_path_factory):
    """The undisturbed run, and how it ended."""
    shop = Workshop(tmp_path_factory.mktemp("twin"), SMALL)
    ended = lived(shop.started("twin"))
    assert ended.code == 0, ended.said
    return shop.folder / "twin", ended


@pytest.fixture
def shop(tmp_path):
    """Where runs of the small training are disturbed."""
    return Workshop(tmp_path, SMALL)


@pytest.fixture(scope="session")
def trained(tmp_path_factory, twin):
    """A run that was killed when its training was over and nothing was saved but checkpoints."""
    shop = Workshop(tmp_path_factory.mktemp("trained"), SMALL)
    with alive(shop.started("run", pause=("weights", 1))) as process:
        assert process.paused()
    return shop.folder / "run"


@pytest.fixture
def halfway(shop):
    """A run that was killed in the middle of its training, with two checkpoints."""
    with alive(shop.started("run", pause=("training", 60))) as process:
        assert process.paused()
    return shop.folder / "run"


@pytest.fixture
def disk(tmp_path):
    """A file system of its own, of 8 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    try:
        refused = subprocess.run(mount, capture_output=True, text=True).stderr
    except FileNotFoundError as error:
        refused = str(error)
    if refused:
        pytest.skip(f"mounting a tmpfs is refused: {refused.strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)
