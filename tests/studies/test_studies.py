"""A study is a value: its conditions, their names, seeds and checksums; JSON and back; words."""

import json
import sys
from dataclasses import replace
from importlib import import_module

import pytest
from hypothesis import given, settings, strategies as st
from my_game import Dilemma
from places import DATA, RECIPES
from tiny_study import FREEZE, GAMMA, LEARNING, MIXED, SETTINGS, TINY

from cprl import Custom, Study, maps
from cprl.algorithms import DQN, PPO, VDN, DQNSettings
from cprl.experiment.experiment import MOST_SEED, Experiment
from cprl.institutions import Quota, Sanctioner
from cprl.learners.settings import RolloutSettings
from cprl.networks import MLP
from cprl.population import Frozen, Learning, Pool, Scripted, Team, stored_in
from cprl.studies import Integers, LogUniform, Uniform
from cprl.studies.factors import draw_combinations, factors_of, values_at, with_changes
from cprl.studies.study import (
    CONDITION_FORMAT,
    Condition,
    condition_name,
    level_text,
    short_names,
    with_unique_names,
)
from cprl.studies.trials import trials_of
from cprl.values import KINDS, defaults_of, trust

OF_FIRST, OF_SECOND = (GAMMA.replace("*", agent) for agent in "01")
OF_ALL = "agents.*.algorithm.settings"
SCRIPTED = replace(TINY, agents=(Scripted("greedy"),) * 2)
ON_POLICY = Learning(PPO(settings=RolloutSettings()))
OTHER = Dilemma(payoffs=((3.0, 0.5), (4.0, 1.0)))
OWN_GAME = replace(TINY, game=Dilemma())
NAN = float("nan")


def checksums(study):
    return [condition.checksum for condition in study.all_conditions]


def only_stored(spec):
    """The one agent of an earlier run that a specification names."""
    (stored,) = stored_in(spec).values()
    return stored


def there_and_back(study, directory=None):
    """The study that is read from its JSON, which has the same conditions."""
    table = json.loads(json.dumps(study.to_config(directory)))
    again = Study.from_config(table, directory=directory)
    assert checksums(again) == checksums(study)
    return again


# Paths


def test_paths_written_as_flags_are_too_change_their_fields_together_and_nothing_else():
    rules = replace(TINY.game.rules, freeze_steps=7, regrow_prob=(0, 0.5))
    new = with_changes(TINY, {FREEZE: 7, "game.rules.regrow-prob": [0, 0.5]})
    assert new == replace(TINY, game=replace(TINY.game, rules=rules))
    new = with_changes(TINY, {"agents.*.algorithm.settings.hidden-cells": [2]})
    assert values_at(new, "agents.*.algorithm.settings.hidden_cells") == [(2,), (2,)]
    four = with_changes(TINY, {"agents": [LEARNING] * 4, "game.map": "commons"})
    assert (four.game.map, len(four.agents)) == (maps.published("commons"), 4), "neither would fit alone"


