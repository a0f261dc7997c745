"""Every field of every class of values refuses what it cannot be, by its name; sizes too, before they are
allocated."""

import json
from collections import UserDict
from dataclasses import dataclass, fields, replace
from functools import partial
from types import MappingProxyType

import numpy as np
import pytest
import torch

from cprl import Custom, Experiment, Observation, Rules, presets
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
from cprl.checks import MOST_NESTED, plain
from cprl.commands.recipe import parse, recipe_main
from cprl.config import KINDS, from_config, to_config
from cprl.envs.matrix import prisoners_dilemma
from cprl.envs.taking import TakingGame
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
from cprl.learners.settings import Exploring
from cprl.networks import GRU, LSTM, MLP, Conv, ConvNetwork, MLPNetwork
from cprl.networks.specification import new_network
from cprl.policies.rng import LaneRng
from cprl.population import Frozen, Learning, Scripted, Team, specs_by_agent
from cprl.runs.files import read_json
from cprl.runs.recipe import read_recipe
from cprl.system.memory import TooLargeError
from cprl.theory import PowerWorth, appropriation, herders
from cprl.training.collectors import stock_collector
from cprl.training.running import run

GAME = presets.game("two_complex")
REPLAY, ROLLOUTS, TABLES, LOOKS = DQNSettings(), RolloutSettings(), TabularSettings(), LOLASettings()
SPACES = GAME.spaces
EXPERIMENT = Experiment(name="mine", game=GAME, agents=[Scripted()] * 2, episodes=1)
INSTITUTIONS = [
    Boundaries(regions=("0.", ".1")),
    *(Quota(), ClosedSeason(), ClosedPatches(), Tax(), Levies(groups=((0,), (1,))), Vote(on=Tax())),
    *(Monitoring(), GraduatedSanctions(), Mediation(), Sanctioner()),
]
VALUES = [
    Rules(),
    Observation(),
    Exploring(),
    *(REPLAY, ROLLOUTS, TABLES),
    *(MLP(), Conv(), GRU(), LSTM(), SPACES),
    prisoners_dilemma(turns=9),
    *(herders(2, cost=2.0), PowerWorth(), TakingGame(appropriation(), most=3.0, turns=9)),
    *(kind(settings=REPLAY) for kind in (DQN, DistributionalDQN, CQL, SAC, IQL, PR2, VDN, QMIX, MADDPG)),
    *(kind(settings=ROLLOUTS) for kind in (PPO, A2C, Reinforce, MAPPO, IPPO)),
    LOOKS,
    LOLA(settings=LOOKS),
    Tabular(settings=TABLES),
    Bandit(),
    Learning(DQN(settings=REPLAY)),
    Team(QMIX(settings=REPLAY), agents=(0, 1)),
    InequityAversion(alpha=5, beta=0.05, smoothing=0.9),
    SocialValueOrientation(angle=0.5, weight=1.0),
    Exchange(0.5),
    Scripted(),
    Frozen("runs/earlier", 0),
    Custom("a:b"),
    *INSTITUTIONS,
    EXPERIMENT,
]
FIELDS = [
    pytest.param(value, own.name, id=f"{type(value).__name__}.{own.name}")
    for value in VALUES
    for own in fields(value)
]
NAN, INF = float("nan"), float("inf")
WRONG = (
    NAN,
    INF,
    -INF,
    -1,
    -0.5,
    2**70,
    10**400,
    10**5000,
    object(),
    b"3",
    {3: 4},
    {"a"},
    torch.nn.ReLU(),
    int,
)
NEVER = (
    *WRONG,
    *(np.float64(NAN), np.array(["x", "y"]), np.longdouble(1), torch.tensor(INF)),
    *("3", "yes", "\ud800", "a\0b"),
    *([], [[]], [NAN], ["x"], [None], [object()], 1.9),
    complex(1, 2),
)
SETTINGS = ("DQNSettings", "RolloutSettings", "LOLASettings")
ALLOWED = {
    ("Frozen", "run"): ("3", "yes"),
    ("Experiment", "name"): ("3", "yes"),
    **{("Experiment", name): ([], ()) for name in ("transforms", "callbacks", "loggers")},
    **{("Spaces", name): ([], ()) for name in ("vectors", "observation_shape")},
    **{(kind, "hidden_cells"): ([], ()) for kind in (*SETTINGS, "MLP", "Conv")},
    ("DQNSettings", "replay_transforms"): ([], ()),
    ("DistributionalDQN", "lowest_return"): (-1, -0.5, 1.9),
    ("Spaces", "observation_scale"): (1.9,),
    **{("SharingGame", name): (1.9,) for name in ("cost", "most_each")},
    ("SharingGame", "payment"): (-1, -0.5, 1.9),
    **{("PowerWorth", name): (1.9,) for name in ("top", "factor", "power")},
    ("TakingGame", "most"): (1.9,),
    ("Rules", "regrow_radius_cells"): (1.9,),
    ("Boundaries", "regions"): (["x"], ["x", "y"]),
    ("Boundaries", "owners"): (["x"], ["x", "y"]),
    ("Tax", "brackets"): ([],),
    **{(kind, "fine"): (1.9,) for kind in ("Quota", "ClosedSeason", "ClosedPatches")},
    **{("Boundaries", name): (1.9,) for name in ("bite_fine", "step_fine")},
    **dict.fromkeys((("Quota", "share"), ("Mediation", "refund")), (1.9,)),
    ("Monitoring", "cost"): (1.9,),
    ("RolloutSettings", "max_grad_norm"): (1.9,),
    **{(kind, "learning_rate"): (1.9,) for kind in SETTINGS},
    **{
        ("LOLASettings", name): (1.9,)
        for name in ("look_ahead_rate", "max_grad_norm", "critic_learning_rate")
    },
    ("LOLA", "entropy_coeff"): (1.9,),
    **{("SAC", name): (1.9,) for name in ("alpha_init",)},
    **{(kind, "temperature"): (1.9,) for kind in ("IQL", "PR2")},
    **{("InequityAversion", name): (1.9,) for name in ("alpha", "beta")},
    ("SocialValueOrientation", "angle"): (-1, -0.5, 1.9),
    ("SocialValueOrientation", "weight"): (1.9,),
    ("DistributionalDQN", "highest_return"): (1.9,),
    ("CQL", "conservative_weight"): (1.9,),
    ("MADDPG", "logit_penalty"): (1.9,),
    **{
        (kind, name): (1.9,)
        for kind in ("PPO", "A2C", "MAPPO", "IPPO")
        for name in ("entropy_coeff", "critic_coeff")
    },
}
"""What fits a field although it fits hardly any other."""
OPTIONAL = {"tau", "max_grad_norm", "network", "start_from", "replica", "decisions"}
OPTIONAL |= {"owners", "bite_fine", "step_fine", "fine", "monitor", "recovery_steps"}
OPTIONAL_OF = {("Sanctioner", "agents"), ("MatrixGame", "memory"), ("SharingGame", "most_each")}
OPTIONAL_OF |= {("TakingGame", name) for name in ("levels", "most", "memory")}


