"""A study of parameters is a value: its conditions, their names, seeds and checksums; JSON and back."""

import json
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from my_game import Dilemma
from tiny_study import FREEZE, GAMMA, LEARNING, MIXED, SETTINGS, TINY

from cprl import Custom, Study, maps, presets
from cprl.algorithms import DQN, PPO
from cprl.config import KINDS, defaults_of
from cprl.experiment import MOST_SEED, Experiment
from cprl.learners.settings import RolloutSettings
from cprl.population import Frozen, Learning, Scripted, Team, stored_of
from cprl.studies import Integers, LogUniform, Uniform
from cprl.studies.factors import changed, drawn, values_at
from cprl.studies.study import CONDITION_FORMAT, Condition, apart
from cprl.studies.trials import trials_of


def there_and_back(study, **how):
    return Study.from_config(json.loads(json.dumps(study.to_config(**how))), **how)


def test_a_path_changes_one_field_and_nothing_else():
    new = changed(TINY, {FREEZE: 7})
    assert new == replace(TINY, game=replace(TINY.game, rules=replace(TINY.game.rules, freeze_steps=7)))


def test_a_star_in_agents_means_every_agent_that_learns_and_a_number_one_of_them():
    both = changed(TINY, {GAMMA: 0.5})
    assert values_at(both, GAMMA) == [0.5, 0.5]
    one = changed(TINY, {GAMMA.replace("*", "1"): 0.5})
    assert values_at(one, GAMMA) == [0.995, 0.5]
    learning_alone = changed(MIXED, {GAMMA: 0.5})
    assert values_at(learning_alone, GAMMA) == [0.5]
    assert learning_alone.agents[1] == Scripted("greedy")


def test_a_number_after_a_star_wins_in_whatever_order_they_are_given():
    for paths in ((GAMMA, GAMMA.replace("*", "0")), (GAMMA.replace("*", "0"), GAMMA)):
        given_in_order = {path: 0.5 if "*" in path else 0.25 for path in paths}
        assert values_at(changed(TINY, given_in_order), GAMMA) == [0.25, 0.5]


def test_a_path_into_a_value_that_is_changed_too_applies_to_the_new_value():
    new = changed(TINY, {GAMMA: 0.5, "agents": [Scripted("random"), LEARNING]})
    assert new.agents[0] == Scripted("random")
    assert values_at(new, GAMMA) == [0.5]


def test_board_and_agents_change_at_once_though_neither_would_fit_alone():
    four = changed(TINY, {"agents": [LEARNING] * 4, "game.map": "commons"})
    assert four.game.map == maps.named("commons")
    assert len(four.agents) == 4


def test_a_path_may_be_written_as_the_flag_is_and_a_list_becomes_a_tuple():
    new = changed(TINY, {"game.rules.regrow-prob": [0, 0.5], "agents.*.algorithm.settings.hidden-cells": [2]})
    assert new.game.rules.regrow_prob == (0, 0.5)
    assert values_at(new, "agents.*.algorithm.settings.hidden_cells") == [(2,), (2,)]


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        (
            {"game.rules.freze_steps": [1]},
            r"game.rules.freze_steps matches nothing \(did you mean 'freeze_steps'",
        ),
        ({"agents.2.algorithm": [3]}, "agents.2 matches nothing; agents has 0, 1"),
        ({"agents.*.algorithm.settings.clip": [1]}, "settings.clip matches nothing"),
        ({"agents.0.reward.by": [1]}, "reward.by matches nothing; agents.0.reward is 'individual'"),
        ({FREEZE: [2.5]}, "freeze_steps is 2.5"),
        ({FREEZE: [True]}, "freeze_steps is True"),
        ({GAMMA: [2.0]}, r"gamma: DQNSettings.gamma is 2.0"),
        ({"game.map": ["comons"]}, "at the path game.map: name is 'comons'"),
        ({"game.map": ["commons"]}, "with game.map: experiment.agents: 2 agents are specified"),
        ({"replicas": [1]}, "a factor is replicas"),
        ({FREEZE: 5}, r"factors\['game.rules.freeze_steps'\] is 5"),
        ({FREEZE: []}, r"is \[\]"),
        ({FREEZE: "12"}, "is '12'"),
        ({FREEZE: [5, 5]}, "conditions 'freeze_steps=5' and 'freeze_steps=5' are equal"),
        ({"": [5]}, "path is ''"),
        ({FREEZE: Integers(1, 3)}, "allowed in a grid: levels, or with draws=N"),
        ({"a": {"x": {FREEZE: 5}}, FREEZE: [6]}, "two factors change the same field"),
        ([], r"factors is \[\]"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_path(factors, message):
    with pytest.raises(ValueError, match=message):
        Study(TINY, factors)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"replicas": 0}, "replicas is 0"),
        ({"block": 1.5}, "block is 1.5"),
        ({"reference": "x"}, "reference is 'x'"),
        ({"draws": 2}, "draws is given without factors"),
        ({"conditions": {"a": 3}}, r"conditions\['a'\] is 3"),
        ({"conditions": {"a": {}, "b": {}}}, "conditions 'a' and 'b' are equal"),
        ({"conditions": {"a": {}}, "factors": {FREEZE: [1]}}, "factors and conditions"),
        ({"name": "a/b"}, "name is 'a/b'"),
        ({"question": 3}, "question is 3"),
    ],
)
def test_a_study_refuses_what_is_no_study(how, message):
    with pytest.raises(ValueError, match=message):
        Study(TINY, **how)


