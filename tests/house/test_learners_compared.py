"""The comparison of learners: its settings are those that the committed tuning chose."""

import sys
from importlib import import_module

import pytest
from places import ROOT

from cprl.studies import StudyTable

BOARDS = ("two_complex", "commons")


@pytest.fixture
def recipe(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "recipes" / "study" / "learners")
    yield import_module
    for name in ("ways", *(f"comparison_{board}" for board in BOARDS)):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("board", BOARDS)
def test_settings_are_those_that_the_tuning_chose_on_other_seeds(recipe, board):
    table = StudyTable.read(ROOT / "docs" / "results" / "learners" / f"tuning_{board}" / "table.parquet")
    assert recipe("ways").winners(table) == recipe(f"comparison_{board}").CHOSEN
    compared, tuned = recipe(f"comparison_{board}").STUDY, recipe("ways").tuning(board)
    assert abs(compared.experiment.seed - tuned.experiment.seed) >= compared.replicas + tuned.replicas
    assert len(tuned.conditions) == 4 * len(recipe("ways").WAYS)
