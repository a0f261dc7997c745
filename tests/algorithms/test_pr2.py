"""PR2: joint values, the peers' expected answers, the soft target, and agents who see what their peers do."""

from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import pytest
import torch
from dqn_parts import make_learner, transitions
from matrix_games import MatrixGame, stag_hunt
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate, ValueEstimators

from cprl import CommonsEnv, Game, Rules, keys, maps
from cprl.algorithms import PR2, VDN, DQNSettings
from cprl.envs import make_env
from cprl.learners.transitions import joint_actions_by_agent
from cprl.objectives import PR2Loss
from cprl.objectives.pr2 import chosen_value, marginal, soft_value
from cprl.population import Learning, Scripted
from cprl.training import Schedule, train
from cprl.training.agents import Population

GAME = Game(
    map=maps.parse(".A>A.A\nAA.A.A\n.A<A>A"),
    rules=Rules(regrow_prob=(0.02, 0.3), window_rows=3, window_columns=5, episode_steps=12),
)
"""Three agents; so many apples that no board is emptied within an episode."""
SETTINGS = DQNSettings(buffer_size=60, batch_size=4, learning_rate=1e-3, hidden_cells=(8,))
PR2S = Learning(PR2(settings=SETTINGS, temperature=1.0))
OPTIMISM = torch.tensor([[[0.0, 3.0], [1.0, 2.0]]])
"""Payoffs of the rows in [[0, 3], [1, 2]] against [[3, 2], [0, 1]]: one peer, own action, the peer's."""


def test_the_peers_are_expected_to_answer_as_suits_the_agent_which_is_optimistic():
    # rho(column | row), the softmax of the row's payoffs: e^3 / (1 + e^3) = 0.9526, e^2 / (e + e^2) = 0.7311.
    # Q(row) = log(1 + e^3) = 3.0486 and log(e + e^2) = 2.3133; 1 / (1 + e^(2.3133 - 3.0486)) = 0.676. In the
    # game's one equilibrium, mixed, the row plays (0.5, 0.5).
    expected = torch.tensor([[[0.0474, 0.9526], [0.2689, 0.7311]]])
    torch.testing.assert_close(OPTIMISM.softmax(-1), expected, rtol=0, atol=1e-4)
    values = marginal(OPTIMISM, 1.0)
    torch.testing.assert_close(values, torch.tensor([3.0486, 2.3133]), rtol=0, atol=1e-4)
    torch.testing.assert_close(values.softmax(-1), torch.tensor([0.676, 0.324]), rtol=0, atol=1e-3)
    torch.testing.assert_close(soft_value(values, 1.0), values.exp().sum().log())


def test_sums_over_the_joint_actions_of_three_peers_are_products_over_pairs():
    temperature, actions, peers = 0.7, 3, 3
    joint = torch.randn(peers, actions, actions, generator=torch.Generator().manual_seed(1))
    by_pairs, answers = marginal(joint, temperature), (joint / temperature).softmax(-1)
    for own in range(actions):
        others = list(product(range(actions), repeat=peers))
        of_all = torch.stack(
            [torch.stack([joint[peer, own, b] for peer, b in enumerate(b)]).sum() for b in others]
        )
        for values, b in zip(of_all, others, strict=True):
            torch.testing.assert_close(chosen_value(joint, torch.tensor([own, *b])), values)
        torch.testing.assert_close(by_pairs[own], temperature * (of_all / temperature).logsumexp(0))
        first_plays_2 = (of_all / temperature).softmax(0)[[b[0] == 2 for b in others]].sum()
        torch.testing.assert_close(answers[0, own, 2], first_plays_2)


class Table(nn.Module):
    """The same values of pairs whatever is seen, added to the mean of what is."""

    def __init__(self, values):
        super().__init__()
        self.values = nn.Parameter(values.clone())

    def forward(self, observation):
        return self.values + observation.mean(-1)[..., None, None, None]


def loss_of(values, *, gamma=0.5, **how):
    loss = PR2Loss(Table(values), **{"temperature": 1.0, **how})
    SoftUpdate(loss, tau=0.1)  # copies the values to the target
    return loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)


