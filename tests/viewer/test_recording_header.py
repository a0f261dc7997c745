"""What people read first in a recording, and its pictures: header, label, phases, recipe and layout; the
boards of all replicas, where agents go, the stock over the turn, and the Lorenz curve."""

import math
import time
from dataclasses import replace
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
import rerun as rr
import torch
from live_viewers import connected, fake, received
from matrix_games import MatrixGame, chicken, matching_pennies, prisoners_dilemma, stag_hunt
from random_agents import random_agents
from recordings import GAME, SCENE, column, headers, names, observing, static, texts
from rerun.chunk import RrdReader
from tensordict import TensorDict
from told_courses import SIXTEEN_WORLDS
from torchrl.envs import StepCounter

from cprl import CommonsEnv, Game, Rules, maps
from cprl.commons.cells import APPLE, GROUND, WALL
from cprl.envs import make_env
from cprl.envs.unwrap import joint_actions
from cprl.institutions import Quota, Tax, Vote
from cprl.measuring import social
from cprl.pictures.colours import PALETTE, agent_colour
from cprl.pictures.readable import rules_of
from cprl.runs.episodes import EpisodeTable
from cprl.runs.recipe import recipe_table
from cprl.training import Schedule, train
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.frames import FrameSchedule, Wall
from cprl.viewer.header import CompilingNotice, Header, fresh_result
from cprl.viewer.layout import layout
from cprl.viewer.live import LiveStream, Stream
from cprl.viewer.logger import RerunLogger, send_buffer
from cprl.viewer.pictures import Pictures, Samples, visit_maps
from cprl.viewer.scene import Curves, Panels, plotted_numbers, scene_of
from cprl.viewer.view import Plots

pytestmark = pytest.mark.usefixtures("strict_rerun")


def recorded(run, numbers, *, replicas=1, episodes=9, learning=lambda number: {}, finished=None, tagged=0):
    """The recording of a run whose agents harvest thirty apples in each episode of these numbers."""
    with ViewerCallback(run, CommonsEnv(GAME, replicas), title="run", episodes=episodes) as viewer:
        observer = observing(viewer)
        if finished:
            viewer.random_play(finished["random"])
        for number in numbers:
            for world in range(replicas):
                returned = 100.0 * world if replicas > 1 else 30.0
                observer.on_episode(fake(number, world, returned=returned, tagged=tagged), learning(number))
        if finished:
            viewer.finished(finished)
            RrdReader(run / "run.rrd").store()  # closed, with its footer
    return run / "run.rrd"


def test_the_header_goes_from_the_beginning_to_the_end(tmp_path):
    path = recorded(
        tmp_path,
        range(6),
        replicas=2,
        episodes=6,
        learning=lambda number: {"agent_0/epsilon": 0.9},
        finished={
            "random": [fake(0, 0, returned=float(apples), tagged=0) for apples in (280, 284)],
            "trained": [fake(5, 0, returned=100.0, tagged=0) for _ in range(4)],
        },
    )
    said = headers(path)
    assert said[0][1] == "#### Episode 1 of 6 · begins"
    line = "Episode 1 of 6 · begins, exploring · 50 apples, random play 282 · 0 of 2 boards died early"
    assert said[1] == (0, f"#### {line}")
    assert said[-2][1].endswith("· 2 of 2 boards died early")
    amounts = "while learning 50 apples, trained 100, random play 282"
    line = f"Finished, 6 episodes · {amounts} · 4 of 4 boards died early"
    assert said[-1] == (5, f"#### {line}")
    words = [text for text in texts(path) if "random play" in text]
    assert words == ["random play 282 [257, 307] apples; 0 of 2 boards died early"]


def test_a_training_without_an_evaluation_or_that_was_stopped_ends_with_a_header_of_its_own(tmp_path):
    for episodes, line in (
        (2, "#### Finished, 2 episodes · 30 apples at the end"),
        (9, "#### Stopped after 2 of 9 episodes · 30 apples"),
    ):
        run = tmp_path / str(episodes)
        assert headers(recorded(run, range(2), episodes=episodes))[-1] == (1, line)


