"""The committed figures of docs are in one style: `make figures` draws them anew when it changes."""

import subprocess

import pytest
from PIL import Image
from places import ROOT

from cprl.terminal.picture_files import FIGURE_STYLE

SCREENSHOTS = {"docs/viewer.png", "docs/replay.png"}
MEGABYTES = 30


def committed(pattern):
    """Return the paths of committed files of docs."""
    listed = subprocess.run(["git", "ls-files", pattern], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("the checkout has no git")
    return listed.stdout.splitlines()


def test_every_figure_is_drawn_in_the_style_of_today():
    figures = sorted({*committed("docs/*.png")} - SCREENSHOTS)
    assert len(figures) > 45
    older = []
    for figure in figures:
        with Image.open(ROOT / figure) as picture:
            if picture.info.get("Software") != FIGURE_STYLE:
                older.append(figure)
    assert older == [], "make figures draws them anew"


def test_docs_are_at_most_thirty_megabytes():
    sizes = {path: (ROOT / path).stat().st_size for path in committed("docs")}
    assert sum(sizes.values()) <= MEGABYTES * 10**6