def transition(*, reward=0.5, ends=False, **entries):
    seen = torch.zeros(1, 2)
    return transitions(seen, [[1, 0]], seen + 2, [[reward]], [[ends]], **entries)


def test_the_loss_is_the_squared_error_of_the_joint_action_taken_against_the_soft_target():
    # Own action 1, the peer's 0: q = 1. Next, all values are 2 higher: V = 2 + log(e^0 + e^3 + e^1 + e^2)
    # = 2 + 3.4402 = 5.4402. The target is 0.5 + 0.5 * 5.4402 = 3.2201, the loss (1 - 3.2201)^2 = 4.9288.
    loss, batch = loss_of(OPTIMISM), transition()
    found = loss(batch)["loss"]
    torch.testing.assert_close(found, torch.tensor(4.9288), rtol=0, atol=1e-3)
    torch.testing.assert_close(batch["td_error"], torch.tensor([[4.9288]]), rtol=0, atol=1e-3)
    found.backward()
    # d/dq (q - y)^2 = 2 (1 - 3.2201) = -4.4402 for the pair that was played alone.
    gradient = loss.value_network_params["module", "values"].grad
    expected = torch.tensor([[[0.0, 0.0], [-4.4402, 0.0]]])
    torch.testing.assert_close(gradient, expected, rtol=0, atol=1e-3)


def test_nothing_comes_after_a_terminated_state_and_the_discount_counts_the_steps_of_a_return():
    # (1 - 0.5)^2 and ln cosh(1 - 0.5)
    for name, expected in (("l2", 0.25), ("log_cosh", 0.1201145)):
        found = loss_of(OPTIMISM, loss_function=name)(transition(ends=True))["loss"]
        torch.testing.assert_close(found, torch.tensor(expected))
    # After three steps the discount is 0.125: y = 0.5 + 0.125 * 5.4402 = 1.1800.
    later = transition(steps_to_next_obs=[[3]])
    torch.testing.assert_close(loss_of(OPTIMISM)(later)["loss"], torch.tensor(0.0324), rtol=0, atol=1e-3)


def test_without_the_entropy_bonus_uniform_play_is_worth_what_it_is_paid():
    # Values that do not differ: V = 2 + 2 log 2 with the bonus, 2 without.
    flat, batch = torch.zeros(1, 2, 2), transition(reward=0.0)
    for entropy_bonus, value in ((True, 2 + 2 * torch.log(torch.tensor(2.0))), (False, torch.tensor(2.0))):
        loss = loss_of(flat, entropy_bonus=entropy_bonus)
        torch.testing.assert_close(loss(batch)["loss"], (0.5 * value).square())


def test_the_loss_has_no_gradient_for_its_targets_and_takes_other_keys():
    loss = loss_of(OPTIMISM, reduction="none")
    loss.set_keys(action="joint", reward=("mine", "reward"))
    batch = transition()
    batch["joint"] = batch.pop("action")
    batch["next", "mine", "reward"] = batch["next"].pop("reward")
    assert set(loss.in_keys) == {
        "joint",
        "observation",
        *(("next", name) for name in ("observation", "done", "terminated")),
        ("next", "mine", "reward"),
    }
    out = loss(batch)["loss"]
    assert out.shape == (1,)
    out.sum().backward()
    assert loss.target_value_network_params["module", "values"].grad is None


def population(agents, *, replicas=2, first_replica=0, game=GAME, **how):
    env = CommonsEnv(game, replicas, seed=3)
    how = {"engine": "eager", "seed": 3, **how}
    return Population(env, agents, first_replica=first_replica, **how)


def test_a_lane_stores_its_own_action_first_then_those_of_the_others_by_their_indices():
    agents = population((PR2S, Scripted("greedy"), PR2S))
    (learner,) = agents.learners.values()
    env = CommonsEnv(GAME, 2, seed=3)
    moment = env.reset()
    moment[keys.ACTION] = torch.tensor([[0, 1, 2], [3, 4, 5]])
    turn = env.step(moment)
    assert joint_actions_by_agent((0, 2), keys.Turn.of(turn)).tolist() == [
        [0, 1, 2],
        [2, 0, 1],
        [3, 4, 5],
        [5, 3, 4],
    ]
    learner.store(turn)
    assert learner.memory.buffer.fields["action"][0].tolist() == [[0, 1, 2], [2, 0, 1], [3, 4, 5], [5, 3, 4]]


