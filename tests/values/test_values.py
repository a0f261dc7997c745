"""Values of recipes: every field of every class refuses what it cannot be, by its name, sizes before they are
allocated; values become tables and come back the same, and what is not known is refused by its place."""

import json
import sys
from collections import UserDict
from dataclasses import dataclass, fields, replace
from functools import partial
from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest
import torch
from c51 import C51
from dqn_parts import make_learner
from my_game import Callback, Dilemma
from sharing_games import appropriation, herders
from taking_games import TakingGame
from valid_values import EVERY

from cprl import Custom, Experiment, Game, Observation, Rules, institutions, maps, presets
from cprl.algorithms import (
    DQN,
    LOLA,
    PPO,
    QMIX,
    DQNSettings,
    LOLASettings,
    RolloutSettings,
    Tabular,
    TabularSettings,
)
from cprl.commands.recipe_command import parse_command
from cprl.experiment import changes
from cprl.institutions import Tax
from cprl.learners.lanes import Lanes
from cprl.learners.settings import EpsilonGreedy
from cprl.networks import GRU, LSTM, Conv
from cprl.objectives.rewards import SocialValueOrientation
from cprl.policies.decisions import Bandit
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.runs.files import read_json
from cprl.runs.recipe import read_recipe
from cprl.system.memory import TooLargeError
from cprl.training.running import run
from cprl.values import (
    KINDS,
    custom_targets,
    describe_changes,
    describe_customs,
    from_config,
    to_config,
    trust,
    trusting,
)

GAME = presets.game("two_complex")
REPLAY, ROLLOUTS, TABLES = DQNSettings(), RolloutSettings(), TabularSettings()
SPACES = GAME.spaces
EXPERIMENT = Experiment(name="mine", game=GAME, agents=[Scripted()] * 2, episodes=1)
VALUES = [
    *EVERY,
    EpsilonGreedy(),
    SPACES,
    TakingGame(appropriation(), most=3.0, turns=9),
    herders(2, cost=2.0),
]
FIELDS = [
    pytest.param(value, own.name, id=f"{type(value).__name__}.{own.name}")
    for value in VALUES
    for own in fields(value)
]
NAN, INF = float("nan"), float("inf")
NEVER = (
    NAN,
    2**70,
    10**5000,
    object(),
    b"3",
    {3: 4},
    {"a"},
    torch.nn.ReLU(),
    int,
    np.float64(NAN),
    "a\0b",
    [NAN],
)
"""What fits no field."""


@pytest.mark.parametrize(("value", "field"), FIELDS)
def test_every_field_refuses_what_it_cannot_be_by_its_name(value, field):
    name = "experiment" if isinstance(value, Experiment) else type(value).__name__
    for wrong in NEVER:
        with pytest.raises(ValueError, match=rf"^{name}\.{field}\b") as refused:
            replace(value, **{field: wrong})
        assert "\n" not in str(refused.value)
        assert len(str(refused.value)) < 700


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_numpys_scalars_and_lists_become_pythons_numbers_and_tuples(value):
    given = {own.name: as_numpy(getattr(value, own.name)) for own in fields(value)}
    again = replace(value, **given)
    assert again == value
    assert hash(again) == hash(value)
    for own in fields(value):
        assert type(getattr(again, own.name)) is type(getattr(value, own.name))


def as_numpy(value):
    if isinstance(value, tuple):
        return [as_numpy(own) for own in value]
    kinds = {bool: np.bool_, int: np.uint64, float: np.float64}
    return kinds[type(value)](value) if type(value) in kinds else value


