"""Lines of progress: how far a training is, one that was stopped and gone on with too."""

import io
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from tensordict import TensorDict

from cprl import CommonsEnv, Game, Rules, maps
from cprl.policies.actors import LaneActor
from cprl.system.times import CLOCK, Speed
from cprl.terminal import progress
from cprl.terminal.progress import ProgressBar
from cprl.training import Schedule, Training, train

GAME = Game(map=maps.parse(".A>\n..A"), rules=Rules(window_rows=3, window_columns=3, episode_steps=5))


def lines(monkeypatch, *, before):
    """What is printed of a training of 6 episodes, as if so many episodes of 2 replicas had ended before."""
    monkeypatch.setattr(progress, "_LINE_PERIOD_S", 0.0)
    told = io.StringIO()
    walker = LaneActor(None, 8, seeds=[(0,), (1,)], agents=1)
    with ProgressBar(Schedule(episodes=9), GAME, replicas=2, console=Console(file=told, width=200)) as bar:
        episodes = 6 + before // 2
        training = Training(
            CommonsEnv(GAME, 2), {}, Schedule(episodes=episodes), others={(0,): walker}, callbacks=[bar]
        )
        training.steps, training._ended_episodes = 5 * before // 2, [before // 2] * 2
        training.run()
    return told.getvalue()


def test_the_bar_shows_square_brackets_of_the_title_as_they_are():
    told = io.StringIO()
    with ProgressBar(
        Schedule(episodes=9), GAME, title="run [a]", console=Console(file=told, force_terminal=True)
    ):
        pass
    assert "run [a]" in told.getvalue()


def test_the_bar_is_one_line_of_80_columns(monkeypatch):
    monkeypatch.setattr(progress, "_BAR_PERIOD_S", 0.0)
    told = io.StringIO()
    console = Console(file=told, force_terminal=True, width=80, legacy_windows=False)
    with ProgressBar(
        Schedule(episodes=1200), GAME, title="a title of many words " * 4, console=console
    ) as bar:
        for _ in range(30):
            bar.on_step(TensorDict(batch_size=[4]))
        bar._progress.refresh()
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", told.getvalue())
    lines = [line for line in re.split(r"[\r\n]+", shown) if line.strip()]
    assert all("steps/s" in line and len(line) <= 80 for line in lines[1:])


def test_a_notebook_has_one_line_with_a_bar_that_fills(monkeypatch):
    monkeypatch.setattr(progress, "_NOTEBOOK_PERIOD_S", 0.0)
    monkeypatch.setattr(progress, "COMPILING_PERIOD_S", float("inf"))  # else a line more with an empty cache
    shown, told = [], io.StringIO()

    class Block:
        def update(self, content, *, raw):
            shown.append(content["text/plain"])

    def display(content, *, raw, display_id):
        assert not shown, "a block of output more"
        shown.append(content["text/plain"])
        return Block()

    monkeypatch.setattr("IPython.display.display", display)
    walker = LaneActor(None, 8, seeds=[(0,)], agents=1)
    with ProgressBar(Schedule(episodes=4), GAME, console=Console(file=told, force_jupyter=True)) as bar:
        train(CommonsEnv(GAME, 1), {}, Schedule(episodes=4), others={(0,): walker}, callbacks=[bar])
    assert told.getvalue() == ""
    full = [line.count("█") for line in shown]
    assert full == sorted(full)
    assert (full[0], full[-1]) == (1, 20)


def test_the_return_is_the_mean_of_the_last_episodes_of_all_worlds():
    with ProgressBar(
        Schedule(episodes=9, worlds=2), GAME, replicas=2, console=Console(file=io.StringIO())
    ) as bar:
        for harvest in (100.0, 7.0, 1.0, 2.0, 4.0):
            bar.on_episode(SimpleNamespace(return_=np.array([harvest]), harvest=None, steps=5), {})
        assert bar._return == "3.5"  # (7 + 1 + 2 + 4) / 4