@pytest.mark.parametrize(("value", "field"), FIELDS)
def test_every_field_refuses_what_it_cannot_be_by_its_name(value, field):
    name = "experiment" if isinstance(value, Experiment) else type(value).__name__
    allowed = ALLOWED.get((type(value).__name__, field), ())
    is_optional = field in OPTIONAL or (type(value).__name__, field) in OPTIONAL_OF
    for wrong in (*NEVER, *([] if is_optional else [None])):
        if any(type(plain(wrong)) is type(plain(own)) and plain(wrong) == plain(own) for own in allowed):
            replace(value, **{field: wrong})
            continue
        with pytest.raises(ValueError, match=rf"^{name}\.{field}\b") as refused:
            replace(value, **{field: wrong})
        assert "\n" not in str(refused.value)
        assert len(str(refused.value)) < 700


def test_every_kind_that_a_recipe_holds_is_tried():
    tried = {type(value) for value in VALUES}
    assert {kind for kind in KINDS.values() if kind not in tried} == {type(GAME), type(GAME.map)}


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


def test_numbers_are_stored_exactly_and_never_rounded():
    settings = DQNSettings(batch_size=np.int64(3), gamma=np.float32(0.5), tau=1, hidden_cells=range(4, 7))
    assert (settings.batch_size, settings.gamma, settings.tau) == (3, 0.5, 1)
    assert settings.hidden_cells == (4, 5, 6)
    assert to_config(settings)["batch_size"] == 3
    for wrong in (1.9, 2.0, np.float64(2), True, np.array([2]), "2"):
        with pytest.raises(ValueError, match=r"DQNSettings\.batch_size"):
            DQNSettings(batch_size=wrong)


