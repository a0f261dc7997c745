"""Values become tables and come back the same; what is not known is refused by the place where it stands."""

import json
from dataclasses import dataclass
from typing import get_args

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_settings import GAME, VALUES

from cprl import Game, Observation, Rules, maps
from cprl.algorithms import (
    A2C,
    CQL,
    DQN,
    IPPO,
    IQL,
    LOLA,
    MADDPG,
    MAPPO,
    PPO,
    PR2,
    QMIX,
    SAC,
    VDN,
    DistributionalDQN,
    DQNSettings,
    LOLASettings,
    Reinforce,
    RolloutSettings,
    Tabular,
    TabularSettings,
)
from cprl.custom import Custom, allowing, custom_targets
from cprl.envs.matrix import MatrixGame
from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    GraduatedSanctions,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Sanctioner,
    Tax,
    Vote,
)
from cprl.learners.decisions import Bandit
from cprl.learners.preferences import Exchange, InequityAversion, SocialValueOrientation
from cprl.learners.settings import Optimizer
from cprl.networks import GRU, LSTM, MLP, Conv
from cprl.objectives.td import DISTANCES
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.values import KINDS, differences, from_config, to_config

SHARES = st.floats(1e-9, 1, allow_subnormal=False)
POSITIVE = st.floats(1e-6, 100, allow_subnormal=False)
CUSTOM = st.builds(
    Custom,
    st.sampled_from(["my.module:Transform", "mine:nested.Class"]),
    arguments=st.dictionaries(
        st.text(max_size=5),
        st.recursive(
            st.none()
            | st.booleans()
            | st.integers()
            | st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False),
            lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.just("kind"), inner, max_size=1),
        ),
        max_size=3,
    ),
)
DQNS = st.builds(
    DQNSettings,
    gamma=SHARES,
    learning_rate=POSITIVE,
    hidden_cells=st.lists(st.integers(1, 64), min_size=1, max_size=3).map(tuple),
    tau=st.none() | st.floats(1e-6, 1, allow_subnormal=False),
    replay_transforms=st.lists(CUSTOM, max_size=2).map(tuple),
    target_every_episodes=st.integers(1, 20),
    relu_on_outputs=st.booleans(),
    optimizer=st.sampled_from(get_args(Optimizer)),
)
ROLLOUTS = st.builds(RolloutSettings, max_grad_norm=st.none() | POSITIVE, epochs=st.integers(1, 9))
LOOKS = st.builds(LOLASettings, max_grad_norm=st.none() | POSITIVE, critic_epochs=st.integers(0, 9))
TABULARS = st.builds(TabularSettings, learning_rate=st.just("1/visits") | SHARES)
NETWORKS = st.none() | st.builds(MLP) | st.builds(Conv, channels=st.just((4, 8))) | CUSTOM
OF_RECURRENT = {"recurrent_cells": st.integers(1, 9), "encoder": st.builds(Conv) | st.builds(MLP)}
RECURRENT = st.builds(GRU, **OF_RECURRENT) | st.builds(LSTM, **OF_RECURRENT)
ALONE = st.one_of(
    st.builds(
        DQN, settings=DQNS, double=st.booleans(), loss_function=st.sampled_from(DISTANCES), network=NETWORKS
    ),
    *[st.builds(kind, settings=DQNS) for kind in (DistributionalDQN, CQL, SAC, IQL, PR2)],
    *[st.builds(kind, settings=ROLLOUTS, network=NETWORKS | RECURRENT) for kind in (PPO, A2C, Reinforce)],
    st.builds(Tabular, settings=TABULARS),
)
TEAMS = st.one_of(
    *[st.builds(kind, settings=DQNS) for kind in (VDN, QMIX, MADDPG)],
    *[st.builds(kind, settings=ROLLOUTS) for kind in (MAPPO, IPPO)],
    st.builds(LOLA, settings=LOOKS, estimator=st.sampled_from(["policy_gradient", "dice"])),
)
FROZEN = st.builds(
    Frozen, st.just("runs/earlier"), agent=st.integers(0, 3), replica=st.none() | st.integers(0, 9)
)
STARTS = st.none() | FROZEN
BANDITS = st.none() | st.builds(
    Bandit, step_size=st.floats(1e-6, 1, allow_subnormal=False), epsilon_end=SHARES
)
UNIT = st.floats(0, 1, allow_subnormal=False)
PREFERENCES = st.one_of(
    st.sampled_from(["individual", "team"]),
    st.builds(InequityAversion, alpha=st.just(5) | UNIT, beta=UNIT, smoothing=UNIT),
    st.builds(SocialValueOrientation, angle=st.floats(-3, 3, allow_subnormal=False), weight=UNIT),
    st.builds(Exchange, UNIT),
)
SPECS = st.one_of(
    st.builds(Learning, ALONE | CUSTOM, reward=PREFERENCES, start_from=STARTS, decisions=BANDITS),
    st.builds(
        Team, TEAMS | CUSTOM, agents=st.just((0, 2)), reward=PREFERENCES, start_from=STARTS, decisions=BANDITS
    ),
    st.builds(Scripted, st.sampled_from(["random", "greedy", "pacifist"])),
    FROZEN,
)
RULES = st.builds(
    Rules,
    regrow_prob=st.lists(st.just(0.0) | SHARES, min_size=1, max_size=6).map(tuple),
    beam_length_cells=st.integers(1, 9) | st.tuples(*[st.integers(1, 9)] * 4),
    freeze_steps=st.integers(0, 99),
    may_fire=st.booleans(),
    shuffle_starts=st.booleans(),
)
BOARD = maps.parse("A>.#.\n.A.vA\n..A..")
FINES = st.none() | st.sampled_from([0.0, 0.5, 9.0])
INSTITUTIONS = st.one_of(
    st.builds(Boundaries, regions=st.just((".01..", "aa...", "...1.")), owners=st.just(("0a", "1"))),
    st.builds(Quota, share=SHARES, window_steps=st.integers(1, 99), by_stock=st.booleans(), fine=FINES),
    st.builds(ClosedSeason, closed_steps=st.integers(0, 100), fine=FINES),
    st.builds(Tax, rate=SHARES, brackets=st.sampled_from([(), ((0, 0.1), (3, 0.5))])),
    st.builds(Levies, groups=st.just(((0,), (1,))), local_rate=st.sampled_from([0.0, 0.5])),
    st.builds(Vote, on=st.builds(Tax) | st.builds(Quota), override_prob=SHARES),
)
ONE_OF_A_KIND = st.tuples(
    st.builds(ClosedPatches, below=st.integers(0, 5), fine=st.sampled_from([0.0, 0.5])),
    st.builds(Monitoring, prob=SHARES, monitor=st.sampled_from([None, 0, "elected"])),
    st.builds(GraduatedSanctions, recovery_steps=st.none() | st.integers(1, 9)),
)
GAMES = st.builds(
    Game,
    map=st.just(BOARD),
    rules=RULES,
    observation=st.builds(Observation, encoding=st.sampled_from(["rgb", "one_hot"])),
    institutions=st.lists(INSTITUTIONS, max_size=3).map(tuple) | ONE_OF_A_KIND,
)
FIRING = Game(
    map=BOARD,
    rules=Rules(),
    observation=Observation(agents_apart=True),
    institutions=(
        Mediation(turns=3),
        Sanctioner(agents=(1,)),
        GraduatedSanctions(freeze_steps=((1,), (2,)), on="tags"),
    ),
)


