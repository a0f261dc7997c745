"""The current policy plays a world of its own for viewers; the training and its file do not notice."""

import warnings
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import rerun as rr
import torch
from matrix_game import MatrixGame
from recordings import column
from rerun.chunk import RrdReader
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from watched import ALONE, DQN_AGENT, REPLAY, ROLLOUT, population_of

from cprl import Game, River, Rules, keys, maps
from cprl.algorithms import MAPPO, PPO
from cprl.experimental import exhibition
from cprl.experimental.current_policy import FirstReplica
from cprl.experimental.exhibition import BATCH_S, BATCH_STEPS, Exhibition, policy_and_world
from cprl.institutions import Governor, Tax
from cprl.measuring.playing import turns
from cprl.policies.governors import Constant
from cprl.population import Learning, Scripted, Team
from cprl.training import Schedule, train
from cprl.training.evaluating import fresh_env, make_agents, random_play
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.live import Stream
from cprl.viewer.scene import plotted_numbers, scene_of

EXPERIMENTS = {
    "mixed, with a transform": ALONE,
    "a team": replace(
        ALONE, agents=[Team(MAPPO(settings=ROLLOUT), agents=(0, 1, 2)), Scripted("random")], transforms=[]
    ),
    "TorchRL's own engine": replace(ALONE, transforms=[], engine="torchrl"),
}


class Viewers(Stream):
    """A stream to a file in the place of one to viewers."""

    is_behind = False

    def __init__(self, path):
        super().__init__("live view", rr.RecordingStream("cprl", recording_id="one"), period_s=1)
        self.path = path
        self.recording.save(path)

    def chunks(self, entity):
        self.close()
        return list(RrdReader(self.path).stream().filter(content=f"/exhibition/{entity}"))


@pytest.mark.parametrize(
    ("drawing", "rules", "is_drawn"),
    [
        (".A>.A", {}, True),
        (".A>.A", {"first_stock_share": 0.5}, False),
        (".A>.A", {"shuffle_starts": True}, False),
        (".A>.A", {"random_headings": True}, False),
        (".A>.AP", {}, False),
        (".A>.A~", {"river": River()}, False),
    ],
)
def test_the_map_that_is_sent_first_is_called_what_it_is(drawing, rules, is_drawn):
    game = Game(map=maps.parse(drawing), rules=Rules(**rules))
    words = "the board as an episode begins" if is_drawn else "the map; episodes begin otherwise"
    assert exhibition._beginning(game) == words


class Kept:
    """An exhibition whose viewers are files, on a clock that the test moves."""

    def __init__(self, folder):
        self.now, self.waits = 0.0, []
        self.fixed, self.newest = Viewers(folder / "live.rrd"), Viewers(folder / "exhibition.rrd")
        env, population = population_of(ALONE)
        policy, self.world = policy_and_world(ALONE, population)
        curves = plotted_numbers(env.base_env, ALONE.game.agent_names, [], episodes=3)
        live = SimpleNamespace(stream=self.fixed, exhibition=self.newest)
        self.logger = SimpleNamespace(scene=scene_of(env.base_env, curves), live=live, episode=0)
        self.exhibition = Exhibition(
            policy,
            self.world,
            trained=env,
            logger=self.logger,
            clock=lambda: self.now,
            wait=lambda seconds: self.waits.append(seconds),
        )

    def step(self, count=1, episode=0):
        """So many steps of the training, each when the exhibition is due."""
        self.logger.episode = episode
        for _ in range(count):
            self.now += exhibition.BATCH_S
            self.exhibition.on_step(None)

    def rows(self, component, entity="board"):
        """The values that viewers were sent."""
        batches = [chunk.to_record_batch() for chunk in self.newest.chunks(entity)]
        timelines = {"step", "episode", "frame", "log_time"}
        assert not {name for batch in batches for name in batch.schema.names} & timelines
        columns = (batch.column(component) for batch in batches if component in batch.schema.names)
        return [value for column in columns for value in column.to_pylist()]


@pytest.fixture
def kept(tmp_path):
    return Kept(tmp_path)


FIRST, *OTHERS = EXPERIMENTS