def test_numbers_are_stored_exactly_and_texts_of_another_class_as_plain_ones():
    settings = DQNSettings(batch_size=np.int64(3), gamma=np.float32(0.5), tau=1, hidden_cells=range(4, 7))
    assert (settings.batch_size, settings.gamma, settings.tau) == (3, 0.5, 1)
    assert settings.hidden_cells == (4, 5, 6)
    assert to_config(settings)["batch_size"] == 3
    for wrong in (1.9, 2.0, np.float64(2), True, np.array([2]), "2"):
        with pytest.raises(ValueError, match=r"DQNSettings\.batch_size"):
            DQNSettings(batch_size=wrong)
    assert type(Scripted(type("Text", (str,), {})("random")).policy) is str


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (partial(PPO, settings=REPLAY), "PPO.settings"),
        (partial(DQN, settings=DQNSettings), "DQN.settings"),
        (partial(DQN, settings=REPLAY, network=torch.nn.Linear(1, 1)), "network"),
        (partial(C51, settings=REPLAY, highest_return=0.0), "highest_return"),
        (partial(C51, settings=REPLAY, lowest_return=1e8, highest_return=1e8 + 9), "atoms"),
        (partial(RolloutSettings, rollout_steps=1, minibatch_size=1), "rollout_steps"),
        (partial(RolloutSettings, minibatch_size=7), "minibatch_size"),
        (partial(DQNSettings, adam_eps=1e-50), "adam_eps"),
        (partial(Team, QMIX(settings=REPLAY), agents="01"), "Team.agents"),
        (partial(Frozen, "", 0), "Frozen.run"),
        (partial(Frozen, "a" * 5000, 0), "Frozen.run"),
        (partial(Scripted, "Greedy"), "Scripted.policy"),
        (partial(presets.dqn_settings, ["commons"]), "board"),
        (partial(parse_command, lambda: 3, ["x.py"]), "what the recipe makes"),
    ],
)
def test_what_does_not_belong_together_is_refused_by_name(make, field):
    with pytest.raises(ValueError, match=field):
        make()


def test_a_field_of_an_algorithm_of_somebodys_own_is_their_own():
    @dataclass(frozen=True, kw_only=True)
    class Mine(DQN):
        temperature: str = "warm"

    assert Mine(settings=REPLAY).temperature == "warm"
    with pytest.raises(ValueError, match=r"^Mine\.double is 'yes'"):
        Mine(settings=REPLAY, double="yes")


@pytest.mark.parametrize(
    ("target", "arguments", "field"),
    [
        *(
            (target, {}, "target")
            for target in ("no colon", ":", "a:", ":b", ".a:b", "a..b:c", "a:b\n", "a:b c")
        ),
        *(("a:b", arguments, "arguments") for arguments in ([1], {2: 2}, {"x": {1: 2}})),
        *(("a:b", {"x": value}, "arguments") for value in (NAN, object(), 10**5000, np.float32(1))),
    ],
)
def test_a_custom_has_a_module_a_name_and_a_table_that_json_can_hold(target, arguments, field):
    assert Custom("a:b", MappingProxyType({"x": (1, 2)})) == Custom("a:b", UserDict(x=[1, 2]))
    with pytest.raises(ValueError, match=rf"Custom\.{field}"):
        Custom(target, arguments=arguments)


def nested(depth):
    """A list in a list, and so on."""
    value = []
    for _ in range(depth):
        value = [value]
    return value


def itself():
    value = {}
    value["again"] = [value] * 3
    return value


@pytest.mark.parametrize("deep", [nested(100_000), itself()], ids=["deep", "in itself"])
def test_what_is_nested_without_end_is_refused_in_a_sentence(deep):
    own = r"^(DQNSettings\.hidden_cells|Rules\.regrow_prob) is "
    for refuses in (
        lambda: Custom("a:b", arguments={"x": deep}),
        lambda: to_config(deep),
        lambda: from_config({**to_config(REPLAY), "hidden_cells": deep}),
        lambda: Experiment.from_recipe({"format": 2, "experiment": {"name": deep}}),
        lambda: DQNSettings(hidden_cells=deep),
        lambda: Rules(regrow_prob=deep),
    ):
        with pytest.raises(ValueError, match=rf"nested|recursion|cannot hold|{own}"):
            refuses()


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000 + "]" * 100_000,
        '{"experiment": ' + '{"a":' * 100_000 + "1" + "}" * 100_001,
        '{"experiment": {"a": ' + "9" * 5000 + "}}",
        '{"experiment": ',
        "3",
        "null",
        '{"experiment": {}}\0',
    ],
    ids=len,
)
def test_a_recipe_that_cannot_be_read_is_refused_with_its_path(text, tmp_path):
    path = tmp_path / "recipe.json"
    path.write_text(text)
    for read in (read_recipe, read_json):
        with pytest.raises(ValueError, match=r"recipe\.json (is not|holds)"):
            read(path)


