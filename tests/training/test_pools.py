"""A pool draws an opponent for each episode of each world, from stored agents and past selves."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from matrix_game import MatrixGame
from recurrent_learners import ON_POLICY
from same_runs import assert_same_training, differences
from small_learners import ALGORITHMS, FOUR, GAME, population, ran
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import cprl
from cprl import CommonsEnv, Custom, Experiment
from cprl.algorithms import Tabular, TabularSettings
from cprl.evaluation import Fresh, crossplay, evaluate_run
from cprl.measuring.playing import evaluate
from cprl.population import Frozen, Learning, OwnPast, Pool, Scripted, Team, partners_in
from cprl.runs.checkpoints import checkpoints_in
from cprl.runs.export import export_results
from cprl.training import Schedule, train
from cprl.training.agents import Population

DQN = Learning(ALGORITHMS["DQN"])
PPO = Learning(ALGORITHMS["PPO"])
CLOCK = GAME.rules.episode_steps


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A run by DQN, DQN, PPO and a script; the tests stand beside it."""
    folder = tmp_path_factory.mktemp("stored")
    ran(folder, [DQN, DQN, PPO, Scripted("random")], name="earlier")
    return folder


@pytest.fixture(autouse=True)
def beside(stored, monkeypatch):
    monkeypatch.chdir(stored)


def earlier(agent, replica=0):
    return Frozen("earlier", agent, replica=replica)


class Drawn:
    """Keeps the opponent of an agent in each turn of each world, counted from 0."""

    def __init__(self, agent=1):
        self.agent = agent
        self.turns = []
        self.ended = []

    def on_step(self, batch):
        self.turns.append((batch["agents", "recurrent_state"][:, self.agent, 0] - 1).int().tolist())
        self.ended.append(batch["next", "done"][:, 0].tolist())

    def by_episode(self, world):
        """The opponents of each episode of a world, as sets."""
        episodes = [set()]
        for turn, ended in zip(self.turns, self.ended, strict=True):
            episodes[-1].add(turn[world])
            if ended[world]:
                episodes.append(set())
        return [drawn for drawn in episodes if drawn]


def training_of(pool, *, learner=DQN, episodes=6, replicas=2, worlds=1, seed=3, first=0, callbacks=()):
    """A population with a pool beside agent 0, trained."""
    specs = [learner, pool, Scripted(), Scripted()]
    how = {"seed": seed, "worlds": worlds, "first_replica": first, "engine": "eager"}
    env = CommonsEnv(GAME, replicas * worlds, seed=seed, first_world=first * worlds)
    agents = Population(env, specs, **how)
    schedule = Schedule(episodes=episodes, worlds=worlds)
    train(env, agents.learners, schedule, others=agents.others, callbacks=list(callbacks))
    return agents


@pytest.mark.integration
def test_each_world_draws_for_itself_and_keeps_its_opponent_for_the_episode():
    drawn = Drawn()
    training_of(Pool(runs=(earlier(0), earlier(2), earlier(3))), worlds=3, episodes=15, callbacks=[drawn])
    by_world = [drawn.by_episode(world) for world in range(6)]
    assert all(len(episode) == 1 for episodes in by_world for episode in episodes)
    sequences = {tuple(tuple(episode) for episode in episodes) for episodes in by_world}
    assert len(sequences) > 3, "worlds draw apart"


@pytest.mark.integration
def test_all_opponents_are_equally_likely():
    pools = population([Pool(runs=(earlier(0),) * 3), Pool(runs=(earlier(0),) * 3), *[Scripted()] * 2]).others
    windows = CommonsEnv(GAME, 2, seed=1).reset()["agents", "observation"][:, :1]
    zeros = torch.zeros(2, 1, 1)  # an episode begins
    draws = []
    for _ in range(1500):
        moments = [TensorDict({"observation": windows, "recurrent_state": zeros}, [2]) for _ in range(2)]
        played = [pools[agent,](moment) for agent, moment in enumerate(moments)]
        draws.append([int(number) for moment in played for number in moment["recurrent_state"]])
    for columns in zip(*draws, strict=True):
        counts = Counter(columns)
        # 1,500 draws of three: 500 each, with a standard deviation of 18.
        assert all(440 < counts[number] < 560 for number in (1, 2, 3))
    # Independent of each other: each of nine pairs 167 times, with a standard deviation of 12.
    for other in (1, 2, 3):
        pairs = Counter((draw[0], draw[other]) for draw in draws)
        assert len(pairs) == 9
        assert all(120 < count < 215 for count in pairs.values())