@pytest.mark.integration
@pytest.mark.parametrize("name", [FIRST, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)])
def test_an_exhibition_changes_nothing_that_is_learned(name, tmp_path, monkeypatch):
    monkeypatch.setattr(exhibition, "BATCH_S", 0.0)
    monkeypatch.setattr(exhibition, "MOST_SHARE", 1e9)
    monkeypatch.setattr(Exhibition, "close", lambda self: None)
    experiment, played = EXPERIMENTS[name], []

    def course(watched):
        env, population = population_of(experiment)
        returns = []

        class Keeping:
            def on_episode(self, episode, learning):
                returns.append((episode.world, episode.return_.tolist(), repr(learning)))

        episodes, callbacks, agents = experiment.episodes, [Keeping()], population.learners
        with ExitStack() as viewing:
            if watched:
                exhibit = partial(exhibition.exhibition, experiment, population)
                how = {"episodes": episodes, "live": "serve", "exhibit": exhibit}
                viewer = viewing.enter_context(ViewerCallback(tmp_path, env, title="run", **how))
                callbacks.append(viewer)
            train(env, agents, Schedule(episodes=episodes), others=population.others, callbacks=callbacks)
            if watched:
                played.append(viewer.exhibition.steps)
        weights = [net.state_dict() for net in population.networks().values()]
        return repr((weights, torch.get_rng_state().tolist(), returns))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert course(True) == course(False)
    assert played[0] > 20, "the exhibition was played"
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "run.rrd").stream()}
    assert not [entity for entity in entities if "exhibition" in entity], "nothing of it is in the file"


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_current_policy_acts_in_its_replica_as_in_evaluation(name):
    _, population = population_of(EXPERIMENTS[name])
    for learner in population.learners.values():
        of_all = learner.evaluation_actor(1)
        alone = FirstReplica(learner.evaluation_actor(1), population.replicas)
        shape = of_all.replicas, of_all.agents, *population.spaces.observation_shape
        seen = torch.randint(0, 256, shape, dtype=torch.uint8)
        with set_exploration_type(ExplorationType.RANDOM):
            for _ in range(20):
                moment = TensorDict({"observation": seen[:1]}, [1])
                assert torch.equal(alone(moment)["action"], of_all.choose(seen)[:1])


@pytest.mark.parametrize("governor", [Constant(1.0), Learning(PPO(settings=ROLLOUT))], ids=["script", "ppo"])
def test_the_governor_of_the_first_replica_governs_the_world_that_is_shown(governor):
    rate = Governor(sets="tax.rate", options=(0.0, 0.5, 1.0), every_steps=5)
    game = replace(ALONE.game, institutions=(Tax(), rate))
    experiment = replace(ALONE, transforms=[], game=game, governor=governor)
    _, population = make_agents(experiment)
    if isinstance(governor, Learning):
        (logits,) = (
            weight
            for weight in population.governor.learner.lane_networks.params.values()
            if weight.numel() == 2 * 3
        )
        logits.view(2, 3)[:] = torch.tensor([[0.0, 0.0, 99.0], [99.0, 0.0, 0.0]])
    policy, world = policy_and_world(experiment, population)
    with policy.apart():
        rates = [float(batch["next", keys.IN_FORCE][0, 0]) for batch in turns(world, policy)]
    assert set(rates) == {1.0}


def test_it_plays_ten_to_twelve_steps_a_second_however_often_the_training_asks(kept):
    assert 10 <= BATCH_STEPS / BATCH_S <= 12
    kept.logger.episode = 7
    for thousandth in range(round(3000 * BATCH_S)):
        kept.now = thousandth / 1000
        kept.exhibition.on_step(None)
    boards = kept.rows("SegmentationImage:buffer")
    assert abs(len(boards) - 3 * BATCH_STEPS) <= 2
    assert len({repr(board) for board in boards}) > len(boards) / 2, "the board moves"
    assert kept.waits == [BATCH_S / BATCH_STEPS] * 3 * (BATCH_STEPS - 1), "they are sent one by one"
    assert kept.rows("Points2D:labels", "caption")[-1] == ["current policy, episode 7, epsilon 1.00"]


@pytest.mark.parametrize("has_begun", [False, True])
def test_random_play_moves_on_the_board_until_the_training_begins(has_begun, kept):
    experiment = replace(ALONE, evaluation_episodes=2)
    _, population = population_of(experiment)
    played = random_play(experiment, population, seen=kept.exhibition.watch_random_play)
    assert [episode.return_.tolist() for episode in played] == [
        episode.return_.tolist() for episode in random_play(experiment, population)
    ]
    kept.exhibition.steps = int(has_begun)
    kept.exhibition.random_play(played)
    boards = kept.rows("SegmentationImage:buffer")[1:]  # the first is the map
    assert len(boards) == (1 if has_begun else played[0].steps)
    assert kept.rows("Points2D:labels", "caption")[-1] == ["random play, before the training"]
    if not has_begun:
        assert len({repr(board) for board in boards}) > len(boards) / 2, "the board moves"
        assert set(kept.waits) == {BATCH_S / len(boards)}, "ten steps a second, of a long episode"


@pytest.mark.integration
@pytest.mark.parametrize("seconds", [0.003, 0.05])
def test_a_slow_exhibition_takes_one_percent_of_the_time(seconds, kept, monkeypatch):
    played, step = [], Exhibition._step

    def slowly(self):
        step(self)
        kept.now += seconds
        played.append(kept.now)

    monkeypatch.setattr(Exhibition, "_step", slowly)
    while kept.now < 200:
        kept.now += 0.01
        kept.exhibition.on_step(None)
    later = len(played) - BATCH_STEPS  # the first ones compile, which is not counted
    assert 0.007 * kept.now <= later * seconds <= 0.011 * kept.now


