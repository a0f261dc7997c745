"""What people read first in a recording: the header, the label, the phases, the recipe, the layout."""

import numpy as np
import pytest
import rerun as rr
from recordings import GAME, SCENE, column, static, strict_rerun
from rerun.chunk import RrdReader
from test_watch import fake

from cprl import CommonsEnv, presets
from cprl.measuring.metrics import reported_by
from cprl.measuring.phases import LONGEST, PHASES_BEGIN
from cprl.viewer import callback
from cprl.viewer.blueprint import layout
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.logger import RerunLogger, as_table, send_waiting
from cprl.viewer.scenery import Curves, curves_of
from cprl.viewer.story import Header, played, published_phases
from cprl.viewer.streams import LiveStream, Stream

__all__ = ["strict_rerun"]


def headers(path):
    """The first line of each header, with its episode."""
    episodes, texts = column(path, "header", "TextDocument:text", "episode")
    return [(episode, text[0].splitlines()[0]) for episode, text in zip(episodes, texts, strict=True)]


def test_the_header_goes_from_the_beginning_to_the_end(tmp_path):
    random = [fake(0, 0, returned=float(apples), tagged=0) for apples in (280, 284)]
    trained = [fake(5, 0, returned=100.0, tagged=0) for _ in range(4)]
    with ViewerCallback(tmp_path, CommonsEnv(GAME, 2), title="run", episodes=6) as viewer:
        viewer.log_status("compiling")
        assert viewer.baseline is None
        viewer.random_play(random)
        assert viewer.baseline == 282.0
        for number in range(6):
            for world in (0, 1):
                viewer.on_episode(
                    fake(number, world, returned=100.0 * world, tagged=0), {"agent_0/epsilon": 0.9}
                )
        viewer.finished({"trained": trained, "random": random})
        RrdReader(tmp_path / "run.rrd").store()  # closed, with its footer
    told = headers(tmp_path / "run.rrd")
    assert [line for _, line in told[:2]] == ["# Episode 1 of 6 · begins", "# Episode 1 of 6 · compiling"]
    assert told[2] == (
        0,
        "# Episode 1 of 6 · exploring · 50 apples (random play 282) · 0 of 2 boards died early",
    )
    assert told[-2][1].endswith("· 2 of 2 boards died early")
    assert told[-1] == (
        5,
        "# Finished, 6 episodes · trained 100 apples, random play 282 · 4 of 4 boards died early",
    )
    _, events = column(tmp_path / "run.rrd", "log", "TextLog:text")
    (words, *_) = [text[0] for text in events if text[0].startswith("random play")]
    assert words.startswith("random play 282.0 ± 2 apples in 2 fresh episodes (mean and its standard error)")
    assert column(tmp_path / "run.rrd", "phase/found", "StateChange:state") == ([], []), "too few episodes"


def test_a_training_without_an_evaluation_ends_with_a_header_of_its_own(tmp_path):
    with ViewerCallback(tmp_path, CommonsEnv(GAME, 1), title="run", episodes=2) as viewer:
        for number in range(2):
            viewer.on_episode(fake(number, 0, returned=30.0, tagged=0), {})
    assert headers(tmp_path / "run.rrd")[-1] == (1, "# Finished, 2 episodes · 30 apples at the end")


def test_a_run_that_was_stopped_says_so_and_where_it_goes_on_when_it_is_resumed(tmp_path):
    env = CommonsEnv(GAME, 1)
    with ViewerCallback(tmp_path, env, title="run", episodes=9) as viewer:
        viewer.on_episode(fake(0, 0, returned=30.0, tagged=0), {})
        state = viewer.state_dict()
    assert headers(tmp_path / "run.rrd")[-1] == (0, "# Stopped after 1 of 9 episodes · 30 apples")
    with ViewerCallback(tmp_path, env, title="run", episodes=9) as resumed:
        resumed.load_state_dict(state)
    assert headers(tmp_path / "run-2.rrd")[-2] == (1, "# Episode 1 of 9 · begins · 30 apples")


@pytest.mark.parametrize("kind", [LiveStream, Stream])
def test_viewers_get_the_newest_header_at_all_times_and_files_each_at_its_own(kind, tmp_path):
    recording = rr.RecordingStream("cprl", recording_id="one")
    recording.save(tmp_path / "kept.rrd")
    stream = kind("stream", recording, period_s=1)
    stream.waiting["header"] = [(0, 0, 0, "# Episode 1"), (10, 1, 0, "# Episode 2")]
    send_waiting(stream)
    stream.close()
    (chunk,) = RrdReader(tmp_path / "kept.rrd").stream().filter(content="/header")
    assert chunk.is_static == (kind is LiveStream), "who connects late reads no old one as the present"
    expected = [["# Episode 2"]] if kind is LiveStream else [["# Episode 1"], ["# Episode 2"]]
    assert chunk.to_record_batch().column("TextDocument:text").to_pylist() == expected


def test_where_exploration_ends_the_strip_changes_and_an_event_says_so(tmp_path):
    with ViewerCallback(tmp_path, CommonsEnv(GAME, 1), title="run", episodes=30) as viewer:
        for number in range(30):
            viewer.on_episode(
                fake(number, 0, returned=30.0, tagged=0), {"agent_0/epsilon": max(0.1, 1 - number / 20)}
            )
    at, events = column(tmp_path / "run.rrd", "log", "TextLog:text", "episode")
    told = dict(zip([text[0] for text in events], at, strict=True))
    assert told["episode 19: exploration ends: no epsilon falls any more; now harvesting"] == 19
    states = column(tmp_path / "run.rrd", "now", "StateChange:state", "episode")
    assert states == ([0, 19], [["exploring"], ["harvesting"]])