@pytest.mark.integration
def test_draws_follow_from_the_seed_alone():
    pool = Pool(runs=(earlier(0), earlier(1)), own_past=OwnPast(0, every_steps=30, kept=2))
    draws = []
    for seed in (3, 3, 4):
        drawn = Drawn()
        training_of(pool, seed=seed, callbacks=[drawn])
        draws.append(drawn.turns)
    assert draws[0] == draws[1]
    assert draws[0] != draws[2]


@pytest.mark.integration
def test_a_replica_draws_and_learns_as_it_would_alone():
    pool = Pool(runs=(earlier(0), earlier(2)), own_past=OwnPast(0, every_steps=25, kept=2))
    among = Drawn()
    alone = Drawn()
    together = training_of(pool, replicas=3, callbacks=[among]).networks()
    last = training_of(pool, replicas=1, first=2, callbacks=[alone]).networks()
    assert [turn[2] for turn in among.turns] == [turn[0] for turn in alone.turns]
    assert {name for name in together if "replica_2" in name} == set(last)
    for name, network in last.items():
        for theirs, weight in zip(together[name].parameters(), network.parameters(), strict=True):
            torch.testing.assert_close(weight, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("agent", FOUR[:3])
def test_a_pool_of_one_plays_as_that_one(agent):
    returns = []
    for spec in (earlier(agent, replica=None), Pool(runs=(earlier(agent, replica=None),))):
        policy = population([spec, *[Scripted("sustainable")] * 3]).policy(2)
        episodes = evaluate(CommonsEnv(GAME, 4, seed=1), policy)
        returns.append([episode.return_.tolist() for episode in episodes])
    assert returns[0] == returns[1]


def test_the_action_of_the_drawn_opponent_counts():
    pool = Pool(runs=tuple(earlier(agent) for agent in FOUR[:3]))
    moment = CommonsEnv(GAME, 8, seed=1).reset()
    windows = moment["agents", "observation"][:, :1].clone()
    actors = [population([earlier(agent), *[Scripted()] * 3], replicas=8).others[0,] for agent in FOUR[:3]]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        population([pool, *[Scripted()] * 3], replicas=8).policy(1)(moment)
        choices = [actor.choose(windows)[:, 0].tolist() for actor in actors]
    drawn = moment["agents", "recurrent_state"][:, 0, 0].int().tolist()
    assert len(set(drawn)) > 1
    chosen = moment["agents", "action"][:, 0].tolist()
    assert chosen == [choices[number - 1][world] for world, number in enumerate(drawn)]


class Kept:
    """Keeps the weights of agent 0 before each turn."""

    def __init__(self):
        self.weights = []

    def on_start(self, training):
        self.learner = training.learners[0,]
        self.on_step(None)

    def on_step(self, batch):
        networks = self.learner.networks()
        self.weights.append({name: network.state_dict() for name, network in networks.items()})


def same(network, weights):
    return all(torch.equal(weights[name], weight) for name, weight in network.state_dict().items())


@pytest.mark.integration
@pytest.mark.parametrize("learner", [DQN, PPO, Learning(ON_POLICY["PPO"])], ids=["DQN", "PPO", "recurrent"])
@pytest.mark.parametrize("draw", ["uniform", "newest"])
def test_past_selves_are_copies_of_every_so_many_steps_of_which_the_newest_are_drawn(learner, draw):
    drawn = Drawn()
    kept = Kept()
    pool = Pool(own_past=OwnPast(0, every_steps=40, kept=3), draw=draw)
    agents = training_of(pool, learner=learner, worlds=2, episodes=40, callbacks=[kept, drawn])
    turns = len(drawn.turns)
    copies = 1 + (2 * (turns - 1)) // 40  # a turn of two worlds is two steps
    past = {name: network for name, network in agents.networks().items() if "past" in name}
    numbers = range(copies - 4, copies)
    assert list(past) == [f"replica_{replica}/agent_1/past_{n}" for n in numbers for replica in (0, 1)]
    for name, network in past.items():
        step = 40 * int(name.rpartition("_")[2])
        assert same(network, kept.weights[step // 2][f"{name.split('/')[0]}/agent_0"]), name
    begins = [0, 0, 0, 0]
    for turn, opponents in enumerate(drawn.turns):
        newest = 2 * turn // 40
        drawable = [number % 4 for number in range(max(0, newest - 2), newest + 1)]
        for world in range(4):
            if turn == begins[world]:
                allowed = drawable if draw == "uniform" else drawable[-1:]
                assert opponents[world] in allowed
            if drawn.ended[turn][world]:
                begins[world] = turn + 1
    stored_pools = agents.as_stored([0, 1])[1]
    for replica, stored_pool in enumerate(stored_pools):
        names = [f"replica_{replica}/agent_1/past_{number}" for number in list(numbers)[1:]]
        assert [opponent.network for opponent in stored_pool.pool] == [past[name] for name in names]


@pytest.mark.integration
def test_an_episode_draws_again_only_when_its_past_self_is_deleted():
    drawn = Drawn()
    # A copy every two turns: of three places, copy 3 takes that of copy 0 at turn 6, copy 5 that of 2 at 10.
    pool = Pool(own_past=OwnPast(0, every_steps=8, kept=2))
    training_of(pool, worlds=4, episodes=4, callbacks=[drawn])
    first, again = drawn.turns[:6], drawn.turns[6:10]
    assert first == [[0] * 8] * 6, "copy 0 has left the pool at turn 4, and plays on"
    assert again == [again[0]] * 4
    assert set(again[0]) == {2, 0}, "copies 2 and 3"


EXPERIMENT = {
    "replicas": 2,
    "worlds": 2,
    "episodes": 12,
    "seed": 3,
    "evaluation_episodes": 2,
    "engine": "eager",
}


def experiment(pool, *, learner=DQN, **changes):
    agents = (learner, pool, Scripted(), Scripted())
    return Experiment(name="pooled", game=GAME, agents=agents, **{**EXPERIMENT, **changes})


FULL = Pool(
    runs=(earlier(1, replica=None), earlier(2), earlier(3)), own_past=OwnPast(0, every_steps=30, kept=2)
)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("learner", "steps"),
    [
        (DQN, (1, 31, 47)),
        (Learning(ON_POLICY["PPO"]), (35,)),
        (Learning(Tabular(settings=TabularSettings())), (35,)),
        (Team(ALGORITHMS["DQN"], agents=(0,), share_parameters=True), (35,)),
    ],
    ids=["DQN", "recurrent", "table", "team"],
)
def test_a_training_against_a_pool_is_stopped_and_resumed_bit_for_bit(learner, steps, tmp_path, stopped):
    changes = {"learner": learner, "evaluate_every": 4, "callbacks": (Custom("own_parts:Stopping"),)}
    pooled = experiment(FULL, **changes)
    whole = cprl.run(pooled, tmp_path / "whole", watch="off")
    for step in steps:
        run = tmp_path / f"stopped_{step}"
        stopped(step, pooled, run)
        assert checkpoints_in(run / "checkpoints")
        cprl.run(pooled, run, resume=True, watch="off")
        assert_same_training(run, whole)
        assert differences(run, whole) == []


@pytest.mark.integration
def test_a_longer_training_continues_bit_for_bit(tmp_path):
    whole = cprl.run(experiment(FULL, episodes=16), tmp_path / "whole", watch="off")
    longer = cprl.run(experiment(FULL), tmp_path / "longer", watch="off", keep_checkpoint=True)
    cprl.run(experiment(FULL, episodes=16), longer, resume=True, watch="off")
    assert_same_training(longer, whole)


@pytest.mark.integration
def test_a_stored_pool_is_loaded_evaluated_crossed_exported_and_frozen(tmp_path, stopped):
    run = cprl.run(experiment(FULL), "pooled", watch="off")
    loaded = cprl.load(run)
    assert loaded.experiment == experiment(FULL)
    assert loaded.replicas == [0, 1]
    pool = loaded.agent(1, replica=1)
    assert len(pool.pool) == 5
    assert [opponent.spec for opponent in pool.pool] == [DQN, PPO, Scripted("random"), DQN, DQN]
    names = [name for name in loaded.networks if name.startswith("replica_1/agent_1/past_")]
    assert [opponent.network for opponent in pool.pool[3:]] == [loaded.networks[name] for name in names[-2:]]
    assert evaluate_run(run, Fresh(episodes=2)).num_rows == 2 * 2 * 4 * 2
    assert crossplay([run, "earlier"], Fresh(episodes=1)).num_rows > 0
    assert loaded.env(2).rollout(5, loaded.policy(1, worlds=2))["agents", "action"].shape == (2, 5, 4)
    exported = cprl.load(export_results(run, Path("deep/exported")))
    assert len(exported.agent(1).pool) == 5
    again = cprl.run(replace(experiment(Frozen("pooled", 1)), name="again"), "again", watch="off")
    assert len(cprl.load(again).agent(1).pool) == 5
    assert partners_in([FULL]) == ["earlier"]
    assert set(json.loads((run / "recipe.json").read_text())["frozen"]) == {"../earlier"}
    pooled = experiment(FULL, callbacks=(Custom("own_parts:Stopping"),))
    running = stopped(35, pooled, tmp_path / "running")
    cprl.trust("own_parts:Stopping")
    assert len(cprl.load(running).agent(1).pool) == 5, "of a checkpoint"


@pytest.mark.integration
def test_a_pool_plays_any_game(tmp_path):
    learner = Learning(ALGORITHMS["PPO"])
    env = MatrixGame(4, steps=3)
    agents = Population(env, [learner, Pool(own_past=OwnPast(0, every_steps=8, kept=2))], engine="eager")
    drawn = Drawn()
    train(env, agents.learners, Schedule(episodes=9), others=agents.others, callbacks=[drawn])
    for world in range(4):
        assert all(len(episode) == 1 for episode in drawn.by_episode(world))
    evaluate(MatrixGame(8, steps=3), agents.policy(2))


def test_pools_that_cannot_play_are_refused_by_name():
    with pytest.raises(ValueError, match=r"Pool\.runs is \(\)"):
        Pool()
    with pytest.raises(ValueError, match=r"Pool\.draw is 'oldest'"):
        Pool(runs=(earlier(0),), draw="oldest")
    with pytest.raises(ValueError, match=r"OwnPast\.kept is 0"):
        OwnPast(0, kept=0)
    for agent in (1, 2, 9):
        with pytest.raises(
            ValueError, match=rf"experiment\.agents: agent 1 is a Pool.*agent={agent}.*learns"
        ):
            experiment(Pool(own_past=OwnPast(agent)))
    with pytest.raises(ValueError, match=r"experiment\.agents\[1\]\.runs\[1\]\.run is /x, an absolute path"):
        experiment(Pool(runs=(earlier(0), Frozen("/x", 0))))
    with pytest.raises(ValueError, match=r"runs\[0\]\.replica is \(0,\), of 1 numbers"):
        experiment(Pool(runs=(earlier(0, replica=(0,)),)))
    taller = replace(GAME, rules=replace(GAME.rules, window_rows=4))
    for runs, game, message in (
        ((earlier(0),), taller, r"the agents of earlier have observations .*; this game has"),
        ((earlier(9),), GAME, "agent is 9"),
        ((Frozen("nowhere", 0),), GAME, "nowhere"),
    ):
        with pytest.raises(ValueError, match=message):
            population([Pool(runs=runs), *[Scripted()] * 3], game=game)