def test_a_population_without_learners_has_no_star():
    scripted = replace(TINY, agents=(Scripted("greedy"),) * 2)
    with pytest.raises(ValueError, match="has no agent that learns"):
        Study(scripted, {GAMMA: [0.5]})


def test_a_grid_has_every_combination_with_names_of_the_last_words():
    study = Study(TINY, {FREEZE: [5, 25], GAMMA: [0.5, 0.995]})
    names = ["freeze_steps=5, gamma=0.5", "freeze_steps=5, gamma=0.995"]
    names += ["freeze_steps=25, gamma=0.5", "freeze_steps=25, gamma=0.995"]
    assert [own.name for own in study.all_conditions] == names
    assert study.all_conditions[1].levels == {FREEZE: 5, GAMMA: 0.995}
    assert study.reference_name == "freeze_steps=25, gamma=0.995"  # the one that changes nothing
    assert study.columns == (FREEZE, GAMMA)


def test_paths_with_the_same_last_word_keep_their_whole_names():
    study = Study(TINY, {GAMMA.replace("*", "0"): [0.5], GAMMA.replace("*", "1"): [0.25]})
    (own,) = study.all_conditions
    assert own.name == "agents.0.algorithm.settings.gamma=0.5, agents.1.algorithm.settings.gamma=0.25"


def test_named_levels_change_several_fields_together():
    levels = {"none": {}, "long": {FREEZE: 99, "game.rules.beam_length_cells": 9}}
    study = Study(TINY, {"time-out": levels, GAMMA: [0.5, 0.9]})
    assert [own.levels["time-out"] for own in study.all_conditions] == ["none", "none", "long", "long"]
    assert study.all_conditions[3].experiment.game.rules.beam_length_cells == 9


def test_a_condition_has_the_checksum_of_what_decides_its_numbers_and_of_nothing_else():
    same = [
        replace(TINY, seed=5),
        replace(TINY, replicas=3),
        replace(TINY, name="x"),
        replace(TINY, on_nan="continue"),
    ]
    sums = {Condition(own).checksum for own in [TINY, *same]}
    assert len(sums) == 1
    others = [replace(TINY, episodes=3), replace(TINY, evaluation_episodes=2), changed(TINY, {GAMMA: 0.9})]
    assert len({Condition(own).checksum for own in [TINY, *others]}) == 4


def test_whole_numbers_are_numbers_to_the_checksum():
    assert Condition(changed(TINY, {GAMMA: 1})).checksum == Condition(changed(TINY, {GAMMA: 1.0})).checksum


def test_fields_that_have_their_default_do_not_count():
    """A later version with further fields then gives the same checksum."""
    table = TINY.to_config()
    del table["game"]["rules"]["walls_block_sight"]
    assert Condition(Experiment.from_config(table)).checksum == Condition(TINY).checksum


def test_the_defaults_of_the_checksums_format_have_not_changed():
    """Where a default has another value, count `CONDITION_FORMAT` up, and write its defaults anew."""
    kept = json.loads((Path(__file__).parent / "condition_defaults.json").read_text())
    found = {name: defaults_of(kind) for name, kind in {**KINDS, "Experiment": Experiment}.items()}
    assert kept["format"] == CONDITION_FORMAT
    for name, defaults in kept["defaults"].items():
        assert {field: found[name].get(field, "gone") for field in defaults} == defaults, name
    assert kept["defaults"].keys() == found.keys()  # of a new kind or field add its defaults
    assert all(kept["defaults"][name].keys() == own.keys() for name, own in found.items())


