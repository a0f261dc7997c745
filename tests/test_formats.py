"""Files of runs have formats: stored ones are read, others are refused by name."""

import json
import shutil
from pathlib import Path

import pytest
import torch

import cprl
from cprl.experiment import Experiment
from cprl.runs.checkpoints import read_checkpoint
from cprl.runs.episodes import read_episodes
from cprl.runs.files import (
    MANIFEST_FORMAT,
    RECIPE_FORMAT,
    STUDY_FORMAT,
    TRAINING_STATE_FORMAT,
    checksum,
    verify,
)
from cprl.runs.recipe import read_recipe
from cprl.studies import Study, read_study

RESULTS = Path(__file__).parents[1] / "docs" / "results"
STORED = Path(__file__).parent / "stored" / "run"
"""A run with a manifest: two episodes of `single_basic`, whose recipe has its command line."""
RUNS = [*sorted(path.parent for path in RESULTS.rglob("recipe.json")), STORED]
STUDIES = sorted(path.parent for path in RESULTS.rglob("study.json"))


@pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run.parent.name}-{run.name}")
def test_a_stored_run_is_read(run):
    experiment = Experiment.from_recipe(read_recipe(run), directory=run)
    assert experiment == Experiment.from_recipe(experiment.to_recipe(), directory=None)
    table = read_episodes(run)
    assert set(table["agent"].to_pylist()) == set(range(experiment.game.agents))
    assert set(table["replica"].to_pylist()) == set(range(experiment.replicas))


def test_the_checksums_of_a_stored_run_still_hold():
    listed = json.loads((STORED / "manifest.json").read_text())["files"]
    assert set(listed) == {
        *("checkpoints/final.pt", "episodes.parquet"),
        *("evaluation/random.parquet", "evaluation/trained.parquet"),
    }
    for name in listed:
        verify(STORED / name)


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_a_stored_study_is_read(study):
    assert read_study(study, allow=["torchrl.envs:CatFrames"]).all_conditions


@pytest.fixture
def changed(tmp_path):
    """A stored run of which a file has other entries."""

    def change(name, **entries):
        run = shutil.copytree(STORED, tmp_path / "run")
        table = json.loads((run / name).read_text())
        (run / name).write_text(json.dumps({**table, **entries}))
        return run

    return change


REFUSED = r"has the format {0}, and cprl \S+ reads up to {1}: a newer cprl wrote it; upgrade cprl"


@pytest.mark.parametrize(
    ("name", "entries", "read"),
    [
        *(("recipe.json", {"format": RECIPE_FORMAT + 1}, read) for read in (read_recipe, cprl.load)),
        ("recipe.json", {"format": RECIPE_FORMAT + 1}, read_episodes),
        ("recipe.json", {"format": RECIPE_FORMAT + 1, "experiment": None}, read_recipe),
        ("manifest.json", {"format": MANIFEST_FORMAT + 1, "files": {}}, read_episodes),
    ],
)
def test_what_a_newer_cprl_wrote_is_refused_by_name(name, entries, read, changed):
    run, number = changed(name, **entries), entries["format"]
    with pytest.raises(ValueError, match=f"{name} {REFUSED.format(number, number - 1)}"):
        read(run)


def test_a_checkpoint_of_a_newer_cprl_is_refused_by_name(tmp_path):
    written = tmp_path / "written.pt"
    torch.save({"format": TRAINING_STATE_FORMAT + 1}, written)
    path = written.rename(tmp_path / f"training-{20:012d}-{checksum(written)}.pt")
    refused = REFUSED.format(TRAINING_STATE_FORMAT + 1, TRAINING_STATE_FORMAT)
    with pytest.raises(ValueError, match=r"training-\S+\.pt " + refused):
        read_checkpoint(path)


def test_a_study_of_a_newer_cprl_is_refused_by_name():
    table = read_study(STUDIES[0]).to_config()
    with pytest.raises(ValueError, match="the study " + REFUSED.format(2, 1)):
        Study.from_config({**table, "format": STUDY_FORMAT + 1})


def test_a_field_that_another_cprl_wrote_is_refused_with_its_version(changed):
    recipe = read_recipe(STORED)
    run = changed(
        "recipe.json",
        experiment={**recipe["experiment"], "weather": "rain"},
        versions={**recipe["versions"], "cprl": "9.1"},
    )
    with pytest.raises(ValueError, match=r"experiment\.weather is no field.*; cprl '9\.1' wrote it, and thi"):
        cprl.load(run)
