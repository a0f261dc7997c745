"""The loop, and evaluation: whoever watches is told of every turn and every episode."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from dqn_parts import dqn_learner, make_learner
from onlookers import Witness
from stock_collector import stock_collector

from cprl import CommonsEnv, Game, Rules, maps
from cprl.algorithms import DQN, LOLA, PPO, LOLASettings, RolloutSettings
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.learners.settings import DEFAULT_HIDDEN_CELLS, DQNSettings
from cprl.measuring.playing import evaluate, mean_return
from cprl.networks import GRU
from cprl.policies.actors import RandomActor
from cprl.policies.joint_policy import JointPolicy
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.episodes import EpisodeTable, read_episodes
from cprl.training import Schedule, Training, train

GAME = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.1), window_rows=3, window_columns=5, episode_steps=9),
)

SETTINGS = DQNSettings(buffer_size=200, learning_rate=1e-3, hidden_cells=(8,), epsilon_hold_steps=5)

OTHER = {1: RandomActor(8)}

ROLLOUTS = RolloutSettings(rollout_steps=8, minibatch_size=4, epochs=1, hidden_cells=(8,))


def learner(agent=0, *, seed=0):
    algorithm = DQN(settings=DQNSettings(buffer_size=200))
    return make_learner(algorithm, GAME.spaces, agents=(agent,), replicas=1, seed=seed, engine="torchrl")


def test_observers_see_every_turn_and_every_episode_and_each_learner_stores_its_own_turns():
    witness, learners = Witness(), {(0,): learner(0), (1,): learner(1)}
    train(CommonsEnv(GAME), learners, Schedule(episodes=5), callbacks=[witness])
    first, second = (one.memory.buffer.each[0][:]["observation"] for one in learners.values())
    assert not torch.equal(first, second)
    turns = {len(first), len(second), learners[0,].steps, sum(episode.steps for episode in witness.episodes)}
    assert turns == {len(witness.turns)}
    assert [episode.episode for episode in witness.episodes] == [0, 1, 2, 3, 4]
    names = {f"agent_{agent}/{name}" for agent in (0, 1) for name in ("loss", "epsilon", "q")}
    assert set(witness.learning[-1]) == names
    assert np.isfinite(witness.learning[-1]["agent_0/loss"])
    harvest = sum(float(turn["next", "agents", "harvest"].sum()) for turn in witness.turns)
    assert harvest == sum(episode.harvest.sum() for episode in witness.episodes)


def train_with(worlds, *, agent, episodes, **arguments):
    train(CommonsEnv(GAME, worlds), {(0,): learner(agent)}, Schedule(episodes=episodes), **arguments)


@pytest.mark.parametrize(
    ("worlds", "arguments", "message"),
    [
        (1, {"others": {}}, r"1 actors for 2 agents"),
        (1, {"others": {0: RandomActor(8), **OTHER}}, r"control the agents \[0, 0, 1\]"),
        (1, {"episodes": 0}, "episodes is 0"),
        (1, {"callbacks": [7]}, "callback 7"),
        (1, {"agent": 1}, r"made for the agents \(1,\) is given for \(0,\)"),
        (2, {}, r"has 2 replicas of 1 worlds; the learner of \(0,\) has 1 of 1"),
    ],
)
def test_what_cannot_be_trained_is_refused(worlds, arguments, message):
    given = {"agent": 0, "others": OTHER, "episodes": 1, **arguments}
    with pytest.raises(ValueError, match=message):
        train_with(worlds, **given)


@pytest.mark.parametrize("odd", [10, {"episodes": 3}, None, Schedule])
def test_what_is_no_schedule_is_refused_by_name(odd):
    with pytest.raises(ValueError, match=r"^schedule is .*; allowed: a Schedule$"):
        train(CommonsEnv(GAME), {(0,): learner(0)}, odd)


def test_learning_may_wait_for_several_steps_and_then_catches_up():
    class Counting(Learner):
        def update(self):
            updated_at.append(self.steps)
            return super().update()

    updated_at = []
    settings = replace(SETTINGS, learning_starts=1)
    lanes = Lanes(GAME.spaces, agents=(0, 1), replicas=2)
    agents = Counting(DQN(settings=settings), lanes, "eager")
    training = train(CommonsEnv(GAME, 2), {(0, 1): agents}, Schedule(episodes=2, update_every=3))
    bouts = training.steps // 3
    assert updated_at == [3 * (bout + 1) for bout in range(bouts) for _ in range(3)]


def test_torchrls_own_collector_trains_the_same():
    def course(*, update_every=1, **arguments):
        witness = Witness()
        agents = dqn_learner(
            GAME.spaces, agents=(0, 1), replicas=2, settings=SETTINGS, seed=3, engine="eager"
        )
        schedule = Schedule(episodes=4, update_every=update_every)
        train(CommonsEnv(GAME, 2, seed=3), {(0, 1): agents}, schedule, callbacks=[witness], **arguments)
        weights = agents.networks()["replica_1/agent_0"].state_dict().values()
        losses = [learning["agent_1/loss"] for learning in witness.learning]
        returns = [episode.return_.tolist() for episode in witness.episodes]
        return returns, losses, [weight.tolist() for weight in weights]

    assert repr(course(make_collector=stock_collector)) == repr(course())
    returns, losses, _ = course(make_collector=partial(stock_collector, steps=4), update_every=4)
    assert len(returns) == 8
    assert np.isfinite(losses[-2:]).all()


def test_checkpoints_of_what_keeps_no_state_are_refused_before_anything_is_played(tmp_path):
    env, witness = CommonsEnv(GAME), Witness()
    saving = {"checkpointer": Checkpointer(tmp_path), "callbacks": [witness]}
    agents = dqn_learner(GAME.spaces, agents=(0, 1), replicas=1, settings=SETTINGS, engine="eager")
    with pytest.raises(ValueError, match="a Collector has no state to resume from"):
        train(env, {(0, 1): agents}, Schedule(episodes=1), make_collector=stock_collector, **saving)
    assert witness.turns == []


def test_what_was_played_before_an_interruption_is_kept(tmp_path):
    class Interrupting(Witness):
        def on_episode(self, episode, learning):
            super().on_episode(episode, learning)
            if len(self.episodes) == 3:
                raise KeyboardInterrupt

    agents = {1: RandomActor(8)}
    table = EpisodeTable(tmp_path / "episodes.parquet")
    with pytest.raises(KeyboardInterrupt), table:
        train(
            CommonsEnv(GAME),
            {(0,): learner()},
            Schedule(episodes=9),
            others=agents,
            callbacks=[table, Interrupting()],
        )
    assert read_episodes(tmp_path)["episode"].to_pylist() == [0, 0, 1, 1, 2, 2]


UNEVEN = Game(
    map=maps.parse(".A>A.A\n.A.<.A"), rules=Rules(episode_steps=400, regrow_prob=(0.0, 0.0, 0.0, 0.0))
)
"""Boards that are empty at different turns in different worlds."""


def train_twice(agents):
    """Two trainings of the same learner, which the first leaves in the midst of an episode; their turns."""
    came = [Witness(), Witness()]
    for seed, witness in enumerate(came):
        env = CommonsEnv(UNEVEN, 3, seed=seed)
        train(env, {(0, 1): agents}, Schedule(episodes=1), callbacks=[witness])
    first, second = ([turn.clone() for turn in witness.turns] for witness in came)
    assert 0 < first[-1]["next", "done"].sum() < 3
    return first, second


@pytest.mark.integration
@pytest.mark.parametrize(("engine", "steps"), [("eager", 1), ("eager", 3), ("torchrl", 1)])
def test_what_a_second_training_stores_does_not_follow_the_last_turn_of_the_first(engine, steps):
    settings = DQNSettings(
        buffer_size=1000, hidden_cells=(8,), n_steps=steps, gamma=0.5, learning_starts=5000
    )
    agents = make_learner(DQN(settings=settings), UNEVEN.spaces, agents=(0, 1), replicas=3, engine=engine)
    first, second = train_twice(agents)
    came = [*first, *second]
    for lane in range(6):
        replica, agent = divmod(lane, 2)
        done = [turn["next", "done"][replica].item() for turn in came]
        done[len(first) - 1] = True
        places = torch.arange(len(came) - steps)
        if engine == "eager":
            stored = agents.memory.buffer.get(places.expand(6, -1))[lane]
        else:
            stored = agents.memory.buffer.each[lane].storage[:][: len(places)]
        for place in places.tolist():
            rewards, last = 0.0, place
            for ahead in range(steps):
                last = place + ahead
                rewards += 0.5**ahead * came[last]["next", "agents", "reward"][replica, agent].item()
                if done[last]:
                    break
            before, after = came[place]["agents"], came[last]["next", "agents"]
            assert torch.equal(stored["observation"][place], before["observation"][replica, agent])
            assert torch.equal(stored["next", "observation"][place], after["observation"][replica, agent])
            assert stored["next", "reward"][place].item() == pytest.approx(rewards)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("algorithm", "engine", "wanted"),
    [
        (PPO(settings=ROLLOUTS), "eager", 8),
        (PPO(settings=replace(ROLLOUTS, hidden_cells=DEFAULT_HIDDEN_CELLS), network=GRU()), "eager", 8),
        (PPO(settings=ROLLOUTS), "torchrl", 8),
        (LOLA(settings=LOLASettings(rollout_steps=4, hidden_cells=(8,)), estimator="dice"), None, 12),
    ],
)
def test_a_second_training_begins_its_rollouts_anew(algorithm, engine, wanted):
    engine = {} if engine is None else {"engine": engine}
    agents = make_learner(algorithm, UNEVEN.spaces, agents=(0, 1), replicas=3, **engine)

    def weights():
        return [value for network in agents.networks().values() for value in network.state_dict().values()]

    first = Training(CommonsEnv(UNEVEN, 3, seed=0), {(0, 1): agents}, Schedule(episodes=1))
    for _ in range(11):
        first.step()
    before, second = (
        weights(),
        Training(CommonsEnv(UNEVEN, 3, seed=1), {(0, 1): agents}, Schedule(episodes=1)),
    )
    states = agents.state_dict()["memory"].get("recurrent")
    assert states is None or states["ended"].all()
    for _ in range(wanted):
        assert all(map(torch.equal, weights(), before))
        second.step()
    assert not all(map(torch.equal, weights(), before))


def test_evaluation_plays_one_episode_in_every_world_and_changes_no_seed():
    state = torch.get_rng_state()
    episodes = evaluate(CommonsEnv(GAME, 7, seed=1), JointPolicy([RandomActor(8), RandomActor(8, seed=1)]))
    assert [episode.world for episode in episodes] == list(range(7))
    assert {episode.steps for episode in episodes} <= set(range(1, 10))
    assert torch.equal(torch.get_rng_state(), state)
    mean, error = mean_return(episodes)
    returns = [episode.return_.sum() for episode in episodes]
    assert mean == pytest.approx(np.mean(returns))
    assert error == pytest.approx(np.std(returns, ddof=1) / 7**0.5)


def test_evaluation_explores_only_if_asked():
    agent = learner()
    agent.actor.epsilon = 1.0
    agents = JointPolicy({(0,): agent.actor, 1: RandomActor(8)})

    def actions(explore):
        env = CommonsEnv(GAME, 1, seed=1)
        seen = []
        step = env.lean_step
        env.lean_step = lambda td, **resets: (
            seen.append(int(td["agents", "action"][0, 0])) or step(td, **resets)
        )
        evaluate(env, agents, explore=explore)
        return seen

    assert actions(explore=False) == actions(explore=False)
    assert len(set(actions(explore=True))) > 2


def test_two_callbacks_of_one_class_each_have_their_own_state():
    class Counts:
        def __init__(self, first):
            self.count = first

        def on_step(self, batch):
            self.count += 1

        def state_dict(self):
            return {"count": self.count}

        def load_state_dict(self, state):
            self.count = state["count"]

    def training(*firsts):
        agents = dqn_learner(GAME.spaces, agents=(0, 1), replicas=1, settings=SETTINGS, engine="eager")
        counts = [Counts(first) for first in firsts]
        return Training(CommonsEnv(GAME, seed=0), {(0, 1): agents}, Schedule(episodes=1), callbacks=counts)

    one, other = training(10, 20), training(0, 0)
    one.step()
    other.load_state_dict(one.state_dict())
    assert [callback.count for callback in other.callbacks] == [11, 21]