@pytest.mark.parametrize(
    ("experiment", "changes", "gammas"),
    [
        (TINY, {GAMMA: 0.5}, [0.5, 0.5]),
        (TINY, {OF_SECOND: 0.5}, [0.995, 0.5]),
        (MIXED, {GAMMA: 0.5}, [0.5]),
        (TINY, {GAMMA: 0.5, OF_FIRST: 0.25}, [0.25, 0.5]),
        (TINY, {OF_FIRST: 0.25, GAMMA: 0.5}, [0.25, 0.5]),
        (TINY, {GAMMA: 0.5, "agents": [Scripted("random"), LEARNING]}, [0.5]),
        (replace(TINY, agents=(Team(VDN(settings=SETTINGS), agents=(0, 1)),)), {GAMMA: 0.5}, [0.5]),
    ],
)
def test_a_star_in_agents_means_all_that_learn_and_a_number_wins_over_it(experiment, changes, gammas):
    assert values_at(with_changes(experiment, changes), GAMMA) == gammas


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"factors": {"game.rules.freze_steps": [1]}}, r"freze_steps matches .*mean 'freeze_steps'"),
        ({"factors": {"agents.2.algorithm": [3]}}, "agents.2 matches nothing; agents has 0, 1"),
        ({"factors": {"agents.0.reward.by": [1]}}, "reward.by matches nothing"),
        ({"factors": {FREEZE: [2.5]}}, "freeze_steps is 2.5"),
        ({"factors": {GAMMA: [2.0]}}, "settings.gamma is 2.0"),
        ({"factors": {"game.map": ["comons"]}}, "at the path game.map: name is 'comons'"),
        ({"factors": {"game.map": ["commons"]}}, "with game.map: .*agents: 2 agents"),
        ({"factors": {"replicas": [1]}}, "a factor is replicas"),
        ({"factors": {FREEZE: []}}, r"factors\['game.rules.freeze_steps'\] is \[\]"),
        ({"factors": {FREEZE: "12"}}, "is '12'"),
        ({"factors": {FREEZE: [5, 5]}}, "conditions 'freeze_steps=5' and 'freeze_steps=5' are equal"),
        ({"factors": {"": [5]}}, "path is ''"),
        ({"factors": {FREEZE: Integers(1, 3)}}, "draws"),
        ({"factors": {"a": {"x": {FREEZE: 5}}, FREEZE: [6]}}, "two factors change the same field"),
        ({"experiment": SCRIPTED, "factors": {GAMMA: [0.5]}}, "has no agent that learns"),
        ({"experiment": replace(TINY, seed=MOST_SEED), "replicas": 2, "block": 1}, "seed is 18446744073"),
        ({"replicas": 0}, "replicas is 0"),
        ({"reference": "x"}, "reference is 'x'"),
        ({"draws": 2}, "draws is given without factors"),
        ({"draws": 4, "factors": {FREEZE: Integers(1, 3)}}, "draws is 4; .* no more than 3"),
        ({"design": "sobol", "factors": {FREEZE: [1]}}, "design is 'sobol'"),
        ({"conditions": {"a": {}, "b": {}}}, "conditions 'a' and 'b' are equal"),
        ({"conditions": {"a": {}}, "factors": {FREEZE: [1]}}, "factors and conditions"),
        ({"name": "a/b"}, "name is 'a/b'"),
    ],
)
def test_what_is_no_study_is_refused_by_its_path(options, message):
    with pytest.raises(ValueError, match=message):
        Study(**{"experiment": TINY, **options})


# Conditions


def test_a_grid_has_every_combination_with_names_of_the_last_words():
    study = Study(TINY, {FREEZE: [5, 25], GAMMA: [0.5, 0.995]})
    assert [condition.name for condition in study.all_conditions] == [
        "freeze_steps=5, gamma=0.5",
        "freeze_steps=5, gamma=0.995",
        "freeze_steps=25, gamma=0.5",
        "freeze_steps=25, gamma=0.995",
    ]
    assert study.all_conditions[1].levels == {FREEZE: 5, GAMMA: 0.995}
    assert study.reference_name == "freeze_steps=25, gamma=0.995", "the one that changes nothing"
    assert study.columns == (FREEZE, GAMMA)
    (condition,) = Study(TINY, {OF_FIRST: [0.5], OF_SECOND: [0.25]}).all_conditions
    assert condition.name == f"{OF_FIRST}=0.5, {OF_SECOND}=0.25"


def test_named_levels_change_several_fields_together():
    levels = {"none": {}, "long": {FREEZE: 99, "game.rules.beam_length_cells": 9}}
    conditions = Study(TINY, {"time-out": levels, GAMMA: [0.5, 0.9]}).all_conditions
    assert [condition.levels["time-out"] for condition in conditions] == ["none", "none", "long", "long"]
    assert conditions[3].experiment.game.rules.beam_length_cells == 9


def test_a_number_that_another_condition_has_in_its_name_is_left_out():
    names = ("beam", "beam #2", "beam", "beam")
    alike = [Condition(replace(TINY, episodes=place + 1), name=name) for place, name in enumerate(names)]
    assert [condition.name for condition in with_unique_names(alike)] == [
        "beam",
        "beam #2",
        "beam #3",
        "beam #4",
    ]


