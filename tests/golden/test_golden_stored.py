"""The stored runs do in fresh worlds what they did, however they are evaluated."""

import json
import re

import pytest
from golden import FOLDER, IS_X86, assert_held, in_a_process
from stored import KINDS, runs

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(not IS_X86, reason="its sums are those of x86-64"),
]


LONGEST = "scenarios"
"""The kind of evaluation that takes as long as all others, which share a process."""


@pytest.mark.parametrize("kinds", [[LONGEST], [kind for kind in KINDS if kind != LONGEST]], ids=" ".join)
def test_stored_runs_do_what_they_did(kinds, tmp_path):
    held = in_a_process("stored.py", *kinds, folder=tmp_path)
    assert {case.split(": ")[0] for case in held} == {*kinds}
    assert_held("stored", held, may_gain=True)


def test_only_the_four_runs_whose_weights_left_are_no_longer_played():
    held = json.loads((FOLDER / "stored.json").read_text())
    cases = [case.removeprefix("evaluated: ") for case in held if case.startswith("evaluated: ")]
    names = {re.sub("(, greedy)?(, estimates)?$", "", case) for case in cases}
    left = [f"{name}_decay_500k" for name in ("commons", "commons_published", "commons_targets_10")]
    assert len(names) == 18
    assert names - set(runs()) <= {*left, "studies/experiment_3/runs/as_run"}
