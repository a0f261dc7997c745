"""`make test-oldest` installs the lowest version of everything that pyproject.toml asks for."""

import tomllib

import pytest
from oldest import PYPROJECT, oldest
from packaging.requirements import Requirement

PROJECT = {
    "name": "cprl",
    "dependencies": ["torch>=2.13,<2.14", "Pillow>=11"],
    "optional-dependencies": {
        "film": ["imageio-ffmpeg>=0.6,<0.9; python_version < '3.14'"],
        "all": ["cprl[film]", "ray~=2.60"],
        "dev": ["cprl[all,film]", "pytest==8.1"],
    },
}


def test_each_requirement_is_pinned_to_its_lower_bound_with_those_of_extras_of_extras():
    lines = {line.partition("=")[0]: line for line in oldest(PROJECT, ["dev"])}
    assert lines == {
        "torch": "torch==2.13",
        "Pillow": "Pillow==11",
        "pytest": "pytest==8.1",
        "ray": "ray==2.60",
        "imageio-ffmpeg": 'imageio-ffmpeg==0.6; python_version < "3.14"',
    }
    assert list(oldest(PROJECT, [])) == ["torch==2.13", "Pillow==11"]


def test_a_requirement_without_a_lower_bound_is_refused():
    with pytest.raises(ValueError, match="'torch<3' has no lower bound; allowed: NAME>=VERSION"):
        list(oldest({**PROJECT, "dependencies": ["torch<3"]}, []))


def test_everything_that_the_package_asks_for_has_a_lower_bound():
    project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    pinned = {Requirement(line).name for line in oldest(project, list(extras))}
    asked = {Requirement(line).name for own in (project["dependencies"], *extras.values()) for line in own}
    assert pinned == asked - {"cprl"}