def test_the_checksum_of_the_published_commons_is_what_it_was():
    experiment = Experiment(
        name="commons",
        game=presets.game("commons", variant="as_run"),
        agents=(Learning(DQN(settings=presets.dqn_settings("commons", variant="as_run"))),) * 4,
        episodes=4800,
    )
    assert Condition(experiment).checksum == "dab4a686bb41"


def test_blocks_have_seeds_of_their_own_and_pairs_the_same_in_every_condition():
    study = Study(TINY, {FREEZE: [5, 25]}, replicas=5, block=2)
    found = [(own.condition.name, own.experiment.seed, own.experiment.replicas) for own in trials_of(study)]
    pairs = [("freeze_steps=5", "freeze_steps=25"), (0, 1000, 2000), (2, 2, 1)]
    assert found == [(name, seed, size) for seed, size in zip(*pairs[1:], strict=True) for name in pairs[0]]


def test_the_first_block_is_the_run_of_the_recipe_itself():
    study = Study(replace(TINY, seed=3, replicas=2))
    (trial,) = trials_of(study)
    assert trial.experiment == replace(TINY, seed=3, replicas=2)


def partners(study):
    """The stored replica of the second agent in each replica of a study."""
    return [
        stored_of(own.experiment.agents[1]).replica_for(replica)
        for own in trials_of(study)
        for replica in range(own.block.replicas)
    ]


@pytest.mark.parametrize("starts", [False, True])
def test_each_block_has_the_stored_partners_of_its_own_replicas(starts):
    def playing(replica, replicas=5):
        stored = Frozen("runs/a", 1, replica=replica)
        second = replace(LEARNING, start_from=stored) if starts else stored
        return replace(TINY, agents=(LEARNING, second), replicas=replicas)

    named = (7, 7, 3, 0, 1)
    assert partners(Study(playing(None), block=2)) == [0, 1, 2, 3, 4]
    assert partners(Study(playing(named), block=2)) == [*named]
    assert partners(Study(playing(3), block=2)) == [3] * 5
    for whole in (playing(None), playing(named)):
        (trial,) = trials_of(Study(whole))
        assert trial.experiment == whole, "the recipe that it always had"
    with pytest.raises(ValueError, match=r"replica is \(7, 7, 3, 0, 1\), of 5 numbers"):
        playing(named, replicas=4)
    with pytest.raises(ValueError, match=r"of condition 'unchanged' is .*, of 5 numbers"):
        Study(playing(named), replicas=6)


def test_more_replicas_and_levels_keep_the_runs_that_are_there():
    names = {own.name for own in trials_of(Study(TINY, {FREEZE: [5, 25]}, replicas=2, block=2))}
    more = {own.name for own in trials_of(Study(TINY, {FREEZE: [5, 25, 50]}, replicas=4, block=2))}
    assert names < more


def test_a_seed_that_leaves_no_room_for_the_blocks_is_refused():
    with pytest.raises(ValueError, match="seed is 18446744073709551614"):
        Study(replace(TINY, seed=MOST_SEED), replicas=2, block=1)


def test_draws_are_the_same_again_and_more_of_them_keep_the_first():
    factors = {GAMMA: Uniform(0.5, 0.9), FREEZE: Integers(1, 50), "a": {"x": {}, "y": {"episodes": 3}}}
    few, more = (Study(TINY, factors, draws=count) for count in (3, 6))
    assert [own.checksum for own in more.all_conditions][:3] == [own.checksum for own in few.all_conditions]
    levels = [own.levels for own in more.all_conditions]
    assert all(0.5 <= own[GAMMA] <= 0.9 and 1 <= own[FREEZE] <= 50 for own in levels)
    assert len({own[GAMMA] for own in levels}) == 6


def test_draws_that_are_equal_are_drawn_again_and_more_than_there_are_is_refused():
    study = Study(TINY, {FREEZE: Integers(1, 3)}, draws=3)
    assert sorted(own.levels[FREEZE] for own in study.all_conditions) == [1, 2, 3]
    with pytest.raises(ValueError, match="draws is 4; the factors have no more than 3 combinations"):
        Study(TINY, {FREEZE: Integers(1, 3)}, draws=4)


def test_conditions_that_words_do_not_tell_apart_are_numbered():
    others = [[LEARNING, Learning(DQN(settings=replace(SETTINGS, gamma=own)))] for own in (0.1, 0.2)]
    names = [own.name for own in Study(TINY, {"agents": others}).all_conditions]
    assert names[1] == f"{names[0]} #2"