def test_a_condition_has_the_checksum_of_what_decides_its_numbers_and_of_nothing_else():
    same = [{"seed": 5}, {"replicas": 3}, {"name": "x"}, {"on_nan": "continue"}]
    assert {Condition(replace(TINY, **changes)).checksum for changes in same} == {Condition(TINY).checksum}
    table = TINY.to_config()
    del table["game"]["rules"]["shuffle_starts"]  # a field that only a later version has
    assert Condition(Experiment.from_config(table)).checksum == Condition(TINY).checksum
    others = [TINY, replace(TINY, episodes=3), replace(TINY, evaluation_episodes=2)]
    others += [with_changes(TINY, {GAMMA: 0.9}), with_changes(TINY, {GAMMA: 1})]
    assert len({Condition(experiment).checksum for experiment in others}) == 5
    assert Condition(with_changes(TINY, {GAMMA: 1.0})).checksum == Condition(others[-1]).checksum


def test_the_defaults_of_the_checksums_format_have_not_changed():
    """Where a default has another value, count `CONDITION_FORMAT` up, and write its defaults anew."""
    stored = json.loads((DATA / "condition_defaults.json").read_text())
    today = {name: defaults_of(kind) for name, kind in {**KINDS, "Experiment": Experiment}.items()}
    assert stored == {"format": CONDITION_FORMAT, "defaults": today}, (
        "of a new kind or field add its defaults"
    )


# Seeds and draws


def test_blocks_have_seeds_of_their_own_and_pairs_the_same_in_every_condition():
    trials = trials_of(Study(TINY, {FREEZE: [5, 25]}, replicas=5, block=2))
    blocks_of = [(trial.condition.name, trial.experiment.seed, trial.experiment.replicas) for trial in trials]
    blocks = [(0, 2), (1000, 2), (2000, 1)]
    names = ("freeze_steps=5", "freeze_steps=25")
    assert blocks_of == [(name, *block) for block in blocks for name in names]
    (trial,) = trials_of(Study(replace(TINY, seed=3, replicas=2)))
    assert trial.experiment == replace(TINY, seed=3, replicas=2), "the first is the run of the recipe itself"
    few = trials_of(Study(TINY, {FREEZE: [5, 25]}, replicas=2, block=2))
    more = trials_of(Study(TINY, {FREEZE: [5, 25, 50]}, replicas=4, block=2))
    assert {trial.name for trial in few} < {trial.name for trial in more}, "which are kept"


@pytest.mark.parametrize("way", ["plays", "starts", "pool"])
def test_each_block_has_the_stored_partners_of_its_own_replicas(way):
    def playing(replica, replicas=5):
        stored = Frozen("runs/a", 1, replica=replica)
        starts = replace(LEARNING, start_from=stored)
        second = {"plays": stored, "starts": starts, "pool": Pool(runs=(stored,))}[way]
        return replace(TINY, agents=(LEARNING, second), replicas=replicas)

    def partners(study):
        """The stored replica of the second agent in each replica of a study."""
        return [
            only_stored(trial.experiment.agents[1]).replica_for(replica)
            for trial in trials_of(study)
            for replica in range(trial.block.replicas)
        ]

    each = (7, 7, 3, 0, 1)
    assert partners(Study(playing(None), block=2)) == [0, 1, 2, 3, 4]
    assert partners(Study(playing(each), block=2)) == [*each]
    assert partners(Study(playing(3), block=2)) == [3] * 5
    for whole in (playing(None), playing(each)):
        (trial,) = trials_of(Study(whole))
        assert trial.experiment == whole, "the recipe that it always had"
    with pytest.raises(ValueError, match=r"replica is \(7, 7, 3, 0, 1\), of 5 numbers"):
        playing(each, replicas=4)
    with pytest.raises(ValueError, match=r"replica is \(7, 7, 3, 0, 1\), of 5 numbers"):
        Study(playing(each), replicas=6)


