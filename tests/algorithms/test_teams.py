"""Teams learn together, one in each replica: VDN, QMIX, MADDPG from replay, MAPPO, IPPO on-policy. Agents
that share one network, whatever they learn by, learn from what all of them meet."""

from dataclasses import replace

import pytest
import torch
from dqn_parts import learn, made_up_batch, watch_steps
from recurrent_learners import DQNS, ON_POLICY as RECURRENT
from small_learners import ALGORITHMS, GAME, REPLAY, ROLLOUTS, population, ran, trained, weights
from team_learners import FOUR, TEAMS
from tensordict import TensorDict

from cprl import CommonsEnv, Custom
from cprl.algorithms import DQN, QMIX, Tabular, TabularSettings
from cprl.algorithms.base import TeamAlgorithm
from cprl.learners.settings import DEFAULT_HIDDEN_CELLS
from cprl.learners.transitions import TransitionForm
from cprl.networks import Conv
from cprl.networks.team import Mixing
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.training import Schedule, train
from cprl.training.agents import Population


def team_of(name, **how):
    agents = population([Team(TEAMS[name], FOUR)], **how)
    (learner,) = agents.learners.values()
    return agents, learner


def test_a_member_acts_by_its_own_network_and_what_it_sees_itself():
    agents, learner = team_of("QMIX")
    seen = CommonsEnv(GAME, 2, seed=9).reset()["agents", "observation"]
    actor = learner.evaluation_actor(1)
    actor.epsilon = 0.0
    chosen = actor.choose(seen)
    for lane, network in agents.networks().items():
        replica, agent = (int(part.rpartition("_")[2]) for part in lane.split("/"))
        assert chosen[replica, agent] == network(seen[replica, agent]).argmax()


def test_a_member_begins_with_the_weights_that_it_would_have_alone():
    alone = population([Learning(DQN(settings=REPLAY))] * 4)
    team, _ = team_of("VDN")
    torch.testing.assert_close(weights(team), weights(alone), rtol=0, atol=0)


def test_the_loss_of_vdn_is_that_of_the_sum_of_its_members_values():
    agents, learner = team_of("VDN", replicas=1)
    networks = list(agents.networks().values())
    form = TransitionForm(observation_shape=(4, *GAME.observation_shape), action_shape=(4,))
    batch = made_up_batch(form, 1, len(GAME.actions))
    (turn,) = batch
    ends = turn["next", "terminated"].squeeze(-1)
    assert 0 < ends.sum() < 8

    def values(observation):
        return torch.stack([own(observation[:, agent]) for agent, own in enumerate(networks)], 1)

    with torch.no_grad():  # r + gamma sum of max Q', the targets are still copies
        chosen = values(turn["observation"]).gather(-1, turn["action"].unsqueeze(-1)).sum((1, 2))
        best = values(turn["next", "observation"]).amax(-1).sum(1)
        target = turn["next", "reward"].squeeze(-1) + REPLAY.gamma * ~ends * best
    torch.testing.assert_close(learn(learner, batch), (target - chosen).square().mean()[None])


def first_turn(replicas=1):
    """A turn in which agents see something, agent n does n and is paid n."""
    chance = torch.Generator().manual_seed(5)
    see = torch.randint(256, (2, replicas, 4, *GAME.observation_shape), generator=chance).to(torch.uint8)
    no = torch.zeros(replicas, 1, dtype=torch.bool)
    agents_then = {"observation": see[1], "reward": torch.arange(4.0).expand(replicas, 4).unsqueeze(-1)}
    return TensorDict(
        {
            "agents": {"observation": see[0], "action": torch.arange(4).expand(replicas, 4)},
            "next": {"agents": agents_then, "done": no, "terminated": no},
        },
        [replicas],
    )


@pytest.mark.parametrize(
    ("name", "reward", "paid"),
    [("VDN", "team", 6.0), ("MADDPG", "team", [6.0, 6.0]), ("MADDPG", "individual", [1.0, 2.0])],
)
def test_members_are_paid_what_each_wants_or_for_all_agents_also_those_outside_the_team(name, reward, paid):
    agents = population([Scripted(), Team(TEAMS[name], (1, 2), reward=reward), Scripted()])
    ((agents, learner),) = agents.learners.items()
    assert agents == (1, 2)
    learner.store(first_turn(2))
    fields = learner.memory.buffer.fields
    assert fields["reward"][0].tolist() == [paid, paid]
    assert fields["action"][0].tolist() == [[1, 2], [1, 2]]


@pytest.mark.parametrize(("name", "sees_all"), [("MAPPO", True), ("IPPO", False)])
def test_the_critic_of_mappo_sees_what_all_see_that_of_ippo_what_one_sees(name, sees_all):
    _, learner = team_of(name)
    turn = first_turn(2)
    before = learner.values(turn)
    turn["next", "agents", "observation"][0, 3] = 255 - turn["next", "agents", "observation"][0, 3]
    after = learner.values(turn)
    changed = (before != after).tolist()
    assert changed == [[sees_all, sees_all, sees_all, True], [False] * 4]
    assert (len(set(before[0].tolist())) == 1) is sees_all


