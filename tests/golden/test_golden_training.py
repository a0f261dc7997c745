"""Every algorithm learns what it learned, stopped in the middle or not: tables, weights, evaluations."""

import pytest
from golden import IS_X86, assert_held, in_a_process
from trainings import COMPILED

FAMILIES = ("dqn", "off-policy", "on-policy", "recurrent", "teams", "opponent-aware", "mixed")
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(not IS_X86, reason="its sums are those of x86-64"),
]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_of_algorithms_learns_what_it_did(family, tmp_path):
    found = in_a_process("trainings.py", family, folder=tmp_path)
    assert {name: case["differs after a stop"] for name, case in found.items()} == {
        name: [] for name in found
    }
    assert_held("weights", {name: case.pop("weights") for name, case in found.items()}, tolerance=1e-4)
    assert_held("training", found, may_gain=True)  # the column of worlds


@pytest.mark.parametrize("family", COMPILED)
def test_compiled_updates_learn_what_eager_ones_do(family, tmp_path):
    found = in_a_process("trainings.py", family, "compiled", folder=tmp_path)
    assert set(found) == set(COMPILED[family])
    assert {name: distance for name, distance in found.items() if not distance < 1e-5} == {}