@pytest.mark.parametrize("kind", [LiveStream, Stream])
def test_viewers_get_the_newest_header_at_all_times_and_files_each_at_its_own(kind, tmp_path):
    recording = rr.RecordingStream("cprl", recording_id="one")
    recording.save(tmp_path / "kept.rrd")
    stream = kind("stream", recording, period_s=1)
    stream.buffer["header"] = [(0, 0, 0, "# Episode 1"), (10, 1, 0, "# Episode 2")]
    send_buffer(stream)
    stream.close()
    (chunk,) = RrdReader(tmp_path / "kept.rrd").stream().filter(content="/header")
    assert chunk.is_static == (kind is LiveStream), "who connects late reads no old one as the present"
    expected = [["# Episode 2"]] if kind is LiveStream else [["# Episode 1"], ["# Episode 2"]]
    assert chunk.to_record_batch().column("TextDocument:text").to_pylist() == expected


def test_strips_and_events_say_what_the_group_does_and_where_exploration_ends(tmp_path):
    path = recorded(
        tmp_path,
        range(30),
        episodes=30,
        learning=lambda number: {"agent_0/epsilon": max(0.1, 1 - number / 20)},
    )
    said = texts(path)
    assert said["episode 19: exploration ends: no epsilon falls any more"] == 19
    assert said["episode 9: now steady"] == 9
    states = column(path, "now", "StateChange:state", "episode")
    assert states == ([0, 9], [["begins"], ["steady"]])
    states = column(path, "exploring", "StateChange:state", "episode")
    assert states == ([0, 19], [["exploring"], ["settled"]])


def test_with_many_worlds_header_label_bold_line_and_new_bests_count_episodes(tmp_path):
    """The tragedy of sixteen worlds, as the viewer told it once: "steady, 333 apples" at 206."""
    with ViewerCallback(tmp_path, CommonsEnv(GAME, 16), title="run", episodes=288, worlds=16) as viewer:
        viewer.random_play([fake(0, 0, returned=280.0, tagged=0)] * 2)
        observer = observing(viewer)
        for group, apples in enumerate(SIXTEEN_WORLDS):
            for world in range(16):
                episode = fake(16 * group + world, world, returned=float(apples), tagged=0)
                observer.on_episode(replace(episode, replica=0), {})
    path = tmp_path / "run.rrd"
    said = [(at + 1, *text.split(" · ")[1:3]) for at, text in headers(path) if "random play 280" in text]
    assert [at for at, *_ in said] == list(range(16, 289, 16))
    for (_, label, amount), apples in zip(said, SIXTEEN_WORLDS, strict=True):
        assert label != "begins"
        assert float(amount.split(" apples")[0]) == pytest.approx(apples, rel=0.1)
    states = dict(zip(*column(path, "now", "StateChange:state", "episode"), strict=True))
    at = {state[0]: episode for episode, state in reversed(states.items())}
    assert at["rising"] < at["falling"] < at["below random play"] < 170
    assert states[max(states)] == ["below random play"]
    lines = column(path, "social/collective_return", "Scalars:scalars")[1]
    assert lines == [[apples, apples] for apples in SIXTEEN_WORLDS], "a mean of ten would be of 160 episodes"
    best = [text for text in texts(path) if "new best" in text]
    assert best == [
        "episode 63: new best: 339.5 apples per episode, mean of the last 64",
        "episode 127: new best: 437.8 apples per episode, mean of the last 64",
    ]


def test_the_header_of_a_finished_run_is_of_the_last_two_episodes_of_each_of_sixteen_worlds(tmp_path):
    """As the terminal says it, whatever the window of the live label is."""
    fresh = [fake(0, 0, returned=280.0, tagged=0)] * 2
    with ViewerCallback(tmp_path, CommonsEnv(GAME, 16), title="run", episodes=64, worlds=16) as viewer:
        viewer.random_play(fresh)
        observer = observing(viewer)
        for group, apples in enumerate((100, 200, 300, 400)):
            for world in range(16):
                episode = fake(16 * group + world, world, returned=float(apples), tagged=0)
                observer.on_episode(replace(episode, replica=0), {})
        viewer.finished({"random": fresh, "trained": fresh})
    assert " · while learning 350 apples, trained 280, " in headers(tmp_path / "run.rrd")[-1][1]