def test_the_bar_never_counts_more_episodes_than_there_are():
    with ProgressBar(Schedule(episodes=3), GAME, console=Console(file=io.StringIO())) as bar:
        for _ in range(3):
            bar.on_episode(SimpleNamespace(return_=np.ones(1), harvest=None, steps=5), {})
        for _ in range(4):  # of an episode beyond the last one
            bar.on_step(TensorDict(batch_size=[1]))
        assert bar._done() == 3


def test_the_bar_counts_the_episodes_that_run_in_every_world():
    with ProgressBar(
        Schedule(episodes=20, worlds=3), GAME, replicas=2, console=Console(file=io.StringIO())
    ) as bar:
        walker = LaneActor(None, 8, seeds=[(0,), (1,)], agents=1, worlds=3)
        training = Training(
            CommonsEnv(GAME, 6), {}, Schedule(episodes=20, worlds=3), others={(0,): walker}, callbacks=[bar]
        )
        for _ in range(12):  # 2.4 episodes of each world
            training.step()
        assert bar._done() == pytest.approx(3 * 12 / 5)


def test_lines_count_episodes_from_where_a_stopped_training_was(monkeypatch):
    shown = [int(number) for number in re.findall(r"episode (\d+)/9", lines(monkeypatch, before=0))]
    assert (shown[0], shown[-1]) == (0, 5)
    shown = [int(number) for number in re.findall(r"episode (\d+)/9", lines(monkeypatch, before=6))]
    assert (shown[0], shown[-1]) == (3, 8)


def printed(*, steps, compile_s=0.0):
    """What a bar prints of so many steps of one world, a millisecond each, the first with a compilation."""
    told, batch = io.StringIO(), TensorDict(batch_size=[1])
    with ProgressBar(Schedule(episodes=1000), GAME, console=Console(file=told, width=200)) as bar:
        with CLOCK.running():
            time.sleep(compile_s)
        for _ in range(steps):
            time.sleep(0.001)
            bar.on_step(batch)
    return told.getvalue()


def test_no_time_left_is_shown_before_twenty_steps_were_timed(monkeypatch):
    monkeypatch.setattr(progress, "_LINE_PERIOD_S", 0.0)
    # What else is compiled meanwhile is told too.
    lines = [line for line in printed(steps=40).splitlines() if ": episode " in line]
    assert [" left" in line for line in lines] == [False] * 19 + [True] * 21


@pytest.mark.integration
def test_a_compilation_is_reported_while_it_lasts_and_slows_no_estimate(monkeypatch):
    monkeypatch.setattr(progress, "_LINE_PERIOD_S", 0.02)
    monkeypatch.setattr(progress, "COMPILING_PERIOD_S", 0.2)
    told = printed(steps=60, compile_s=1.0)
    assert re.search(r"training: compiling, \d s so far", told)
    rates = [int(rate.replace(",", "")) for rate in re.findall(r"([\d,]+) steps/s", told)]
    assert min(rates) > 30, "a second of compiling for the first step would make it one step per second"


def test_speed_is_of_the_time_in_which_nothing_is_compiled(monkeypatch):
    now, clock = SimpleNamespace(s=10.0), SimpleNamespace(total_s=0.0)
    monkeypatch.setattr("cprl.system.times.time", SimpleNamespace(perf_counter=lambda: now.s))
    monkeypatch.setattr("cprl.system.times.CLOCK", clock)
    speed = Speed(100)
    assert speed.mean(100) is None
    assert np.isnan(speed.lap(100))
    now.s, clock.total_s = 44.0, 30.0  # 4 s of work
    assert speed.lap(108) == 2.0
    now.s = 45.0
    assert speed.waited_s == 1.0
    assert speed.lap(109) == 1.0
    assert speed.mean(109) == 9 / 5


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (99, "99 s"), (125, "2 min"), (6_050, "1 h 41 min"), (34_897, "9 h 42 min")],
)
def test_durations_are_told_in_units_that_fit(seconds, words):
    assert progress.format_duration(seconds) == words