def test_an_unknown_keyword_is_pythons_own_type_error():
    with pytest.raises(TypeError, match="gama"):
        DQNSettings(gama=0.9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (partial(PPO, settings=REPLAY), r"^PPO\.settings is a DQNSettings; allowed: a RolloutSettings"),
        (partial(Tabular, settings=None), r"^Tabular\.settings is None; allowed: a TabularSettings"),
        (partial(DQN, settings=DQNSettings), r"^DQN\.settings is the class DQNSettings; allowed: a DQNSett"),
        (
            partial(DQN, settings=REPLAY, network=torch.nn.Linear(1, 1)),
            r"network is a Linear; allowed: MLP, ",
        ),
        (
            partial(DistributionalDQN, settings=REPLAY, highest_return=0.0),
            r"highest_return is 0\.0; allowed: above lowest_return, 0\.0",
        ),
        (
            partial(DistributionalDQN, settings=REPLAY, lowest_return=1e8, highest_return=1e8 + 9),
            r"so far that float32 tells 51 atoms apart",
        ),
        (
            partial(RolloutSettings, rollout_steps=1, minibatch_size=1),
            r"rollout_steps is 1; allowed with nor",
        ),
        (partial(RolloutSettings, minibatch_size=7), r"RolloutSettings\.minibatch_size is 7; it must divide"),
        (partial(DQNSettings, adam_eps=1e-50), r"adam_eps is 1e-50; allowed: a number in 1e-30\.\.1"),
        (partial(Team, QMIX(settings=REPLAY), agents=3), r"^Team\.agents is 3; allowed: ascending agent ind"),
        (partial(Team, QMIX(settings=REPLAY), agents="01"), r"^Team\.agents is '01'"),
        (partial(Frozen, "runs/a", agent="0"), r"^Frozen\.agent is '0'; allowed: an integer in 0"),
        (partial(Frozen, "", 0), r"^Frozen\.run is ''; allowed: the path"),
        (partial(Frozen, "a" * 5000, 0), r"^Frozen\.run is 'aaa"),
        (partial(Scripted, "Greedy"), r"^Scripted\.policy is 'Greedy'; allowed: 'random', "),
        (partial(Learning, DQN), r"^Learning\.algorithm is the class DQN; allowed: a Algorithm|an Algorithm"),
        (partial(presets.game, 3), r"^board is 3; allowed: 'single_basic', "),
        (partial(presets.game, "commons", variant="pirated"), r"^variant is 'pirated'; allowed: 'published'"),
        (partial(presets.dqn_settings, ["commons"]), r"^board is \('commons',\); allowed: 'single_basic', "),
        (
            partial(MLPNetwork, (3, 0), 2),
            r"^observation_shape is \(3, 0\); allowed: a tuple of 1 or more",
        ),
        (partial(MLPNetwork, (3, 2), 1.5), r"^outputs is 1\.5; allowed: an integer in 1"),
        (partial(ConvNetwork, (3, 2), 2), r"^observation_shape is \(3, 2\); allowed: a tuple of 3 or more"),
        (partial(ConvNetwork, (3, 2, 2), 2, kernel_cells=2), r"^kernel_cells is 2; allowed: 1, 3, 5"),
        (partial(new_network, 3, SPACES, 2), r"^network is 3; allowed: MLP, Conv, GRU, LSTM, Custom"),
        (partial(new_network, MLP(), GAME, 2), r"^spaces is a Game; allowed: a Spaces"),
        (partial(specs_by_agent, [3], 1), r"^agents\[0\] is 3; allowed: Learning, Team, Scripted, Frozen"),
        (partial(specs_by_agent, 3, 1), r"^specs is 3; allowed: a tuple"),
        (partial(parse, lambda: 3, ["x.py"]), r"^what the recipe makes is 3; allowed: an Experiment"),
        (partial(stock_collector, None, None, steps=0), r"^steps is 0; allowed: an integer in 1"),
    ],
)
def test_what_does_not_belong_together_is_refused_in_a_sentence(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_field_of_an_algorithm_of_somebodys_own_is_their_own():
    @dataclass(frozen=True, kw_only=True)
    class Mine(DQN):
        temperature: str = "warm"

    assert Mine(settings=REPLAY).temperature == "warm"
    with pytest.raises(ValueError, match=r"^Mine\.double is 'yes'"):
        Mine(settings=REPLAY, double="yes")


@pytest.mark.parametrize(
    ("target", "arguments", "message"),
    [
        ("no colon", {}, r"^Custom\.target is 'no colon'; allowed: \"module:Class\""),
        *(
            (wrong, {}, r"^Custom\.target is ")
            for wrong in (":", "a:", ":b", ".a:b", "a..b:c", "a:b\n", "a:b c")
        ),
        ("a:b", [1], r"^Custom\.arguments is \[1\]; allowed: a table|^Custom\.arguments is \(1,\)"),
        ("a:b", {"x": NAN}, r"cannot be kept as JSON: Out of range"),
        ("a:b", {"x": object()}, r"cannot be kept as JSON: Object of type object"),
        ("a:b", {"x": {1: 2}}, r"cannot be kept as JSON: a table has the key 1; allowed: text"),
        ("a:b", {2: 2}, r"cannot be kept as JSON: a table has the key 2; allowed: text"),
        ("a:b", {"x": 10**5000}, r"cannot be kept as JSON: Exceeds"),
        ("a:b", {"x": np.float32(1)}, r"cannot be kept as JSON: Object of type float32"),
    ],
)
def test_a_custom_holds_names_and_what_json_can_hold(target, arguments, message):
    with pytest.raises(ValueError, match=message):
        Custom(target, arguments=arguments)


def test_the_arguments_of_a_custom_may_be_any_table():
    assert Custom("a:b", MappingProxyType({"x": (1, 2)})) == Custom("a:b", UserDict(x=[1, 2]))


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
    table = {**to_config(REPLAY), "hidden_cells": deep}
    for refuses in (
        lambda: Custom("a:b", arguments={"x": deep}),
        lambda: to_config(deep),
        lambda: from_config(deep),
        lambda: from_config(table),
        lambda: Experiment.from_config({"name": deep}),
        lambda: Experiment.from_recipe({"format": 2, "experiment": {"name": deep}}),
    ):
        with pytest.raises(ValueError, match=rf"(nested more than {MOST_NESTED} deep|entries); allowed: "):
            refuses()
    for refuses in (lambda: DQNSettings(hidden_cells=deep), lambda: Rules(regrow_prob=deep)):
        with pytest.raises(ValueError, match=r"^(DQNSettings\.hidden_cells|Rules\.regrow_prob) is "):
            refuses()


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000 + "]" * 100_000,
        '{"experiment": ' + '{"a":' * 100_000 + "1" + "}" * 100_001,
        '{"experiment": {"a": ' + "[" * 300 + "]" * 300 + "}}",
        '{"experiment": {"a": ' + "9" * 5000 + "}}",
        '{"experiment": ',
        "3",
        "null",
        '{"experiment": {}}\0',
    ],
    ids=["deep list", "deep table", "rather deep", "many digits", "cut", "a number", "null", "a NUL"],
)
def test_a_recipe_that_cannot_be_read_is_refused_with_its_path(text, tmp_path):
    path = tmp_path / "recipe.json"
    path.write_text(text)
    for read in (read_recipe, read_json):
        with pytest.raises(ValueError, match=r"recipe\.json (is not|holds)"):
            read(path)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("seed",), 1e400, r"^experiment\.seed is inf; allowed: a finite number"),
        (("seed",), 10**30, r"^experiment: experiment\.seed is 1000000000000000000000000000000; allowed"),
        (("game", "rules", "episode_steps"), 10**400, r"^experiment\.game\.rules: Rules\.episode_steps is "),
        (("agents",), {}, r"^experiment\.agents is a table without \"kind\""),
        (("agents", 0), [], r"^experiment(\.agents\[0\]|\.agents) is "),
        (("agents", 0, "policy"), "\ud800", r"^experiment\.agents\[0\]\.policy is '.ud800'"),
        (("agents", 0, "kind"), None, r"^experiment\.agents\[0\]\.kind is None"),
        (("agents", 0, "kind"), {}, r"^experiment\.agents\[0\]\.kind is "),
        (("game",), None, r"^experiment\.game is None"),
        (("game", "map"), 3, r"^experiment\.game\.map is 3"),
        (("device",), "\0", r"^experiment: experiment\.device is "),
    ],
)
def test_hostile_tables_are_refused_by_the_place(place, value, message):
    table = json.loads(json.dumps(EXPERIMENT.to_config()))
    inner = table
    for step in place[:-1]:
        inner = inner[step]
    inner[place[-1]] = value
    with pytest.raises(ValueError, match=message):
        Experiment.from_config(table)