@pytest.mark.parametrize("design", ["random", "sobol"])
def test_draws_are_the_same_again_and_more_of_them_keep_the_first(design):
    factors = {GAMMA: Uniform(0.5, 0.9), FREEZE: Integers(1, 50), "a": {"x": {}, "y": {"episodes": 3}}}
    few, more = (Study(TINY, factors, draws=count, design=design) for count in (3, 6))
    assert checksums(more)[:3] == checksums(few)
    assert len({condition.levels[GAMMA] for condition in more.all_conditions}) == 6
    conditions = Study(TINY, {FREEZE: Integers(1, 3)}, draws=3, design=design).all_conditions
    assert sorted(condition.levels[FREEZE] for condition in conditions) == [1, 2, 3], "equal ones again"


@settings(deadline=None, max_examples=30)
@given(
    seed=st.integers(0, 2**63),
    design=st.sampled_from(["random", "latin_hypercube", "sobol"]),
    low=st.floats(1e-6, 1),
    times=st.floats(1, 1e6),
)
def test_draws_stay_in_their_range(seed, design, low, times):
    factors = {"a": LogUniform(low, low * times), "b": Uniform(-low, low), "c": Integers(-3, 3), "d": "xyz"}
    for levels in draw_combinations(factors, 3, seed=seed, design=design):
        a, b, c, d = (level.value for level in levels.values())
        assert low * (1 - 1e-12) <= a <= low * times * (1 + 1e-12)
        assert -low <= b <= low
        assert c in range(-3, 4)
        assert d in "xyz"


@pytest.mark.parametrize("design", ["latin_hypercube", "sobol"])
def test_an_even_design_has_a_draw_in_each_part_of_every_range(design):
    factors = {"a": Uniform(0, 8), "b": LogUniform(1, 2**8), "c": Integers(0, 7)}
    draws = list(draw_combinations(factors, 8, seed=3, design=design))[:8]
    assert sorted(int(levels["a"].value) for levels in draws) == [*range(8)]
    assert sorted(int(levels["b"].value).bit_length() - 1 for levels in draws) == [*range(8)]
    assert sorted(levels["c"].value for levels in draws) == [*range(8)]
    study = Study(TINY, {GAMMA: Uniform(0.5, 0.9)}, draws=4, design=design)
    assert there_and_back(study) == study
    parts = [int((condition.levels[GAMMA] - 0.5) / 0.1) for condition in study.all_conditions]
    assert sorted(parts) == [0, 1, 2, 3]


def test_a_range_that_is_none_is_refused():
    for kind, low, high in ((Uniform, 2, 1), (LogUniform, 0, 1), (Integers, 0.5, 2), (Uniform, NAN, 1)):
        with pytest.raises(ValueError, match=f"{kind.__name__}.low is "):
            kind(low, high)


# JSON


GRID = Study(TINY, {FREEZE: [5, 25], "agents": [[LEARNING] * 2, [ON_POLICY, Scripted("random")]]})


@pytest.mark.parametrize(
    "study",
    [
        GRID,
        Study(TINY, {"b": {"x": {}, "y": {"game.rules.regrow_prob": (0, 0.5)}}}),
        Study(TINY, {GAMMA: LogUniform(0.1, 0.9)}, draws=2, question="Why?", expectation="Thus."),
        Study(TINY, conditions={"a": {}, "b": {FREEZE: 3}}, reference="b", replicas=9, block=4, name="n"),
        Study(TINY),
    ],
)
def test_a_study_becomes_json_and_comes_back_the_same(study):
    assert there_and_back(study) == study


@pytest.mark.parametrize(
    "study",
    [
        Study(OWN_GAME, {"game": (OWN_GAME.game, OTHER)}),
        Study(OWN_GAME, {"size": {"a": {}, "b": {"game": OTHER}}}),
        Study(TINY, conditions={"a": {}, "b": {"game": OTHER}}),
    ],
)
def test_a_game_of_ones_own_is_a_level(study):
    trust("my_game:Dilemma")
    again = there_and_back(study)
    assert again == study
    assert again.all_conditions[1].experiment.game == OTHER, "no Custom, but the game"

    class Inner(Dilemma):
        """Nobody can import it."""

    with pytest.raises(ValueError, match="Inner"):
        Study(OWN_GAME, {"game": [Inner()]})


