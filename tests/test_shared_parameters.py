"""Members of a team may share one network, which learns from what all of them meet."""

from dataclasses import replace

import pytest
import torch
from test_population import ALGORITHMS, GAME, REPLAY, ROLLOUTS, population, ran, trained
from test_recurrent import DQNS
from test_recurrent import ON_POLICY as RECURRENT
from test_teams import TEAMS, first_turn

from cprl import CommonsEnv, Custom, Experiment
from cprl.algorithms import DQN, PPO, Tabular, TabularSettings
from cprl.algorithms.base import TeamAlgorithm
from cprl.learners.ring import TransitionForm
from cprl.learners.settings import DEFAULT_HIDDEN_CELLS
from cprl.learners.trial import trial_batch
from cprl.networks import Conv
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.training.agents import Population

FOUR = tuple(range(4))
EVERY = {
    **ALGORITHMS,
    **TEAMS,
    "recurrent PPO": RECURRENT["PPO"],
    "recurrent MAPPO": RECURRENT["MAPPO"],
    "recurrent DQN": DQNS["GRU"],
    "DQN, convolutions": DQN(
        settings=replace(REPLAY, hidden_cells=DEFAULT_HIDDEN_CELLS), network=Conv(channels=(2,))
    ),
}


def shared(algorithm, agents=FOUR, **how):
    reward = "team" if isinstance(algorithm, TeamAlgorithm) else "individual"
    return Team(algorithm, agents, **{"reward": reward, "share_parameters": True, **how})


def by_member(agents):
    """The weights of each member's network, in one row: [R, S, ...]."""
    flat = [
        torch.cat([value.flatten() for value in network.state_dict().values()])
        for network in agents.networks().values()
    ]
    return torch.stack(flat).unflatten(0, (agents.replicas, -1))


@pytest.mark.integration
@pytest.mark.parametrize("name", EVERY)
def test_members_share_one_network_in_each_replica_which_learns_as_it_would_alone(name):
    together = population([shared(EVERY[name])], replicas=3)
    alone = population([shared(EVERY[name])], replicas=1, first_replica=2)
    before = by_member(together)
    _, returns = trained(together, episodes=4)
    _, returns_alone = trained(alone, first=2, episodes=4)
    assert returns[2] == returns_alone[0]
    after = by_member(together)
    assert (after == after[:, :1]).all(), "every member has the same"
    assert (after != before).any(-1).all(), "it learns"
    assert len({float(row.sum()) for row in after[:, 0]}) == 3, "each replica has its own"
    torch.testing.assert_close(after[2], by_member(alone)[0], rtol=1e-4, atol=1e-5)


def test_the_shared_network_starts_as_that_of_the_first_member_alone():
    alone = by_member(population([Learning(DQN(settings=REPLAY))] * 4))
    for name in ("DQN", "VDN"):
        assert torch.equal(by_member(population([shared(EVERY[name])])), alone[:, :1].expand(-1, 4, -1))


def test_the_loss_is_the_mean_over_the_transitions_of_all_members():
    agents = population([shared(DQN(settings=REPLAY), (1, 3)), Scripted(), Scripted()], replicas=2)
    (learner,) = agents.learners.values()
    network = agents.networks()["replica_1/agent_1"]
    batch = trial_batch(4, TransitionForm(observation_shape=GAME.observation_shape), len(GAME.actions))
    mine = batch[2:].reshape(-1)  # lanes are replicas times members
    with torch.no_grad():  # r + gamma max Q', the target is still a copy
        chosen = network(mine["observation"]).gather(-1, mine["action"].unsqueeze(-1))
        best = network(mine["next", "observation"]).amax(-1, keepdim=True)
        target = mine["next", "reward"] + REPLAY.gamma * ~mine["next", "terminated"] * best
    losses = learner.engine.update_from(batch)
    assert losses.shape == (2,), "of each network"
    torch.testing.assert_close(losses[1], (target - chosen).square().mean())


def test_a_member_acts_on_what_it_sees_itself_and_is_paid_for_itself():
    agents = population([shared(DQN(settings=REPLAY), (1, 2)), Scripted(), Scripted()])
    (learner,) = agents.learners.values()
    learner.store(first_turn(2))
    assert learner.buffer.fields["reward"][0].tolist() == [1.0, 2.0, 1.0, 2.0]
    seen = CommonsEnv(GAME, 2, seed=9).reset()["agents", "observation"][:, 1:3]
    actor = learner.evaluation_actor(1)
    actor.epsilon = 0.0
    for replica in range(2):
        network = agents.networks()[f"replica_{replica}/agent_1"]
        assert torch.equal(actor.choose(seen)[replica], network(seen[replica]).argmax(-1))


def test_members_explore_each_by_random_numbers_of_its_own():
    alone = population([Learning(DQN(settings=REPLAY))] * 4)
    team = population([shared(DQN(settings=REPLAY))])
    seen = CommonsEnv(GAME, 2, seed=9).reset()["agents", "observation"]
    chosen = [next(iter(own.learners.values())).actor.choose(seen) for own in (alone, team)]
    assert torch.equal(*chosen), "epsilon is 1 at first"
    assert len(set(chosen[1][0].tolist())) > 1


@pytest.mark.integration
def test_weights_that_differ_are_refused_as_a_start(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run, _ = ran(tmp_path, [Team(TEAMS["VDN"], FOUR)])
    with pytest.raises(ValueError, match=r"the agents \[0, 1, 2, 3\] would start from different weights"):
        population([shared(TEAMS["VDN"], start_from=Frozen(run, 0))])


def test_what_cannot_be_shared_is_refused_by_name():
    with pytest.raises(ValueError, match="share_parameters is True"):
        shared(Tabular(settings=TabularSettings()))
    with pytest.raises(ValueError, match=r"Team\.share_parameters is 1"):
        Team(TEAMS["VDN"], FOUR, share_parameters=1)
    with pytest.raises(ValueError, match=r"a Team, which engine=\"torchrl\" cannot train"):
        Experiment(
            name="shared",
            game=GAME,
            agents=(shared(PPO(settings=ROLLOUTS)),),
            episodes=1,
            engine="torchrl",
            update_every=1,
        )
    own = Custom("cprl.algorithms:Tabular", arguments={"settings": None})
    with pytest.raises(ValueError, match="settings"):
        population([shared(own)])
    env = CommonsEnv(GAME, 2, seed=3)
    with pytest.raises(ValueError, match="share_parameters is True"):
        Population(env, [shared(DQN(settings=REPLAY))], seed=3, engine="torchrl")


def test_sharing_takes_the_engine_that_agents_of_their_own_take():
    for name, way in (("DQN", "lane_axis"), ("SAC", "vmapped"), ("C51", "lane_axis_flat")):
        (learner,) = population([shared(EVERY[name])]).learners.values()
        assert (learner.engine.sharing, learner.engine.batching) == (4, way)
