"""An experiment is a value: its recipe says all of it, and gives it back."""

import json
from dataclasses import replace

import pytest
from my_game import Callback, Dilemma

from cprl import presets
from cprl.algorithms import DQN, PPO, QMIX, DQNSettings, RolloutSettings, Tabular, TabularSettings
from cprl.experiment import Experiment, changes
from cprl.institutions import Tax
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.values import Custom

DQN_AGENT = Learning(DQN(settings=DQNSettings()))
EXPERIMENT = Experiment(
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
    recipe = as_stored(EXPERIMENT.to_recipe())
    assert (recipe["format"], recipe["recipe"]) == (2, "mixed")
    again = Experiment.from_recipe(recipe, allow=OWN)
    assert again == EXPERIMENT
    assert hash(again) == hash(EXPERIMENT)
    assert again.agents == EXPERIMENT.agents
    assert again.to_recipe() == EXPERIMENT.to_recipe()
    other = replace(EXPERIMENT, seed=1)
    assert other != EXPERIMENT
    assert changes(EXPERIMENT, other) == ["experiment.seed was 0, is 1"]


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
        replace(EXPERIMENT, **change)


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
    again = Experiment.from_recipe(recipe, allow=["my_game:Dilemma"])
    assert again.game == game
    assert again == experiment
    with pytest.raises(ValueError, match="1 agents are specified for a game of 2 agents"):
        replace(experiment, agents=[DQN_AGENT])
    recipe["experiment"]["game"]["arguments"]["temptation"] = 1
    with pytest.raises(ValueError, match=r"experiment\.game: my_game:Dilemma does not take its arguments"):
        Experiment.from_recipe(recipe, allow=["my_game:Dilemma"])


@pytest.mark.parametrize(
    "stored",
    [Custom("my_game:dilemma", arguments={"temptation": 9}), Custom("my_game:Dilemma", arguments={})],
)
def test_a_custom_that_makes_a_game_stays_the_same_text(stored):
    experiment = Experiment(name="dilemma", game=stored, agents=[DQN_AGENT] * 2, episodes=5)
    again = Experiment.from_recipe(as_stored(experiment.to_recipe()), allow=[stored.target])
    assert again == experiment
    assert again.game == stored


def test_a_game_that_no_recipe_can_name_is_refused():
    class Local(Dilemma):
        pass

    with pytest.raises(ValueError, match=r"experiment\.game is a .*Local"):
        Experiment(name="local", game=Local(), agents=[DQN_AGENT] * 2, episodes=1)


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