def test_a_number_that_another_condition_has_in_its_name_is_left_out():
    names = ("beam", "beam #2", "beam", "beam")
    found = apart(Condition(replace(TINY, episodes=1 + nth), name=own) for nth, own in enumerate(names))
    assert [own.name for own in found] == ["beam", "beam #2", "beam #3", "beam #4"]


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**63), nth=st.integers(0, 10**6), low=st.floats(1e-6, 1), times=st.floats(1, 1e6))
def test_draws_stay_in_their_range(seed, nth, low, times):
    factors = {"a": LogUniform(low, low * times), "b": Uniform(-low, low), "c": Integers(-3, 3)}
    found = {name: level.value for name, level in drawn(factors, seed=seed, nth=nth).items()}
    assert low * (1 - 1e-12) <= found["a"] <= low * times * (1 + 1e-12)
    assert -low <= found["b"] <= low
    assert found["c"] in range(-3, 4)


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [(Uniform, 2, 1), (LogUniform, 0, 1), (Integers, 0.5, 2), (Uniform, float("nan"), 1)],
)
def test_a_range_that_is_none_is_refused(kind, low, high):
    with pytest.raises(ValueError, match=f"{kind.__name__}.low is "):
        kind(low, high)


ON_POLICY = Learning(PPO(settings=RolloutSettings()))
STUDIES = {
    "grid": Study(TINY, {FREEZE: [5, 25], "agents": [[LEARNING] * 2, [ON_POLICY, Scripted("random")]]}),
    "levels": Study(TINY, {"b": {"x": {}, "y": {"game.rules.regrow_prob": (0, 0.5)}}}),
    "draws": Study(TINY, {GAMMA: LogUniform(0.1, 0.9)}, draws=2, question="Why?", expectation="Thus."),
    "named": Study(
        TINY, conditions={"a": {}, "b": {FREEZE: 3}}, reference="b", replicas=9, block=4, name="n"
    ),
    "alone": Study(TINY),
}


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_becomes_json_and_comes_back_the_same(name):
    study = STUDIES[name]
    back = there_and_back(study)
    assert back == study
    assert [own.checksum for own in back.all_conditions] == [own.checksum for own in study.all_conditions]


def test_a_game_of_ones_own_is_a_level_and_what_a_study_cannot_keep_is_refused():
    two = (Dilemma(), Dilemma(payoffs=((3.0, 0.5), (4.0, 1.0))))
    of_game = replace(TINY, game=two[0])
    for own in (
        Study(of_game, {"game": two}),
        Study(of_game, {"size": {"a": {}, "b": {"game": two[1]}}}),
        Study(TINY, conditions={"a": {}, "b": {"game": two[1]}}),
    ):
        back = Study.from_config(json.loads(json.dumps(own.to_config())), allow=["my_game:Dilemma"])
        assert back == own
        assert back.all_conditions[1].experiment.game == two[1], "no Custom, but the game"
        assert [one.checksum for one in back.all_conditions] == [one.checksum for one in own.all_conditions]

    class Inner(Dilemma):
        """Nobody can import it."""

    with pytest.raises(ValueError, match=r"Inner"):
        Study(of_game, {"game": [Inner()]})


def test_the_runs_of_frozen_agents_are_kept_relative_to_the_study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    study = Study(
        replace(TINY, agents=(LEARNING, Frozen("runs/a", 0))),
        {"agents.1": [Frozen("runs/b", 0), Scripted("greedy")]},
    )
    table = study.to_config("studies/x")
    assert "../../runs/a" in json.dumps(table)
    assert "../../runs/b" in json.dumps(table)
    assert there_and_back(study, directory="studies/x") == study


def test_a_run_of_a_frozen_agent_is_the_same_however_its_path_is_written():
    plain, *others = [
        Study(replace(TINY, agents=(LEARNING, Frozen(own, 0))))
        for own in ("runs/a", "runs/a/", "./runs//a", "runs/b/../a")
    ]
    for other in others:
        assert other == plain
        assert other.all_conditions[0].checksum == plain.all_conditions[0].checksum
        back = Study.from_config(json.loads(json.dumps(other.to_config("studies/x"))), directory="studies/x")
        assert back.all_conditions[0].checksum == plain.all_conditions[0].checksum