def test_the_live_label_goes_on_after_a_resume(tmp_path):
    def play(viewer, numbers):
        for number in numbers:
            viewer.on_episode(fake(number, 0, returned=600.0 if number < 30 else 200.0, tagged=1), {})

    env = CommonsEnv(GAME, 1)
    with ViewerCallback(tmp_path, env, title="run", episodes=60, file_name="whole.rrd") as whole:
        play(whole, range(40))
        state = whole.state_dict()
        play(whole, range(40, 60))
    with ViewerCallback(tmp_path, env, title="run", episodes=60, file_name="now.rrd") as resumed:
        resumed.load_state_dict(state)
        play(resumed, range(40, 60))
    assert headers(tmp_path / "now.rrd")[-20:] == headers(tmp_path / "whole.rrd")[-20:]
    assert "tragedy" in headers(tmp_path / "now.rrd")[-2][1]


def test_phases_of_the_published_game_stand_beside_those_found():
    commons = presets.game("commons", variant="as_run")
    assert published_phases(commons) == dict(
        zip((0, *PHASES_BEGIN), ("exploration", "tragedy", "combat", "cultivation"), strict=True)
    )
    assert published_phases(presets.game("single_basic")) == {}
    assert published_phases(None) == {}


def test_a_recording_of_a_training_too_long_for_the_search_has_no_phases():
    env = CommonsEnv(GAME, 1)
    shown = {
        episodes: curves_of(env, GAME.agent_names, reported_by(env), episodes=episodes).has_phases
        for episodes in (999, 1000, LONGEST, LONGEST + 1)
    }
    assert shown == {999: False, 1000: True, LONGEST: True, LONGEST + 1: False}


def test_while_code_is_compiled_the_live_header_says_for_how_long(monkeypatch):
    monkeypatch.setattr(callback, "_PERIOD_S", 0.02)
    told = []

    def tell(status):
        told.append(status)
        if status == "begins":
            notice.stop()

    notice = callback.CompilingNotice(tell)
    with callback.CLOCK.running():
        while len(told) < 2:
            pass
    while told[-1] != "begins":
        pass
    assert told[0] == "compiling, 0 s so far"


def test_the_recipe_is_a_table_of_places():
    same = {"kind": "DQN", "settings": {"gamma": 0.995}}
    recipe = {"name": "a|b", "agents": [same, same, {"kind": "Frozen"}], "loggers": [], "map": "A.\n.B"}
    assert as_table(recipe).splitlines() == [
        "| place | value |",
        "| --- | --- |",
        "| name | a\\|b |",
        "| agents.0.kind | DQN |",
        "| agents.0.settings.gamma | 0.995 |",
        "| agents.1 | as agents.0 |",
        "| agents.2.kind | Frozen |",
        "| loggers | [] |",
        "",
        "`map`",
        "",
        "```",
        "A.",
        ".B",
        "```",
    ]


def names(view):
    """The names of all views and tabs of a layout."""
    found = [str(own) for own in [getattr(view, "name", None)] if own]
    for inner in getattr(view, "contents", None) or ():
        found += names(inner) if not isinstance(inner, str) else []
    return found


def test_the_live_layout_has_the_present_policy_and_the_files_has_the_recorded_board():
    live, file = (names(layout(SCENE, live=live).root_container) for live in (True, False))
    assert "Present policy" in live
    assert "Recorded episodes" in live
    assert "Present policy" not in file
    assert "Board" in file


def test_a_game_without_a_board_or_metrics_has_no_empty_views():
    bare = names(layout(Curves(agents=("a",), metrics=(), has_tags=False)).root_container)
    assert "Outcome" not in bare
    assert "Board" not in bare
    assert "Who tagged whom" not in bare
    assert {"Agents", "Learning", "Events", "Recipe"} <= set(bare)


def test_the_file_closes_while_the_live_view_goes_on(tmp_path):
    with RerunLogger("run", tmp_path, scene=SCENE, live="serve") as logger:
        logger.log_document("header", "# one")
        logger.close_file()
        RrdReader(tmp_path / "run.rrd").store()
        assert logger.is_served
        logger.log_document("header", "# two")
        logger.flush()
    assert not logger.is_served
    assert column(tmp_path / "run.rrd", "header", "TextDocument:text")[1] == [["# one"]]
    assert static(tmp_path / "run.rrd", "header", "TextDocument:media_type") == ["text/markdown"]


def test_the_numbers_of_an_evaluation_are_means_with_their_error():
    episodes = [fake(5, 0, returned=apples, tagged=0) for apples in (10.0, 14.0)]
    own = played(episodes)
    assert (own.mean, own.error, own.died, own.episodes) == (12.0, 2.0, 2, 2)
    assert np.isnan(played(episodes[:1]).error)


def test_the_header_says_where_a_run_is_and_how_to_read_its_plots():
    header = Header(episodes=4800, replicas=8, unit="apples")
    line = header.line(episode=640, label="tragedy", mean=436.4, random_play=282.1, died=2.0)
    assert all(word in line for word in ("640", "4,800", "tragedy", "436", "282", "2 of 8"))
    notes = header.notes(window=96, of_mean=64)
    assert all(word in notes for word in ("64 episodes", "96 episodes", "8 replicas"))
    alone = Header(episodes=200, replicas=1, unit="return")
    assert "replicas" not in alone.notes(window=10)
    for died in (None, float("nan"), 0.0):
        line = alone.line(episode=1, label="harvesting", mean=4.25, random_play=None, died=died)
        assert "return 4.25" in line
        assert "died" not in line
