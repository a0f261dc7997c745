"""Runs of people: values like any other, finished without a training."""

import json

import pytest
from hosted_runs import begun, hosted, played
from stored_runs import MEADOW, SEED, an_experiment, stored

import cprl
from cprl import Experiment
from cprl.evaluation import Fresh, evaluate_run
from cprl.evaluation.fresh import fresh_episodes, record
from cprl.measuring.table import complete
from cprl.population import Frozen, Person, Scripted, learned
from cprl.runs import played as played_runs
from cprl.runs.export import export_results
from cprl.runs.played import absence, write_played
from cprl.runs.recipe import read_recipe
from cprl.runs.states import state_of
from cprl.studies.tables.pooled import pooled_table

PEOPLE = (Person(), Person())


def test_a_person_is_a_value_that_a_recipe_holds_and_words_count():
    experiment = an_experiment("classroom", MEADOW, PEOPLE)
    assert Experiment.from_recipe(json.loads(json.dumps(experiment.to_recipe()))) == experiment
    assert experiment != an_experiment("classroom", MEADOW, (Scripted(), Scripted()))
    assert learned([*PEOPLE, Scripted("greedy")]) == "2 people, 1 agent by the script 'greedy'"
    assert learned([Scripted("greedy"), Person()]) == "1 agent by the script 'greedy', 1 person"
    assert experiment.trained_for == "played for 3 episodes in 3 groups"


def test_a_finished_run_of_people_can_be_loaded_and_has_the_metrics_of_any_run(tmp_path):
    run = hosted(tmp_path / "classroom", MEADOW, bots=[Scripted("greedy")], session="monday")
    loaded = cprl.load(run)
    assert loaded.experiment.agents == (Person(), Scripted("greedy"))
    assert state_of(run) == "finished"
    assert loaded.recipe["session"] == "monday"
    evaluated = evaluate_run(stored(tmp_path / "scripts", MEADOW), Fresh(episodes=1, seed=SEED))
    assert {*complete(loaded.episodes()).column_names} == {*evaluated.column_names} - {"policy", "world"}
    assert loaded.episodes()["replica"].to_pylist() == [0, 0, 1, 1, 2, 2]


def test_turns_without_a_person_are_said(tmp_path):
    run, _ = begun(tmp_path / "classroom", MEADOW)
    episodes, turns = played(MEADOW)
    is_there = [group.as_py() != 1 for group in turns["group"]]
    write_played(run, episodes, turns=turns.append_column("person", [is_there]))
    share = 1 - sum(is_there) / len(is_there)
    assert f"in {share:.0%} of their turns; groups of these turns: 1." in absence(run)
    table = pooled_table([run], by=["agents"])
    assert any(absence(run) in note for note in table.design.notes)
    assert absence(hosted(tmp_path / "whole", MEADOW)) == ""


def test_a_run_of_people_is_begun_until_all_of_it_is_written(tmp_path, monkeypatch):
    run, _ = begun(tmp_path / "classroom", MEADOW)
    episodes, turns = played(MEADOW)
    assert state_of(run) == "begun"

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(played_runs, "save_weights", killed)
        with pytest.raises(KeyboardInterrupt):
            write_played(run, episodes, turns=turns)
    assert state_of(run) == "begun"
    write_played(run, episodes[::-1], turns=turns)
    assert state_of(run) == "finished"
    whole = hosted(tmp_path / "whole", MEADOW)
    assert cprl.load(run).episodes() == cprl.load(whole).episodes()
    with pytest.raises(FileExistsError, match=r"report\.json"):
        write_played(run, episodes)


def test_episodes_that_the_recipe_does_not_announce_are_refused(tmp_path):
    run, _ = begun(tmp_path / "classroom", MEADOW, groups=2)
    episodes, _ = played(MEADOW, groups=3)
    for wrong in (episodes, episodes[1:], []):
        with pytest.raises(ValueError, match="of each of 2 groups"):
            write_played(run, wrong)
    assert state_of(run) == "begun"
    assert not list(run.glob("*.parquet"))


@pytest.mark.integration
def test_people_are_trained_by_no_run_and_no_study_and_nothing_is_written(tmp_path):
    experiment = an_experiment("classroom", MEADOW, (Person(), Scripted("greedy")))
    with pytest.raises(ValueError, match=r"agents\[0\] is a Person.*cprl host"):
        cprl.run(experiment, tmp_path / "run", watch="off")
    with pytest.raises(ValueError, match="is a Person"):
        cprl.Study(an_experiment("a", MEADOW, [Scripted()] * 2), {"agents": [list(PEOPLE)]})
    assert not list(tmp_path.iterdir())


@pytest.mark.integration
def test_an_agent_of_another_run_cannot_be_a_person(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hosted(tmp_path / "classroom", MEADOW)
    experiment = an_experiment("again", MEADOW, (Frozen("classroom", 0), Scripted("greedy")))
    with pytest.raises(ValueError, match="agent 0 of classroom is a person: people cannot be played again"):
        cprl.run(experiment, tmp_path / "again", watch="off")
    assert not (tmp_path / "again").exists()


def test_an_export_keeps_what_people_played_and_can_be_replayed(tmp_path):
    run = hosted(tmp_path / "classroom", MEADOW, session="monday")
    folder = export_results(run, tmp_path / "export")
    assert read_recipe(folder)["session"] == "monday"
    recorded = [record(*fresh_episodes([each], replica=2)).episode.outcome for each in (run, folder)]
    assert recorded[0] == recorded[1]