def test_hostile_recipes_are_refused_in_a_sentence():
    for recipe in (
        3,
        None,
        [],
        {},
        {"recipe": "old", "arguments": {}},
        {"format": [2]},
        {"format": 2, "experiment": []},
    ):
        with pytest.raises(ValueError, match=r"^the recipe "):
            Experiment.from_recipe(recipe)


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        "a/b",
        "a\\b",
        "a\nb",
        "a\0b",
        "\ud800",
        "a" * 201,
        "ä" * 101,
        "CON",
        "nul.txt",
        "a ",
        "a.",
    ],
)
def test_a_name_is_that_of_a_directory_anywhere(name):
    with pytest.raises(ValueError, match=r"^experiment\.name is .*; allowed: the name of a directory"):
        replace(EXPERIMENT, name=name)


@pytest.mark.parametrize("name", ["commons", "gamma 0.9, two runs", "größe", ".hidden", "a" * 200, "console"])
def test_other_names_are_names(name):
    assert replace(EXPERIMENT, name=name).name == name


@pytest.mark.parametrize("device", ["meta", "cuda:300", "cuda:-1", "", "gpu", "cpu "])
def test_a_device_is_one_that_torch_takes_as_it_is(device):
    with pytest.raises(ValueError, match=r"^experiment\.device is "):
        replace(EXPERIMENT, device=device)


