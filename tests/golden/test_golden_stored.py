"""The stored runs do in fresh worlds what they did, however they are evaluated."""

import pytest
from golden import IS_X86, assert_held, in_a_process
from stored import KINDS

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(not IS_X86, reason="its sums are those of x86-64"),
]


@pytest.mark.parametrize("kind", KINDS)
def test_stored_runs_do_what_they_did(kind, tmp_path):
    held = in_a_process("stored.py", kind, folder=tmp_path)
    assert_held("stored", held, may_gain=True)
