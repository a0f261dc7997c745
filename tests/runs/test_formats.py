"""Files of runs have formats: stored ones are read, others are refused by name."""

import json
import os
import shutil
from dataclasses import replace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from golden import RESULTS, WITH_THE_FAULT
from places import DATA

import cprl
from cprl.experiment import Experiment
from cprl.runs.checkpoints import read_checkpoint
from cprl.runs.curves import curves_of
from cprl.runs.episodes import EpisodeTable, read_episodes
from cprl.runs.files import (
    MANIFEST_FORMAT,
    RECIPE_FORMAT,
    STUDY_FORMAT,
    TRAINING_STATE_FORMAT,
    RunLock,
    checksum,
    verify,
)
from cprl.runs.recipe import read_recipe
from cprl.studies import Study, read_study
from cprl.studies.tables.sources import circumstances_of
from cprl.system.output import console, say
from cprl.values import custom_targets
from cprl.web.report import report

STORED = DATA / "stored" / "run"
"""A run with a manifest: two episodes of `single_basic`, whose recipe has its command line."""
RUNS = [*sorted(path.parent for path in {*RESULTS.rglob("recipe.json")} - WITH_THE_FAULT), STORED]
STUDIES = sorted(path.parent for path in {*RESULTS.rglob("study.json")} - WITH_THE_FAULT)


@pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run.parent.name}-{run.name}")
def test_a_stored_run_is_read(run):
    recipe = read_recipe(run)
    cprl.trust(*custom_targets(recipe["experiment"]))
    experiment = Experiment.from_recipe(recipe, directory=run)
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
    cprl.trust("torchrl.envs:CatFrames")
    assert read_study(study).all_conditions


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


def nested(depth):
    return [] if depth == 0 else [nested(depth - 1)]


ODD_RECIPES = [
    ({"extended": 3}, "extended"),
    ({"extended": [None]}, "extended"),
    ({"resumed": [1]}, "resumed"),
    ({"resumed": "yes"}, "resumed"),
    ({"versions": [1]}, "versions"),
    ({"code": [["a", "b"]]}, "code"),
    ({"code_text": 5}, "code_text"),
    ({"frozen": 5}, "frozen"),
    ({"extended": [{"versions": 7}]}, "versions"),
    ({"note": nested(900)}, "nested"),
    ({"experiment": {"note": nested(400)}}, "nested"),
]
LENGTHENED = Experiment.from_recipe(read_recipe(STORED), directory=STORED)
LENGTHENED = replace(LENGTHENED, episodes=LENGTHENED.episodes + 1)
READERS = [
    cprl.load,
    circumstances_of,
    report,
    lambda run: cprl.run(LENGTHENED, run, resume=True, watch="off"),
]


@pytest.mark.integration
@pytest.mark.parametrize(("entries", "place"), ODD_RECIPES, ids=lambda value: str(value)[:30])
@pytest.mark.parametrize("read", READERS, ids=["load", "table", "report", "extend"])
def test_an_odd_recipe_is_refused_by_its_place(entries, place, read, changed):
    run = changed("recipe.json", **entries)
    with pytest.raises(ValueError, match=rf"recipe\.json.*{place}"):
        read(run)


OTHER_TABLES = {
    "another schema": pa.table({"a": [1, 2]}),
    "texts": pa.table({"replica": ["a"], "episode": ["b"], "agent": ["c"], "return": ["d"]}),
    "no column agent": lambda table: table.drop(["agent"]),
    "below 0": lambda table: table.set_column(0, "replica", pa.array([-1] * len(table), pa.int32())),
    "empty": lambda table: table.set_column(0, "replica", pa.nulls(len(table), pa.int32())),
    "twice": lambda table: table.append_column("agent", table["agent"]),
}


