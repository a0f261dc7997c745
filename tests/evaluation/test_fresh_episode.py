"""Which fresh episode is shown where nobody says which: a typical one, in a world of no training."""

import io
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from matrix_games import prisoners_dilemma
from stored_runs import CORRIDORS, DQN, MEADOW, an_experiment, command, stored

from cprl.commands.play_by_keys import play_in_terminal
from cprl.evaluation.film import Style, film_episode, record_episode
from cprl.evaluation.fresh import averages_of, fresh_episodes, fresh_seed, typical_replica
from cprl.evaluation.play import open_session
from cprl.runs.recipe import start_run
from cprl.runs.weights import save_weights
from cprl.system.defaults import FILM_SEED, PLAY_SEED
from cprl.training.evaluating import make_agents
from cprl.training.stored import load
from cprl.values import trust
from cprl.web.report import report
from cprl.web.show import show

TURNS, APPLES = [9.0, 2.0, 4.0, 14.0], [20.0, 3.0, 11.0, 30.0]
"""Of four replicas in their evaluation. Medians: 6.5 turns, to which 9 and 4 are equally near, and 15.5
apples, to which 11 and 20 are equally near: so it is the replica that comes first, 0."""


def fresh_episode(run, **numbers):
    """A fresh episode of a single run."""
    (fresh,) = fresh_episodes([run], **numbers)
    return fresh


def trained(folder, *, game=MEADOW, turns=TURNS, apples=APPLES, seed=3):
    """A run of agents that learned nothing yet, with an evaluation of these means over two episodes."""
    experiment = replace(an_experiment(folder.name, game, (DQN, DQN), replicas=len(turns)), seed=seed)
    run = start_run(folder, folder.name, experiment.to_recipe)
    save_weights(run, make_agents(experiment)[1].networks())
    rows = [
        {
            "replica": replica,
            "episode": episode,
            "agent": agent,
            "harvest": apples[replica] / 2 + agent,
            "survival_steps": turns[replica] + 2 * episode - 1,
            "collective_return": apples[replica],
            "return": apples[replica] / 2,
            "steps": int(turns[replica]),
            "terminated": True,
        }
        for replica in range(len(turns))
        for episode in range(2)
        for agent in range(2)
    ]
    (folder / "evaluation").mkdir()
    for policy in ("trained", "random"):
        pq.write_table(pa.Table.from_pylist(rows), folder / "evaluation" / f"{policy}.parquet")
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("runs") / "run")


SMALL = Style(width=240, every=50)


def first_five(run, replica, folder):
    """The turns and the apples of the first five fresh episodes of a replica."""
    reached = []
    for episode in range(5):
        _, (played,) = film_episode(
            run, folder / f"{episode}.gif", replica=replica, episode=episode, style=SMALL
        )
        reached.append((played.steps, played.harvest.sum()))
    return np.array(reached)


def test_the_replica_is_the_one_whose_survival_is_nearest_to_the_median(run, tmp_path):
    assert averages_of(load(run)) == dict(enumerate(zip(TURNS, APPLES, strict=True)))
    assert typical_replica(load(run)) == 0
    middle = trained(tmp_path / "odd", turns=[3.0, 30.0, 8.0], apples=[1.0, 2.0, 3.0])
    assert typical_replica(load(middle)) == 2
    alike = trained(tmp_path / "alike", turns=[9.0] * 3, apples=[10.0, 30.0, 20.0])
    assert typical_replica(load(alike)) == 2, "of equal lives the harvest in the middle"


@pytest.mark.integration
def test_the_episode_is_the_one_of_five_whose_turns_and_apples_are_nearest_to_the_medians(run, tmp_path):
    reached = first_five(run, 0, tmp_path)
    medians = np.median(TURNS), np.median(APPLES)
    far = np.sum(abs(reached - medians) / medians, axis=1)
    fresh = fresh_episode(run)
    assert (fresh.replica, far[fresh.episode]) == (0, min(far))
    _, (filmed,) = film_episode(run, tmp_path / "film.gif", style=SMALL)
    assert (filmed.steps, filmed.harvest.sum()) == tuple(reached[fresh.episode])
    again = fresh_episode(run)
    assert (again.replica, again.episode) == (fresh.replica, fresh.episode)


def test_runs_side_by_side_have_each_their_replica_and_one_world(run, tmp_path):
    other = trained(tmp_path / "other", turns=[3.0, 8.0, 20.0], apples=[1.0, 2.0, 3.0])
    first, second, scripted = fresh_episodes([run, other, stored(tmp_path / "greedy")])
    assert (first.replica, second.replica, scripted.replica) == (0, 1, 0)
    assert first.episode == second.episode == scripted.episode
    assert (first.is_typical, second.is_typical, scripted.is_typical) == (True, True, False)


