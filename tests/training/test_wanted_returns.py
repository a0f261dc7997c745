"""Every learner stores the rewards that its agents want; a training that was stopped goes on with them."""

from dataclasses import dataclass, replace

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from dqn_parts import make_learner
from matrix_game import MatrixGame

import cprl
from cprl import CommonsEnv, Experiment, Game, Rules, algorithms, maps
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.commands.recipe_command import parse_command
from cprl.envs import spaces_of
from cprl.institutions import Tax
from cprl.measuring.tracker import EpisodeTracker
from cprl.objectives.rewards import Exchange, InequityAversion, RewardModel, SocialValueOrientation
from cprl.population import Learning, Scripted, Team
from cprl.runs.episodes import read_episodes
from cprl.training import Schedule, Training, train
from cprl.training.agents import Population

AVERSE = InequityAversion(alpha=5, beta=0.05, smoothing=0.9)
REWARDS = {
    "individual": "individual",
    "team": "team",
    "averse": AVERSE,
    "angle": SocialValueOrientation(angle=0.5, weight=0.3),
    "half": Exchange(0.5),
}
REPLAY = DQNSettings(
    buffer_size=60, batch_size=4, hidden_cells=(8,), learning_rate=1e-3, epsilon_decay_steps=40
)
ROLLOUTS = RolloutSettings(rollout_steps=20, minibatch_size=10, epochs=2, hidden_cells=(8,))
LOOK = algorithms.LOLASettings(rollout_steps=20, hidden_cells=(8,))
LEARNERS = {
    "replay": (DQN(settings=REPLAY), "eager"),
    "replay of torchrl": (DQN(settings=REPLAY), "torchrl"),
    "rollouts": (PPO(settings=ROLLOUTS), "eager"),
    "rollouts of torchrl": (PPO(settings=ROLLOUTS), "torchrl"),
    "tables": (algorithms.Tabular(settings=algorithms.TabularSettings()), "eager"),
    "team": (algorithms.IPPO(settings=ROLLOUTS), "eager"),
    "look ahead": (algorithms.LOLA(settings=LOOK), "eager"),
}
BOARD = Game(
    map=maps.parse(".A>.A.A\nA.A.v.A\n..<.A.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=12, freeze_steps=2),
)


def learner_of(name, reward, agents=(0, 1)):
    algorithm, engine = LEARNERS[name]
    return make_learner(
        algorithm,
        spaces_of(MatrixGame(2)),
        agents=agents,
        replicas=2,
        seed=3,
        engine=engine,
        reward=reward,
    )


def batches(turns):
    """Turns of a dilemma with actions by chance; its worlds end after 5 and 6 turns, again and again."""
    return MatrixGame(2).rollout(turns, break_when_any_done=False).unbind(1)


def on_paper(reward, found):
    """The wanted rewards of turns, [T, R, N]."""
    model = RewardModel(reward)
    return np.stack(
        [
            model.add(batch["next", "agents", "reward"][..., 0].numpy(), batch["next", "done"][:, 0].numpy())
            for batch in found
        ]
    )


def stored(name, learner, turns):
    """The rewards that a learner holds, [T, L]."""
    if name == "replay":
        return learner.memory.buffer.fields["reward"][:turns].numpy()
    if name == "replay of torchrl":
        own = [buffer.storage[:turns]["next", "reward"][:, 0] for buffer in learner.memory.buffer.each]
        return torch.stack(own, 1).numpy()
    if name == "tables":
        return np.stack([turn["reward"] for turn in learner.memory._turns])
    if name == "look ahead":
        return learner.memory.rollout.fields["reward"][0, :, 0, :turns].T.numpy()
    return learner.memory.rollout.fields["reward"][:, 0, :turns].transpose(0, 1).reshape(turns, -1).numpy()


@pytest.mark.parametrize("reward", REWARDS.values(), ids=REWARDS)
@pytest.mark.parametrize("name", LEARNERS)
def test_a_learner_stores_what_its_agents_want(name, reward):
    found = batches(17)
    expected = on_paper(reward, found)
    assert expected.std() > 0
    learner = learner_of(name, reward)
    for batch in found:
        given = batch["next", "agents", "reward"].clone()
        learner.store(batch)
        assert torch.equal(batch["next", "agents", "reward"], given), "the environment's reward stays"
    assert np.array_equal(stored(name, learner, 17), expected.reshape(17, -1))


@pytest.mark.parametrize("name", ["replay", "rollouts of torchrl", "tables"])
def test_who_learns_alone_compares_itself_with_those_who_do_not_learn(name):
    found = batches(17)
    learner = learner_of(name, AVERSE, agents=(1,))
    for batch in found:
        learner.store(batch)
    assert np.array_equal(stored(name, learner, 17), on_paper(AVERSE, found)[:, :, 1])


@pytest.mark.parametrize("name", LEARNERS)
def test_a_learner_remembers_where_its_state_was_taken(name):
    found = batches(17)
    whole, first, then = (learner_of(name, AVERSE) for _ in range(3))
    for batch in found:
        whole.store(batch)
    for batch in found[:8]:  # within an episode of both replicas
        first.store(batch)
    state = first.state_dict()
    assert state["rewards"]["smoothed"].shape == (2, 2)
    then.load_state_dict(state)
    for batch in found[8:]:
        then.store(batch)
    assert np.array_equal(stored(name, then, 17), stored(name, whole, 17))


class InState:
    """Keeps batches and episodes; stops at a step."""

    def __init__(self, stop_at=None):
        self.batches, self.episodes, self.stop_at = [], [], stop_at

    def on_step(self, batch):
        self.batches.append(batch.clone())
        if len(self.batches) == self.stop_at:
            raise StoppedError

    def on_episode(self, episode, learning):
        self.episodes.append(episode)


class StoppedError(Exception):
    """A training is stopped."""


def population(specs, env, **how):
    return Population(env, specs, seed=3, engine="eager", **how)


def test_the_wanted_return_is_the_sum_of_the_episode_and_the_return_stays_that_of_the_game():
    env, kept = CommonsEnv(BOARD, 2, seed=3), InState()
    dqn = DQN(settings=REPLAY)
    agents = population([Learning(dqn, reward=AVERSE), Learning(dqn), Scripted("greedy")], env)
    train(env, agents.learners, Schedule(episodes=3), others=agents.others, callbacks=[kept])
    tracker, wanted, total = EpisodeTracker(2, 3), np.zeros((2, 3)), []
    for batch, rewards in zip(kept.batches, on_paper(AVERSE, kept.batches), strict=True):
        wanted += rewards
        for episode in tracker.add(batch):
            total.append((episode.return_, wanted[episode.world].copy()))
            wanted[episode.world] = 0
    assert len(total) == len(kept.episodes) == 6
    assert sum(abs(returns - sums).sum() for returns, sums in total) > 1
    for episode, (returns, sums) in zip(kept.episodes, total, strict=True):
        assert episode.return_.tolist() == returns.tolist()
        assert episode.wanted_return.tolist()[:2] == [sums[0], returns[1]]
        assert np.isnan(episode.wanted_return[2]), "who does not learn wants nothing"


def test_what_is_wanted_is_made_of_what_is_left_after_fines_and_transfers():
    taxed = replace(BOARD, institutions=(Tax(rate=0.5),))
    env, kept = CommonsEnv(taxed, 2, seed=3), InState()
    agents = population([Learning(DQN(settings=REPLAY), reward="team"), *[Scripted("greedy")] * 2], env)
    train(env, agents.learners, Schedule(episodes=3), others=agents.others, callbacks=[kept])
    fines, transfers, harvest = (
        sum(float(batch["next", "agents", name].sum()) for batch in kept.batches)
        for name in ("fines", "transfers", "harvest")
    )
    assert fines > 1
    wanted = sum(episode.wanted_return[0] for episode in kept.episodes)
    assert wanted == pytest.approx(harvest - fines + transfers, abs=1e-4)
    assert wanted == pytest.approx(sum(episode.return_.sum() for episode in kept.episodes), abs=1e-4)


def test_a_second_training_begins_without_what_the_first_remembered():
    learner = learner_of("replay", AVERSE)
    for batch in batches(3):
        learner.store(batch)
    assert learner.rewards.state_dict()
    Training(MatrixGame(2), {(0, 1): learner}, Schedule(episodes=1))
    assert learner.rewards.state_dict() == {}


EXPERIMENT = Experiment(
    name="wants",
    game=BOARD,
    agents=[Learning(DQN(settings=REPLAY), reward=AVERSE), Learning(DQN(settings=REPLAY)), Scripted()],
    episodes=2,
    replicas=2,
    evaluation_episodes=1,
    engine="eager",
)


@pytest.mark.integration
def test_a_run_keeps_rewards_in_its_recipe_and_its_table(tmp_path):
    run = cprl.run(EXPERIMENT, tmp_path / "run", watch="off")
    loaded = cprl.load(run)
    assert loaded.experiment == EXPERIMENT
    assert loaded.specs[0].reward == AVERSE
    table = pq.read_table(run / "episodes.parquet").to_pylist()
    assert len(table) == 2 * 2 * 3
    for row in table:
        if row["agent"] == 1:
            assert row["wanted_return"] == row["return"]
        if row["agent"] == 2:
            assert row["wanted_return"] is None
    longer = cprl.run(EXPERIMENT, tmp_path / "other", watch="off")
    assert read_episodes(longer).equals(read_episodes(run)), "null equals null, NaN does not"
    milder = Learning(DQN(settings=REPLAY), reward=replace(AVERSE, alpha=4))
    changed = replace(EXPERIMENT, agents=[milder, *EXPERIMENT.agents[1:]])
    with pytest.raises(ValueError, match=r"agents\[0\]\.reward\.alpha was 5.0, is 4.0"):
        cprl.run(changed, run, resume=True, watch="off")


def test_rewards_are_flags_by_their_place():
    given, _ = parse_command(
        lambda: EXPERIMENT, ["mine.py", "--agents.0.reward.alpha", "2", "--agents.1.reward", "team"]
    )
    assert given.agents[0].reward == replace(AVERSE, alpha=2.0)
    assert given.agents[1].reward == "team"


@dataclass(frozen=True)
class Deaf(DQN):
    """An algorithm of somebody's own, whose learner knows two rewards."""

    def make_learner(self, lanes, engine="compiled"):
        return super().make_learner(replace(lanes, reward="individual"), engine)


@pytest.mark.parametrize(
    ("specs", "message"),
    [
        ([Team(algorithms.QMIX(settings=REPLAY), (0, 1), reward=AVERSE)], "reward is InequityAversion"),
        (
            [Learning(Deaf(settings=REPLAY), reward=AVERSE)] * 2,
            "reward is InequityAversion, which the learner of Deaf does not have as its `rewards`",
        ),
    ],
)
def test_where_it_cannot_be_wanted_it_is_refused_by_name(specs, message):
    with pytest.raises(ValueError, match=message):
        population(specs, MatrixGame(2))


def test_agents_without_others_are_refused():
    alone = Game(map=maps.parse("A.>.A"), rules=Rules(may_fire=False))
    with pytest.raises(ValueError, match=r"experiment\.agents\[0\]\.reward is Exchange.* a game of 1 agent"):
        replace(EXPERIMENT, game=alone, agents=[Learning(DQN(settings=REPLAY), reward=Exchange(0.5))])
    with pytest.raises(ValueError, match=r"reward is Exchange, which compares an agent with others"):
        make_learner(DQN(settings=REPLAY), alone.spaces, agents=(0,), replicas=1, reward=Exchange(0.5))