def test_a_run_of_a_frozen_agent_is_the_same_however_its_path_is_written():
    plain, *others = [
        Study(replace(TINY, agents=(LEARNING, Frozen(path, 0))))
        for path in ("runs/a", "runs/a/", "./runs//a", "runs/b/../a")
    ]
    for other in others:
        assert other == plain
        assert checksums(there_and_back(other, directory="studies/x")) == checksums(plain)


@pytest.mark.parametrize("way", ["plays", "starts", "pool"])
def test_runs_are_kept_relative_to_the_study_and_other_texts_as_they_are(tmp_path, monkeypatch, way):
    (tmp_path / "sub").mkdir()
    stored = Frozen("runs/a", 0)
    second, path = {
        "plays": (stored, "agents.1.run"),
        "starts": (replace(LEARNING, start_from=stored), "agents.1.start_from.run"),
        "pool": (Pool(runs=(stored,)), "agents.1.runs.0.run"),
    }[way]
    fatigue = Custom("own_parts:Fatigue", arguments={"run": "runs/a"})
    experiment = replace(TINY, agents=(LEARNING, second), transforms=(fatigue,))
    allow = ["own_parts:Fatigue"]
    for study in (
        Study(experiment, {path: ["runs/a", "runs/b/"]}, reference="run=runs/b"),
        Study(
            experiment,
            {"agents.1": [Frozen("runs/b", 0), Scripted("greedy")]},
            reference="agents.1=Frozen(runs/b)",
        ),
        Study(experiment, {"partner": {"a": {}, "b": {path.replace("_", "-"): "runs/b"}}}),
        Study(experiment, conditions={"a": {}, "b": {path: "runs/b"}}),
        Study(experiment, {"transforms.0.arguments.run": ["runs/b", "runs/c"]}),
    ):
        monkeypatch.chdir(tmp_path)
        trust(*allow)
        assert there_and_back(study, directory="studies/x") == study
        table = study.to_config("studies/x")
        assert "../../runs/b" in json.dumps(table) or "transforms.0.arguments.run" in study.columns
        monkeypatch.chdir(tmp_path / "sub")
        if study.reference is None:
            elsewhere = Study.from_config(table, directory="../studies/x")
            there, here = (each.all_conditions[1].experiment for each in (elsewhere, study))
            assert only_stored(there.agents[1]).run == f"../{only_stored(here.agents[1]).run}"
            assert there.transforms == here.transforms


@pytest.mark.parametrize("starts", [False, True])
def test_a_trial_has_the_same_name_from_wherever_its_stored_agents_are_named(tmp_path, monkeypatch, starts):
    (tmp_path / "sub").mkdir()

    def name(run, runs):
        stored = Frozen(run, 0)
        second = replace(LEARNING, start_from=stored) if starts else stored
        (trial,) = trials_of(Study(replace(TINY, agents=(LEARNING, second))), runs)
        return trial.name

    monkeypatch.chdir(tmp_path)
    names = [name(run, "studies/x/runs") for run in ("runs/a", "runs/b")]
    monkeypatch.chdir(tmp_path / "sub")
    assert [name(run, tmp_path / "studies/x/runs") for run in ("../runs/a", "../runs/b")] == names
    assert names[0] != names[1]


def test_a_table_that_is_no_study_is_refused():
    for change, message in (
        ({"factors": None}, "NoneType"),
        ({"factors": [["a", {"distribution": "Normal", "low": 0, "high": 1}]]}, "Normal"),
        ({"experiment": {"name": "x"}}, "lacks game, agents"),
        ({"pairing": False}, "pairing"),
        ({"replica": 99}, "no 'replica' .did you mean 'replicas'.*allowed: format, experiment"),
        ({"made up": 1}, "no 'made up'; allowed"),
        ({"format": 3}, "format"),
    ):
        with pytest.raises(ValueError, match=message):
            Study.from_config({**GRID.to_config(), **change})


# Words


SHARES = st.floats(0, 1, allow_subnormal=False)


