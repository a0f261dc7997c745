"""The reports of the stored runs beside the published study are the committed ones, byte for byte."""

import os
import subprocess
import sys

import pytest
from golden import IS_X86, LIKE_EVERY_MACHINE
from places import RESULTS, ROOT

COMMONS, TARGETS_10 = "commons", "commons_targets_10"
REPORTS = {
    "studies/dip/report": [
        f"studies/dip/runs/{name}"
        for name in ("seed_0", "seed_1000", "decay_400k", "decay_400k_seed_1000", "gamma_0.999")
    ],
    "studies/combat/report": [
        *(COMMONS, TARGETS_10),
        *(f"studies/experiment_5/runs/{name}" for name in ("targets_3", "targets_10", "rmsprop_targets_10")),
        *(f"studies/combat/runs/gamma_0.99_{name}" for name in ("targets_3", "targets_10")),
    ],
    "": [
        *(COMMONS, "commons_decay_500k", "single_basic", "single_complex", "two_complex"),
        *("two_complex_no_beam", "two_against_random", "commons_published", "commons_published_decay_500k"),
        *(TARGETS_10, "commons_targets_10_decay_500k"),
    ],
}
"""The runs of each committed report, as docs/results.md and docs/results.md say, by its folder.

That of experiment_3 is of a rule that no game has any more, and stays as it was written."""

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(not IS_X86, reason="its last digits are those of x86-64"),
]


@pytest.mark.parametrize(
    "folder", [pytest.param(folder, marks=[pytest.mark.slow] * (not folder)) for folder in REPORTS]
)
def test_a_report_of_stored_runs_is_the_committed_one(folder, tmp_path):
    runs = [RESULTS / run for run in REPORTS[folder]]
    subprocess.run(
        [sys.executable, ROOT / "recipes" / "study" / "report.py", *runs, "--out", tmp_path],
        env={**os.environ, **LIKE_EVERY_MACHINE},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    assert (tmp_path / "tables.md").read_bytes() == (RESULTS / folder / "tables.md").read_bytes()
    assert len(list((tmp_path / "figures").iterdir())) >= len(runs)
