"""Teams learn together: VDN, QMIX, MADDPG from replay, MAPPO, IPPO on-policy, one team in each replica."""

from dataclasses import replace
from statistics import fmean

import pytest
import test_optimum
import torch
from tensordict import TensorDict
from test_population import GAME, REPLAY, ROLLOUTS, population, weights

from cprl import CommonsEnv, Game, Rules, maps
from cprl.algorithms.off_policy import DQN
from cprl.algorithms.teams import IPPO, MADDPG, MAPPO, QMIX, VDN
from cprl.learners.ring import TransitionForm
from cprl.learners.trial import trial_batch
from cprl.measuring.evaluate import evaluate
from cprl.networks.team import Mixing
from cprl.population import Learning, Scripted, Team
from cprl.training import train
from cprl.training.agents import Population

TEAMS = {
    "VDN": VDN(settings=REPLAY),
    "QMIX": QMIX(settings=REPLAY, mixing_cells=6),
    "MAPPO": MAPPO(settings=ROLLOUTS),
    "IPPO": IPPO(settings=ROLLOUTS),
    "MADDPG": MADDPG(settings=REPLAY),
}
FOUR = tuple(range(4))


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
    for key, value in weights(alone).items():
        assert torch.equal(weights(team)[key], value)


def test_the_loss_of_vdn_is_that_of_the_sum_of_its_members_values():
    agents, learner = team_of("VDN", replicas=1)
    networks = list(agents.networks().values())
    form = TransitionForm(observation_shape=(4, *GAME.observation_shape), action_shape=(4,))
    batch = trial_batch(1, form, len(GAME.actions))
    (turn,) = batch
    ends = turn["next", "terminated"].squeeze(-1)
    assert 0 < ends.sum() < 8

    def values(observation):
        return torch.stack([own(observation[:, agent]) for agent, own in enumerate(networks)], 1)

    with torch.no_grad():  # r + gamma sum of max Q', the targets are still copies
        chosen = values(turn["observation"]).gather(-1, turn["action"].unsqueeze(-1)).sum((1, 2))
        best = values(turn["next", "observation"]).amax(-1).sum(1)
        target = turn["next", "reward"].squeeze(-1) + REPLAY.gamma * ~ends * best
    torch.testing.assert_close(learner.engine.update_from(batch), (target - chosen).square().mean()[None])


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


def test_a_team_is_paid_for_all_agents_also_those_who_are_not_of_it():
    agents = population([Scripted(), Team(TEAMS["VDN"], (1, 2)), Scripted()])
    ((agents, learner),) = agents.learners.items()
    assert agents == (1, 2)
    learner.store(first_turn(2))
    fields = learner.buffer.fields
    assert fields["reward"][0].tolist() == [6.0, 6.0]
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
    seen = []
    update_from = learner.engine.update_from
    learner.engine.update_from = lambda batch: seen.append(batch) or update_from(batch)
    train(env, {FOUR: learner}, episodes=2)
    advantage = torch.cat([batch["advantage"] for batch in seen[:2]], 1)
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


@pytest.mark.parametrize("name", ["VDN", "QMIX", "MAPPO"])
def test_who_shares_a_reward_but_is_paid_for_itself_is_refused(name):
    with pytest.raises(ValueError, match=r'reward is "individual"'):
        population([Team(TEAMS[name], FOUR, reward="individual")])


def test_what_is_no_team_is_refused_and_says_what_fits():
    with pytest.raises(ValueError, match="the team has 1 agents"):
        population([Team(TEAMS["QMIX"], (0,)), *[Scripted()] * 3])
    with pytest.raises(ValueError, match=r"QMIX is learned by a team: Team\(QMIX\(...\), agents=\(0, 1\)\)"):
        Learning(TEAMS["QMIX"])
    with pytest.raises(ValueError, match=r"Team\.algorithm is a DQN"):
        Team(DQN(settings=REPLAY), FOUR)
    with pytest.raises(ValueError, match=r"QMIX\.settings is a RolloutSettings"):
        population([Team(QMIX(settings=ROLLOUTS), FOUR)])
    for agents, message in [((1, 0), "ascending agent indices"), ((), "at least one"), ((0, 0), "ascending")]:
        with pytest.raises(ValueError, match=message):
            Team(TEAMS["QMIX"], agents)


def test_two_equal_teams_stay_two_teams():
    pairs = [Team(TEAMS["QMIX"], (0, 2)), Team(TEAMS["QMIX"], (1, 3))]
    assert list(population(pairs).learners) == [(0, 2), (1, 3)]
    with pytest.raises(ValueError, match="agent 2 is in two teams"):
        population([Team(TEAMS["QMIX"], (0, 2)), Team(TEAMS["QMIX"], (2, 3))])
    with pytest.raises(ValueError, match="a team has agent 4; the game has the agents 0 to 3"):
        population([Team(TEAMS["QMIX"], (0, 4)), *[Scripted()] * 3])


ROWS = Game(
    map=maps.parse(
        """
        >AA#
        ####
        #AA<
        """
    ),
    rules=Rules(regrow_prob=(1.0,), may_fire=False, window_rows=2, window_columns=3, episode_steps=24),
)
"""Two boards of `test_optimum.py`, an agent on each: 24 apples an episode for each, and no more."""


@pytest.mark.slow
@pytest.mark.parametrize("name", TEAMS)
def test_a_team_comes_close_to_the_optimum(name):
    algorithm = replace(
        TEAMS[name], settings=test_optimum.ROLLOUTS if name.endswith("PPO") else test_optimum.REPLAY
    )
    # With the reward of the group, one of four replicas of IPPO ended at half of the apples.
    spec = Team(algorithm, (0, 1), reward="individual" if name == "IPPO" else "team")
    team = Population(CommonsEnv(ROWS, 4, seed=1), [spec], seed=1, engine="eager")

    def share():
        played = evaluate(CommonsEnv(ROWS, 4, seed=99), team.policy(1))
        return [float(episode.return_.sum()) / 48 for episode in played]

    untrained = share()
    train(CommonsEnv(ROWS, 4, seed=1), team.learners, episodes=400 if name.endswith("PPO") else 125)
    assert fmean(untrained) < 0.5
    shares = share()
    assert fmean(shares) > 0.9, shares