def read(word, experiment=TINY):
    ((_, factor),) = factors_of(experiment, [word]).items()
    return factor


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("game.rules.freeze-steps=5,25,100", (5, 25, 100)),
        ("game.rules.freeze_steps= 5 , 25", (5, 25)),
        (f"{GAMMA}=0.9,1", (0.9, 1.0)),
        (f"{OF_ALL}.learning-rate=1e-4", (1e-4,)),
        (f"{OF_ALL}.hidden-cells=32x32,64 64,(8,),16", ((32, 32), (64, 64), (8,), (16,))),
        (f"{OF_ALL}.hidden-cells=(),(4, 4)", ((), (4, 4))),
        ("game.rules.regrow-prob=0 0.5,0x.1x.2", ((0.0, 0.5), (0.0, 0.1, 0.2))),
        ("game.rules.beam-length-cells=6,1x2x3x4", (6, (1, 2, 3, 4))),
        ("game.rules.may-fire=True,false", (True, False)),
        (f"{OF_ALL}.tau=None,0.1", (None, 0.1)),
        ("agents.0.reward=team,individual", ("team", "individual")),
        ("agents.*.algorithm.network=None", (None,)),
        ("game.map=commons,single_basic", ("commons", "single_basic")),
        ("device=cpu", ("cpu",)),
        (f"{OF_ALL}.learning_rate=loguniform(1e-5,1e-3)", LogUniform(1e-5, 1e-3)),
        (f"{OF_ALL}.learning_rate=log_uniform(1e-5, 1e-3)", LogUniform(1e-5, 1e-3)),
        (f"{GAMMA}=Uniform(0.5,1)", Uniform(0.5, 1)),
        (f"{FREEZE}=integers(1,9)", Integers(1, 9)),
    ],
)  # fmt: skip
def test_values_are_of_the_type_of_their_field(word, values):
    assert read(word) == values
    assert repr(read(word)) == repr(values), "1.0 is not 1, and True is not 1"


@settings(deadline=None)
@given(st.lists(SHARES, min_size=1, max_size=4))
def test_numbers_are_read_as_python_writes_them(numbers):
    assert read(f"{GAMMA}={','.join(map(repr, numbers))}") == tuple(numbers)


@settings(deadline=None)
@given(st.lists(st.lists(st.integers(1, 99), min_size=1, max_size=3), min_size=1, max_size=3), st.data())
def test_values_of_several_numbers_are_read_in_each_of_their_forms(values, data):
    forms = [
        lambda numbers: "x".join(map(str, numbers)),
        lambda numbers: " ".join(map(str, numbers)),
        lambda numbers: f"{(*numbers,)}",
    ]
    texts = [data.draw(st.sampled_from(forms))(numbers) for numbers in values]
    assert read(f"{OF_ALL}.hidden_cells={','.join(texts)}") == tuple(map(tuple, values))


@pytest.mark.parametrize(
    ("word", "message"),
    [
        (f"{FREEZE}=many", r"at the path game\.rules\.freeze_steps is 'many'"),
        (f"{FREEZE}=0.5", "is '0.5'"),
        (f"{FREEZE}=True", "is 'True'"),
        (f"{GAMMA}=nan", "is 'nan'"),
        (f"{OF_ALL}.tau=soft", "is 'soft'"),
        ("game.rules.beam-length-cells=1x2", r"is '1x2'"),
        ("agents.0.reward=greedy", "is 'greedy'"),
        ("agents.0.algorithm=PPO", "a command line can say"),
        ("game.map.sites=1", "a command line can say"),
        (f"{FREEZE}=normal(1,2)", r"is 'normal\(1,2\)'"),
        (f"{FREEZE}=integers(1,2.5)", r"Integers\.high is 2\.5"),
        (f"{FREEZE}=integers(5,1)", r"Integers\.low is 5"),
        (f"{FREEZE}=", "--vary is"),
        (FREEZE, "--vary is 'game.rules.freeze_steps'"),
        ("=1", "--vary is '=1'"),
    ],
)  # fmt: skip
def test_what_a_field_cannot_have_is_refused_by_its_path(word, message):
    with pytest.raises(ValueError, match=message):
        read(word)