def test_checkpoints_name_the_weights_of_pr2_as_they_always_did():
    (learner,) = population((PR2S,) * 3).learners.values()
    stored = learner.state_dict()["lane_networks"]["params"]
    assert stored
    assert all(name.startswith("value_network_params:module.of.network.") for name in stored)


def test_agents_act_on_what_they_see_themselves_by_the_policy_of_their_joint_values():
    agents = population((PR2S,) * 3)
    (learner,) = agents.learners.values()
    assert learner.lane_networks.update == "stacked", "the fastest way"
    seen = CommonsEnv(GAME, 2, seed=3).reset()[keys.OBSERVATION]
    network = agents.networks()["replica_1/agent_2"]
    joint = network.joint_values(seen[1, 2])
    assert joint.shape == (2, 8, 8)
    torch.testing.assert_close(network(seen[1, 2]).softmax(-1), marginal(joint, 1.0).softmax(-1))
    logits = learner.lane_networks.outputs(seen.flatten(0, 1).unsqueeze(1))
    torch.testing.assert_close(logits[5, 0], network(seen[1, 2]))
    with set_exploration_type(ExplorationType.RANDOM):
        assert learner.actor.choose(seen).shape == (2, 3)


def test_a_game_of_one_agent_has_no_peers_and_is_refused():
    alone = Game(map=maps.parse(".A>.A"), rules=Rules(window_rows=3, window_columns=3, episode_steps=5))
    for engine in ("eager", "torchrl"):
        with pytest.raises(ValueError, match=r"^PR2 learns from the actions of its peers, and the gam"):
            population((PR2S,), game=alone, engine=engine)


def test_a_team_does_not_see_peers_of_its_own():
    @dataclass(frozen=True, kw_only=True)
    class Seeing(VDN):
        sees_peers_actions: ClassVar[bool] = True

    how = {"agents": (0, 1), "replicas": 2, "seed": 1, "reward": "team"}
    with pytest.raises(ValueError, match=r"^sees_peers_actions is True"):
        make_learner(Seeing(settings=SETTINGS), GAME.spaces, engine="eager", **how)


STAG = stag_hunt()
"""4 for both who hunt the stag, 3 and 0 where one takes the hare, 1 for both who take it."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("game", "temperature", "first_action"),
    [
        # Wen et al. (2019) by exact values, see above: (0.676, 0.324) for both, not the equilibrium's 0.5.
        pytest.param(MatrixGame((((0, 3), (3, 2)), ((1, 0), (2, 1)))), 1.0, 0.676, id="optimism"),
        # Q(stag) = log(e^8 + 1) / 2 = 4.0002, Q(hare) = log(e^6 + e^2) / 2 = 3.0091, at T = 0.5 a probability
        # of 1 / (1 + e^(-2 * 0.9911)) = 0.879 of the stag, though the hare is safer against uniform play.
        pytest.param(STAG, 0.5, 0.879, id="stag hunt"),
    ],
)
def test_ten_pairs_of_learners_end_at_the_policy_of_exact_values(game, temperature, first_action):
    settings = DQNSettings(
        buffer_size=1000, batch_size=16, learning_rate=3e-3, hidden_cells=(16,), learning_starts=50
    )
    learning = Learning(PR2(settings=settings, temperature=temperature))
    env = make_env(game, worlds=10, seed=0)
    agents = Population(env, (learning, learning), seed=0, engine="eager")
    train(env, agents.learners, Schedule(episodes=1000))
    networks = agents.networks()
    assert len(networks) == 20
    for name, network in networks.items():
        with torch.no_grad():
            found = network(torch.ones(1)).softmax(-1)[0]
        assert abs(found - first_action) < 0.02, name
