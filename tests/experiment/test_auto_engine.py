"""engine="auto": the experiment alone says whether a training is compiled; a run keeps what it began with."""

from dataclasses import dataclass, replace

import pytest
from own_parts import Dilemma
from same_runs import assert_same_training, live
from tiny_study import LEARNING, TINY

import cprl
from cprl import CommonsEnv, Custom, Experiment, Study
from cprl.algorithms import PPO, DQNSettings, OffPolicy, RolloutSettings
from cprl.experiment import engine
from cprl.experiment.engine import FEWEST_COMPILED, about_engine, engine_of, planned_updates
from cprl.population import Learning, Scripted
from cprl.runs.recipe import read_recipe
from cprl.studies.study import Condition
from cprl.studies.trials import trials_of
from cprl.training.agents import Population
from cprl.values import custom_targets, trusting

SHORT = replace(TINY, engine="auto")
"""40 updates of each agent: 2 episodes of 20 turns."""
LONG = replace(SHORT, episodes=FEWEST_COMPILED // 20)
EPISODES = "episodes"


def of_rollouts(**settings):
    return Learning(PPO(settings=RolloutSettings(**settings)))


@pytest.mark.parametrize(
    ("changes", "updates"),
    [
        ({}, 40),
        ({"worlds": 4}, 40),
        ({"episodes": None, "steps": 99}, 99),
        ({"agents": (Scripted("greedy"),) * 2}, 0),
        ({"agents": (of_rollouts(rollout_steps=10, minibatch_size=5, epochs=3), LEARNING)}, 40),
        ({"agents": (of_rollouts(rollout_steps=10, minibatch_size=5, epochs=3), Scripted("greedy"))}, 24),
        ({"agents": (of_rollouts(rollout_steps=10, minibatch_size=5), Scripted("greedy")), "worlds": 2}, 32),
    ],
)
def test_the_updates_to_come_are_those_of_the_agents_with_the_most(changes, updates):
    assert planned_updates(replace(SHORT, **changes)) == updates


def test_updates_are_counted_as_the_settings_space_them():
    settings = DQNSettings(steps_per_update=4, updates_per_step=3)
    assert settings.updates_in(101, worlds=1) == 75


def test_short_trainings_are_eager_and_long_ones_compiled_whatever_their_seed_and_replicas():
    assert engine_of(SHORT) == "eager"
    assert engine_of(LONG) == "compiled"
    for experiment in (SHORT, LONG):
        for other in (replace(experiment, replicas=64), replace(experiment, seed=5)):
            assert engine_of(other) == engine_of(experiment)
    rare = of_rollouts(minibatch_size=250 * 64), Scripted("greedy")
    rare = {"agents": rare, "episodes": None, "worlds": 64}
    turns = FEWEST_COMPILED * 10
    assert engine_of(replace(SHORT, **rare, steps=turns * 64)) == "compiled", "acting is compiled too"
    assert engine_of(replace(SHORT, **rare, steps=turns * 32)) == "eager"
    assert engine_of(replace(LONG, agents=(Scripted("greedy"),) * 2)) == "eager", "nobody learns"
    for word in ("eager", "compiled", "torchrl"):
        assert engine_of(replace(SHORT, engine=word)) == engine_of(replace(LONG, engine=word)) == word


def test_auto_is_the_default_and_what_a_recipe_or_a_study_that_says_nothing_means():
    assert Experiment.from_config({**SHORT.to_config()}) == SHORT
    recipe = SHORT.to_recipe()
    del recipe["experiment"]["engine"]
    assert Experiment.from_recipe(recipe) == SHORT
    study = Study(SHORT, {EPISODES: [2, 4]})
    table = study.to_config()
    del table["experiment"]["engine"]
    assert Study.from_config(table) == study
    assert Experiment(name="x", game=SHORT.game, agents=SHORT.agents, episodes=2).engine == "auto"


def test_a_population_has_no_length_and_refuses_auto():
    with pytest.raises(ValueError, match=r"engine is 'auto'; allowed: 'compiled'"):
        Population(CommonsEnv(SHORT.game, 1), SHORT.agents, engine="auto")


@pytest.mark.integration
def test_a_run_says_and_stores_its_engine_and_keeps_it_when_it_is_extended(tmp_path, capsys, monkeypatch):
    longer = replace(SHORT, episodes=4)
    whole = cprl.run(replace(longer, engine="eager"), tmp_path / "whole", watch="off")
    run = cprl.run(SHORT, tmp_path / "run", watch="off", keep_checkpoint=True)
    assert "Trains uncompiled: about 40 updates of each replica" in capsys.readouterr().out
    assert read_recipe(run)["experiment"]["engine"] == "eager"
    monkeypatch.setattr(engine, "FEWEST_COMPILED", 60)
    assert engine_of(longer) == "compiled"
    assert cprl.load(run).experiment == SHORT
    assert replace(longer, engine="eager") != longer
    with pytest.raises(ValueError, match=r"engine was 'eager', is 'compiled'"):
        cprl.run(replace(longer, engine="compiled"), run, resume=True, watch="off")
    cprl.run(longer, run, resume=True, watch="off")
    assert 'Trains with engine="eager", as the run began' in capsys.readouterr().out
    stored = read_recipe(run)["experiment"]
    assert (stored["engine"], stored["episodes"]) == ("eager", 4)
    assert_same_training(run, whole)
    before = (run / "report.json").read_bytes()
    cprl.run(longer, run, resume=True, watch="off")
    assert (run / "report.json").read_bytes() == before, "it is finished"


def test_a_study_decides_for_each_condition_by_itself_and_its_checksums_see_what_was_decided(monkeypatch):
    monkeypatch.setattr(engine, "FEWEST_COMPILED", 60)
    study = Study(SHORT, {EPISODES: [2, 4]}, replicas=2, block=1)
    assert [trial.experiment.engine for trial in trials_of(study)] == ["eager", "compiled"] * 2
    for condition in study.all_conditions:
        said = replace(condition.experiment, engine=engine_of(condition.experiment))
        assert Condition(said).checksum == condition.checksum
    short, long = (condition.checksum for condition in study.all_conditions)
    monkeypatch.setattr(engine, "FEWEST_COMPILED", 200)
    assert Condition(replace(SHORT, episodes=2)).checksum == short
    assert Condition(replace(SHORT, episodes=4)).checksum != long


def test_a_compiled_condition_has_the_checksum_that_it_had_when_compiled_was_the_default():
    assert Condition(replace(TINY, engine="compiled")).checksum == "a323f7d62ec8"


@dataclass(frozen=True, kw_only=True)
class Conservative(OffPolicy):
    """An algorithm of the user's own."""

    weight: float = 0.1


@live
class OfAScript(Conservative):
    """The same, as a script has it."""


@pytest.mark.parametrize("own", [Conservative, OfAScript])
def test_an_own_algorithm_counts_alike_as_a_value_and_as_it_is_read_back(own, monkeypatch):
    learning = Learning(own(settings=DQNSettings(buffer_size=100, steps_per_update=4)))
    experiment = replace(SHORT, agents=(learning, learning), episodes=10)
    with trusting(custom_targets(experiment.to_config())):
        read = Experiment.from_config(experiment.to_config())
    assert isinstance(read.agents[0].algorithm, Custom)
    assert planned_updates(experiment) == planned_updates(read) == 10 * 20 // 4
    monkeypatch.setattr(engine, "FEWEST_COMPILED", 100)
    assert engine_of(experiment) == engine_of(read) == "eager"
    assert read == experiment
    assert Condition(read).checksum == Condition(experiment).checksum


def test_a_study_of_an_own_algorithm_finds_its_runs_when_it_is_read_back(monkeypatch):
    monkeypatch.setattr(engine, "FEWEST_COMPILED", 100)
    own = Learning(Conservative(settings=DQNSettings(buffer_size=100, steps_per_update=4)))
    experiment = replace(SHORT, agents=(own, own), episodes=10)
    conditions = {"as it is": {}, "short": {"game.rules.freeze_steps": 2}}
    study = Study(experiment, conditions=conditions)
    with trusting(custom_targets(experiment.to_config())):
        read = Study.from_config(study.to_config())
    assert [trial.name for trial in trials_of(study)] == [trial.name for trial in trials_of(read)]
    assert {trial.experiment.engine for trial in trials_of(study)} == {"eager"}
    assert study.reference_name == read.reference_name == "as it is"


def test_own_settings_that_say_nothing_count_turns(monkeypatch):
    by_name = Custom("mymod:Own", {"settings": {"kind": "DQNSettings", "gamma": 7}})
    assert planned_updates(replace(SHORT, agents=(Learning(by_name),) * 2)) == 40
    assert planned_updates(replace(SHORT, agents=(Learning(Custom("mymod:Own")),) * 2)) == 40


@pytest.mark.integration
def test_the_engine_is_said_where_a_training_begins_that_learns_and_what_is_assumed(tmp_path, capsys):
    def said(experiment, out, **options):
        cprl.run(experiment, tmp_path / out, watch="off", **options)
        return [line for line in capsys.readouterr().out.splitlines() if line.startswith("Trains ")]

    assert said(replace(SHORT, agents=(Scripted("greedy"),) * 2), "scripted") == []
    assert len(said(SHORT, "run")) == 1
    assert said(SHORT, "run", resume=True) == [], "it is finished"
    said(SHORT, "kept", keep_checkpoint=True)
    assert said(replace(SHORT, episodes=3), "kept", resume=True) == [], "it began before"


def test_a_game_without_a_clock_has_as_many_updates_as_are_assumed():
    endless = replace(SHORT, game=Dilemma())
    sentence = about_engine(endless)
    assert "about 200 updates of each replica in 200 turns, if each episode has 100 turns, are" in sentence
    assert "if each" not in about_engine(replace(endless, episodes=None, steps=300))
    assert "if each" not in about_engine(SHORT)


@pytest.mark.integration
def test_a_lengthened_study_continues_a_kept_run_of_its_engine_and_says_where_it_is_another(
    tmp_path, capsys, monkeypatch
):
    def lengthened(episodes, out):
        study = Study(replace(SHORT, episodes=episodes), replicas=1)
        cprl.run_study(study, tmp_path / out, keep_checkpoints=True, results=False)
        (trial,) = trials_of(study, tmp_path / out / "runs")
        extended = read_recipe(tmp_path / out / "runs" / trial.name).get("extended", [])
        return extended, "trials begin with their first episode: " in capsys.readouterr().out

    assert lengthened(2, "study") == ([], False)
    extended, is_said = lengthened(3, "study")
    assert (len(extended), is_said) == (1, False)
    monkeypatch.setattr(engine, "FEWEST_COMPILED", 70)
    monkeypatch.setattr(Population, "__init__", of_an_eager(Population.__init__))
    assert lengthened(4, "study") == ([], True)
    assert lengthened(4, "study") == ([], False), "it has begun"


def of_an_eager(make):
    """Makes a population that compiles nothing, whatever its engine."""
    return lambda self, *arguments, **options: make(self, *arguments, **{**options, "engine": "eager"})
