"""What every algorithm keeps: each agent learns, each replica as it would alone, by any engine, and stopped
as in one go; a run of it is stored, loaded and evaluated, and its agents play on frozen and start others.
The numbers of each are in tests/golden."""

from dataclasses import replace

import pytest
import torch
from lola_teams import ESTIMATORS, team as lola_team
from recurrent_learners import DQNS, ON_POLICY as RECURRENT, specs as recurrent_specs
from small_learners import (
    ALGORITHMS,
    FOUR,
    GAME,
    REPLAY,
    assert_all_weights_move_and_replicas_learn_apart,
    population,
    trained,
    weights,
)
from team_learners import TEAMS

import cprl
from cprl import CommonsEnv, Experiment
from cprl.algorithms import DQN, Tabular, TabularSettings
from cprl.evaluation import Fresh, crossplay, evaluate_run
from cprl.measuring.table import where
from cprl.objectives.rewards import InequityAversion
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.runs.checkpoints import Checkpointer, checkpoints_in
from cprl.training import Schedule, train


def shared(algorithm, agents=FOUR):
    return Team(algorithm, agents, reward="individual", share_parameters=True)


GROUPS = {
    **{name: [Learning(algorithm)] * 4 for name, algorithm in ALGORITHMS.items()},
    **{name: [Team(algorithm, FOUR, reward="team")] for name, algorithm in TEAMS.items()},
    **{f"LOLA, {estimator}": [lola_team(estimator)] for estimator in ESTIMATORS},
    **{f"recurrent {name}": recurrent_specs(name) for name in RECURRENT},
    **{f"recurrent DQN, {name}": [Learning(algorithm)] * 4 for name, algorithm in DQNS.items()},
}
STORED = {
    **{name: GROUPS[name] for name in ("DQN", "PR2", "PPO", "QMIX", "IPPO", "MADDPG", "LOLA, dice")},
    **{name: GROUPS[name] for name in ("recurrent MAPPO", "recurrent DQN, GRU")},
    "shared DQN": [shared(ALGORITHMS["DQN"])],
}


@pytest.mark.integration
@pytest.mark.parametrize("name", GROUPS)
def test_all_weights_of_every_agent_move_and_no_replica_knows_of_the_others(name):
    agents = GROUPS[name]
    together, alone = population(agents, replicas=3), population(agents, replicas=1, first_replica=2)
    assert len(together.networks()) == 12
    assert_all_weights_move_and_replicas_learn_apart(together, alone)
    sums = dict.fromkeys(together.networks(), 0.0)
    for name, value in weights(together).items():
        sums[name.rsplit("/", 1)[0]] += float(value.sum())
    assert len(set(sums.values())) == 12, "every agent has a network of its own"


@pytest.mark.integration
@pytest.mark.parametrize("name", STORED)
def test_a_run_is_stored_loaded_and_evaluated_plays_frozen_and_others_start_from_it(
    name, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)

    def run(agents, folder):
        experiment = Experiment(
            name=folder, game=GAME, agents=agents, replicas=2, episodes=3, evaluation_episodes=1
        )
        return experiment, cprl.run(replace(experiment, engine="eager"), folder, watch="off")

    experiment, first = run(STORED[name], "first")
    loaded = cprl.load(first)
    assert loaded.experiment == replace(experiment, engine="eager")
    assert len(loaded.networks) == 8
    played = evaluate_run(first, Fresh(episodes=3))
    assert len(where(played, policy="trained", replica=1, agent=0)) == 3
    frozen = population([Frozen(str(first), 1, replica=1), *[Scripted()] * 3])
    assert len(frozen.others) == 2
    begun = population([replace(one, start_from=Frozen(str(first), 0, replica=1)) for one in STORED[name]])
    ours = begun.networks()["replica_0/agent_0"].state_dict()
    theirs = loaded.networks["replica_1/agent_0"].state_dict()
    assert all(torch.equal(ours[key], value) for key, value in theirs.items())
    _, second = run([Frozen(str(first), 2, replica=1), *[Scripted("greedy")] * 3], "second")
    crossplay([first, second], Fresh(episodes=1))


