"""Factors as words of a command line: each is read by the type of the field that its path names."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_study import FREEZE, GAMMA, MIXED, TINY

from cprl.algorithms import PPO, RolloutSettings
from cprl.population import Learning
from cprl.studies import Integers, LogUniform, Uniform
from cprl.studies.factors import factors_of

SETTINGS = "agents.*.algorithm.settings"
FINITE = st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False)


def read(word, experiment=TINY):
    ((_, factor),) = factors_of(experiment, [word]).items()
    return factor


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("game.rules.freeze-steps=5,25,100", (5, 25, 100)),
        ("game.rules.freeze_steps= 5 , 25", (5, 25)),
        (f"{GAMMA}=0.9,1", (0.9, 1.0)),
        (f"{SETTINGS}.learning-rate=1e-4", (1e-4,)),
        (f"{SETTINGS}.hidden-cells=32x32,64 64,(8,),16", ((32, 32), (64, 64), (8,), (16,))),
        (f"{SETTINGS}.hidden-cells=(),(4, 4)", ((), (4, 4))),
        ("game.rules.regrow-prob=0 0.5,0x.1x.2", ((0.0, 0.5), (0.0, 0.1, 0.2))),
        ("game.rules.beam-length-cells=6,1x2x3x4", (6, (1, 2, 3, 4))),
        ("game.rules.may-fire=True,false", (True, False)),
        (f"{SETTINGS}.tau=None,0.1", (None, 0.1)),
        ("agents.0.reward=team,individual", ("team", "individual")),
        ("agents.*.algorithm.network=None", (None,)),
        ("game.map=commons,single_basic", ("commons", "single_basic")),
        ("device=cpu", ("cpu",)),
        (f"{SETTINGS}.learning_rate=loguniform(1e-5,1e-3)", LogUniform(1e-5, 1e-3)),
        (f"{SETTINGS}.learning_rate=log_uniform(1e-5, 1e-3)", LogUniform(1e-5, 1e-3)),
        (f"{GAMMA}=Uniform(0.5,1)", Uniform(0.5, 1.0)),
        (f"{FREEZE}=integers(1,9)", Integers(1, 9)),
    ],
)  # fmt: skip
def test_values_are_of_the_type_of_their_field(word, values):
    found = read(word)
    assert found == values
    assert repr(found) == repr(values), "1.0 is not 1, and True is not 1"


@settings(deadline=None)
@given(st.lists(FINITE, min_size=1, max_size=4))
def test_numbers_are_read_as_python_writes_them(numbers):
    assert read(f"{GAMMA}={','.join(map(repr, numbers))}") == tuple(numbers)


@settings(deadline=None)
@given(st.lists(st.lists(st.integers(0, 99), min_size=1, max_size=3), min_size=1, max_size=3), st.data())
def test_values_of_several_numbers_are_read_in_each_of_their_forms(values, data):
    forms = [
        lambda own: "x".join(map(str, own)),
        lambda own: " ".join(map(str, own)),
        lambda own: f"{(*own,)}",
    ]
    texts = [data.draw(st.sampled_from(forms))(own) for own in values]
    assert read(f"{SETTINGS}.hidden_cells={','.join(texts)}") == tuple(map(tuple, values))


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("game.rules.freeze-step=5", r"freeze_step matches nothing \(did you mean 'freeze_steps'\?\)"),
        (f"{FREEZE}=many", r"at the path game\.rules\.freeze_steps is 'many'"),
        (f"{FREEZE}=0.5", "is '0.5'"),
        (f"{FREEZE}=True", "is 'True'"),
        (f"{GAMMA}=nan", "is 'nan'"),
        (f"{SETTINGS}.tau=soft", "is 'soft'"),
        ("game.rules.beam-length-cells=1x2", r"is '1x2'"),
        ("agents.0.reward=greedy", "is 'greedy'"),
        ("agents.0.algorithm=PPO", "which a command line cannot say"),
        ("game.map.sites=1", "which a command line cannot say"),
        ("game.institutions=tax", "which a command line cannot say"),
        (f"{FREEZE}=normal(1,2)", r"is normal\(1,2\)"),
        (f"{FREEZE}=integers(1,2.5)", r"is integers\(1,2\.5\)"),
        (f"{FREEZE}=integers(5,1)", r"Integers\.low is 5"),
        (f"{FREEZE}=", "are ''"),
        (f"{FREEZE}=1,,2", "are '1,,2'"),
        (FREEZE, "--vary is 'game.rules.freeze_steps'"),
        ("=1", "--vary is '=1'"),
    ],
)  # fmt: skip
def test_what_a_field_cannot_have_is_refused_by_its_path(word, message):
    with pytest.raises(ValueError, match=message):
        read(word)


def test_a_path_stands_once_however_it_is_written():
    with pytest.raises(ValueError, match=r"has game\.rules\.freeze_steps twice"):
        factors_of(TINY, ["game.rules.freeze-steps=1", "game.rules.freeze_steps=2"])


def test_only_agents_that_learn_are_meant_by_a_star():
    assert read(f"{GAMMA}=0.5", MIXED) == (0.5,)


def test_a_value_fits_every_place_that_its_path_names():
    other = Learning(PPO(settings=RolloutSettings()))
    mixed = replace(TINY, agents=(TINY.agents[0], other))
    assert read(f"{GAMMA}=0.5", mixed) == (0.5,)
    with pytest.raises(ValueError, match="matches nothing"):
        read(f"{SETTINGS}.buffer_size=7", mixed)