def test_header_and_timelines_count_the_episodes_that_all_replicas_have_ended(tmp_path):
    """The first replica is far ahead; its last apples and frames stand where the header is."""
    env = CommonsEnv(GAME, 4)
    with ViewerCallback(tmp_path, env, title="run", episodes=20, worlds=2) as viewer:
        observer = observing(viewer)
        for number, world in ((0, 0), (1, 1), (2, 0), (3, 1), (4, 0), (5, 0)):
            observer.on_episode(replace(fake(number, world, returned=30.0, tagged=0), replica=0), {})
        for number, world in ((0, 2), (1, 3)):
            observer.on_episode(replace(fake(number, world, returned=30.0, tagged=0), replica=1), {})
        assert viewer._episode == 2
        observer.on_episode(replace(fake(6, 0, returned=30.0, tagged=0), replica=0), {})
    path = tmp_path / "run.rrd"
    said = headers(path)
    assert said[1][1].startswith("#### Episode 2 of 20 ")
    assert said[1][0] == 1, "counted from 0"
    assert texts(path)["episode 5: last apple taken in step 7"] == 0
    ends = [
        max(chunk.to_record_batch().column("episode").to_pylist())
        for chunk in RrdReader(path).stream()
        if "episode" in chunk.to_record_batch().schema.names
    ]
    assert max(ends) <= 2


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_resumed_recording_goes_on_as_if_it_had_not_been_stopped_and_viewers_get_all_of_it(tmp_path):
    """Running means, label and new bests go on from the episodes in the table, which are not logged again."""

    def play(numbers, *callbacks, worlds=(0, 1)):
        for number in numbers:
            for world in worlds:
                returned = (200.0 if 30 <= number < 58 else 600.0) + number * world
                for callback in callbacks:
                    episode = fake(number, world, returned=returned, tagged=1)
                    callback.on_episode(episode, {"agent_0/epsilon": max(0.1, 1 - number / 60)})

    (tmp_path / "recipe.json").write_text("{}")
    env, common = CommonsEnv(GAME, 2), {"title": "run", "episodes": 70}
    with ViewerCallback(tmp_path / "whole", env, **common) as whole:
        play(range(70), observing(whole))
    with ViewerCallback(tmp_path, env, **common) as first:
        observer = observing(first)
        with EpisodeTable(tmp_path / "episodes.parquet") as table:
            play(range(49), observer, table)
            play([49], observer, table, worlds=[0])
        state, observed = first.state_dict(), observer.state_dict()
    assert headers(tmp_path / "run.rrd")[-1][1].startswith("#### Stopped after 49 of 70 episodes")
    with ViewerCallback(tmp_path, env, live="serve", **common) as second:
        second.load_state_dict(state)
        observer = observing(second)
        observer.load_state_dict(observed)
        observer.on_start(SimpleNamespace(steps=1000, env=env))
        play([49], observer, worlds=[1])
        play(range(50, 70), observer)
        second.flush()
        seen_by_viewers(second.logger, tmp_path / "seen", "social/collective_return", list(range(70)))
    files = [tmp_path / name for name in ("run.rrd", "run-2.rrd")]
    assert len({RrdReader(file).recordings()[0].recording_id for file in files}) == 1
    complete, resumed = tmp_path / "whole" / "run.rrd", files[1]
    assert headers(resumed)[1][1].startswith("#### Episode 49 of 70 · falling · ")
    assert headers(resumed)[-20:] == headers(complete)[-20:]
    for name in ("social/collective_return", "agent_0/return"):
        episodes, values = column(resumed, name, "Scalars:scalars", "episode")
        assert episodes == list(range(49, 70))
        assert values == column(complete, name, "Scalars:scalars", "episode")[1][49:]
    titles = [
        dict(zip(*column(path, "lorenz/title", "Points2D:labels", "episode"), strict=True))
        for path in (complete, resumed)
    ]
    assert titles[1] == {episode: title for episode, title in titles[0].items() if episode > 48}
    episodes, labels = column(resumed, "visits/labels", "Points2D:labels", "episode")
    assert (episodes[0], labels[0][0]) == (50, "0: episodes 50 to 51"), "who went where before was not kept"
    for entity, present in (("now", {48: ["falling"]}), ("exploring", {50: ["exploring"]})):
        states = dict(zip(*column(complete, entity, "StateChange:state", "episode"), strict=True))
        later = {episode: state for episode, state in states.items() if episode > 48}
        goes_on = dict(zip(*column(resumed, entity, "StateChange:state", "episode"), strict=True))
        assert goes_on == {**present, **later}
        assert later, "it changes once more"