class Strange:
    """A game of somebody's own whose number of agents is none."""

    agents = 1.5

    def to_config(self):
        return {}

    def make(self, worlds, seed, device):
        raise AssertionError


def test_games_that_cannot_be_played_are_refused_in_a_sentence():
    for game, message in (
        (type(GAME), "is the class Game"),
        (Strange(), r"agents is 1\.5"),
        (Strange, "the class"),
    ):
        with pytest.raises(ValueError, match=rf"^experiment\.game.*{message}"):
            replace(EXPERIMENT, game=game)
    with pytest.raises(ValueError, match=r"^experiment\.evaluation_episodes is 8192; allowed for 1024 repl"):
        replace(EXPERIMENT, replicas=1024, evaluation_episodes=8192)


HOW = {"agents": (0, 1), "replicas": 1, "engine": "eager"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agents": ()}, r"^agents is \(\); allowed: one or more of the agents 0 to 1, each once"),
        ({"agents": (0, 2)}, r"^agents is \(0, 2\)"),
        ({"agents": (0, 0)}, r"^agents is \(0, 0\)"),
        ({"agents": 0}, r"^agents is 0"),
        ({"replicas": 0}, r"^replicas is 0; allowed: an integer in 1"),
        ({"reward_kind": "group"}, r"^reward_kind is 'group'; allowed: 'individual', 'team'"),
    ],
)
@pytest.mark.parametrize(
    "algorithm", [DQN(settings=REPLAY), PPO(settings=ROLLOUTS), Tabular(settings=TABLES)]
)
def test_learners_refuse_agents_and_replicas_that_there_cannot_be(algorithm, changes, message):
    with pytest.raises(ValueError, match=message):
        algorithm.make_learner(SPACES, **{**HOW, **changes})


WIDE = (2**16,) * 64
MANY = {**HOW, "replicas": 2**20}


