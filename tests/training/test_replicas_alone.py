"""Training many replicas at once: each plays and learns as it would alone. One DQN agent of stock parts: its
transitions, its target worked by hand, its clock."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from dqn_parts import MEADOW as GAME, dqn_learner, make_learner
from onlookers import ByWindow, Witness
from tensordict import TensorDict, assert_close
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl import CommonsEnv, keys
from cprl.algorithms import DQN
from cprl.commons.spaces import Spaces
from cprl.experimental.current_policy import FirstReplica
from cprl.learners.lanes import Lanes
from cprl.learners.settings import DQNSettings
from cprl.learners.transitions import transitions_of
from cprl.policies.actors import LaneActor, RandomActor
from cprl.policies.joint_policy import JointPolicy
from cprl.runs.episodes import EpisodeTable, read_episodes
from cprl.training import Schedule, train
from cprl.training.training import StepCollector

SETTINGS = DQNSettings(
    buffer_size=150,
    batch_size=4,
    learning_rate=1e-3,
    hidden_cells=(8,),
    epsilon_hold_steps=20,
    epsilon_decay_steps=100,
    target_every_episodes=2,
)
UPDATES = ["list", "vmapped", "stacked"]


def learner(update="stacked", *, game=GAME, agents=(0, 1), settings=SETTINGS, **how):
    return dqn_learner(game.spaces, agents=agents, settings=settings, update=update, engine="eager", **how)


@pytest.mark.integration
def test_every_replica_is_told_of_so_many_episodes_and_of_its_losses(tmp_path):
    with EpisodeTable(tmp_path / "episodes.parquet") as table:
        witness = Witness()
        env = CommonsEnv(GAME, 3, seed=1)
        train(env, {(0, 1): learner(replicas=3)}, Schedule(episodes=5), callbacks=[table, witness])
    rows = read_episodes(tmp_path).to_pydict()
    for replica in range(3):
        told = zip(rows["replica"], rows["agent"], rows["episode"], strict=True)
        episodes = [episode for number, agent, episode in told if (number, agent) == (replica, 1)]
        assert episodes == [0, 1, 2, 3, 4]
        learning = zip(witness.episodes, witness.learning, strict=True)
        *_, last = (learned for episode, learned in learning if episode.world == replica)
        assert np.isfinite([last["agent_0/loss"], last["agent_1/loss"]]).all()
    assert set(witness.learning[0]) == {
        f"agent_{i}/{name}" for i in (0, 1) for name in ("loss", "epsilon", "q")
    }


@pytest.mark.integration
@pytest.mark.parametrize("worlds", [1, 4])
def test_the_lean_collector_yields_what_torchrls_own_yields(worlds):
    # By a policy that follows from the window alone: the stock collector calls it once to see its entries.
    stock = Collector(
        CommonsEnv(GAME, worlds, seed=2),
        ByWindow(),
        frames_per_batch=worlds,
        total_frames=60 * worlds,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    lean = StepCollector(CommonsEnv(GAME, worlds, seed=2), ByWindow())
    ends = 0
    for batch, own in zip(stock, lean, strict=False):
        assert_close(own, batch[:, 0])
        assert set(own.keys(True, True)) == set(batch.keys(True, True))
        ends += int(own["next", "done"].sum())
    assert ends >= 4 * worlds
    stock.shutdown()
    lean.shutdown()


def test_the_transitions_of_an_agent_are_its_own_under_torchrls_default_keys():
    for turn in CommonsEnv(GAME, 2).rollout(12, break_when_any_done=False).unbind(1):
        lanes = Lanes(GAME.spaces, agents=(1,), replicas=2)
        rewards = turn["next", "agents", "reward"][..., 0].numpy()
        own = transitions_of(lanes.turn(keys.Turn.of(turn), rewards, lanes.form())._asdict())
        assert own.batch_size == (2,)
        assert torch.equal(own["observation"], turn[keys.OBSERVATION][:, 1])
        assert torch.equal(own["action"], turn[keys.ACTION][:, 1])
        assert torch.equal(own["next", "observation"], turn["next", "agents", "observation"][:, 1])
        assert torch.equal(own["next", "reward"], turn["next", "agents", "reward"][:, 1])
        for name in ("done", "terminated"):
            assert torch.equal(own["next", name], turn["next", name])
        assert own["observation"].dtype == torch.uint8


def test_transitions_of_lanes_are_those_of_the_agents():
    turn = CommonsEnv(GAME, 3).rollout(1)[:, 0]
    before, after = turn["agents"], turn["next", "agents"]
    for agents in ((0, 1), (1,), (1, 0)):
        learning = Lanes(GAME.spaces, agents=agents, replicas=3)
        rewards = after["reward"][..., 0].numpy()
        lanes = learning.turn(keys.Turn.of(turn), rewards, learning.form())
        for place, agent in enumerate(agents):
            own = lanes._make(entry if entry is None else entry[place :: len(agents)] for entry in lanes)
            assert np.array_equal(own.observation, before["observation"][:, agent])
            assert np.array_equal(own.action, before["action"][:, agent])
            assert np.array_equal(own.next_observation, after["observation"][:, agent])
            assert np.array_equal(own.reward, after["reward"][:, agent, 0])
            for name in ("done", "terminated"):
                assert np.array_equal(getattr(own, name), turn["next", name][:, 0])


@pytest.mark.integration
def test_a_lane_explores_by_its_own_numbers_and_only_where_asked():
    def values(seen):
        return torch.zeros(*seen.shape[:2], 8).index_fill(2, torch.tensor(5), 1.0)

    def chosen(seeds, *, agents=1, worlds=1, epsilon=0.5, manner=ExplorationType.RANDOM, steps=400):
        actor = LaneActor(values, 8, seeds=seeds, agents=agents, worlds=worlds)
        actor.epsilon = epsilon
        shape = len(seeds) // agents * worlds, agents, 3, 2, 2
        seen = TensorDict({"observation": torch.zeros(shape, dtype=torch.uint8)}, shape[:1])
        with set_exploration_type(manner):
            return torch.stack([actor(seen.clone())["action"] for _ in range(steps)])

    both = chosen([(1, 0), (1, 1)])
    assert both.shape == (400, 2, 1)
    assert torch.equal(both[:, 1], chosen([(1, 1)])[:, 0])
    assert not torch.equal(both[:, 0], both[:, 1])
    assert (both == 5).float().mean() == pytest.approx(0.5 + 0.5 / 8, abs=0.05)
    assert (chosen([(1, 0)], epsilon=0.0) == 5).all()
    assert (chosen([(1, 0)], manner=ExplorationType.DETERMINISTIC) == 5).all()
    many = chosen([(1, 0), (1, 1)], agents=2, worlds=3)
    assert many.shape == (400, 3, 2)
    assert (many[:, 0] != many[:, 1]).any()


def test_lanes_by_worlds_reach_the_right_network():
    agents = learner(replicas=2)
    actor = agents.evaluation_actor(3)
    windows = torch.randint(0, 256, (6, 2, *GAME.observation_shape), dtype=torch.uint8)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        chosen = actor(TensorDict({"observation": windows}, [6]))["action"]
    for world in range(6):
        for agent in range(2):
            lane = 2 * (world // 3) + agent
            seen = windows[world, agent].expand(4, 1, *GAME.observation_shape)
            assert chosen[world, agent] == agents.lane_networks.outputs(seen)[lane, 0].argmax()


@pytest.mark.integration
@pytest.mark.parametrize("update", UPDATES)
def test_the_first_replica_alone_acts_with_the_weights_of_the_moment(update):
    agents = learner(update, replicas=3)
    actor, of_all = (agents.evaluation_actor(1) for _ in range(2))
    alone = FirstReplica(actor, replicas=3)
    env = CommonsEnv(GAME, 3, seed=3)
    windows = torch.randint(0, 256, (3, 2, *GAME.observation_shape), dtype=torch.uint8)
    before = actor.action_values(windows)[0]
    train(env, {(0, 1): agents}, Schedule(episodes=3))
    now = agents.lane_networks.outputs(windows.flatten(0, 1)[:, None])[:2, 0]
    torch.testing.assert_close(actor.action_values(windows)[0], now)
    assert (before - now).abs().max() > 1e-4, "it has learned since"
    seen = TensorDict({"observation": windows[:1]}, [1])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(alone(seen)["action"][0], now.argmax(-1))
    of_all.epsilon = actor.epsilon = 0.5
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(20):
            assert torch.equal(alone(seen)["action"], of_all.choose(windows)[:1])


def test_seats_take_every_agent_once():
    with pytest.raises(ValueError, match=r"actors control the agents \[0, 0\]"):
        JointPolicy({0: RandomActor(8), (0,): RandomActor(8)})
    env = CommonsEnv(GAME, 2)
    agents = JointPolicy({1: RandomActor(8, seed=1), 0: RandomActor(8)})
    with pytest.raises(ValueError, match="1 actors for 2 agents"):
        JointPolicy([RandomActor(8)])(env.reset())
    assert agents(env.reset())[keys.ACTION].shape == (2, 2)


SPACES = Spaces(agents=1, observation_shape=(3, 2, 3), actions=4)


def stock_learner(**changes):
    """The learner of one agent in one replica, of stock parts."""
    settings = replace(DQNSettings(buffer_size=100, learning_rate=1e-3), **changes)
    return make_learner(DQN(settings=settings), SPACES, agents=(0,), replicas=1, engine="torchrl")


def store(agent, count, *, reward=0.0):
    """Stores so many made-up turns of a world in which nothing ends."""
    for made_up in transitions(count, reward=reward).split(1):
        following = made_up["next"]
        after = {name: following[name][:, None] for name in ("observation", "reward")}
        flags = {name: following[name] for name in ("done", "terminated", "truncated")}
        before = {name: made_up[name][:, None] for name in ("observation", "action")}
        agent.store(TensorDict({"agents": before, "next": {"agents": after, **flags}}, [1]))


def transitions(count, *, reward=0.0, terminated=False, truncated=False):
    seen = torch.randint(256, (2, count, 3, 2, 3), dtype=torch.uint8)
    after = {"reward": reward, "terminated": terminated, "truncated": truncated}
    after = {name: torch.full((count, 1), value) for name, value in after.items()}
    after |= {"observation": seen[1], "done": after["terminated"] | after["truncated"]}
    before = {"observation": seen[0], "action": torch.randint(4, (count,))}
    return TensorDict({**before, "next": TensorDict(after, [count])}, [count])


@pytest.mark.parametrize(
    ("ending", "bootstraps"), [({}, 1.0), ({"truncated": True}, 1.0), ({"terminated": True}, 0.0)]
)
def test_the_clock_running_out_is_no_end_for_the_target_but_depletion_is(ending, bootstraps):
    # target = r + gamma max_a Q'(s', a), without the second term behind a terminal state;
    # loss = mean (Q - target)^2
    engine, batch = stock_learner().lane_networks, transitions(8, reward=1.0, **ending)
    (loss,), (network,) = engine.losses, engine.parts[0]
    with torch.no_grad():
        value = network(batch["observation"]).gather(-1, batch["action"][:, None])[:, 0]
        best = network(batch["next", "observation"]).amax(-1)
        by_hand = ((value - (1.0 + bootstraps * 0.995 * best)) ** 2).mean()
    assert loss(batch)["loss"].item() == pytest.approx(by_hand.item(), rel=1e-5)


def test_the_actor_follows_the_learner_and_epsilon_its_steps():
    agent = stock_learner(epsilon_hold_steps=10, epsilon_decay_steps=100)
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
    best = agent.lane_networks.parts[0][0](seen[:, 0]).argmax(-1)
    assert torch.equal(chosen()[:, 0], best)