def seen_by_viewers(logger, folder, entity, episodes):
    """Waits until viewers of a served recording have these episodes of an entity, each once."""
    folder.mkdir()
    client = connected(logger.addresses["native"].split()[-1], folder)
    try:
        ends = time.monotonic() + 60
        while sorted(received(folder, entity, "Scalars:scalars", "episode")[0]) != episodes:
            assert time.monotonic() < ends
            time.sleep(0.5)
    finally:
        client.terminate()
        client.wait()


def test_while_code_is_compiled_the_live_header_says_for_how_long(monkeypatch):
    clock, said, is_over = SimpleNamespace(is_running=True, total_s=3.0), [], Event()
    monkeypatch.setattr(CompilingNotice, "PERIOD_S", 0.02)
    monkeypatch.setattr("cprl.viewer.header.CLOCK", clock)

    def say(status):
        said.append(status)
        clock.total_s = 15.0
        clock.is_running = len(said) < 2  # it ends while that is said
        if status == "begins":
            notice.close()
            is_over.set()

    notice = CompilingNotice(say)
    assert is_over.wait(10), said
    assert said == ["compiling, 0 s so far", "compiling, 12 s so far", "begins"]


def test_the_recipe_is_a_table_of_places():
    same = {"kind": "DQN", "settings": {"gamma": 0.995}}
    recipe = {"name": "a|b", "agents": [same, same, {"kind": "Frozen"}], "loggers": [], "map": "A.\n.B"}
    assert recipe_table(recipe) == (
        "| place | value |\n"
        "| --- | --- |\n"
        "| name | a\\|b |\n"
        "| agents.0.kind | DQN |\n"
        "| agents.0.settings.gamma | 0.995 |\n"
        "| agents.1 | as agents.0 |\n"
        "| agents.2.kind | Frozen |\n"
        "| loggers | [] |\n\n"
        "`map`\n\n```\nA.\n.B\n```"
    )


def plotted(view):
    """The entities of all plots of a layout."""
    parts = getattr(view, "contents", None) or ()
    return [entity for part in parts for entity in ([part] if isinstance(part, str) else plotted(part))]


def test_a_layout_has_the_views_of_what_a_game_reports_and_the_live_one_the_present_policy():
    alone = replace(SCENE, agents=("a",))
    bare = Curves(agents=("a", "b"), metrics=(), has_tags=False)
    live, file, several, single, matrix, stage = (
        set(names(view.root_container))
        for view in (
            layout(SCENE, live=True),
            layout(SCENE),
            layout(replace(SCENE, replicas=2)),
            layout(alone),
            layout(replace(bare, joint=("CC", "CD", "DC", "DD"))),
            layout(bare),
        )
    )
    assert {"Live board", "Recorded episodes", "Overview", "Stock left at the end, apples"} <= live
    assert live - file == {"Live board", "Recorded episodes"}
    assert file - live == {"Board"}
    wall = "All replicas; orange: the episode before ended without an apple"
    assert wall in several - file
    tags = next(name for name in file if name.startswith("Tags in"))
    of_worlds = layout(replace(SCENE, worlds=16)).root_container.contents[1].contents
    overview = next(set(names(tab)) for tab in of_worlds if tab.name == "Overview")
    assert "Apples on the board, over the turn" in overview, "not sixteen small boards"
    assert {"Peace", "Peacefulness"} <= {name.split(" (")[0].split(",")[0] for name in file}
    assert {tags, "Equality (1 - Gini), 0 to 1"} <= file - single
    for curves in (SCENE, bare):
        assert "+ /evaluation/return" in plotted(layout(curves).root_container)
    joint = "Joint actions, share of turns; agent 0 first"
    assert joint in matrix - stage
    assert {"Return of each, rewards", "Learning", "Events", "Recipe"} <= stage
    assert not {"Board", tags, "More metrics"} & stage


