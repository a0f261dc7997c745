"""A game of two steps in which who coordinates gets 8, and who does not dare to, 7.

At first agent 0 chooses between two matrix games, for both, and in that the two choose once, at once:

    safe    7  7        daring    0  1
            7  7                  1  8

Independent learners, who all explore alike, take what the other does for chance and expect (1 + 8) / 2 = 4.5
of the daring game. A sum of two values cannot tell it either: the nearest one says 6.5. Both choose safety.
Only what mixes values by the state can tell both games, and gets 8. Source: Rashid et al., "QMIX: Monotonic
Value Function Factorisation for Deep Multi-Agent Reinforcement Learning" (2018), section on the two-step
game, whose VDN gets 7 and QMIX 8.
"""

from itertools import product

import pytest
import torch
from tensordict import TensorDict

from cprl import CommonsEnv, Game, Rules, maps
from cprl.algorithms import DQN, QMIX, VDN
from cprl.algorithms.base import TeamAlgorithm
from cprl.learners.settings import DQNSettings
from cprl.population import Learning, Team
from cprl.training.agents import Population

START, SAFE, DARING, OVER = range(4)
PAYOFFS = torch.tensor([[[7.0, 7.0], [7.0, 7.0]], [[0.0, 1.0], [1.0, 8.0]]])
"""Of the games SAFE and DARING, by the choices of agents 0 and 1."""
REPLICAS = 5
SETTINGS = DQNSettings(
    buffer_size=1000,
    batch_size=32,
    gamma=0.99,
    learning_rate=2e-3,
    hidden_cells=(32,),
    epsilon_evaluation=0.0,
    target_every_episodes=1,
)
UPDATES, COPIES = 100, 8
"""Updates between copies of weights to targets, and how often that."""


def game():
    """Two agents; of the boards of the commons only the forms of what is seen and done are used."""
    rules = Rules(window_rows=1, window_columns=1, regrow_prob=(0.0, 0.2))
    return Game(map=maps.parse("A>.\n..<"), rules=rules)


def seen(state):
    """What both see: a channel for each state; uint8 [R, 2, C, 1, 1]."""
    return (
        torch.eye(OVER + 1)[state, None, :OVER, None, None].expand(-1, 2, -1, 1, 1).mul(255).to(torch.uint8)
    )


def turn(state, action):
    """The next state [R], and the turn, for actions [R, 2]; of the commons, even and odd."""
    choice, ends = action % 2, state != START
    paid = torch.where(ends, PAYOFFS[(state == DARING).long(), choice[:, 0], choice[:, 1]], 0.0)
    then = torch.where(ends, OVER, SAFE + choice[:, 0])
    rewards = torch.stack([paid, torch.zeros_like(paid)], 1).unsqueeze(-1)
    after = {"agents": {"observation": seen(then), "reward": rewards}, "done": ends[:, None]}
    before = {"observation": seen(state), "action": action}
    return then, TensorDict(
        {"agents": before, "next": {**after, "terminated": ends[:, None]}}, batch_size=len(state)
    )


def taught(algorithm):
    """A learner of two agents, who are paid together, after it has learned from every pair of actions in both
    games, each met once; all actions are tried equally often at first, too."""
    is_team = isinstance(algorithm, TeamAlgorithm)
    specs = [Team(algorithm, (0, 1))] if is_team else [Learning(algorithm, reward="team")] * 2
    population = Population(CommonsEnv(game(), REPLICAS), specs, seed=1, engine="eager")
    (learner,) = population.learners.values()
    actions = range(population.spaces.actions)
    for daring, (mine, yours) in product((0, 1), product(actions, actions)):
        state, chooses = torch.full((REPLICAS,), START), 2 * ((mine + yours) % 4) + daring
        for pair in ((chooses, yours), (mine, yours)):
            state, batch = turn(state, torch.tensor([pair]).expand(REPLICAS, 2))
            learner.store(batch)
    for _ in range(COPIES):
        for _ in range(UPDATES):
            learner.update()
        learner.end_episode(torch.ones(REPLICAS, dtype=torch.bool))
    return learner


def returns(learner):
    """What the group gets when everybody does what it thinks best, of each replica."""
    actor, state = learner.evaluation_actor(1), torch.full((REPLICAS,), START)
    for _ in range(2):
        state, batch = turn(state, actor.choose(seen(state)))
    return batch["next", "agents", "reward"].sum((1, 2)).tolist()


@pytest.mark.slow
def test_qmix_dares_and_coordinates_where_independent_learners_and_vdn_play_safe_by_the_nearest_sum():
    assert returns(taught(QMIX(settings=SETTINGS))) == [8.0] * REPLICAS
    assert returns(taught(DQN(settings=SETTINGS))) == [7.0] * REPLICAS
    learner = taught(VDN(settings=SETTINGS))
    assert returns(learner) == [7.0] * REPLICAS
    with torch.no_grad():
        values = learner.lane_networks.outputs(seen(torch.full((REPLICAS,), DARING)).unsqueeze(1)).squeeze(1)
    by_choice = values.unflatten(-1, (4, 2)).mean(-2)
    sums = by_choice[:, 0, :, None] + by_choice[:, 1, None, :]
    # row and column means 0.5 and 4.5, less the mean 2.5
    wanted = torch.tensor([[-1.5, 2.5], [2.5, 6.5]]).expand_as(sums)
    torch.testing.assert_close(sums, wanted, atol=0.3, rtol=0)