@pytest.mark.parametrize("starts", [False, True])
def test_runs_that_are_levels_are_kept_relative_to_the_study_and_other_texts_as_they_are(
    tmp_path, monkeypatch, starts
):
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path)
    stored = Frozen("runs/a", 0)
    second, path = (
        (replace(LEARNING, start_from=stored), "agents.1.start_from.run")
        if starts
        else (stored, "agents.1.run")
    )
    fatigue = Custom("one_road_parts:Fatigue", arguments={"run": "runs/a"})
    experiment = replace(TINY, agents=(LEARNING, second), transforms=(fatigue,))
    for study in (
        Study(experiment, {path: ["runs/a", "runs/b/"]}, reference="run=runs/b"),
        Study(experiment, {"partner": {"a": {}, "b": {path.replace("_", "-"): "runs/b"}}}),
        Study(experiment, conditions={"a": {}, "b": {path: "runs/b"}}),
        Study(experiment, {"transforms.0.arguments.run": ["runs/b", "runs/c"]}),
    ):
        table = json.loads(json.dumps(study.to_config("studies/x")))
        how = {"allow": ["one_road_parts:Fatigue"]}
        assert Study.from_config(table, directory="studies/x", **how) == study
        monkeypatch.chdir(tmp_path / "sub")
        if study.reference is None:
            elsewhere = Study.from_config(table, directory="../studies/x", **how).all_conditions[1].experiment
            ours = study.all_conditions[1].experiment
            assert stored_of(elsewhere.agents[1]).run == f"../{stored_of(ours.agents[1]).run}"
            assert elsewhere.transforms == ours.transforms
        monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 9}, "the study has the format 9, and cprl .* reads up to 1: a newer cprl wrote it"),
        ({"factors": None}, "has no factors and conditions that it could have"),
        ({"factors": [["a", {"distribution": "Normal", "low": 0, "high": 1}]]}, "KeyError.*Normal"),
        ({"experiment": {"name": "x"}}, "lacks game, agents, episodes"),
    ],
)
def test_a_table_that_is_no_study_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Study.from_config({**STUDIES["grid"].to_config(), **change})


def test_a_team_is_an_agent_that_learns():
    from cprl.algorithms import VDN

    team = replace(TINY, agents=(Team(VDN(settings=SETTINGS), agents=(0, 1)),))
    study = Study(team, {GAMMA: [0.5]})
    assert values_at(study.all_conditions[0].experiment, GAMMA) == [0.5]


RECIPES = Path(__file__).parents[1] / "recipes" / "studies"


@pytest.mark.parametrize("name", sorted(own.stem for own in RECIPES.glob("*.py") if own.stem != "base"))
def test_a_shipped_study_asks_a_question_and_says_what_is_expected(name, monkeypatch):
    monkeypatch.syspath_prepend(RECIPES)
    study = import_module(name).STUDY
    assert study.name == name
    assert study.question.endswith("?")
    assert len(study.expectation) > 100
    assert len(study.all_conditions) >= 3
    assert Condition(study.experiment).checksum in [own.checksum for own in study.all_conditions]
    for module in (name, "base"):
        sys.modules.pop(module, None)


@pytest.mark.integration
def test_the_studies_of_the_programs_versions_share_their_runs(monkeypatch):
    monkeypatch.syspath_prepend(RECIPES)
    names = "combat", "experiment_5", "published_schedule", "dip"
    combat, experiment_5, schedule, dip = (import_module(name).STUDY for name in names)
    for module in (*names, "base"):
        sys.modules.pop(module, None)
    trials = [trial.name for trial in trials_of(experiment_5)]
    assert (len(combat.all_conditions), len(trials)) == (24, 16)
    assert set(trials[:8]) <= {trial.name for trial in trials_of(combat)}
    assert {name.partition("-")[2] for name in trials[8:]} == {"s1000-r4"}
    for study, first in ((combat, 6), (experiment_5, 2)):
        learns = [own.experiment.agents[0].algorithm for own in study.all_conditions]
        assert {(own.settings.optimizer, own.loss_function) for own in learns[:first]} == {("adam", "l2")}
    committed = {"dab4a686bb41": schedule, "2919eaddb858": dip}  # those of docs/results
    for checksum, study in committed.items():
        assert trials_of(study)[0].name == f"{checksum}-s0-r8"


def test_a_stored_study_says_that_it_is_paired_or_is_refused():
    table = there_and_back(STUDIES["grid"]).to_config()
    assert Study.from_config({**table, "pairing": True}) == STUDIES["grid"]
    with pytest.raises(ValueError, match="pairing"):
        Study.from_config({**table, "pairing": False})