def test_joint_actions_are_named_by_letters_c_and_d_in_social_dilemmas():
    for game in (prisoners_dilemma(), chicken()):
        assert joint_actions(make_env(game)) == ("CC", "CD", "DC", "DD")
    assert joint_actions(make_env(matching_pennies())) == ("AA", "AB", "BA", "BB")
    three = joint_actions(make_env(MatrixGame(np.zeros((2, 2, 2, 3)))))
    assert three[:3] == ("AAA", "AAB", "ABA")
    assert joint_actions(make_env(MatrixGame(np.zeros((5, 5, 2))))) == (), "too many for lines"


def test_a_game_of_ones_own_names_its_joint_actions():
    env = make_env(stag_hunt(), transforms=[StepCounter()])
    env.base_env.joint_actions = ["both", "first", "second", "none"]
    assert joint_actions(env) == ("both", "first", "second", "none")
    assert plotted_numbers(env, ("a", "b"), (), episodes=9).joint == joint_actions(env)
    env.base_env.joint_actions = ["both", "none"]
    with pytest.raises(ValueError, match="joint_actions of the environment has 2 names"):
        joint_actions(env)
    larger = make_env(MatrixGame(np.zeros((5, 5, 2))))
    larger.joint_actions = [str(number) for number in range(25)]
    assert plotted_numbers(larger, ("a", "b"), (), episodes=9).joint == (), "too many for lines"


def test_a_recording_of_a_matrix_game_has_the_sum_of_returns_and_shares_of_joint_actions(tmp_path):
    """Two replicas of a dilemma of two turns: CC and CD in the first, DD twice in the second."""
    env = make_env(prisoners_dilemma(turns=2), worlds=2)
    with ViewerCallback(tmp_path, env, title="run", episodes=2) as viewer:
        viewer.random_play([fake(0, 0, returned=-7.0, tagged=0)])
        for action in ([[0, 0], [1, 1]], [[0, 1], [1, 1]]):
            viewer.on_step(TensorDict({("agents", "action"): torch.tensor(action)}, [2]))
        observer = observing(viewer)
        for world, returned in ((0, -5.0), (1, -8.0)):
            observer.on_episode(fake(0, world, returned=returned, tagged=0), {})
    path = tmp_path / "run.rrd"
    assert column(path, "joint_actions", "Scalars:scalars")[1] == [[0.25, 0.25, 0, 0.5]]
    assert column(path, "income", "Scalars:scalars")[1] == [[-5, -8, -6.5, -6.5]]
    assert column(path, "random_play/income", "Scalars:scalars")[1] == [[-7]]


@pytest.mark.integration
def test_the_file_closes_while_the_live_view_goes_on(tmp_path):
    with RerunLogger("run", tmp_path, curves=SCENE, live="serve") as logger:
        logger.log_header("# one")
        logger.close_file()
        RrdReader(tmp_path / "run.rrd").store()
        assert logger.is_live
        logger.log_header("# two")
        logger.flush()
    assert not logger.is_live
    assert column(tmp_path / "run.rrd", "header", "TextDocument:text")[1] == [["# one"]]
    assert static(tmp_path / "run.rrd", "header", "TextDocument:media_type") == ["text/markdown"]


def test_the_header_says_where_a_run_is_and_which_institutions_are_in_force():
    institutions = (Quota(share=0.25, window_steps=50, fine=2.0), Vote(on=Tax(), choices=(0.0, 0.5)))
    rules = rules_of(replace(GAME, institutions=institutions))
    eight = Curves(agents=("a", "b"), replicas=8)
    header = Header(curves=eight, episodes=4800, rules=rules)
    begins = header.line(episode=1, label="compiling", mean=math.nan, random_play=None, died=None)
    assert begins == f"#### Episode 1 of 4,800 · compiling · {rules}\n\n{eight.legend}"
    alone = Header(curves=Curves(agents=("a", "b"), metrics=()), episodes=200)
    for died in (None, 0):
        line = alone.line(episode=1, label="steady", mean=4.25, random_play=None, died=died)
        assert line.splitlines()[0] == "#### Episode 1 of 200 · steady · return 4.25"