def test_words_say_which_episode_it_is_and_what_all_replicas_come_to(run, tmp_path):
    fresh = fresh_episode(run)
    known = (
        "The trained agents of the 4 replicas last 9, 2, 4 and 14 turns on average and pick 20, 3, 11 and 30 "
        "apples."
    )
    assert fresh.description == (
        f"A typical episode (replica 0, episode {fresh.episode}), chosen of the first 5 for a life and a "
        f"harvest near the medians of the replicas, 6 turns and 16 apples. {known}"
    )
    assert fresh_episode(run, replica=1, episode=3).description == f"Replica 1, episode 3. {known}"
    many = trained(tmp_path / "many", turns=list(range(1, 10)), apples=list(range(11, 20)))
    assert (
        "of the 9 replicas last 1 to 9 turns on average and pick 11 to 19 apples"
        in fresh_episode(many).description
    )
    alone = trained(tmp_path / "alone", turns=[9.0], apples=[20.0])
    assert (
        "near the averages, 9 turns and 20 apples. The trained agents last 9 turns"
        in fresh_episode(alone).description
    )


def test_what_is_asked_for_is_taken_as_it_is(run):
    assert fresh_episode(run, replica=3)[3:] == (3, 0, False)
    assert fresh_episode(run, episode=4)[3:] == (0, 4, False)


@pytest.mark.parametrize("lacks", ["learners", "evaluation", "board"])
def test_a_run_without_an_evaluation_of_learners_shows_its_first_episode(tmp_path, lacks):
    if lacks == "evaluation":
        run = trained(tmp_path / "run")
        (run / "evaluation" / "trained.parquet").unlink()
    else:
        game = prisoners_dilemma(turns=2) if lacks == "board" else CORRIDORS
        run = stored(tmp_path / "run", game, "random")
        trust("matrix_games:MatrixGame")
    assert fresh_episode(run)[3:] == (0, 0, False)
    assert fresh_episode(run).description == "Replica 0, episode 0."


@pytest.mark.integration
def test_film_show_report_and_play_show_a_typical_one_and_say_so(run, tmp_path, monkeypatch, capsys):
    words = fresh_episode(run).description
    assert words in command(monkeypatch, capsys, "film", run, "--out", tmp_path / "a.gif", "--width", 240)
    assert words in command(monkeypatch, capsys, "show", run, "--out", tmp_path / "a.html")
    for page in (tmp_path / "a.html", report(run, tmp_path / "report.html", episodes=1)):
        assert words in page.read_text(encoding="utf-8")
    session = open_session(str(run))
    play_in_terminal(session, io.StringIO("." * 15 + "\n").readline)
    said = capsys.readouterr().out
    assert "The others are of replica 0. The trained agents of the 4 replicas last 9, 2, 4 and 14" in said
    assert "On average trained agent 0 gets 8, and 8 where all act at random." in said


def test_nothing_is_said_of_what_agents_usually_get_in_another_game(run, capsys):
    session = open_session(str(run), steps=1)
    play_in_terminal(session, io.StringIO(".\n").readline)
    assert "On average trained agent" not in capsys.readouterr().out


@pytest.mark.parametrize("how", ["film", "film_episode", "show", "play"])
def test_the_worlds_of_a_training_are_refused_as_fresh_ones(run, tmp_path, how):
    makes = {
        "film": lambda: record_episode(run, tmp_path / "a.rrd", seed=3),
        "film_episode": lambda: film_episode(run, tmp_path / "a.gif", seed=3),
        "show": lambda: show(run, tmp_path / "a.html", seed=3),
        "play": lambda: open_session("commons", others=str(run), seed=3),
    }
    with pytest.raises(ValueError, match=r"seed is 3, the training seed of .*run; allowed: any other seed"):
        makes[how]()
    assert not [*tmp_path.iterdir()]


@pytest.mark.integration
@pytest.mark.parametrize("seed", [FILM_SEED, PLAY_SEED])
def test_by_default_no_world_of_a_training_is_taken(tmp_path, seed):
    """Agents of a run that was trained with the default seed play the worlds of the next one."""
    runs = [trained(tmp_path / name, seed=each) for name, each in (("one", seed), ("two", seed + 1))]
    assert fresh_seed([load(one) for one in runs], seed) == seed + 2
    show(runs[0], tmp_path / "a.html", beside=[runs[1]])
    report(runs[0], episodes=1)
    open_session(str(runs[0]), agent=1)


@pytest.mark.parametrize("what", ["film", "show", "evaluate", "play"])
def test_a_seed_that_is_none_is_refused_by_the_name_of_its_flag(run, monkeypatch, capsys, what):
    with pytest.raises(SystemExit, match=f"--seed is {2**70}; allowed: an integer"):
        command(monkeypatch, capsys, what, run, "--seed", 2**70)


def test_a_game_without_a_board_cannot_be_shown_and_a_sentence_says_so(tmp_path):
    run = stored(tmp_path / "matrix", prisoners_dilemma(turns=2), "random")
    trust("matrix_games:MatrixGame")
    with pytest.raises(ValueError, match="plays a game without a board"):
        show(run, tmp_path / "a.html")
