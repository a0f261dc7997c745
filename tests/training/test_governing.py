"""A governor decides and learns beside the agents: at its own clock, and the same after a stop."""

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from recordings import column
from same_runs import differences
from tiny_study import GAME, LEARNING, TINY

import cprl
from cprl import keys
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.evaluation.cross_play import crossplay
from cprl.evaluation.film import record_episode
from cprl.evaluation.populations import play_population
from cprl.institutions import Governor, Quota, Tax
from cprl.policies.governors import Constant, StockRule
from cprl.population import Frozen, Learning, Scripted
from cprl.runs.episodes import read_episodes
from cprl.studies import Study
from cprl.system.defaults import Fresh
from cprl.training.evaluating import make_agents
from cprl.training.nan_check import NotFiniteError
from cprl.training.training import Training

GOVERNOR = Governor(sets="tax.rate", options=(0.0, 0.5, 1.0), every_steps=5)
GOVERNED = replace(GAME, institutions=(Tax(), GOVERNOR))
BY_PPO = Learning(PPO(settings=RolloutSettings(rollout_steps=2, minibatch_size=4, hidden_cells=(4,))))
BY_DQN = Learning(DQN(settings=DQNSettings(hidden_cells=(4,), learning_starts=4, epsilon_decay_steps=20)))
EXPERIMENT = replace(
    TINY, game=GOVERNED, agents=(LEARNING, LEARNING), worlds=2, episodes=None, steps=80, replicas=2
)
QUIET = {"watch": "off"}


def training_of(experiment, *callbacks):
    env, population = make_agents(experiment)
    return Training(
        env,
        population.learners,
        experiment.schedule,
        others=population.others,
        governor=population.governor,
        callbacks=callbacks,
    )


class Onlooker:
    """A callback that gets every turn."""

    def __init__(self, on_step):
        self.on_step = on_step


@pytest.mark.parametrize("governor", [BY_PPO, BY_DQN])
def test_a_governor_learns_from_one_transition_of_each_world_and_period(governor):
    training = training_of(replace(EXPERIMENT, governor=governor))
    learner = training.governor.learner
    before = {name: network.state_dict() for name, network in learner.networks().items()}
    assert set(before) == {"replica_0/agent_2", "replica_1/agent_2"}
    training.run()  # 40 turns: 8 periods
    assert learner.steps == 8 * 2
    for name, network in learner.networks().items():
        changed = [not torch.equal(weight, before[name][key]) for key, weight in network.state_dict().items()]
        assert any(changed), name


def test_a_reward_is_the_objective_of_the_turns_up_to_the_first_end():
    incomes, ends, stored = [], [], []

    def note(batch):
        incomes.append(batch["next", keys.REWARD][..., 0].sum(-1).numpy())
        ends.append(batch["next", keys.DONE][:, 0].numpy())

    training = training_of(replace(EXPERIMENT, governor=BY_DQN, replicas=1), Onlooker(note))
    learner = training.governor.learner
    store = learner.store
    learner.store = lambda batch: (stored.append(batch), store(batch))
    for _ in range(20):
        training.step()
    assert len(stored) == 4
    for number, period in enumerate(stored):
        turns = slice(5 * number, 5 * number + 5)
        ended = np.array(ends[turns])
        counts = np.cumsum(ended, 0) - ended == 0
        wanted = (np.array(incomes[turns]) * counts).sum(0) / counts.sum(0)
        assert np.allclose(period["next", keys.REWARD][:, -1, 0], wanted, atol=1e-5)
        assert (period["next", keys.DONE][:, 0].numpy() == ended.any(0)).all()


def test_agents_learn_first_under_the_first_option():
    rates = []
    note = Onlooker(lambda batch: rates.append(float(batch["next", keys.IN_FORCE][0, 0])))
    training_of(replace(EXPERIMENT, governor=Constant(1.0), governor_from_step=30), note).run()
    assert rates == [0.0] * 15 + [1.0] * 25


@pytest.mark.integration
@pytest.mark.parametrize("governor", [BY_PPO, BY_DQN, StockRule()], ids=["ppo", "dqn", "stock"])
def test_a_stopped_training_goes_on_bit_for_bit(tmp_path, stopped, governor):
    experiment = replace(EXPERIMENT, governor=governor, callbacks=(cprl.Custom("own_parts:Stopping"),))
    whole = cprl.run(experiment, tmp_path / "whole", **QUIET)
    halves = tmp_path / "halves"
    stopped(23, experiment, halves)  # within a period
    cprl.run(experiment, halves, resume=True, **QUIET)
    assert differences(halves, whole) == []
    table = read_episodes(whole)
    assert {"governor/rule", "governor/objective", "institutions/in_force_0"} <= set(table.column_names)
    assert table["governor/objective"].to_numpy() == pytest.approx(
        table["governor/objective"].to_numpy().clip(0, 2)
    )


@pytest.mark.integration
def test_a_state_in_the_middle_of_a_period_is_resumed():
    experiment = replace(EXPERIMENT, governor=BY_PPO)
    first = training_of(experiment)
    for _ in range(13):
        first.step()
    second = training_of(experiment)
    second.load_state_dict(first.state_dict())
    for training in (first, second):
        while not training.is_over:
            training.step()
    assert repr(first.governor.state_dict()) == repr(second.governor.state_dict())