def test_the_header_names_rules_of_ones_own(tmp_path):
    recipe = {"transforms": [{"kind": "Custom", "target": "laws:RichPay", "arguments": {"share": 0.5}}]}
    game = replace(SMALL, institutions=(Quota(fine=1.0),))
    with ViewerCallback(tmp_path, CommonsEnv(game), title="run", episodes=1, recipe=recipe) as viewer:
        assert viewer.header_view.header.rules == "quota (share 1, fine 1), laws:RichPay (share 0.5)"


SMALL = Game(
    map=maps.parse(".A>.A\n.A#A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.02), window_rows=3, window_columns=5, episode_steps=70),
)


class Remembers:
    """The episodes, and the first replica's stock after each step."""

    def __init__(self, env):
        self.env, self.episodes, self.stocks = env, [], []

    def on_step(self, batch):
        self.stocks.append(int(self.env.worlds.now.stock_left[0, 0]))

    def on_episode(self, episode, learning):
        self.episodes.append(episode)


def trained(folder, *, game=SMALL, replicas=2, episodes=6):
    """The recording of a training of random agents, its callback, and what happened."""
    env = CommonsEnv(game, replicas, seed=1)
    seen = Remembers(env)
    with ViewerCallback(folder, env, title="run", episodes=episodes) as viewer:
        others = random_agents(game.spaces, tuple(range(game.agents)), replicas=replicas, seed=1)
        train(env, {}, Schedule(episodes=episodes), others=others, callbacks=[seen, viewer])
    return folder / "run.rrd", viewer, seen


def test_before_the_first_point_viewers_see_random_play_and_read_when_curves_begin():
    sent = []
    titles = []

    def log_columns(name, at, columns, *, live_only=False):
        assert live_only, "the file has them with the first point"
        values = {
            part.component_descriptor().component: part.as_arrow_array().to_pylist() for part in columns
        }
        sent.append((name, at[1], values))

    def log_row(name, texts, *, live_only=False):
        assert live_only
        titles.append((name, texts.labels.as_arrow_array().to_pylist()))

    env = CommonsEnv(GAME, 16)
    curves = scene_of(env, plotted_numbers(env, GAME.agent_names, ["harvest"], episodes=300, worlds=16))
    logger = SimpleNamespace(
        curves=curves, log_columns=log_columns, log_row=log_row, log_static=lambda *parts: None
    )
    Plots(logger).random_play([fake(0, 0, returned=280.0, tagged=0)])
    lines = {name: (at, values["Scalars:scalars"]) for name, at, values in sent}
    assert lines["random_play/collective_return"] == ([0, 1], [[280.0], [280.0]]), "a line needs two points"
    for every, first in ((15, 16), (20, 32)):
        titles.clear()
        Pictures(logger, Samples(env, logger), every=every)
        words = [f"lines from episode {first} on"]
        assert titles == [("turn/title", words), ("lorenz/title", words)]


def view_of(viewer, kind):
    return next(view for view in viewer._views if isinstance(view, kind))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("run"))


def test_the_gini_coefficient_of_a_lorenz_curve_is_one_minus_equality():
    for harvest in ([4.0, 1.0, 0.0], [2.0, 2.0], [0.0, 0.0, 0.0, 9.0], [5.0]):
        equality = float(social.equality(np.array(harvest)))
        assert social.gini(social.lorenz_curve(np.array(harvest))) == pytest.approx(1 - equality)
    assert np.isnan(social.lorenz_curve(np.zeros(3))).all()


def test_the_lorenz_curve_is_the_mean_over_the_episodes_of_all_replicas(run):
    path, _, seen = run
    _, lines = column(path, "lorenz/lines", "LineStrips2D:strips", "episode")
    _, titles = column(path, "lorenz/title", "Points2D:labels", "episode")
    first = [own for own in seen.episodes if own.episode == 0 and own.harvest.sum()]
    mean = np.mean([1 - own.metrics["equality"] for own in first])
    assert titles[0][0].startswith(f"Gini {mean:.2f}: episode 1, {len(first)} with a harvest")
    assert len(lines[0]) == 3, "equal shares, the first curve, this one"