@pytest.mark.parametrize("name", ["MAPPO", "IPPO"])
def test_advantages_are_normalised_within_a_team(name):
    _, learner = team_of(name)
    env = CommonsEnv(GAME, 2, seed=3)
    seen = watch_steps(learner, lambda draw: draw.gather(draw.columns)["advantage"])
    train(env, {FOUR: learner}, Schedule(episodes=2))
    advantage = torch.cat(seen[:2], 1)
    assert advantage.shape == (2, 20, 4, 1)
    torch.testing.assert_close(advantage.flatten(1).mean(1), torch.zeros(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(advantage.flatten(1).std(1), torch.ones(2), atol=1e-4, rtol=0)


def test_the_teams_value_grows_with_each_members_value():
    mixing = Mixing(GAME.observation_shape, members=4, cells=6, highest=255.0)
    state = torch.randint(256, (64, 4, *GAME.observation_shape), dtype=torch.uint8)
    chosen = torch.randn(64, 4, 1, requires_grad=True)
    (slope,) = torch.autograd.grad(mixing(chosen, state).sum(), chosen)
    assert (slope >= 0).all()
    assert (slope > 0).any()
    raw = mixing.mixer.hyper_w_1(state.flatten(1).float() / 255)
    assert (raw < 0).any(), "without the absolute value it would not"
    doubled = mixing(chosen, (state // 2).to(torch.uint8))
    assert not torch.equal(doubled, mixing(chosen, state)), "how it mixes depends on what is seen"


def of(algorithm, agents=FOUR, **options):
    return Team(algorithm, agents, **options)


REFUSED = [
    *(
        (lambda name=name: population([of(TEAMS[name], reward="individual")]), 'reward is "individual"')
        for name in ("VDN", "QMIX", "MAPPO")
    ),
    (lambda: population([of(TEAMS["QMIX"], (0,)), *[Scripted()] * 3]), "the team has 1 agents"),
    (lambda: Learning(TEAMS["QMIX"]), r"QMIX is learned by a team: Team\(QMIX\(...\), agents=\(0, 1\)\)"),
    (lambda: of(DQN(settings=REPLAY)), r"Team\.algorithm is a DQN"),
    (lambda: QMIX(settings=ROLLOUTS), r"QMIX\.settings is a RolloutSettings"),
    (lambda: of(TEAMS["QMIX"], (1, 0)), "ascending agent indices"),
    (lambda: of(TEAMS["QMIX"], ()), "at least one"),
    (lambda: of(TEAMS["QMIX"], (0, 0)), "ascending"),
    (lambda: population([of(TEAMS["QMIX"], pair) for pair in ((0, 2), (2, 3))]), "agent 2 is in two teams"),
    (
        lambda: population([of(TEAMS["QMIX"], (0, 4)), *[Scripted()] * 3]),
        "a team has agent 4; the game has the agents 0 to 3",
    ),
    (lambda: shared(Tabular(settings=TabularSettings())), "share_parameters is True"),
    (lambda: of(TEAMS["VDN"], share_parameters=1), r"Team\.share_parameters is 1"),
    (lambda: population([shared(Custom("cprl.algorithms:Tabular", {"settings": None}))]), "settings"),
    (
        lambda: Population(
            CommonsEnv(GAME, 2, seed=3), [shared(DQN(settings=REPLAY))], seed=3, engine="torchrl"
        ),
        "share_parameters is True",
    ),
]


@pytest.mark.parametrize(("make", "message"), REFUSED)
def test_what_is_no_team_or_cannot_be_shared_is_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_two_equal_teams_stay_two_teams():
    pairs = [Team(TEAMS["QMIX"], (0, 2)), Team(TEAMS["QMIX"], (1, 3))]
    assert list(population(pairs).learners) == [(0, 2), (1, 3)]


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
    batch = made_up_batch(TransitionForm(observation_shape=GAME.observation_shape), 4, len(GAME.actions))
    mine = batch[2:].reshape(-1)  # lanes are replicas times members
    with torch.no_grad():  # r + gamma max Q', the target is still a copy
        chosen = network(mine["observation"]).gather(-1, mine["action"].unsqueeze(-1))
        best = network(mine["next", "observation"]).amax(-1, keepdim=True)
        target = mine["next", "reward"] + REPLAY.gamma * ~mine["next", "terminated"] * best
    losses = learn(learner, batch)
    assert losses.shape == (2,), "of each network"
    torch.testing.assert_close(losses[1], (target - chosen).square().mean())


def test_a_member_acts_on_what_it_sees_itself_and_is_paid_for_itself():
    agents = population([shared(DQN(settings=REPLAY), (1, 2)), Scripted(), Scripted()])
    (learner,) = agents.learners.values()
    learner.store(first_turn(2))
    assert learner.memory.buffer.fields["reward"][0].tolist() == [1.0, 2.0, 1.0, 2.0]
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


def test_sharing_takes_the_engine_that_agents_of_their_own_take():
    for name, way in (("DQN", "stacked"), ("SAC", "vmapped"), ("C51", "stacked")):
        (learner,) = population([shared(EVERY[name])]).learners.values()
        assert (learner.lane_networks.sharing, learner.lane_networks.update) == (4, way)
