"""Where things lie in the checkout whose tests run."""

from pathlib import Path

SUPPORT = Path(__file__).parent
TESTS = SUPPORT.parent
ROOT = TESTS.parent
DATA = TESTS / "data"
"""Files that tests read: recorded traces, a stored run, the defaults of conditions."""
GOLDEN = TESTS / "golden"
RECIPES = ROOT / "recipes"
RESULTS = ROOT / "docs" / "results"
