"""What people played is replayed by their actions; they play nothing else again."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from hosted_runs import PEOPLE_SEED, begun, hosted, played
from stored_runs import MEADOW, command, stored

from cprl import CommonsEnv, keys
from cprl.evaluation import crossplay, evaluate_run
from cprl.evaluation.film import record_episode
from cprl.evaluation.fresh import fresh_episodes, record
from cprl.evaluation.play import open_session
from cprl.institutions import Tax, Vote
from cprl.measuring.table import where
from cprl.population import Scripted
from cprl.runs.episodes import read_episodes, read_table
from cprl.runs.played import write_played

VOTING = replace(MEADOW, institutions=(Vote(on=Tax(), choices=(0.0, 0.9)),))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return hosted(tmp_path_factory.mktemp("hosted") / "classroom", MEADOW)


@pytest.mark.parametrize("game", [MEADOW, VOTING], ids=["no rule", "a vote"])
def test_a_replay_is_the_episode_of_a_group_turn_by_turn(game, tmp_path):
    run = hosted(tmp_path / "run", game, bots=[Scripted("greedy")])
    stored_turns = read_table(run / "turns.parquet")
    for group in range(3):
        recorded = record(*fresh_episodes([run], replica=group))
        rows = where(stored_turns, group=group)
        assert recorded.entry(*keys.ACTION).reshape(-1).tolist() == rows["action"].to_pylist()
        episode = where(read_episodes(run), replica=group)
        assert recorded.episode.harvest.tolist() == episode["harvest"].to_pylist()
        assert recorded.episode.return_.tolist() == episode["return"].to_pylist()
        assert recorded.last_turn == episode["steps"][0].as_py()


def test_the_group_that_is_shown_is_a_typical_one_and_is_said_to_be_of_people(run):
    (shown,) = fresh_episodes([run])
    assert shown.description.startswith(f"Group {shown.replica}, as people played it. The people of the 3")
    episodes = where(read_episodes(run), agent=0)
    steps = episodes["steps"].to_numpy()
    distances = np.abs(steps - np.median(steps))
    assert distances[shown.replica] == distances.min()


def test_people_are_shown_beside_trained_agents(run, tmp_path, monkeypatch, capsys):
    scripts = stored(tmp_path / "scripts", MEADOW)
    page = tmp_path / "page.html"
    printed = command(monkeypatch, capsys, "show", run, scripts, "--out", page)
    assert "as people played it" in printed
    text = page.read_text(encoding="utf-8")
    assert "Players: 2 people." in text
    assert "Computer players: 2 agents by the script" in text


def test_a_recording_of_people_says_that_they_have_no_action_values(run, tmp_path):
    path, episode = record_episode(run, tmp_path / "people.rrd", replica=1)
    assert path.stat().st_size
    assert episode.harvest.tolist() == where(read_episodes(run), replica=1)["harvest"].to_pylist()


def test_turns_that_give_other_apples_than_the_run_tells_of_are_refused(tmp_path):
    for name, change in {
        "another action": lambda turns: turns.set_column(
            turns.column_names.index("action"), "action", pa.array(np.zeros(len(turns), np.int8))
        ),
        "a turn less": lambda turns: turns.slice(0, len(turns) - MEADOW.agents),
        "another group": lambda turns: where(turns, group=(0, 1)),
    }.items():
        changed, experiment = begun(tmp_path / name, MEADOW)
        episodes, turns = played(experiment.game, seed=experiment.seed)
        assert sum(episode.harvest.sum() for episode in episodes) > 0
        write_played(changed, episodes, turns=change(turns))
        harvested = max(range(3), key=lambda group: episodes[group].harvest.sum())
        with pytest.raises(ValueError, match=r"turns\.parquet"):
            fresh_episodes([changed], replica=2 if name != "another action" else harvested)


def test_without_their_turns_people_are_in_a_report_but_not_in_a_film(tmp_path, monkeypatch, capsys):
    run = hosted(tmp_path / "run", MEADOW, turns=False)
    with pytest.raises(ValueError, match=r"turns\.parquet does not exist.*people cannot be played again"):
        fresh_episodes([run])
    command(monkeypatch, capsys, "report", run)
    text = (run / "report.html").read_text(encoding="utf-8")
    assert "<h2>The episodes that people played</h2>" in text
    assert "2 people, played for 1 episode in 3 groups." in text
    assert "random play" not in text
    assert "cprl run RUN" not in text
    with pytest.raises(SystemExit, match="episodes is 5"):
        command(monkeypatch, capsys, "report", run, "--out", tmp_path / "other.html", "--episodes", 5)


def test_a_report_shows_what_people_played(run, tmp_path, monkeypatch, capsys):
    command(monkeypatch, capsys, "report", run, "--out", tmp_path / "report.html")
    assert "Players: 2 people." in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_people_play_no_fresh_worlds(run, tmp_path):
    scripts = stored(tmp_path / "scripts", MEADOW)
    again = "is a person: people cannot be played again"
    for play in (
        lambda: evaluate_run(run),
        lambda: crossplay([scripts, run]),
        lambda: open_session(str(run)),
        lambda: open_session(str(scripts), others=str(run)),
    ):
        with pytest.raises(ValueError, match=again):
            play()
    for which in ({"episode": 1}, {"seed": 8}):
        with pytest.raises(ValueError, match="people, who play no fresh worlds"):
            fresh_episodes([scripts, run], **which)


def test_a_world_of_a_group_is_the_world_of_that_number_alone():
    both = CommonsEnv(MEADOW, worlds=3, seed=PEOPLE_SEED).reset()[keys.OBSERVATION][2]
    alone = CommonsEnv(MEADOW, worlds=1, seed=PEOPLE_SEED, first_world=2).reset()[keys.OBSERVATION][0]
    assert both.tolist() == alone.tolist()