def test_the_wall_shows_each_replica_with_the_frame_of_the_same_step(run):
    path, _, _ = run
    wall = column(path, "wall/boards", "SegmentationImage:buffer", "frame")
    images = dict(zip(*column(path, "world/board", "SegmentationImage:buffer", "frame"), strict=True))
    assert 3 < len(wall[0]) < len(images) / 5
    (top, left), second = Panels(2, (5, 7)).corners
    for frame, pixels in zip(*wall, strict=True):
        image = np.array(pixels[0], np.uint8).reshape(Panels(2, (5, 7)).shape)
        first = image[top : top + 5, left : left + 7]
        assert np.array_equal(first, np.array(images[frame][0], np.uint8).reshape(5, 7))
    assert len(column(path, "wall/labels", "Points2D:labels")[1][0]) == 2
    assert second[1] > left


def test_a_bar_below_the_board_is_as_long_as_its_apples_are_many(run):
    path, _, _ = run
    frames, bars = column(path, "world/stock", "LineStrips2D:strips", "frame")
    _, words = column(path, "world/stock", "LineStrips2D:labels")
    boards = dict(zip(*column(path, "world/board", "SegmentationImage:buffer", "frame"), strict=True))
    sites = len(SMALL.map.sites)
    for frame, (whole, filled, _), (_, _, label) in zip(frames, bars, words, strict=True):
        apples = sum(kind == APPLE for kind in boards[frame][0])
        covered = int(label.split()[0]) - apples
        assert 0 <= covered <= SMALL.agents, "an agent may stand where an apple is"
        assert label.endswith(f" of {sites} apples")
        lengths = [end[0] - start[0] for start, end in (whole, filled)]
        assert lengths == [5, pytest.approx(5 * (apples + covered) / sites, abs=1e-6)]


def test_the_line_of_a_replica_is_its_stock_turn_by_turn(run):
    path, viewer, seen = run
    first = [own for own in seen.episodes if own.world == 0]
    steps = sum(own.steps for own in first[:-1])
    stocks = seen.stocks[steps : steps + first[-1].steps - 1]
    expected = [(0, len(SMALL.map.sites)), *enumerate(stocks, 1), (first[-1].steps, first[-1].stock_left)]
    assert view_of(viewer, Samples).lines[0] == expected
    _, colours = column(path, "turn/lines", "LineStrips2D:colors")
    died = [own.terminated for own in seen.episodes if own.episode == 5]
    assert len(set(colours[-1])) == len(set(died))


def test_maps_show_where_agents_were_in_their_hues(run):
    path, viewer, _ = run
    scene = viewer.logger.scene
    visits = np.zeros((2, scene.height, scene.width), np.int64)
    assert (visit_maps(visits, scene)[:, 1, 1:-1] == PALETTE[GROUND]).all()
    assert (visit_maps(visits, scene)[:, 2, 3] == PALETTE[WALL]).all()
    visits[[0, 1], [0, 2], [0, 4]] = [9, 1]
    drawn = visit_maps(visits, scene)
    assert drawn[0, 1, 1].tolist() == list(agent_colour(0)), "the longest stay is brightest"
    assert drawn[1, 3, 5].sum() < sum(agent_colour(1))
    assert drawn[1, 3, 5].argmax() == np.argmax(agent_colour(1))
    _, labels = column(path, "visits/labels", "Points2D:labels", "episode")
    assert labels[0] == ["0: episode 1", "1: episode 1"]


@pytest.mark.parametrize(("drawing", "replicas"), [(">A", 1), ("A" * 12 + "\n" + ">" * 12, 8)])
def test_any_number_of_agents_and_replicas_is_shown(drawing, replicas, tmp_path):
    game = Game(map=maps.parse(drawing), rules=Rules(episode_steps=12, window_rows=2, window_columns=3))
    path, _, _ = trained(tmp_path, game=game, replicas=replicas, episodes=2)
    assert (static(path, "wall/boards", "SegmentationImage:format") is not None) == (replicas > 1)
    assert bool(column(path, "lorenz/lines", "LineStrips2D:strips")[0]) == (game.agents > 1)
    assert len(column(path, "visits/labels", "Points2D:labels")[1][0]) == game.agents
    assert len(column(path, "turn/lines", "LineStrips2D:strips")[1][-1]) == replicas