@pytest.mark.parametrize(
    ("algorithm", "how", "message"),
    [
        (
            DQN(settings=DQNSettings(buffer_size=2**40 - 1)),
            HOW,
            r"replay buffers of 2 \w+ x 1,099,511,627,775 ",
        ),
        (
            DQN(settings=DQNSettings(batch_size=2**31 - 1)),
            HOW,
            r"replay buffers .* a smaller buffer_size or b",
        ),
        (
            DQN(settings=DQNSettings(hidden_cells=WIDE)),
            HOW,
            r"270,\d+,\d+,\d+ weights of a network .*smaller layers",
        ),
        (
            DQN(settings=REPLAY, network=Conv(channels=WIDE)),
            HOW,
            r"weights of a network .*: use smaller layers",
        ),
        (
            DQN(settings=DQNSettings(hidden_cells=WIDE[:1])),
            {**HOW, "replicas": 200},
            r"networks of 400 learners, ",
        ),
        (DQN(settings=REPLAY), MANY, r"1048576 replicas of 2 agents take .*: use fewer replicas"),
        (
            PPO(settings=RolloutSettings(rollout_steps=2**28, minibatch_size=1)),
            HOW,
            r"(rollouts of 2 learners x 268,435,456 steps|random numbers of 2 agents, 268,435,456 a step)",
        ),
    ],
)
@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_what_no_memory_has_is_refused_before_it_is_allocated(algorithm, how, engine, message, monkeypatch):
    for place in ("system.memory", "learners.ring"):
        monkeypatch.setattr(f"cprl.{place}.free_bytes", lambda device="cpu": 2 * 2**30)
    with pytest.raises(TooLargeError, match=message) as refused:
        algorithm.make_learner(SPACES, **{**how, "engine": engine})
    assert " GiB; 2.00 GiB are free: use " in str(refused.value)


def test_tables_of_too_many_agents_are_refused_too(monkeypatch):
    monkeypatch.setattr("cprl.system.memory.free_bytes", lambda device="cpu": 2 * 2**30)
    with pytest.raises(TooLargeError, match="1048576 replicas of 2 agents take 8"):
        Tabular(settings=TABLES).make_learner(SPACES, **MANY)


def test_an_evaluation_that_no_memory_has_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr("cprl.system.memory.free_bytes", lambda device="cpu": 50 * 2**20)
    with pytest.raises(TooLargeError, match=r"random numbers of 2 agents, .* fewer evaluation episodes"):
        run(replace(EXPERIMENT, evaluation_episodes=1000), tmp_path / "run", watch="off")
    assert list(tmp_path.iterdir()) == []


def test_the_refusal_of_what_is_too_large_is_a_value_error_and_a_memory_error():
    assert issubclass(TooLargeError, ValueError)
    assert issubclass(TooLargeError, MemoryError)
    with pytest.raises(TooLargeError, match=r"^random numbers of 2 agents, 2,147,483,647 a .* take 65,5"):
        LaneRng([(0,), (1,)], 2**31 - 1)


@pytest.mark.parametrize(
    "line",
    [
        "--seed -1",
        "--seed 1.9",
        "--replicas 0",
        "--name a/b",
        "--game.rules.freeze-steps 1.5",
        "--agents.0.algorithm.settings.gamma nan",
        *(
            pytest.param(line, marks=pytest.mark.slow)
            for line in (
                "--seed 99999999999999999999999",
                "--seed nan",
                f"--seed {'9' * 5000}",
                "--replicas 3000000",
                "--episodes 1e3",
                "--evaluation-episodes 0",
                "--name CON",
                "--device meta",
                "--update-every 0",
                "--game.rules.regrow-prob nan",
                "--game.rules.regrow-prob",
                "--agents.0.algorithm.settings.gamma inf",
                "--agents.0.algorithm.settings.hidden-cells 0",
                "--agents.0.algorithm.settings.learning-rate 0",
                "--agents.0.algorithm.settings.buffer-size -5",
                "--agents.0.algorithm.settings.tau 2",
                "--agents.0.algorithm.loss-function l3",
                "--board 3",
            )
        ),
    ],
)
def test_a_command_line_that_cannot_be_is_refused_in_a_sentence(line, capsys):
    def recipe(*, board: str = "two_complex") -> Experiment:
        dqn = Learning(DQN(settings=REPLAY))
        return Experiment(name="mine", game=presets.game(board), agents=[dqn] * 2, episodes=1)

    with pytest.raises(SystemExit) as refused:
        recipe_main(recipe, ["recipes/mine.py", *line.split()])
    assert refused.value.code not in (0, None)
    said = str(refused.value.code) + "".join(capsys.readouterr())
    assert "Traceback" not in said
    assert line.split()[0].strip("-").split(".")[-1].replace("-", "_") in said.replace("-", "_")