def changed(table, place, value):
    """A copy of a table with something else somewhere."""
    table = json.loads(json.dumps(table))
    *way, last = place
    inner = table
    for step in way:
        inner = inner[step]
    inner[last] = value
    return table


@pytest.mark.parametrize(
    ("place", "value"),
    [
        *((("seed",), 1e400), (("seed",), 10**30), (("game", "rules", "episode_steps"), 10**400)),
        *((("agents",), {}), (("agents", 0), []), (("agents", 0, "policy"), "\ud800")),
        *((("agents", 0, "kind"), {}), (("game",), None), (("game", "map"), 3), (("device",), "\0")),
    ],
)
def test_hostile_tables_are_refused_by_the_place(place, value):
    with pytest.raises(ValueError, match=str(place[0])):
        Experiment.from_config(changed(EXPERIMENT.to_config(), place, value))


def test_recipes_of_another_form_are_refused():
    for recipe in ({}, {"recipe": "old", "arguments": {}}, {"format": [2]}, {"format": 2, "experiment": []}):
        with pytest.raises(ValueError, match="format"):
            Experiment.from_recipe(recipe)


NAMES = ["", ".", "..", "a/b", "a\\b", "a\nb", "a\0b", "\ud800", "a" * 201, "ä" * 101, "a ", "a."]
DEVICES = ["meta", "cuda:300", "cuda:-1", "", "gpu", "cpu "]


@pytest.mark.parametrize(
    ("field", "value"), [*(("name", name) for name in NAMES), *(("device", device) for device in DEVICES)]
)
def test_a_name_is_that_of_a_directory_anywhere_and_a_device_one_that_torch_takes(field, value):
    for name in ("gamma 0.9, two runs", "größe", ".hidden", "a" * 200, "console"):
        assert replace(EXPERIMENT, name=name).name == name
    with pytest.raises(ValueError, match=rf"^experiment\.{field} is "):
        replace(EXPERIMENT, **{field: value})


def test_games_that_cannot_be_played_are_refused_in_a_sentence():
    for game, message in (
        *((type(GAME), "is the class Game"), (Dilemma, "the class")),
        (SimpleNamespace(agents=1.5, to_config=dict, make=print), r"agents is 1\.5"),
    ):
        with pytest.raises(ValueError, match=rf"^experiment\.game.*{message}"):
            replace(EXPERIMENT, game=game)


HOW = {"agents": (0, 1), "replicas": 1, "engine": "eager"}


def test_who_learns_cannot_be_agents_and_replicas_that_there_are_not():
    for field, value in (
        *(("agents", agents) for agents in ((), (0, 2), (0, 0))),
        *(("replicas", 0), ("reward", "group")),
    ):
        with pytest.raises(ValueError, match=field):
            Lanes(SPACES, **{"agents": (0, 1), "replicas": 1, field: value})


TOO_LARGE = DQNSettings(buffer_size=2**40 - 1)


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_a_replay_buffer_that_no_memory_has_is_refused_before_it_is_allocated(engine):
    with pytest.raises(TooLargeError, match=r"^the replay buffers of .* are free: use a smaller "):
        make_learner(DQN(settings=TOO_LARGE), SPACES, **{**HOW, "engine": engine})
    assert issubclass(TooLargeError, ValueError)
    assert issubclass(TooLargeError, MemoryError)


@pytest.mark.parametrize("engine", ["compiled", "torchrl"])
def test_a_replay_buffer_that_no_memory_has_is_refused_before_anything_is_written(engine, tmp_path):
    agents = [Learning(DQN(settings=TOO_LARGE))] * 2
    with pytest.raises(TooLargeError, match="smaller buffer_size"):
        run(replace(EXPERIMENT, agents=agents, engine=engine), tmp_path / "run", watch="off")
    assert list(tmp_path.iterdir()) == []


