"""What an experiment names works everywhere: training, stop, resume, evaluation, film, from its recipe."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from own_experiment import MEADOW, REPLAY
from own_parts import Dilemma
from same_runs import assert_same_training
from stored_runs import episodes_of

import cprl
from cprl import Custom, Experiment, Observation, maps
from cprl.algorithms import DQN, PPO, QMIX, RolloutSettings
from cprl.commands import main as cli
from cprl.evaluation.film import record_episode
from cprl.networks import GRU
from cprl.objectives.rewards import Exchange
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.runs.checkpoints import checkpoints_in
from cprl.runs.episodes import read_episodes
from cprl.runs.weights import load_weights
from cprl.system.shipped import cprl_command

ALLOW = (
    *(f"own_parts:{name}" for name in ("Bored", "Fatigue", "largest_share")),
    "torchrl.envs.transforms:RewardScaling",
)


@pytest.fixture(scope="module")
def in_one_go(tmp_path_factory):
    return cprl.run(MEADOW, tmp_path_factory.mktemp("whole") / "run", watch="off")


@pytest.mark.integration
def test_an_experiment_with_parts_of_its_own_is_stopped_resumed_evaluated_and_filmed(
    in_one_go, stopped, tmp_path, monkeypatch, capsys
):
    run = stopped(71, MEADOW, tmp_path / "run")
    told = capsys.readouterr().out
    flags = " ".join(f"--allow {target}" for target in ALLOW)
    assert f"To resume: {' '.join(cprl_command())} run {run} --resume {flags}" in told
    assert len(checkpoints_in(run / "checkpoints")) == 1
    monkeypatch.setattr("sys.argv", ["cprl", "run", str(run), "--resume", *flags.split(), "--watch", "off"])
    cli.main()
    assert_same_training(run, in_one_go, ("final", "transforms"))
    cprl.trust(*ALLOW)
    tables = [cprl.evaluate_run(each, cprl.Fresh(episodes=2)) for each in (run, in_one_go)]
    assert repr(tables[0].to_pydict()) == repr(tables[1].to_pydict())
    assert cprl.load(run).experiment == MEADOW
    recording, episode = record_episode(run)
    assert episode.steps <= 20
    assert re.fullmatch(r"film-\d-\d\.rrd", recording.name), "a typical episode"
    assert (run / recording.name).stat().st_size > 10_000


@pytest.mark.integration
def test_what_a_callback_writes_into_learning_is_logged(tmp_path):
    log = Custom("torchrl.record.loggers:CSVLogger", arguments={"exp_name": "own", "log_dir": str(tmp_path)})
    cprl.run(replace(MEADOW, loggers=[log]), tmp_path / "run", watch="off")
    lines = (tmp_path / "own/scalars/bored/episodes.csv").read_text().split()
    assert [line.split(",")[0] for line in lines] == [str(number) for number in range(6)]
    assert lines[0] == "0,1.5", "the mean of the first and the second"


def test_the_reward_is_what_the_transforms_make_of_it_and_the_harvest_is_not(in_one_go):
    table = read_episodes(in_one_go).to_pydict()
    bitten = [(own, paid) for own, paid in zip(table["harvest"], table["return"], strict=True) if own]
    assert bitten
    assert all(0 < paid < own / 2 for own, paid in bitten), "halved, and less with every step"
    cprl.trust(*ALLOW)
    evaluated = cprl.evaluate_run(in_one_go, cprl.Fresh(episodes=2))
    steps = load_weights(in_one_go / "checkpoints" / "transforms.pt")
    (fatigue,) = [float(value) for name, value in steps.items() if name.endswith("steps")]
    assert fatigue >= 6 * 20 - 20, "as many as were played"
    both = [episodes_of(evaluated, name, policy="trained")[0] for name in ("return", "harvest")]
    for paid, bitten in zip(*both, strict=True):
        assert sum(paid) <= sum(bitten) / 2 / (1 + 0.01 * fatigue)


def test_no_command_imports_what_is_not_allowed(in_one_go, monkeypatch, capsys):
    for words in (["evaluate"], ["film"], ["run"], ["crossplay", str(in_one_go)]):
        monkeypatch.setattr("sys.argv", ["cprl", words[0], str(in_one_go), *words[1:]])
        with pytest.raises(SystemExit, match=r"own_parts:Bored.*--allow"):
            cli.main()
    cprl.trust(*ALLOW[:1])
    with pytest.raises(ValueError, match="own_parts:Fatigue"):
        cprl.load(in_one_go)


DILEMMA = Experiment(
    name="dilemma",
    game=Dilemma(steps=5),
    agents=[
        Learning(DQN(settings=replace(REPLAY, hidden_cells=(8,))), reward=Exchange(0.25)),
        Learning(PPO(settings=RolloutSettings(rollout_steps=10, minibatch_size=5, hidden_cells=(8,)))),
    ],
    replicas=2,
    episodes=8,
    evaluation_episodes=3,
    engine="eager",
)
DILEMMA_ALLOW = ("own_parts:Dilemma",)


@pytest.mark.integration
def test_a_matrix_game_is_trained_stopped_resumed_evaluated_and_cross_played(tmp_path, stopped, capsys):
    experiment = replace(DILEMMA, callbacks=MEADOW.callbacks)
    whole = cprl.run(experiment, tmp_path / "whole")
    assert "left out" in capsys.readouterr().out
    stopped(23, experiment, tmp_path / "parts")
    parts = cprl.run(experiment, tmp_path / "parts", resume=True)
    allow = (*DILEMMA_ALLOW, "own_parts:Bored")
    assert_same_training(parts, whole)
    assert "harvest" not in read_episodes(whole).column_names
    rows = read_episodes(whole).to_pylist()
    for first, second in zip(rows[::2], rows[1::2], strict=True):
        assert first["wanted_return"] == pytest.approx(0.75 * first["return"] + 0.25 * second["return"])
    cprl.trust(*allow)
    loaded = cprl.load(whole)
    assert loaded.experiment == experiment
    found = cprl.estimates(cprl.evaluate_run(loaded, cprl.Fresh(episodes=4)), "agent_0/return", by="policy")
    assert 5 <= found["trained", "agent_0/return"].value <= 4.5 * 9
    other = cprl.run(replace(DILEMMA, seed=9), tmp_path / "other", watch="off")
    played = cprl.crossplay([loaded, cprl.load(other)], cprl.Fresh(episodes=2))
    levels = cprl.estimates(played, "focal/return", by=("focal", "background"))
    assert len(levels) == 4
    assert levels["whole", "other", "focal/return"].replicas
    record_episode(whole)


FLAT = Custom(
    "torchrl.envs.transforms:FlattenObservation",
    arguments={"first_dim": -3, "last_dim": -1, "in_keys": [["agents", "observation"]]},
)


@pytest.mark.integration
def test_scripted_policies_that_read_a_window_are_refused_where_there_is_none():
    with pytest.raises(ValueError, match=r"Scripted\('greedy'\) reads the window of a"):
        cprl.run(replace(DILEMMA, agents=[Scripted("greedy"), Scripted()]), "never")
    for agents, message in (
        ([Scripted("greedy"), Scripted()], "reads the window of the game; transforms make"),
        (MEADOW.agents, "Conv"),
    ):
        with pytest.raises(ValueError, match=message):
            cprl.run(replace(MEADOW, agents=agents, transforms=[FLAT]), "never")
    assert not Path("never").exists()


NORM = Custom(
    "torchrl.envs.transforms:ObservationNorm",
    arguments={"loc": 100.0, "scale": 50.0, "standard_normal": True, "in_keys": [["agents", "observation"]]},
)
FLOATS = {"observation_dtype": "float32", "observation_scale": 1.0}


@pytest.mark.integration
@pytest.mark.parametrize(
    ("transform", "agent", "spaces"),
    [
        (FLAT, Learning(DQN(settings=REPLAY)), {"observation_shape": (45,)}),
        *((NORM, agent, FLOATS) for agent in (MEADOW.agents[0], DILEMMA.agents[1])),
    ],
)
def test_what_transforms_make_of_observations_is_learned_from_and_evaluated(
    transform, agent, spaces, tmp_path
):
    changes = {"transforms": [transform], "callbacks": (), "loggers": (), "episodes": 2}
    run = cprl.run(replace(MEADOW, agents=[agent] * 2, **changes), tmp_path / "run", watch="off")
    cprl.trust(transform.target, *ALLOW)
    loaded = cprl.load(run)
    assert {name: getattr(loaded.spaces, name) for name in spaces} == spaces
    assert len(cprl.evaluate_run(loaded, cprl.Fresh(episodes=1)))


@pytest.mark.integration
@pytest.mark.parametrize("of_agent", ["convolutions", "memory", "team"])
def test_planes_are_learned_from_through_stop_resume_and_evaluation(of_agent, tmp_path, stopped, monkeypatch):
    rollouts = RolloutSettings(rollout_steps=10, minibatch_size=5)
    agents = {
        "convolutions": MEADOW.agents,
        "memory": [Learning(PPO(settings=rollouts, network=GRU(recurrent_cells=4)))] * 2,
        "team": [Team(QMIX(settings=REPLAY), (0, 1))],
    }
    planes = Observation(scoreboard=True, stock_gauge=True)
    experiment = replace(
        MEADOW,
        game=replace(MEADOW.game, observation=planes),
        agents=agents[of_agent],
        transforms=(),
        callbacks=[Custom("own_parts:Bored", arguments={"from_episode": 99, "epsilon": 0.4})],
        episodes=4,
    )
    whole = cprl.run(experiment, tmp_path / "whole", watch="off")
    stopped(33, experiment, tmp_path / "parts")
    parts = cprl.run(experiment, tmp_path / "parts", watch="off", resume=True)
    assert_same_training(parts, whole)
    cprl.trust(*ALLOW)
    loaded = cprl.load(parts)
    assert loaded.experiment == experiment
    assert loaded.spaces.observation_shape == (5, 3, 5)
    assert set(cprl.evaluate_run(loaded, cprl.Fresh(episodes=1))["replica"].to_pylist()) == {0, 1}
    monkeypatch.chdir(tmp_path)
    three = replace(experiment.game, map=maps.with_agents(MEADOW.game.map, 3))
    others = {"have observations": MEADOW.game, "have a scoreboard of so many agents: 2": three}
    for message, game in others.items():
        with pytest.raises(ValueError, match=message):
            cprl.run(replace(experiment, game=game, agents=[Frozen("whole", 1)] * game.agents), "other")


@pytest.mark.integration
def test_an_experiment_with_torchrls_own_engine_is_stopped_and_resumed(tmp_path, stopped):
    experiment = replace(
        MEADOW,
        agents=[Learning(DQN(settings=replace(REPLAY, hidden_cells=(8,)))), Scripted("greedy")],
        transforms=(),
        loggers=(),
        engine="torchrl",
        episodes=3,
    )
    whole = cprl.run(experiment, tmp_path / "whole", watch="off")
    stopped(33, experiment, tmp_path / "parts")
    parts = cprl.run(experiment, tmp_path / "parts", watch="off", resume=True)
    assert_same_training(parts, whole)