WAYS = {
    "VDN": ("vmapped",),
    "QMIX": ("vmapped",),
    **dict.fromkeys(("MAPPO", "IPPO", "MADDPG", "recurrent IPPO"), ("stacked",)),
    "recurrent PPO": ("stacked", "vmapped"),
    "recurrent PPO, LSTM": ("stacked",),
    **{f"recurrent DQN, {name}": ("stacked", "vmapped") for name in DQNS},
}


@pytest.mark.integration
@pytest.mark.parametrize("name", WAYS)
def test_every_engine_learns_what_a_list_of_torchrls_losses_does(name, monkeypatch):
    kind = type(GROUPS[name][0].algorithm)
    assert (kind.update,) == WAYS[name] or name not in TEAMS, "this is the way that it names"

    def learned(update):
        monkeypatch.setattr(kind, "update", update)
        agents = population(GROUPS[name])
        trained(agents, episodes=3)
        return weights(agents)

    listed = learned("list")
    for way in WAYS[name]:
        ours = learned(way)
        for key, value in listed.items():
            rtol = 1e-3 if name in TEAMS else 1e-4
            torch.testing.assert_close(ours[key], value, rtol=rtol, atol=1e-5, msg=f"{way}: {key}")


BESIDE = Learning(ALGORITHMS["DQN"])
ALONE = [Scripted("greedy"), Scripted()]
SEVERAL = replace(REPLAY, n_steps=3, tau=0.05, updates_per_step=2, optimizer="rmsprop")
STOPPED = {
    "GRU and LSTM by rollouts and by replay": [
        Learning(RECURRENT["PPO"]),
        Learning(RECURRENT["PPO, LSTM"]),
        Learning(DQNS["GRU"]),
        Learning(DQNS["LSTM, double, log-cosh"]),
    ],
    "tables and who is averse to inequity": [
        Learning(Tabular(settings=TabularSettings(epsilon_hold_steps=10, epsilon_decay_steps=200))),
        Learning(ALGORITHMS["PPO"], reward=InequityAversion(alpha=5, beta=0.05, smoothing=0.9)),
        *ALONE,
    ],
    "returns of several steps beside a shared DQN": [
        Learning(DQN(settings=SEVERAL)),
        shared(ALGORITHMS["DQN"], (1, 2)),
        Scripted(),
    ],
    "a shared PPO beside a team of GRUs": [
        shared(ALGORITHMS["PPO"], (0, 1)),
        Team(RECURRENT["MAPPO"], (2, 3), reward="team"),
    ],
    "QMIX and MADDPG": [
        Team(TEAMS["QMIX"], (0, 1), reward="team"),
        Team(TEAMS["MADDPG"], (2, 3), reward="team"),
    ],
    "MAPPO beside DQN": [Team(TEAMS["MAPPO"], (0, 1, 2), reward="team"), BESIDE],
    "LOLA": [
        lola_team("policy_gradient", (0, 1), rollout_steps=10),
        lola_team("dice", (2, 3), rollout_steps=10),
    ],
}


class StopError(Exception):
    """A training is stopped."""


class Stopping:
    def __init__(self, at):
        self.turns_left = at

    def on_step(self, batch):
        self.turns_left -= 1
        if self.turns_left == 0:
            raise StopError


class AtSteps(Checkpointer):
    def after_step(self, training):
        if training.steps in (20, 45):
            self.save(training)


@pytest.mark.integration
@pytest.mark.parametrize("name", STOPPED)
def test_a_training_that_was_stopped_within_an_episode_and_a_rollout_goes_on_bit_for_bit(name, tmp_path):
    def ends(folder, *, stop_at=0):
        agents = population(STOPPED[name])
        (tmp_path / folder).mkdir(exist_ok=True)
        with AtSteps(tmp_path / folder) as checkpoints:
            train(
                CommonsEnv(GAME, 2, seed=3),
                agents.learners,
                Schedule(episodes=7),
                others=agents.others,
                callbacks=[Stopping(stop_at)],
                checkpointer=checkpoints,
            )
        return weights(agents)

    whole = ends("whole")
    with pytest.raises(StopError):
        ends("stopped", stop_at=47)
    assert checkpoints_in(tmp_path / "stopped" / "checkpoints")
    for key, value in ends("stopped").items():
        assert torch.equal(value, whole[key]), key
