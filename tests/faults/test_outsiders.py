"""Who looks on does no harm: a reader of the output who leaves."""

import subprocess
import sys

import pytest

from .driver import differences, lived

pytestmark = pytest.mark.slow


def test_a_closed_standard_output_loses_nothing(shop, twin):
    life = shop.started("run")
    program = [sys.executable, "-c", "from cprl.cli import main; main()", *life.argv[1:]]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        said = process.stderr.read()
    assert "Traceback" not in said
    assert "output" in said
    assert lived(shop.resumed("run")).code == 0
    assert differences(life.run, twin[0]) == []
