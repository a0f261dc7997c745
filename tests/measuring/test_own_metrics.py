"""A metric of the user's own, one function of an episode, appears wherever those of the library do."""

from dataclasses import replace
from math import inf
from shutil import copytree

import pyarrow as pa
import pytest
from recordings import column, names
from stored_runs import command
from tiny_study import TINY

import cprl
from cprl import Custom, Study
from cprl.experimental.search import Search
from cprl.measuring.registry import bounds, title, unit, with_unit
from cprl.measuring.table import all_metrics, where
from cprl.runs.curves import curves_of
from cprl.runs.episodes import read_episodes, read_evaluations
from cprl.runs.recipe import read_recipe
from cprl.studies import StudyTable
from cprl.studies.tables.comparing import condition_table
from cprl.studies.tables.tidy_table import StudyDesign
from cprl.values import METRIC_WORDS
from cprl.viewer.layout import layout, styles
from cprl.viewer.scene import Curves

KEYS = ("policy", "trained_episodes", "replica", "episode")
SHARE, LOGGER = "own_parts:largest_share", "torchrl.record.loggers:CSVLogger"
ALLOW = [SHARE, LOGGER]


def experiment(*targets, **changes):
    return replace(TINY, metrics=[Custom(f"own_parts:{target}") for target in targets], **changes)


