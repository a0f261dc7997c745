"""One DQN agent of stock parts: what it stores, its target worked by hand, its clock and its targets."""

from dataclasses import replace

import pytest
import torch
from dqn_parts import make_learner
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl import CommonsEnv, Game, Rules, keys, maps
from cprl.algorithms import DQN
from cprl.commons.spaces import Spaces
from cprl.learners.settings import DQNSettings
from cprl.learners.transitions import transitions_of

SHORT = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.1), window_rows=3, window_columns=5, episode_steps=9),
)


SPACES = Spaces(agents=1, observation_shape=(3, 2, 3), actions=4)


def learner(spaces=SPACES, *, seed=0, **changes):
    """The learner of agent 0 in one replica."""
    settings = replace(DQNSettings(buffer_size=100, learning_rate=1e-3), **changes)
    how = {"agents": (0,), "replicas": 1, "seed": seed, "engine": "torchrl"}
    return make_learner(DQN(settings=settings), spaces, **how)


def store(agent, count, *, reward=0.0):
    """Stores so many made-up turns of a world in which nothing ends."""
    for made_up in transitions(count, reward=reward).split(1):
        following = made_up["next"]
        after = {name: following[name][:, None] for name in ("observation", "reward")}
        flags = {name: following[name] for name in ("done", "terminated", "truncated")}
        before = {name: made_up[name][:, None] for name in ("observation", "action")}
        agent.store(TensorDict({"agents": before, "next": {"agents": after, **flags}}, [1]))


def transitions(count, *, reward=0.0, terminated=False, truncated=False):
    def flag(value):
        return torch.full((count, 1), value)

    following = {
        "observation": torch.randint(256, (count, 3, 2, 3), dtype=torch.uint8),
        "reward": torch.full((count, 1), reward),
        "terminated": flag(terminated),
        "truncated": flag(truncated),
        "done": flag(terminated or truncated),
    }
    return TensorDict(
        {
            "observation": torch.randint(256, (count, 3, 2, 3), dtype=torch.uint8),
            "action": torch.randint(4, (count,)),
            "next": TensorDict(following, (count,)),
        },
        (count,),
    )


def test_the_transitions_of_an_agent_are_its_own_under_torchrls_default_keys():
    env = CommonsEnv(SHORT, 2)
    turns = env.rollout(12, break_when_any_done=False)
    flat = transitions_of(1, turns)
    assert flat.batch_size == (24,)
    assert torch.equal(flat["observation"], turns[keys.OBSERVATION][:, :, 1].flatten(0, 1))
    assert torch.equal(flat["action"], turns[keys.ACTION][:, :, 1].flatten())
    assert torch.equal(flat["next", "reward"], turns["next", "agents", "reward"][:, :, 1].flatten(0, 1))
    assert torch.equal(flat["next", "truncated"], turns["next", "truncated"].flatten(0, 1))
    assert flat["observation"].dtype == torch.uint8


@pytest.mark.parametrize(
    ("ending", "bootstraps"), [({}, 1.0), ({"truncated": True}, 1.0), ({"terminated": True}, 0.0)]
)
def test_the_clock_running_out_is_no_end_for_the_target_but_depletion_is(ending, bootstraps):
    # target = r + gamma max_a Q'(s', a), without the second term behind a terminal state;
    # loss = mean (Q - target)^2
    engine, batch = learner().engine, transitions(8, reward=1.0, **ending)
    (loss,), (network,) = engine.losses, engine.parts[0]
    with torch.no_grad():
        value = network(batch["observation"]).gather(-1, batch["action"][:, None])[:, 0]
        best = network(batch["next", "observation"]).amax(-1)
        by_hand = ((value - (1.0 + bootstraps * 0.995 * best)) ** 2).mean()
    assert loss(batch)["loss"].item() == pytest.approx(by_hand.item(), rel=1e-5)


def test_the_actor_follows_the_learner_and_epsilon_its_steps():
    agent = learner(epsilon_hold_steps=10, epsilon_decay_steps=100)
    assert agent.actor.epsilon == 1.0
    store(agent, 60)
    assert agent.actor.epsilon == pytest.approx(0.55)
    seen = transitions(200)["observation"][:, None]
    greedy = agent.evaluation_actor(200)

    def chosen():
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return greedy.choose(seen)

    before = chosen()
    for _ in range(50):
        agent.update()
    assert not torch.equal(before, chosen())
    best = agent.engine.parts[0][0](seen[:, 0]).argmax(-1)
    assert torch.equal(chosen()[:, 0], best)