def test_an_evaluation_that_no_memory_has_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr("cprl.system.memory.free_bytes", lambda device="cpu": 50 * 2**20)
    with pytest.raises(TooLargeError, match=r"^worlds is 1,048,576: .* use fewer worlds"):
        run(replace(EXPERIMENT, evaluation_episodes=2**20), tmp_path / "run", watch="off")
    assert list(tmp_path.iterdir()) == []


BOARD = maps.parse("A>.#.\n.A.vA\n..A..")
SOMETHING = Custom("mine:nested.Class", arguments={"x": [1, {"kind": 2.5}], "": None})
UNUSUAL = (
    DQN(
        settings=DQNSettings(hidden_cells=(8,), tau=0.05, optimizer="sgd"),
        double=True,
        network=SOMETHING,
    ),
    PPO(settings=RolloutSettings(max_grad_norm=None), network=LSTM(encoder=Conv(channels=(4, 8)))),
    Tabular(settings=TabularSettings(learning_rate="1/visits")),
    Learning(
        PPO(settings=RolloutSettings(), network=GRU(recurrent_cells=3)),
        reward=SocialValueOrientation(angle=-2.5, weight=0.25),
        start_from=Frozen("runs/earlier", agent=1, replica=None),
        decisions=Bandit(step_size=1e-6),
    ),
    Team(LOLA(settings=LOLASettings(), estimator="dice"), agents=(0, 2), reward="individual"),
    Game(
        map=BOARD,
        rules=Rules(regrow_prob=(0.0, 5e-9), beam_length_cells=(1, 2, 3, 4), shuffle_starts=True),
        observation=Observation(encoding="one_hot"),
        institutions=(
            institutions.Boundaries(regions=(".01..", "aa...", "...1."), owners=("0a", "1")),
            institutions.ClosedSeason(closed_steps=3, fine=0.5),
            institutions.Vote(on=institutions.Tax(), override_prob=0.5),
            institutions.Monitoring(prob=0.5, monitor="elected"),
        ),
    ),
    Game(
        map=BOARD,
        rules=Rules(),
        observation=Observation(agents_apart=True),
        institutions=(
            institutions.Tax(brackets=((0, 0.1), (3, 0.5))),
            institutions.Mediation(turns=3),
            institutions.Sanctioner(agents=(1,)),
            institutions.GraduatedSanctions(freeze_steps=((1,), (2,)), on="tags"),
        ),
    ),
)


@pytest.mark.parametrize(
    "value",
    [value for value in (*VALUES, *UNUSUAL, GAME, BOARD) if type(value) in KINDS.values()],
    ids=lambda value: type(value).__name__,
)
def test_a_value_comes_back_from_its_table_as_it_was(value):
    table = json.loads(json.dumps(to_config(value), allow_nan=False))
    assert KINDS[table["kind"]] is type(value)
    with trusting(custom_targets(table)):
        back = from_config(table)
    assert back == value
    assert hash(back) == hash(value)
    assert to_config(back) == table


TABLE = to_config([Learning(DQN(settings=DQNSettings()))], "agents")


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
        from_config(changed(TABLE, place, value), "agents")


@dataclass(frozen=True, kw_only=True)
class MyDQN(DQN):
    """An algorithm of somebody's own, which is not in the registry."""

    sizes: tuple[int, ...] = (1, 2)


def test_a_value_of_somebodys_own_is_stored_by_its_class_and_its_fields():
    own = MyDQN(settings=DQNSettings(batch_size=3), network=Custom("a:B"), sizes=(3,))
    table = as_stored(to_config(own))
    assert (table["kind"], table["target"]) == ("Custom", "test_values:MyDQN")
    assert custom_targets(table) == ["a:B", "test_values:MyDQN"]
    with trusting(["a:B", "test_values:MyDQN"]):
        assert from_config(table).make() == own
        of_before = changed(table, ("arguments", "settings"), {"kind": "DQNSettings", "batch_size": 3})
        assert from_config(of_before) == from_config(table), "fields that a version did not know"


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (torch.nn.Linear(1, 1), r"is a Linear"),
        (torch.nn.Linear, r"is a class"),
        (lambda: 0, r'is a function, .*Custom\("module:name", .*at the top of a module'),
        (float("nan"), r"is nan"),
        ({"a": 1}, r"is a dict"),
    ],
)
def test_a_live_object_is_refused_with_what_to_write_instead(value, message):
    with pytest.raises(ValueError, match=r"^callbacks\[1\] ?" + message):
        to_config((None, value), "callbacks")


