"""A person plays among others: the session, the terminal."""

import io
import os
import re
import sys

import pytest
import torch
from matrix_games import stag_hunt
from places import ROOT
from stored_runs import command, stored

from cprl import CommonsEnv, Game, River, Rules, keys, maps, presets
from cprl.commands.play_by_keys import board_text, help_of, keys_of, play_in_terminal
from cprl.envs.make_env import make_env
from cprl.evaluation.play import Session, open_session
from cprl.measuring.tracker import EpisodeTracker

DRAWING = """
.A>.A.
#.....
..AA<.
"""
RULES = Rules(regrow_prob=(0.0,), window_rows=3, window_columns=5, episode_steps=6, freeze_steps=2)
MEADOW = Game(map=maps.parse(DRAWING), rules=RULES)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run on the meadow, in which everybody always leaves the apples that hang alone."""
    return stored(tmp_path_factory.mktemp("runs") / "meadow", MEADOW, "sustainable")


def text_of(session):
    return board_text(session).plain.splitlines()


@pytest.mark.integration
def test_the_person_decides_for_one_agent_and_the_others_for_themselves(run):
    session = open_session(str(run), agent=0, seed=1)
    assert text_of(session) == [". A 0>. A .", "##. . . . .", ". . A A 1<."]
    session.act("forward")
    turned = session.act("forward")
    assert turned.harvest.tolist() == [[1, 0]]
    assert (session.harvested, session.stock, session.turn) == ([1, 0], 3, 2)
    assert text_of(session)[0] == ". A . . 0>."
    session.act("turn_left")
    assert text_of(session)[0] == ". A . . 0^."


def test_the_same_seed_and_keys_play_the_same_again(run):
    def played(seed):
        session = open_session(str(run), others="random", seed=seed)
        while not session.has_ended:
            session.act("stay")
        return [moment.col[1] for moment in session.boards]

    assert played(3) == played(3)
    assert len({tuple(played(seed)) for seed in range(4)}) > 1


def test_the_metrics_are_those_of_an_episode(run):
    session, tracker, ended = open_session(str(run), others="greedy", seed=2), EpisodeTracker(1, 2), []
    played = session._turns

    def watched():
        for batch in played:
            ended.extend(tracker.add(batch))
            yield batch

    session._turns = watched()
    assert session.metrics() == {}
    for action in ("forward", "beam", "turn_right", "forward", "forward", "beam"):
        if not session.has_ended:
            session.act(action)
    (episode,) = ended
    assert session.metrics() == pytest.approx(episode.metrics, nan_ok=True)
    with pytest.raises(ValueError, match="the episode has ended"):
        session.act("stay")


def test_a_tagged_person_waits(tmp_path, capsys):
    drawing = tmp_path / "lane.txt"
    drawing.write_text(">..<A\n")
    session = open_session(str(drawing), agent=0, others="aggressive", steps=9)
    play_in_terminal(session, iter([".\n", ".\n", ""]).__next__)
    told = capsys.readouterr().out
    assert "turn 1: agent 1 tags you out" in told
    assert "0 by you (out of play)" in told


def in_terminal(session, text, capsys):
    play_in_terminal(session, io.StringIO(text).readline)
    return capsys.readouterr().out.splitlines()


def test_lines_of_keys_play_an_episode_to_its_end(run, capsys):
    told = in_terminal(open_session(str(run), seed=1), "ww\n\nq..\n", capsys)
    first = told.index("keys> ww")
    assert told[first + 1] == "turn 2: you harvest an apple", "what is typed through a pipe is shown"
    assert "The end: time is over." in told
    assert len([line for line in told if line.startswith("turn")]) == 4 + 1


def test_keys_that_are_unknown_play_nothing_and_are_named(run, capsys):
    session = open_session(str(run), seed=1)
    told = in_terminal(session, "wz\nquit\n", capsys)
    assert session.turn == 0
    assert any(line.startswith("key is 'z'; allowed: w step forward") for line in told)
    assert told[-2:] == [
        "The end: stopped after turn 0.",
        "No turn was played, so there is nothing to measure.",
    ]


def test_the_session_in_the_docs_is_what_is_printed(tmp_path, monkeypatch, capsys):
    page = (ROOT / "docs" / "play.md").read_text()
    drawing, printed = re.findall(r"```text\n(.*?)```", page, re.DOTALL)
    (line,) = re.findall(r"cprl (play meadow\.txt [^`]*)`", page)
    (tmp_path / "meadow.txt").write_text(drawing)
    typed = "".join(f"{keys}\n" for keys in re.findall(r"^keys> (.*)$", printed, re.MULTILINE))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))
    assert command(monkeypatch, capsys, *line.split()) == printed


def test_ctrl_c_ends_an_episode_like_quit(run, capsys):
    def interrupted():
        raise KeyboardInterrupt

    session = open_session(str(run), seed=1)
    session.act("stay")
    play_in_terminal(session, interrupted)
    assert "The end: stopped after turn 1." in capsys.readouterr().out


@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal")
def test_in_a_terminal_a_key_plays_at_once_and_the_terminal_is_left_as_it_was(run, monkeypatch, capsys):
    import termios

    session, turns = open_session(str(run), seed=1), []
    ours, theirs = os.openpty()
    before = termios.tcgetattr(theirs)
    act = session.act

    def noted(action):
        turns.append(action)
        os.write(ours, b"\x1b[D" if len(turns) == 1 else b"\x1b")
        return act(action)

    monkeypatch.setattr(session, "act", noted)
    with open(theirs, encoding="utf-8", closefd=False) as typed:
        monkeypatch.setattr("sys.stdin", typed)
        os.write(ours, b"w")
        play_in_terminal(session)
    assert turns == ["forward", "turn_left"]
    assert termios.tcgetattr(theirs) == before
    assert "The end: stopped after turn 2." in capsys.readouterr().out
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize(
    ("pressed", "keys"),
    [
        ("w", "w"),
        ("\x1b[A\x1b[B", "ws"),
        ("\x1bOC\x1bOD", "eq"),
        ("\x1b", ""),
        ("\x04", ""),
        ("\n", "\n"),
        ("", ""),
    ],
)
def test_arrows_are_keys_and_escape_ends(pressed, keys):
    assert keys_of(pressed) == keys


def test_a_question_mark_prints_the_keys_in_lines_that_break_between_keys(run, capsys):
    session = open_session(str(run), seed=1)
    told = in_terminal(session, "?\nquit\n", capsys)
    keys = [line for line in told if "w step forward" in line]
    assert len(keys) == 2, "as it begins, and when asked"
    assert session.turn == 0
    printed = told[1 : told.index(next(line for line in told if "turn 0 of" in line)) - 3]
    assert all(len(line) <= 80 for line in printed)
    assert " ".join(printed).startswith(f"Keys: {help_of(MEADOW)}, ")
    assert not any(line.endswith((" q", " e")) for line in printed)


def test_a_game_without_a_beam_has_no_key_for_it():
    assert "f fire the beam" in help_of(MEADOW)
    assert "beam" not in help_of(presets.game("single_basic"))


def test_keys_harvest_and_clean_where_the_game_has_these_actions(tmp_path, capsys):
    assert not {"h harvest", "c clean the river"} & set(help_of(MEADOW).split(", "))
    assert "h harvest" in help_of(presets.game("janssen/foraging-v1"))
    river = River(may_clean=True)
    rules = Rules(regrow_prob=(1.0,), river=river, beam_width_cells=1, window_rows=3, window_columns=3)
    env = CommonsEnv(Game(map=maps.parse("A>.~HH"), rules=rules), seed=0)
    session = Session(env, lambda moment: moment.set(keys.ACTION, torch.zeros(1, 1, dtype=torch.long)))
    assert text_of(session) == ["A 0>. ~ H H"]
    in_terminal(session, "c\n", capsys)
    assert text_of(session) == ["A 0>* * * H"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["chess"], "board is 'chess'"),
        (["commons", "--others", "nobody"], "others is 'nobody'"),
        (["commons", "--agent", "4"], "agent is 4"),
        (["commons", "--replica", "3"], 'replica is 3, and others is "greedy"'),
        (["commons", "--steps", "0"], "steps is 0"),
        (["odd.txt"], r"odd\.txt: unknown sign 'x' at row 0, column 1"),
        (["odd.txt", "--variant", "as_run"], "variant is 'as_run'"),
        (["huge.txt"], r"huge\.txt has more than 10,000,000 bytes"),
    ],
)
def test_what_cannot_be_played_is_refused(tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "odd.txt").write_text(".x>A\n")
    with (tmp_path / "huge.txt").open("wb") as file:
        file.truncate(10_000_001)
    with pytest.raises(SystemExit, match=said):
        command(monkeypatch, capsys, "play", *words)


def test_a_person_plays_no_other_game_than_the_commons():
    with pytest.raises(ValueError, match=r"env is .*allowed: a CommonsEnv"):
        Session(make_env(stag_hunt(turns=2)), lambda moment: moment)


def test_agents_of_no_replica_are_refused(run):
    with pytest.raises(ValueError, match="replica is -1"):
        open_session(str(run), replica=-1)
    with pytest.raises(ValueError, match=r"replica is 0.*allowed: with the agents of a run"):
        open_session(str(run), others="greedy", replica=0)