MATRICES = st.builds(
    MatrixGame,
    st.sampled_from([(((1, 2.5), (0, 1)), ((2, 3), (0, 0))), ((((((1.0,) * 4,) * 2,) * 2,) * 2,) * 2)]),
    turns=st.integers(2, 9),
    memory=st.none() | st.integers(0, 3),
    continue_prob=SHARES,
)


@pytest.mark.integration
@settings(max_examples=200, deadline=None)
@given(value=SPECS | GAMES | MATRICES | CUSTOM | st.tuples(SPECS, GAMES) | st.just(FIRING))
def test_a_value_comes_back_from_its_table_as_it_was(value):
    text = json.dumps(to_config(value), allow_nan=False)
    with allowing(custom_targets(json.loads(text))):
        back = from_config(json.loads(text))
    assert back == value
    assert hash(back) == hash(value)
    assert to_config(back) == json.loads(text)


@pytest.mark.parametrize(
    "value",
    [value for value in (*VALUES, GAME, BOARD) if type(value) in KINDS.values()],
    ids=lambda value: type(value).__name__,
)
def test_every_kind_comes_back(value):
    table = json.loads(json.dumps(to_config(value)))
    assert KINDS[table["kind"]] is type(value)
    with allowing(custom_targets(table)):
        assert from_config(table) == value


