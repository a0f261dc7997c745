"""What tests of recordings share."""

import pytest
import rerun as rr


@pytest.fixture
def strict_rerun():
    """Rerun raises what it otherwise only warns of."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)