def test_code_of_ones_own_is_described_without_importing_it(tmp_path, monkeypatch):
    (tmp_path / "own_laws.py").write_text('class RichPay:\n    """The rich\x1b[2J pay."""\n\nPLAIN = 1\n')
    monkeypatch.syspath_prepend(tmp_path)
    own = Custom("own_laws:RichPay", arguments={"fee": 2.0, "to": "all"}), Custom("own_laws:Missing.part")
    table = to_config([*own, *own])
    said = ["own_laws:RichPay (fee 2.0, to 'all')", "own_laws:Missing.part"]
    assert describe_customs(table) == said
    assert "own_laws" not in sys.modules
    own[0].resolve()
    assert describe_customs(table) == [f"{said[0]}: The rich?[2J pay", said[1]]
    del sys.modules["own_laws"]


def test_what_would_be_imported_is_refused_unless_it_is_allowed():
    table = to_config((Custom("a:B"), Custom("c:D", arguments={"kind": "Custom", "target": "not:one"})))
    assert custom_targets(table) == ["a:B", "c:D"]
    with pytest.raises(ValueError, match=r"^a:B, c:D would be imported.*--allow a:B --allow c:D"):
        from_config(table)
    with trusting(["a:B"]), pytest.raises(ValueError, match=r"^c:D would be imported"):
        from_config(table)
    with trusting(["a:B", "c:D"]):
        assert from_config(table)[0] == Custom("a:B")
    with pytest.raises(ValueError, match="would be imported"):
        from_config(table)


def test_two_tables_are_told_apart_by_place_and_what_one_leaves_out_takes_its_default():
    assert from_config({"kind": "DQNSettings", "gamma": 0.9}) == DQNSettings(gamma=0.9)
    before, now = TABLE, changed(TABLE, (0, "algorithm", "settings", "gamma"), 0.5)
    assert describe_changes(before, now, "agents") == ["agents[0].algorithm.settings.gamma was 0.995, is 0.5"]
    assert describe_changes(before, before, "agents") == []
    assert describe_changes({"a": 1}, {}, "x") == ["x.a was 1, is not there"]
    assert describe_changes([1], [1, 2], "x") == ["x was [1], is [1, 2]"]


# An experiment is a value: its recipe says all of it, and gives it back.


DQN_AGENT = Learning(DQN(settings=DQNSettings()))
MIXED = Experiment(
    name="mixed",
    game=presets.game("commons"),
    agents=[DQN_AGENT, Team(QMIX(settings=DQNSettings()), agents=(1, 3)), Scripted("greedy")],
    episodes=10,
    transforms=[Custom("torchrl.envs:RewardScaling", arguments={"loc": 0, "scale": 2})],
    loggers=["wandb", Custom("my.loggers:Mine")],
)
OWN = ("torchrl.envs:RewardScaling", "my.loggers:Mine")


def as_stored(recipe):
    return json.loads(json.dumps(recipe, allow_nan=False))