def test_the_text_of_a_board_is_orange_after_an_episode_in_which_it_died(run):
    path, _, seen = run
    steps, colours = column(path, "wall/labels", "Points2D:colors", "step")
    assert 0 < sum(episode.terminated for episode in seen.episodes) < len(seen.episodes), (
        "some die, some live"
    )
    ended, died = 0, False
    for episode in (episode for episode in seen.episodes if episode.world == 0):
        until = ended + episode.steps
        rows = [row for step, row in zip(steps, colours, strict=True) if ended < step <= until]
        assert all((row[0] >> 8 == 0xD55E00) == died for row in rows)
        ended, died = until, episode.terminated


class Listener:
    """Takes what is logged, as a logger with viewers does."""

    is_live, frames, episode = True, 12, 3

    def __init__(self, scene):
        self.scene = self.curves = scene
        self.step = self.turn = 0
        self.rows, self.live_only = [], []

    def log_static(self, name, *what):
        """Nothing."""

    def log_columns(self, entity, at, columns, *, live_only=False):
        self.live_only.append(live_only)
        self.rows.append((entity, dict(zip(("step", "episode", "frame"), map(list, at), strict=True))))


def test_viewers_get_the_wall_every_two_seconds_and_the_file_does_not(run, monkeypatch):
    _, viewer, _ = run
    clock, listener = iter(np.arange(10.0, 20.0, 0.8)), Listener(viewer.logger.scene)
    perf_counter = SimpleNamespace(perf_counter=lambda: next(clock))  # other threads have the clock itself
    schedule = FrameSchedule(None, listener, episodes=1)
    monkeypatch.setattr("cprl.viewer.frames.time", perf_counter)
    wall = Wall(viewer.env, listener, schedule, recorded_steps=100)
    for step in range(1, 10):
        listener.step = listener.turn = step
        wall.on_step(None)
    boards_at = [at for name, at in listener.rows if name == "wall/boards"]
    assert boards_at == [{"step": [step], "episode": [3], "frame": [12]} for step in (1, 4, 7)]
    assert listener.live_only == [True] * 6


def test_the_numbers_of_an_evaluation_are_means_with_their_interval_over_replicas():
    """Episodes of a replica are no evidence of their own: 10 and 14 apples, so 12 and 12.706 x 2."""
    episodes = [fake(5, 0, returned=apples, tagged=0) for apples in (9.0, 11.0, 15.0, 13.0)]
    apples, died, count = fresh_result(episodes, replicas=2)
    assert (apples.value, died, count) == (12.0, 4, 4)
    assert (apples.low, apples.high) == pytest.approx((12 - 25.412, 12 + 25.412), abs=0.001)
    assert f"{apples}" == "12.0 [0.0, 37.4]", "no harvest is below 0"
    assert f"{fresh_result(episodes).harvest}" == "12.0", "one replica has no interval"


def test_who_tagged_whom_is_a_matrix_of_tags_in_an_episode_of_the_last_fifty(tmp_path):
    with ViewerCallback(tmp_path, CommonsEnv(GAME, 2), title="run", episodes=60) as viewer:
        observer = observing(viewer)
        for number in range(60):
            for world in (0, 1):
                episode = fake(number, world, returned=30.0, tagged=2 if number < 10 else world)
                observer.on_episode(episode, {})
    path = tmp_path / "run.rrd"
    episodes, labels = column(path, "tags/counts", "Points2D:labels", "episode")
    assert episodes == [9, 19, 29, 39, 49, 59]
    assert labels[0] == ["0", "0", "2", "0", "0", "1", "0", "1"], "agent 1 by agent 0"
    assert labels[1][2] == "1.25", "10 episodes of 2 and 10 of 0 or 1, in each of two replicas"
    assert labels[4][2] == "0.8", "of fifty"
    assert labels[5][2] == "0.5", "the first ten are too long ago"
    assert len(column(path, "tags", "Image:buffer")[0]) == 6
