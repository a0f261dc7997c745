"""The wall of replicas, where agents go, the stock over the turn, and the Lorenz curve, as recorded."""

import numpy as np
import pytest
import torch
from recordings import column, static

from cprl import CommonsEnv, Game, Rules, maps
from cprl.commons.colours import APPLE, FIRST_AGENT, GROUND, PALETTE, WALL, agent_colour
from cprl.measuring import Episode, social
from cprl.policies.lanes import random_agents
from cprl.training import train
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.panels import Panels
from cprl.viewer.stage import boards
from cprl.viewer.views import Wall, gini, lorenz_curve

GAME = Game(
    map=maps.parse(".A>.A\n.A#A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.02), window_rows=3, window_columns=5, episode_steps=70),
)


class Remembers:
    """The episodes, and the first replica's and the second's stock after each step."""

    def __init__(self, env):
        self.env, self.episodes, self.stocks = env, [], []

    def on_step(self, batch):
        self.stocks.append(self.env.worlds.now.stock_left[:, 0].copy())

    def on_episode(self, episode, learning):
        self.episodes.append(episode)


def recorded(run, *, game=GAME, replicas=2, episodes=6):
    """A training of random agents that is recorded in `run`: its callback, and what happened."""
    env = CommonsEnv(game, replicas, seed=1)
    agents = tuple(range(game.agents))
    seen = Remembers(env)
    with ViewerCallback(run, env, title="run", episodes=episodes) as viewer:
        others = random_agents(game.spaces, agents, replicas=replicas, seed=1)
        train(env, {}, others=others, episodes=episodes, callbacks=[seen, viewer])
    return viewer, seen


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder / "run.rrd", *recorded(folder)


def test_the_gini_coefficient_of_a_lorenz_curve_is_one_minus_equality():
    for harvest in ([4.0, 1.0, 0.0], [2.0, 2.0], [0.0, 0.0, 0.0, 9.0], [5.0]):
        equality = float(social.equality_of(torch.tensor(harvest)))
        assert gini(lorenz_curve(np.array(harvest))) == pytest.approx(1 - equality)
    assert np.isnan(lorenz_curve(np.zeros(3))).all()


def test_the_lorenz_curve_is_the_mean_over_the_episodes_of_all_replicas(run):
    path, _, seen = run
    _, lines = column(path, "lorenz", "LineStrips2D:strips", "episode")
    _, titles = column(path, "lorenz/title", "Points2D:labels", "episode")
    first = [own for own in seen.episodes if own.episode == 0 and own.harvest.sum()]
    mean = np.mean([1 - own.metrics["equality"] for own in first])
    assert titles[0][0].startswith(f"Gini {mean:.2f}: episode 1, {len(first)} with a harvest")
    assert len(lines[0]) == 3, "equal shares, the first curve, this one"


def test_the_wall_shows_each_replica_with_the_frame_of_the_same_step(run):
    path, _, _ = run
    wall = column(path, "wall/boards", "SegmentationImage:buffer", "frame")
    world = column(path, "world/board", "SegmentationImage:buffer", "frame")
    assert 3 < len(wall[0]) < len(world[0]) / 5
    (top, left), second = Panels(2, (5, 7)).corners
    images = dict(zip(*world, strict=True))
    for frame, pixels in zip(*wall, strict=True):
        image = np.array(pixels[0], np.uint8).reshape(Panels(2, (5, 7)).shape)
        first = image[top : top + 5, left : left + 7]
        assert np.array_equal(first, np.array(images[frame][0], np.uint8).reshape(5, 7))
    assert len(column(path, "wall/labels", "Points2D:labels")[1][0]) == 2
    assert second[1] > left


def test_the_line_of_a_replica_is_its_stock_turn_by_turn(run):
    path, viewer, seen = run
    turns = viewer._views["turns"]
    (last,) = (own for own in seen.episodes if own.world == 0 and own.episode == 5)
    steps = sum(own.steps for own in seen.episodes if own.world == 0 and own.episode < 5)
    stocks = [int(stock[0]) for stock in seen.stocks[steps : steps + last.steps - 1]]
    sites = len(GAME.map.sites)
    expected = [(0, sites), *enumerate(stocks, 1), (last.steps, last.stock_left)]
    assert turns._ended[0] == expected
    _, colours = column(path, "turn/lines", "LineStrips2D:colors")
    died = [own.terminated for own in seen.episodes if own.episode == 5]
    assert len(set(colours[-1])) == len(set(died))


def test_maps_show_where_agents_were_in_their_hues(run):
    path, viewer, _ = run
    visits = viewer._views["visits"]
    visits._counts[:] = 0
    assert (visits.maps()[:, 1, 1:-1] == PALETTE[GROUND]).all()
    assert (visits.maps()[:, 2, 3] == PALETTE[WALL]).all()
    visits._counts[[0, 15 + 14]] = [9, 1]
    maps_of = visits.maps()
    assert maps_of[0, 1, 1].tolist() == list(agent_colour(0)), "the longest stay is brightest"
    assert maps_of[1, 3, 5].sum() < sum(agent_colour(1))
    assert maps_of[1, 3, 5].argmax() == np.argmax(agent_colour(1))
    visits._counts[:] = 0
    _, labels = column(path, "visits/labels", "Points2D:labels", "episode")
    assert labels[0] == ["0: episode 1", "1: episode 1"]


@pytest.mark.parametrize(("drawing", "replicas"), [(">A", 1), ("A" * 12 + "\n" + ">" * 12, 8)])
def test_any_number_of_agents_and_replicas_is_shown(drawing, replicas, tmp_path):
    game = Game(map=maps.parse(drawing), rules=Rules(episode_steps=12, window_rows=2, window_columns=3))
    recorded(tmp_path, game=game, replicas=replicas, episodes=2)
    path = tmp_path / "run.rrd"
    assert (static(path, "wall/boards", "SegmentationImage:format") is not None) == (replicas > 1)
    assert bool(column(path, "lorenz", "LineStrips2D:strips")[0]) == (game.agents > 1)
    assert len(column(path, "visits/labels", "Points2D:labels")[1][0]) == game.agents
    assert len(column(path, "turn/lines", "LineStrips2D:strips")[1][-1]) == replicas


def test_a_resumed_recording_goes_on_counting(tmp_path):
    viewer, _ = recorded(tmp_path / "a", episodes=2)
    views = viewer._views
    for episode in (3, 4):
        views["lorenz"].on_episode(
            Episode(
                world=0,
                episode=episode,
                steps=3,
                terminated=True,
                return_=np.ones(2),
                metrics={},
                harvest=np.array([1.0, episode]),
            )
        )
    views["visits"]._counts[3] = 7
    views["wall"]._died[1] = True
    state = viewer.state_dict()
    other, _ = recorded(tmp_path / "b", episodes=2)
    other.load_state_dict(state)
    assert repr(other.state_dict()["views"]) == repr(state["views"])


def test_the_wall_marks_a_board_that_has_died(run):
    path, _, seen = run
    frames, colours = column(path, "wall/died", "Boxes2D:colors", "step")
    assert 0 < sum(own.terminated for own in seen.episodes) < len(seen.episodes), "some die, some live"
    ended, died = 0, False
    for own in (own for own in seen.episodes if own.world == 0):
        rows = [row for step, row in zip(frames, colours, strict=True) if ended < step <= ended + own.steps]
        assert all((row[0] >> 8 == 0xD55E00) == died for row in rows)
        ended, died = ended + own.steps, own.terminated


class Listener:
    """Takes what is logged, as a logger with viewers does."""

    is_live, frames = True, 12

    def __init__(self):
        self.rows, self.live_only = [], []

    def log_static(self, name, *what):
        """Nothing."""

    def do(self, what, *, live_only=False):
        self.live_only.append(live_only)
        what(self)

    def take(self, entity, timelines, columns):
        self.rows.append((entity, {name: own.to_pylist() for name, own in timelines.items()}))


def test_viewers_get_the_wall_every_two_seconds_and_the_file_does_not(run, monkeypatch):
    _, viewer, _ = run
    clock, listener = iter(np.arange(10.0, 20.0, 0.8)), Listener()
    monkeypatch.setattr("cprl.viewer.views.time.perf_counter", lambda: next(clock))
    monkeypatch.setattr("cprl.viewer.views.send_chunk", Listener.take)
    wall = Wall(viewer.env, listener, scene=viewer.logger.scene, recorded_steps=100)
    for step in range(1, 10):
        wall.on_step(step, 3, None)
    boards_at = [at for name, at in listener.rows if name == "wall/boards"]
    assert boards_at == [{"step": [step], "episode": [3], "frame": [12]} for step in (1, 4, 7)]
    assert listener.live_only == [True] * 3


def test_boards_of_many_worlds_are_drawn_as_frames_of_one(run):
    _, viewer, _ = run
    now = viewer.env.worlds.now
    state = {name: getattr(now, name) for name in ("stock", "in_play", "row", "col")}
    drawn = boards(viewer.logger.scene, {"step": now.step, **state})
    assert drawn.shape == (2, 5, 7)
    assert set(np.unique(drawn)) <= {GROUND, 1, APPLE, FIRST_AGENT, FIRST_AGENT + 1}
