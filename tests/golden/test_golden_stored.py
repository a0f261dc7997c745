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


@pytest.mark.parametrize("kind", KINDS)
def test_stored_runs_do_what_they_did(kind, tmp_path):
    held = in_a_process("stored.py", kind, folder=tmp_path)
    assert_held("stored", held, may_gain=True)


def test_only_the_four_runs_whose_weights_left_are_no_longer_played():
    held = json.loads((FOLDER / "stored.json").read_text())
    cases = [case.removeprefix("evaluated: ") for case in held if case.startswith("evaluated: ")]
    names = {re.sub("(, greedy)?(, estimates)?$", "", case) for case in cases}
    left = [f"{name}_decay_500k" for name in ("commons", "commons_published", "commons_targets_10")]
    assert len(names) == 18
    assert names - set(runs()) <= {*left, "studies/experiment_3/runs/as_run"}
