"""What is committed says nothing about the machine that made it."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PATH = re.compile(rb"(?<![\w.])/(?:tmp|work|home|root)/[\w.]")
TESTS = "tests/"
"""Strings of tests may be such paths."""


def committed():
    """The files of the checkout that git knows."""
    try:
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this is no git checkout")
    return [name for name in listed.stdout.decode().split("\0") if name and (ROOT / name).is_file()]


@pytest.mark.integration
def test_no_committed_file_holds_a_path_of_a_machine():
    # Recordings, weights and tables too, as far as they are not compressed.
    found = [
        f"{name}: {line.strip()[:100]!r}"
        for name in committed()
        if not name.startswith(TESTS)
        for line in (ROOT / name).read_bytes().splitlines()
        if PATH.search(line)
    ]
    assert found == []


@pytest.mark.parametrize("line", [b'"command": "/tmp/exp/run.py"', b"see /home/ada/cprl", b"--out /work/run"])
def test_the_gate_closes(line):
    assert PATH.search(line)


@pytest.mark.parametrize(
    "line", [b"~/.cache/cprl", b"#!/usr/bin/env python", b"docs/home/index", b"work/runs"]
)
def test_the_gate_lets_through(line):
    assert not PATH.search(line)


@pytest.mark.parametrize("page", ["README.md", "CHANGELOG.md", "CONTRIBUTING.md"])
def test_what_a_page_links_to_is_in_the_source_distribution_too(page):
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    sdist = settings["tool"]["hatch"]["build"]["targets"]["sdist"]
    always = ["/README.md", "/pyproject.toml"]
    links = {f"/{link}" for link in re.findall(r"\]\(([^)#:]+)[)#]", (ROOT / page).read_text())}

    def lies_in(link, places):
        return any(f"{link}/".startswith(f"{place}/") for place in places)

    assert links
    assert [own for own in links if not lies_in(own, sdist["include"] + always)] == []
    assert [own for own in links if lies_in(own, sdist["exclude"])] == []