@pytest.mark.parametrize("what", OTHER_TABLES)
@pytest.mark.parametrize("read", [read_episodes, curves_of])
@pytest.mark.parametrize("suffix", ["parquet", "arrows"])
def test_a_table_that_is_none_of_episodes_is_refused_by_its_name(what, read, suffix, tmp_path):
    run = shutil.copytree(STORED, tmp_path / "run")
    (run / "manifest.json").unlink()
    other = OTHER_TABLES[what]
    table = other if isinstance(other, pa.Table) else other(read_episodes(run))
    if suffix == "parquet":
        pq.write_table(table, run / "episodes.parquet")
    else:
        with pa.ipc.new_stream(run / "episodes.arrows", table.schema) as stream:
            stream.write_table(table)
    with pytest.raises(ValueError, match=rf"episodes\.{suffix} is not a table"):
        read(run)


def test_a_run_whose_table_is_none_of_episodes_is_not_extended(tmp_path):
    run = shutil.copytree(STORED, tmp_path / "run")
    (run / "manifest.json").unlink()
    pq.write_table(OTHER_TABLES["another schema"], run / "episodes.parquet")
    with pytest.raises(ValueError, match=r"episodes\.parquet is not a table of episodes"):
        EpisodeTable(run / "episodes.parquet", resumable=True)
    assert not (run / "episodes.arrows").exists()


def test_a_manifest_is_of_one_experiment_whatever_its_length_and_name(changed):
    listed = json.loads((STORED / "manifest.json").read_text())
    recipe = json.loads((STORED / "recipe.json").read_text())
    same = {**recipe["experiment"], "episodes": 7, "name": "renamed", "on_nan": "continue"}
    run = changed("recipe.json", experiment=same)
    verify(run / "episodes.parquet")
    assert len(listed["experiment"]) == 32


@pytest.mark.parametrize("read", [read_episodes, cprl.load])
def test_files_beside_the_recipe_of_another_run_are_refused_by_the_manifest(read, changed):
    recipe = json.loads((STORED / "recipe.json").read_text())
    run = changed("recipe.json", experiment={**recipe["experiment"], "seed": 77})
    with pytest.raises(ValueError, match=r"manifest\.json is of another experiment than recipe\.json"):
        read(run)


@pytest.mark.parametrize("read", [cprl.load, report, cprl.evaluate_run])
def test_a_run_before_its_first_checkpoint_says_how_far_it_is(read, tmp_path):
    run = shutil.copytree(STORED, tmp_path / "run")
    for name in ("checkpoints/final.pt", "report.json", "manifest.json"):
        (run / name).unlink()
    so_far = r"run has 4 episodes, .* and no checkpoint yet \({}\); read_episodes reads them"
    with pytest.raises(ValueError, match=so_far.format(r"nobody is writing it; to resume it: .*--resume")):
        read(run)
    by_this = rf"process {os.getpid()} on \S+ since \S+ is writing it, or was killed"
    with RunLock(run), pytest.raises(ValueError, match=so_far.format(by_this)):
        read(run)
    (run / "episodes.parquet").unlink()
    with pytest.raises(ValueError, match=r"has .* been trained"):
        read(run)


def test_names_of_a_foreign_manifest_and_recipe_reach_no_terminal_as_commands(changed, monkeypatch, capsys):
    run = changed("manifest.json", files={"\x1b[31mred": "0", "new\rline": "0"})
    with pytest.raises(ValueError, match="lacks") as refused:
        cprl.load(run)
    assert "\x1b" not in str(refused.value)
    assert "\r" not in str(refused.value)
    recipe = json.loads((run / "recipe.json").read_text())
    versions = {**recipe["versions"], "torch": "\x1b[31m2.0", "\x9bm": "1"}
    (run / "recipe.json").write_text(json.dumps({**recipe, "versions": versions}))
    made = json.dumps(circumstances_of(run), ensure_ascii=False)
    assert not {"\x1b", "\x9b"} & {*made}
    say("\x1b[2J", "two\nlines")
    console().print("\x1b[2J in a cell")
    printed = capsys.readouterr().out
    assert "\x1b" not in printed
    assert "two\nlines" in printed


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
