"""What the package shows from outside: its names, version and types."""

import subprocess
import sys
from importlib.metadata import version
from importlib.resources import files

import pytest

import cprl
from cprl import cli


def test_dir_shows_all_and_only_the_public_names():
    assert dir(cprl) == sorted(cprl.__all__)
    assert len(set(cprl.__all__)) == len(cprl.__all__)
    for name in cprl.__all__:
        assert getattr(cprl, name) is not None, name


def test_what_is_imported_when_used_is_public():
    assert set(cprl._IMPORTED_WHEN_USED) <= set(cprl.__all__)


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'cprl' has no attribute 'lode'"):
        _ = cprl.lode


def test_the_viewer_exports_its_logger():
    from cprl import viewer
    from cprl.viewer import RerunLogger, logger

    assert RerunLogger is logger.RerunLogger
    with pytest.raises(AttributeError, match=r"module 'cprl\.viewer' has no attribute 'RerunLoger'"):
        _ = viewer.RerunLoger


@pytest.mark.integration
def test_importing_cprl_leaves_the_viewer_and_stored_runs_out():
    code = (
        "import sys, cprl\n"
        "heavy = {'rerun', 'pyarrow', 'matplotlib', 'scipy.stats', 'cprl.stored', 'cprl.evaluation'}\n"
        "import cprl.viewer\n"
        "loaded = (heavy | {'cprl.viewer.logger'}) & set(sys.modules)\n"
        "sys.exit(str(sorted(loaded)) if loaded else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_version_is_that_of_the_installed_package(capsys, monkeypatch):
    assert cprl.__version__ == version("cprl")
    monkeypatch.setattr(sys, "argv", ["cprl", "--version"])
    cli.main()
    assert capsys.readouterr().out == f"cprl {version('cprl')}\n"


@pytest.mark.integration
def test_the_command_works_by_the_name_of_the_package_too():
    """Where the scripts of Python are not on the path; it is called `cprl` all the same."""
    words = [sys.executable, "-m", "cprl", "--help"]
    said = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120).stdout
    assert said.startswith("usage: cprl [-h]")


def test_type_checkers_find_the_types():
    assert files("cprl").joinpath("py.typed").is_file()