def test_it_plays_the_weights_and_the_exploration_of_the_moment(tmp_path):
    experiment = replace(ALONE, agents=[DQN_AGENT] * 4, transforms=[])
    _, population = population_of(experiment)
    policy, world = policy_and_world(experiment, population)
    (learner,) = population.learners.values()
    learner.actor.epsilon = 0.0
    seen = world.reset()
    last = [value for value in learner.lane_networks.params.values() if len(value) == value.shape[-1] == 8][
        -1
    ]
    for best in (2, 5):
        with torch.no_grad():
            last.zero_()
            last[:4, ..., best] = 1e6  # of the first replica; those of the second choose action 0
        with policy.apart():
            assert policy(seen)["agents", "action"].tolist() == [[best] * 4]
    learner.actor.epsilon = 1.0
    with policy.apart():
        chosen = {action for _ in range(40) for action in policy(seen)["agents", "action"][0].tolist()}
    assert len(chosen) == 8
    assert policy.epsilons == [1.0]
    policy.is_trained = True
    policy.explore_as_now()
    assert policy.epsilons == [REPLAY.epsilon_evaluation]


def test_its_world_is_played_by_no_training_and_no_evaluation():
    env, population = population_of(replace(ALONE, transforms=[]))
    _, world = policy_and_world(replace(ALONE, transforms=[]), population)
    courses = []
    for each in (env, fresh_env(replace(ALONE, transforms=[])), world):
        moment, stocks = each.reset(), []
        for step in range(15):
            moment["agents", "action"] = torch.full((*each.batch_size, 4), step % 4)
            moment = each.step_and_maybe_reset(moment)[1]
            stocks.append(each.worlds.state()["stock"])
        courses += [repr(own.tolist()) for own in np.stack(stocks, 1)]
    assert len(set(courses)) == len(courses)


def test_an_exhibition_that_fails_warns_once_and_ends(kept, monkeypatch):
    kept.step()
    monkeypatch.setattr(kept.world, "step", lambda moment: 1 / 0)
    with pytest.warns(RuntimeWarning, match="the exhibition failed, the run") as caught:
        kept.step(8)
    assert len(caught) == 1


def test_viewers_that_do_not_keep_up_miss_frames_and_nothing_waits(kept, monkeypatch):
    monkeypatch.setattr(Viewers, "is_behind", True)
    kept.step(5)
    assert len(kept.rows("SegmentationImage:buffer")) == 1, "the first, which the constructor sent"


def test_after_the_training_the_trained_policy_plays_on_and_rests_on_the_last_board_of_an_episode(kept):
    waits = []
    stop = SimpleNamespace(wait=waits.append, is_set=lambda: waits.count(exhibition.REST_S) == 2)
    kept.exhibition.play_on(stop)
    boards, captions = kept.rows("SegmentationImage:buffer"), kept.rows("Points2D:labels", "caption")
    plays = "trained policy, epsilon 0.05"
    assert captions[1:] == 2 * [[plays], [f"{plays}: the end, turn 20"]]
    assert waits == 2 * [exhibition.REST_S]
    assert len(boards) == 1 + 2 * (1 + 20)
    assert boards[0] == boards[1] == boards[22], "an episode begins"
    assert boards[21] != boards[1], "its last board is seen"


def test_a_game_without_a_board_has_no_exhibition_and_one_event_says_so(tmp_path):
    env = MatrixGame(1)
    how = {"episodes": 1, "live": "serve", "exhibit": partial(exhibition.exhibition, ALONE, None)}
    with ViewerCallback(tmp_path, env, title="run", **how) as viewer:
        assert viewer.exhibition is None
        viewer.play_on(SimpleNamespace())
    texts = column(tmp_path / "run.rrd", "log", "TextLog:text")[1]
    assert ["no exhibition: the game has no board"] in texts


def test_parts_that_never_change_are_sent_once_to_the_server_that_keeps_them_and_formats_with_frames(kept):
    kept.step()
    fixed, frames = (
        [set(chunk.to_record_batch().schema.names) for chunk in stream.chunks("board")]
        for stream in (kept.fixed, kept.newest)
    )
    image = {"SegmentationImage:buffer", "SegmentationImage:format"}
    assert all(image <= frame for frame in frames), "a frame without its format draws nothing"
    assert "SegmentationImage:opacity" in set().union(*fixed)
    assert not any(image & part for part in fixed), "a format that comes after a frame hides it"
    assert len(frames) == 1 + BATCH_STEPS
