"""The recipes of recipes/study/perolat run, in miniature, and their claims are read off what they leave."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pyarrow as pa
import pytest
from places import RECIPES

import cprl
from cprl import maps
from cprl.measuring.statistics import Estimate
from cprl.runs.episodes import read_table
from cprl.studies.tables.sources import sources_of

STUDIES = ("perolat_open", "perolat_walls", "perolat_unequal")
SMALL = {"episodes": 2, "evaluation_episodes": 2, "engine": "eager", "replicas": 2}


@pytest.fixture(scope="module")
def recipes():
    """The modules of the folder by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(RECIPES / "study" / "perolat")
        names = ("perolat_base", *STUDIES, "perolat_claims", "perolat_lows")
        return {name: import_module(name) for name in names}


def in_miniature(study):
    """The study with episodes of 25 steps and two replicas of two of them."""
    whole = study.experiment
    game = replace(whole.game, rules=replace(whole.game.rules, episode_steps=25))
    (agent,) = set(whole.agents)
    settings = replace(agent.algorithm.settings, buffer_size=100)
    agents = (replace(agent, algorithm=replace(agent.algorithm, settings=settings)),) * len(whole.agents)
    small = replace(whole, game=game, agents=agents, **SMALL)
    return replace(study, experiment=small, replicas=2)


@pytest.fixture(scope="module")
def ran(recipes, tmp_path_factory):
    """All studies, run in one pool of runs; the directory of the runs."""
    folder = tmp_path_factory.mktemp("perolat")
    for name in STUDIES:
        study = in_miniature(recipes[name].STUDY)
        recipes[name].STUDY = study
        cprl.run_study(study, folder / name, runs=folder / "runs", progress=False, results=False)
        assert not any(source.reason for source in sources_of(study, folder / "runs")), name
    return folder / "runs"


def test_modules_of_recipes_have_names_of_their_own():
    names = [path.stem for path in RECIPES.rglob("*.py")]
    assert sorted(names) == sorted(set(names))


def test_equal_rooms_are_the_walls_of_the_study_of_walls(recipes):
    walls, unequal = (recipes[f"perolat_{name}"].STUDY for name in ("walls", "unequal"))
    sums = [{own.checksum for own in study.all_conditions} for study in (walls, unequal)]
    assert len(sums[0] & sums[1]) == 2, "one for each length of the beam"
    boards = [own.experiment.game.map for own in unequal.all_conditions]
    assert boards == [maps.rooms("single"), maps.rooms("unequal")] * 2


@pytest.mark.slow  # nine trainings
def test_every_study_runs_and_its_conditions_share_what_does_not_vary(ran, recipes):
    studies = [recipes[name].STUDY for name in STUDIES]
    sources = [source for study in studies for source in sources_of(study, ran) if not source.reason]
    assert [len(study.all_conditions) for study in studies] == [3, 4, 4]
    assert len({source.run for source in sources}) == 9
    rules = [cprl.load(source.run).game.rules for source in sources]
    assert {own.beam_length_cells for own in rules} == {10, 20}
    for own in rules:
        assert (own.window_rows, own.window_columns, own.beam_width_cells) == (20, 21, 5)
        assert (own.hits_to_tag, own.freeze_steps) == (1, 25)


@pytest.mark.slow  # nine trainings
def test_the_table_of_claims_has_a_row_for_each_measure_and_says_what_is_not_run(
    ran, recipes, monkeypatch, tmp_path
):
    claims = recipes["perolat_claims"]
    monkeypatch.setattr(claims, "EPISODES", 2)
    rows = claims.table(ran).splitlines()[2:]
    assert len(rows) == sum(len(claim.measures) for claim in claims.claims())
    assert not [row for row in rows if "not run" in row]
    ends = {row.split(" | ")[-1].removesuffix(" |") for row in rows}
    assert ends <= {
        "as claimed",
        "contradicted",
        "cannot be told with 2 replicas",
        "cannot be told with 1 replica",
        "undefined in all replicas",
    }
    (harvest,) = (
        row
        for row in rows
        if "harvest less than random" in row and "harvest, apples" in row and "of 10" in row
    )
    (run,) = (
        source.run
        for source in sources_of(recipes["perolat_open"].STUDY, ran)
        if source.condition == "beam of 10"
    )
    for policy in ("trained", "random"):
        apples = sum(read_table(run / "evaluation" / f"{policy}.parquet")["harvest"].to_pylist())
        assert f": {apples / 4:.4g} [" in harvest, "two episodes of two replicas"
    for nowhere in (claims.table(tmp_path), claims.table(ran, episodes=3)):
        assert all("not run: " in row for row in nowhere.splitlines()[2:])
    assert claims.table(ran, episodes=SMALL["episodes"]).splitlines()[2:] == rows


def test_a_verdict_says_whether_an_interval_excludes_nothing_and_on_which_side(recipes):
    verdict = recipes["perolat_claims"].verdict
    assert verdict(Estimate(value=2, low=1, high=3, replicas=4)) == "as claimed"
    assert verdict(Estimate(value=-2, low=-3, high=-1, replicas=4)) == "contradicted"
    assert verdict(Estimate(value=2, low=-1, high=5, replicas=4)) == "cannot be told with 4 replicas"


def test_the_share_of_the_rich_is_that_of_every_fourth_agent(recipes, monkeypatch):
    claims = recipes["perolat_claims"]
    returns = [2.0 if agent % 4 == 0 else 1.0 for agent in range(8)]
    episode = pa.table({"replica": [0] * 8, "agent": range(8), "return": returns})
    monkeypatch.setattr(claims, "evaluated", lambda run, policy: episode)
    # Agents 0 and 4 begin in the north-west room: 4 of 10 apples.
    assert claims.rich_share(Path("anywhere"), "trained").tolist() == [0.4]


def test_a_file_of_claims_that_cannot_be_written_is_refused_before_anything_is_played(
    recipes, monkeypatch, tmp_path
):
    claims = recipes["perolat_claims"]
    monkeypatch.setattr(claims, "table", lambda runs, episodes: "cannot be told \u2212")
    claims.main(out=tmp_path / "new" / "claims.md")
    assert (tmp_path / "new" / "claims.md").read_text(encoding="utf-8") == "cannot be told \u2212\n"
    monkeypatch.setattr(claims, "table", None)  # it would be called
    with pytest.raises(IsADirectoryError, match="a directory; allowed: the name of a file"):
        claims.main(out=tmp_path / "new")


def test_the_lowest_harvests_are_those_of_the_committed_tables(recipes, monkeypatch, tmp_path):
    lows = recipes["perolat_lows"]
    monkeypatch.chdir(RECIPES.parent)
    lows.main(out=tmp_path / "lows.md")
    committed = (RECIPES.parent / "docs" / "results" / "studies" / "perolat_lows.md").read_text()
    assert (tmp_path / "lows.md").read_text() == committed


def test_the_lowest_harvest_is_looked_for_after_the_peak(recipes):
    courses = {"collective_return": [1.0, 8.0, 4.0, 6.0], "survival_steps": [9.0, 7.0, 5.0, 3.0]}
    rows = [
        {"replica": 0, "episode": 10 * window, "metric": metric, "part": "training", "value": value}
        for metric, course in courses.items()
        for window, value in enumerate(course)
    ]
    random = {"replica": 0, "episode": 0, "metric": "collective_return", "part": "random", "value": 2.0}
    cells = recipes["perolat_lows"].row(pa.Table.from_pylist([*rows, random]), windows=1)
    assert [cell.split()[0] for cell in cells] == ["8", "4", "2", "5"], "not the 1 before the peak"