def test_an_experiment_equals_what_its_recipe_holds():
    recipe = as_stored(MIXED.to_recipe())
    assert (recipe["format"], recipe["recipe"]) == (2, "mixed")
    trust(*OWN)
    again = Experiment.from_recipe(recipe)
    assert again == MIXED
    assert hash(again) == hash(MIXED)
    assert again.agents == MIXED.agents
    assert again.to_recipe() == MIXED.to_recipe()
    other = replace(MIXED, seed=1)
    assert other != MIXED
    assert changes(MIXED, other) == ["experiment.seed was 0, is 1"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": 0}, r"experiment\.episodes is 0"),
        ({"agents": DQN_AGENT}, r"experiment\.agents is a Learning"),
        ({"seed": 2**64 - 1}, r"experiment\.seed is 18446744073709551615"),
        ({"replicas": 2**20, "evaluation_episodes": 5}, r"experiment\.evaluation_episodes is 5"),
        ({"engine": "torchrl"}, r"experiment\.agents\[1\] is a Team"),
        ({"agents": [DQN_AGENT]}, r"experiment\.agents: 1 agents are specified for a game of 4 agents"),
        ({"agents": [DQN(settings=DQNSettings())]}, r"agents\[0\] is a DQN"),
        (
            {"agents": [DQN_AGENT] * 3 + [Frozen("/somewhere/run", 0)]},
            r"experiment\.agents\[3\]\.run is /somewhere/run, an absolute path",
        ),
        (
            {"agents": [DQN_AGENT] * 3 + [Learning(PPO(settings=RolloutSettings()))], "update_every": 3},
            r"update_every is 3",
        ),
        (
            {"agents": [DQN_AGENT] * 3 + [Team(QMIX(settings=DQNSettings()), agents=(3,))]},
            r"the team has 1 agents",
        ),
        (
            {"agents": [Learning(Tabular(settings=TabularSettings()))] * 4, "engine": "torchrl"},
            r"agents\[0\] is Tabular, which",
        ),
        ({"callbacks": [Callback()]}, r"callbacks\[0\] is a Callback, .*Custom\(\"my_game:Callback\", arg"),
        ({"loggers": ["csv"]}, "loggers"),
        ({"transforms": [Custom("__main__:Mine")]}, r"__main__:Mine, of the script that runs"),
    ],
)
def test_what_cannot_be_trained_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        replace(MIXED, **change)


def test_a_game_of_somebodys_own_is_stored_by_the_name_of_its_class():
    game = Dilemma(payoffs=((3.0, 0.5), (4.0, 1.0)))
    experiment = Experiment(name="dilemma", game=game, agents=[DQN_AGENT] * 2, episodes=5)
    recipe = as_stored(experiment.to_recipe())
    assert recipe["experiment"]["game"] == {
        "kind": "Custom",
        "target": "my_game:Dilemma",
        "arguments": {"payoffs": [[3.0, 0.5], [4.0, 1.0]], "agents": 2},
    }
    with pytest.raises(ValueError, match="--allow my_game:Dilemma"):
        Experiment.from_recipe(recipe)
    trust("my_game:Dilemma")
    again = Experiment.from_recipe(recipe)
    assert again.game == game
    assert again == experiment
    with pytest.raises(ValueError, match="1 agents are specified for a game of 2 agents"):
        replace(experiment, agents=[DQN_AGENT])
    recipe["experiment"]["game"]["arguments"]["temptation"] = 1
    with pytest.raises(ValueError, match=r"experiment\.game: my_game:Dilemma does not take its arguments"):
        Experiment.from_recipe(recipe)


@pytest.mark.parametrize(
    "stored",
    [Custom("my_game:dilemma", arguments={"temptation": 9}), Custom("my_game:Dilemma", arguments={})],
)
def test_a_custom_that_makes_a_game_stays_the_same_text(stored):
    experiment = Experiment(name="dilemma", game=stored, agents=[DQN_AGENT] * 2, episodes=5)
    trust(stored.target)
    again = Experiment.from_recipe(as_stored(experiment.to_recipe()))
    assert again == experiment
    assert again.game == stored


def test_a_run_of_frozen_agents_is_kept_relative_to_the_run_that_has_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agents = [Frozen("runs/earlier", 0), *[DQN_AGENT] * 3]
    experiment = Experiment(name="frozen", game=presets.game("commons"), agents=agents, episodes=1)
    recipe = as_stored(experiment.to_recipe("runs/later"))
    assert recipe["experiment"]["agents"][0]["run"] == "../earlier"
    assert Experiment.from_recipe(recipe, directory="runs/later") == experiment
    (tmp_path / "runs").mkdir()
    monkeypatch.chdir(tmp_path / "runs")
    seen = Experiment.from_recipe(recipe, directory="later")
    assert seen.agents[0] == Frozen("earlier", 0)


def test_a_published_game_with_institutions_is_no_published_game():
    game = presets.game("commons", variant="as_run")
    assert presets.variant_of(game) == "as_run"
    assert presets.variant_of(replace(game, institutions=(Tax(),))) is None