def train(measured, out, **options):
    return cprl.run(measured, out, **options)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run and the folder of its logger."""
    folder = tmp_path_factory.mktemp("own")
    log = Custom(LOGGER, arguments={"exp_name": "own", "log_dir": str(folder)})
    return train(experiment("largest_share", episodes=3, evaluate_every=2, loggers=(log,)), folder / "run")


@pytest.mark.integration
def test_it_is_a_column_of_every_table_of_episodes(run):
    cprl.trust(*ALLOW)
    evaluated = cprl.evaluate_run(run, cprl.Fresh(episodes=2))
    for table in (read_episodes(run), read_evaluations(run), evaluated):
        by_episode = table.group_by([name for name in table.column_names if name in KEYS]).aggregate(
            [("harvest", "max"), ("harvest", "sum"), ("largest_share", "min"), ("largest_share", "max")]
        )
        for row in by_episode.to_pylist():
            share = row["harvest_max"] / row["harvest_sum"] if row["harvest_sum"] else float("nan")
            assert row["largest_share_min"] == pytest.approx(share, nan_ok=True)
            assert row["largest_share_max"] == pytest.approx(share, nan_ok=True)


@pytest.mark.integration
def test_it_is_a_curve_of_the_recording_and_of_a_logger_and_a_row_of_what_is_evaluated(
    run, monkeypatch, capsys
):
    curve = curves_of(run)["largest_share"]
    defined = [(episode, pytest.approx(value)) for episode, value in enumerate(curve[0]) if value == value]
    episodes, values = column(run / "run.rrd", "social/largest_share", "Scalars:scalars", "episode")
    assert [(episode, value[0]) for episode, value in zip(episodes, values, strict=True)] == defined
    lines = (run.parent / "own/scalars/social/largest_share.csv").read_text().split()
    assert len(lines) == len(defined)
    assert column(run / "run.rrd", "random_play/largest_share", "Scalars:scalars")[1]
    words = ["evaluate", run, "--episodes", 2, "--allow", SHARE, "--allow", LOGGER]
    assert "largest_share" in command(monkeypatch, capsys, *words)


def test_its_title_and_unit_come_from_its_function_and_stand_in_the_recipe_alone(tmp_path):
    run = train(experiment("gap", "largest_share"), tmp_path / "run", watch="off")
    assert read_recipe(run)["metrics"] == {"gap": {"title": "most minus least", "unit": "apples"}}
    METRIC_WORDS.clear()  # as in another process, which imports nothing
    assert title("gap") == "gap"
    assert read_recipe(run)
    assert title("gap") == with_unit("gap") == "most minus least, apples"
    assert unit("gap") == "apples"
    assert title("largest_share") == "largest_share"


def test_the_table_of_a_study_says_what_it_is_called(tmp_path):
    METRIC_WORDS["gap"] = {"title": "most minus least", "unit": "apples"}
    row = {"condition": "a", "replica": 0, "part": "training", "metric": "gap", "episode": 0}
    rows = pa.Table.from_pylist([row | {"window_episodes": 10, "undefined": 0, "value": 3.0}])
    design = StudyDesign(name="one", conditions={"a": {}}, reference="a", is_paired=True)
    written = StudyTable(design=design, rows=rows, window=10).write(tmp_path / "table.parquet")
    METRIC_WORDS.clear()
    assert condition_table(StudyTable.read(written, last=10)).head[-1] == "most minus least, apples"
    METRIC_WORDS.clear()


def test_one_from_0_to_1_has_these_bounds():
    assert bounds("gap") == (-inf, inf)
    METRIC_WORDS["of_all"] = {"unit": "0 to 1"}
    assert (title("of_all"), unit("of_all"), bounds("of_all")) == ("of_all, 0 to 1", "", (0.0, 1.0))
    del METRIC_WORDS["of_all"]


def test_a_unit_that_is_no_text_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"own_parts:nameless\.unit is 3"):
        train(experiment("nameless"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_it_has_a_plot_and_a_line_of_its_own_in_the_viewer():
    curves = Curves(agents=("a", "b"), metrics=("equality", "largest_share"))
    assert "largest_share" in names(layout(curves).root_container)
    assert "social/largest_share" in styles(curves)


@pytest.mark.integration
def test_it_is_compared_in_a_study_and_what_a_search_looks_for(tmp_path):
    measured = experiment("largest_share")
    study = Study(measured, {"game.rules.freeze_steps": [2, 5]}, replicas=1)
    result = cprl.run_study(study, tmp_path / "study")
    assert "largest_share" in (result.out / "summary.md").read_text()
    table = StudyTable.read(result.out / "table.parquet")
    for part in ("training", "evaluation", "random"):
        rows = where(table.windows(part), condition="freeze_steps=5", metric="largest_share")
        assert rows["value"].to_pylist()
    factors = {"game.rules.freeze_steps": [2, 5]}
    assert Search(measured, factors, points=2, metric="largest_share").metric == "largest_share"
    with pytest.raises(ValueError, match="metric"):
        Search(TINY, factors, points=2, metric="largest_share")


@pytest.mark.integration
def test_nothing_else_of_a_run_changes(tmp_path):
    measured = train(experiment("largest_share"), tmp_path / "run", watch="off")
    plain = train(TINY, tmp_path / "plain", watch="off")
    tables = [read_episodes(measured).drop(["largest_share"]), read_episodes(plain)]
    assert repr(tables[0].to_pydict()) == repr(tables[1].to_pydict())
    again = copytree(measured, tmp_path / "again")
    cprl.trust(*ALLOW)
    for others, has in ([measured, plain], False), ([plain, measured], False), ([measured, again], True):
        played = cprl.crossplay(others, cprl.Fresh(episodes=1))
        assert ("largest_share" in played.column_names) == has
        assert ("largest_share" in all_metrics(played)) == has


@pytest.mark.parametrize("target", ["no_number", "fails", "of_another_game", "missing"])
def test_one_that_gives_no_number_is_refused_before_anything_is_written(target, tmp_path):
    with pytest.raises(ValueError, match=f"own_parts:{target}"):
        train(experiment(target), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "targets", [["equality"], ["steps"], ["return_1"], ["policy"], ["largest_share"] * 2]
)
def test_one_with_the_name_of_another_number_is_refused(targets):
    with pytest.raises(ValueError, match=f"another number of an episode is called {targets[0]}"):
        experiment(*targets)


@pytest.mark.parametrize("target", ["rewrites_harvest", "rewrites_metrics"])
def test_one_that_writes_into_its_episode_is_refused_before_anything_is_written(target, tmp_path):
    with pytest.raises(ValueError, match=rf"{target} gives no number.*(read-only|assignment)"):
        train(experiment(target), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_recipe_with_one_is_read_where_it_is_allowed():
    recipe = experiment("largest_share").to_recipe()
    with pytest.raises(ValueError, match=f"--allow {SHARE}"):
        cprl.Experiment.from_recipe(recipe)
    cprl.trust(SHARE)
    assert cprl.Experiment.from_recipe(recipe) == experiment("largest_share")
