"""Recipes, stored recipes and the conditions of stored studies mean what they meant."""

import hashlib
import importlib.util
import inspect
import json
import sys
from itertools import product
from pathlib import Path
from typing import get_args

import pytest
from golden import RESULTS, WITH_THE_FAULT, assert_held
from places import ROOT

from cprl import Experiment, Study
from cprl.experiment.engine import engine_of
from cprl.values import trust

RECIPES = sorted(path for path in (ROOT / "recipes").rglob("*.py"))
STORED = sorted({*RESULTS.rglob("recipe.json")} - WITH_THE_FAULT)
STUDIES = sorted({*RESULTS.rglob("study.json")} - WITH_THE_FAULT)


def below(path, folder):
    return path.relative_to(folder).as_posix()


def module_of(path, monkeypatch):
    """A recipe, imported as if it were run; its neighbours can be imported by it."""
    monkeypatch.syspath_prepend(str(path.parent))
    name = f"golden_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    before = set(sys.modules)
    spec.loader.exec_module(module)
    for imported in set(sys.modules) - before:
        if (
            getattr(sys.modules[imported], "__file__", None)
            and path.parent in Path(sys.modules[imported].__file__).parents
        ):
            del sys.modules[imported]
    return module


def experiments(module):
    """Each experiment that a recipe makes: by its words of choice, or of its study."""
    if callable(made := getattr(module, "experiment", None)):
        choices = {
            name: get_args(parameter.annotation) or (parameter.default,)
            for name, parameter in inspect.signature(made, eval_str=True).parameters.items()
        }
        for values in product(*choices.values()):
            words = dict(zip(choices, values, strict=True))
            try:
                yield " ".join(map(str, values)), made(**words)
            except ValueError:  # words that do not go together
                continue
    if isinstance(study := getattr(module, "STUDY", None), Study):
        yield "study", study.experiment


def shortened(value):
    """A table in which maps are checksums, and an agent like the one before it says so.

    A map without spawn places and river has the checksum that it had before maps could have them.
    """
    if isinstance(value, dict):
        if value.get("kind") == "Map":
            value = {
                name: part for name, part in value.items() if name not in ("spawns", "river", "waste") or part
            }
            return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
        return {name: shortened(part) for name, part in value.items()}
    if not isinstance(value, list | tuple):
        return value
    return [
        "as before" if isinstance(part, dict) and index and part == value[index - 1] else shortened(part)
        for index, part in enumerate(value)
    ]


def trained_by(experiment):
    """The table of an experiment, with the engine that trains it in place of "auto"."""
    return {**experiment.to_config(), "engine": engine_of(experiment)}


@pytest.mark.integration
@pytest.mark.parametrize("path", RECIPES, ids=lambda path: below(path, ROOT))
def test_a_recipe_makes_the_experiment_that_it_made(path, monkeypatch):
    made = {
        f"{below(path, ROOT)} {words}".strip(): shortened(trained_by(experiment))
        for words, experiment in experiments(module_of(path, monkeypatch))
    }
    if made:
        assert_held("recipes", made, may_gain=True)


def targets(value):
    """The code of a user's own that a stored table names."""
    if isinstance(value, dict):
        own = [value["target"]] if value.get("kind") == "Custom" else []
        return [*own, *(target for part in value.values() for target in targets(part))]
    return [target for part in value for target in targets(part)] if isinstance(value, list) else []


@pytest.mark.integration
@pytest.mark.parametrize("path", STORED, ids=lambda path: below(path, RESULTS))
def test_a_stored_recipe_is_read_as_it_was(path):
    recipe = json.loads(path.read_text())
    trust(*targets(recipe))
    read = Experiment.from_recipe(recipe, directory=path.parent)
    assert_held("stored_recipes", {below(path.parent, RESULTS): shortened(read.to_config())}, may_gain=True)


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: below(path, RESULTS))
def test_the_conditions_of_a_stored_study_keep_their_checksums(path):
    table = json.loads(path.read_text())
    trust(*targets(table))
    study = Study.from_config(table, directory=path.parent)
    conditions = {condition.name: condition.checksum for condition in study.all_conditions}
    assert_held("conditions", {below(path.parent, RESULTS): conditions})