def test_what_a_table_leaves_out_takes_its_default():
    assert from_config({"kind": "DQNSettings", "gamma": 0.9}) == DQNSettings(gamma=0.9)


TABLE = to_config([Learning(DQN(settings=DQNSettings()))], "agents")


def changed(place, value):
    """The table of one DQN agent with something else somewhere."""
    table = json.loads(json.dumps(TABLE))
    *way, last = place
    inner = table
    for step in way:
        inner = inner[step]
    inner[last] = value
    return table


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ((0, "algorithm", "settings", "gama"), 0.9, r"settings\.gama is no field of .* mean 'gamma'\?"),
        ((0, "algorithm", "settings", "gamma"), "0.9", r"settings\.gamma is '0\.9'"),
        ((0, "algorithm", "settings", "batch_size"), 8.5, r"settings\.batch_size is 8\.5"),
        ((0, "algorithm", "settings", "batch_size"), True, r"settings\.batch_size is True"),
        ((0, "algorithm", "settings", "gamma"), float("inf"), r"settings\.gamma is inf"),
        ((0, "algorithm", "settings", "kind"), "DQNSetting", r"settings\.kind is 'DQNSetting' \(did you mea"),
        ((0, "algorithm", "settings"), {"gamma": 1}, r'settings is a table without "kind"'),
        ((0, "algorithm", "settings", "hidden_cells"), [8, "x"], r"hidden_cells is \(8, 'x'\)"),
        ((0, "algorithm", "settings"), {"kind": "RolloutSettings"}, r"allowed: a DQNSettings"),
        ((0, "algorithm"), {"kind": "DQN"}, r"\.algorithm lacks settings"),
        (
            (0, "algorithm"),
            {"kind": "QMIX", "settings": {"kind": "DQNSettings"}},
            r": QMIX is learned by a team",
        ),
        ((0, "reward"), "own", r"\.reward is 'own'"),
    ],
)
def test_what_is_not_known_is_refused_by_the_place_where_it_stands(place, value, message):
    with pytest.raises(ValueError, match=r"^agents\[0\].*" + message):
        from_config(changed(place, value), "agents")


@dataclass(frozen=True, kw_only=True)
class MyDQN(DQN):
    """An algorithm of somebody's own, which is not in the registry."""


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (torch.nn.Linear(1, 1), r"is a Linear"),
        (torch.nn.Linear, r"is a class"),
        (lambda: 0, r'is a function, .*Custom\("module:name", .*at the top of a module'),
        (MyDQN(settings=DQNSettings()), r"is a MyDQN"),
        (float("nan"), r"is nan"),
        ({"a": 1}, r"is a dict"),
    ],
)
def test_a_live_object_is_refused_with_what_to_write_instead(value, message):
    with pytest.raises(ValueError, match=r"^callbacks\[1\] ?" + message):
        to_config((None, value), "callbacks")


def test_what_would_be_imported_is_refused_unless_it_is_allowed():
    table = to_config((Custom("a:B"), Custom("c:D", arguments={"kind": "Custom", "target": "not:one"})))
    assert custom_targets(table) == ["a:B", "c:D"]
    with pytest.raises(ValueError, match=r"^a:B, c:D would be imported.*--allow a:B --allow c:D"):
        from_config(table)
    with allowing(["a:B"]), pytest.raises(ValueError, match=r"^c:D would be imported"):
        from_config(table)
    with allowing(["a:B", "c:D"]):
        assert from_config(table)[0] == Custom("a:B")
    with pytest.raises(ValueError, match="would be imported"):
        from_config(table)


def test_two_tables_are_told_apart_by_place():
    before, now = TABLE, changed((0, "algorithm", "settings", "gamma"), 0.5)
    assert differences(before, now, "agents") == ["agents[0].algorithm.settings.gamma was 0.995, is 0.5"]
    assert differences(before, before, "agents") == []
    assert differences({"a": 1}, {}, "x") == ["x.a was 1, is not there"]
    assert differences([1], [1, 2], "x") == ["x was [1], is [1, 2]"]