@pytest.mark.parametrize("on_nan", ["stop", "continue"])
def test_a_governor_whose_weights_are_nan_is_noticed_as_an_agent_is(on_nan):
    class Breaks:
        turns = 0

        def on_step(self, batch):
            self.turns += 1
            if self.turns == 12:
                next(iter(training.governor.learner.lane_networks.params.values()))[1] = torch.nan

    training = training_of(replace(EXPERIMENT, governor=BY_PPO, on_nan=on_nan), Breaks())
    message = "weights of agent 2 in replica 1 are not finite"
    stops = pytest.raises(NotFiniteError, match=message)
    with stops if on_nan == "stop" else pytest.warns(RuntimeWarning, match=message):
        training.run()
    assert [(one.what, one.replica, one.agent) for one in training.finite.reported] == [("weights", 1, 2)]


@pytest.mark.integration
def test_the_governor_of_the_background_agents_governs_in_cross_play(tmp_path):
    runs = {}
    for name, rate in (("free", 0.0), ("taxed", 1.0)):
        runs[name] = cprl.run(replace(EXPERIMENT, governor=Constant(rate)), tmp_path / name, **QUIET)
    table = crossplay(runs, Fresh(episodes=2, seed=40))
    rules = zip(table["background"].to_pylist(), table["governor/rule"].to_pylist(), strict=True)
    assert set(rules) == {("free", 0.0), ("taxed", 1.0)}


@pytest.mark.integration
def test_a_frozen_governor_meets_fresh_agents_and_plays_in_evaluations(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cprl.run(replace(EXPERIMENT, governor=BY_PPO), "first", **QUIET)
    weights = cprl.load("first").networks
    assert {"replica_0/agent_2", "replica_1/agent_2"} <= set(weights)
    again = replace(EXPERIMENT, governor=Frozen("first", 2, replica=None), seed=7)
    cprl.run(again, "second", **QUIET)
    table = pq.read_table("second/evaluation/trained.parquet")
    assert set(np.round(table["governor/rule"].to_numpy() * 20) % 5) <= {0.0, 2.5}  # periods of 5 in 20 turns
    played = cprl.evaluate_run("second", Fresh(episodes=2, seed=40))
    assert played["governor/rule"].null_count == 0
    among = play_population(
        cprl.load("first"), (Scripted("greedy"),) * 2, Fresh(episodes=2, seed=40, replicas=(0, 1))
    )
    assert among["governor/rule"].null_count == 0
    study = Study(again, {"agents.*.algorithm.settings.gamma": [0.9, 0.8]})
    assert all(condition.experiment.governor == again.governor for condition in study.all_conditions)
    with pytest.raises(ValueError, match="after the last one"):
        make_agents(replace(again, governor=Frozen("first", 1)))
    other = replace(GAME, institutions=(Tax(), replace(GOVERNOR, options=(0.0, 1.0))))
    with pytest.raises(ValueError, match="options"):
        make_agents(replace(again, game=other))


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("governor", {"game": GAME}),
        ("governor_from_step", {"governor": None, "governor_from_step": 5}),
        ("number", {"governor": Constant(0.3)}),
        (
            "sees",
            {
                "governor": StockRule(),
                "game": replace(GAME, institutions=(Tax(), replace(GOVERNOR, sees=("time",)))),
            },
        ),
        ("governor", {"governor": replace(BY_PPO, reward="team")}),
        (
            "minibatch_size",
            {
                "governor": Learning(PPO(settings=RolloutSettings(rollout_steps=3, minibatch_size=12))),
                "worlds": 2,
            },
        ),
        ("governor.run", {"governor": Frozen("/runs/x", 2)}),
    ],
)
def test_a_governor_that_cannot_govern_is_refused_by_name(field, changes):
    with pytest.raises(ValueError, match=field):
        replace(EXPERIMENT, **{"governor": BY_PPO, **changes})


def test_an_experiment_with_a_governor_equals_its_recipe():
    for governor in (BY_PPO, StockRule(lower=0.1, upper=0.4), Constant(0.5), Frozen("runs/first", 2)):
        experiment = replace(EXPERIMENT, governor=governor, governor_from_step=10)
        assert cprl.Experiment.from_recipe(experiment.to_recipe()) == experiment


@pytest.mark.integration
def test_a_replica_alone_is_the_same_as_beside_others():
    experiment = replace(EXPERIMENT, governor=BY_PPO)
    both = training_of(experiment)
    alone = training_of(replace(experiment, replicas=1))
    for training in (both, alone):
        training.run()
    weights = both.governor.learner.networks()["replica_0/agent_2"].state_dict()
    for name, weight in alone.governor.learner.networks()["replica_0/agent_2"].state_dict().items():
        assert torch.allclose(weight, weights[name], atol=1e-6), name


def test_a_governor_of_a_quota_opens_and_closes_the_harvest():
    game = replace(
        GAME,
        institutions=(
            Quota(window_steps=5),
            Governor(sets="quota.share", options=(0.0, 1000.0), every_steps=5),
        ),
    )
    experiment = replace(EXPERIMENT, game=game, agents=(Scripted("greedy"),) * 2, steps=40)

    def harvest_under(number):
        harvests = []
        note = Onlooker(lambda batch: harvests.append(batch["next", keys.HARVEST]))
        training_of(replace(experiment, governor=Constant(number)), note).run()
        return float(torch.stack(harvests).sum())

    assert harvest_under(0.0) == 0 < harvest_under(1000.0)


@pytest.mark.integration
def test_a_film_draws_the_number_in_force_under_the_stock(tmp_path):
    run = cprl.run(replace(EXPERIMENT, governor=StockRule()), tmp_path / "run", **QUIET)
    path, _ = record_episode(run, tmp_path / "film.rrd", episode=0)
    drawn, rates = column(path, "turn/rule", "Scalars:scalars")
    times, _ = column(path, "turn/stock", "Scalars:scalars")
    assert drawn == times
    assert {*np.ravel(rates)} <= {*GOVERNOR.options}