def test_a_value_fits_every_place_of_a_path_a_star_means_those_who_learn_and_a_path_stands_once():
    mixed = replace(TINY, agents=(LEARNING, ON_POLICY))
    assert read(f"{GAMMA}=0.5", mixed) == read(f"{GAMMA}=0.5", MIXED) == (0.5,)
    with pytest.raises(ValueError, match=r"has game\.rules\.freeze_steps twice"):
        factors_of(TINY, ["game.rules.freeze-steps=1", "game.rules.freeze_steps=2"])
    with pytest.raises(ValueError, match="matches nothing"):
        read(f"{OF_ALL}.buffer_size=7", mixed)


# Names


LEARNER = DQN(settings=DQNSettings())


@pytest.mark.parametrize(
    ("level", "text"),
    [
        (0.1 + 0.2, "0.3"),
        ((1, 2.5), "(1, 2.5)"),
        ("greedy", "greedy"),
        (Scripted("greedy"), "Scripted(greedy)"),
        (LEARNER, "DQN"),
        (Learning(LEARNER), "Learning(DQN)"),
        (Team(VDN(settings=DQNSettings()), (0, 1)), "Team(VDN)"),
        (MLP(hidden_cells=(8, 8)), "MLP((8, 8))"),
        ((), "()"),
        ((Quota(share=0.5), Sanctioner()), "(Quota(0.5), Sanctioner)"),
    ],
)
def test_a_level_is_told_by_its_value_and_an_agent_by_what_it_is(level, text):
    assert level_text(level) == text


def test_a_factor_is_named_by_its_last_word_where_that_tells_it():
    assert condition_name({"agents.0": Scripted("greedy")}) == "agents.0=Scripted(greedy)"
    paths = ["agents.0", "game.rules.freeze_steps", "a.gamma", "b.gamma"]
    assert short_names(paths) == {
        "agents.0": "agents.0",
        "game.rules.freeze_steps": "freeze_steps",
        "a.gamma": "a.gamma",
        "b.gamma": "b.gamma",
    }


# Recipes


FOLDER = RECIPES / "study"
SHIPPED = sorted(path.stem for path in FOLDER.glob("*.py") if "\nSTUDY = " in path.read_text())


@pytest.fixture
def shipped(monkeypatch):
    """Imports a shipped study, and forgets its modules at the end."""
    monkeypatch.syspath_prepend(FOLDER)
    before = {*sys.modules}
    yield lambda name: import_module(name).STUDY
    for name in {path.stem for path in FOLDER.glob("*.py")} - before:
        sys.modules.pop(name, None)


@pytest.mark.integration
def test_a_shipped_study_asks_a_question_and_says_what_is_expected(shipped):
    assert {"combat", "dip", "exploration", "no_beam"} <= {*SHIPPED}
    for name in SHIPPED:
        study = shipped(name)
        assert study.name == name
        assert study.question.endswith("?"), name
        assert len(study.expectation) > 100, name
        assert len(study.all_conditions) >= 2, name
        assert Condition(study.experiment).checksum in checksums(study), name


@pytest.mark.integration
def test_the_studies_of_the_programs_versions_share_their_runs(shipped):
    combat, experiment_5 = shipped("combat"), shipped("experiment_5")
    trials = [trial.name for trial in trials_of(experiment_5)]
    assert (len(combat.all_conditions), len(trials)) == (24, 16)
    assert set(trials[:8]) <= {trial.name for trial in trials_of(combat)}
    assert {name.partition("-")[2] for name in trials[8:]} == {"s1000-r4"}
    for study, count in ((combat, 6), (experiment_5, 2)):
        learns = [condition.experiment.agents[0].algorithm for condition in study.all_conditions[:count]]
        assert {(dqn.settings.optimizer, dqn.loss_function) for dqn in learns} == {("adam", "l2")}
    for checksum, name in {"dfd7ebd751a3": "published_schedule", "3b5ad6d79d31": "dip"}.items():
        assert trials_of(shipped(name))[0].name == f"{checksum}-s0-r8", "of docs/results"
