"""Lines of progress: how far a training is, one that was stopped and gone on with too."""

import io
import re

from rich.console import Console

from cprl import CommonsEnv, Game, Rules, maps
from cprl.policies.lanes import random_lanes
from cprl.terminal import progress
from cprl.terminal.progress import ProgressBar
from cprl.training import train

GAME = Game(map=maps.parse(".A>\n..A"), rules=Rules(window_rows=3, window_columns=3, episode_steps=5))


def lines(monkeypatch, *, before):
    """What is printed of a training of 6 episodes, as if so many episodes of 2 replicas had ended before."""
    monkeypatch.setattr(progress, "_LINE_PERIOD_S", 0.0)
    told = io.StringIO()
    walker = random_lanes(8, seeds=[(0,), (1,)], agents=1)
    with ProgressBar(GAME, episodes=9, replicas=2, console=Console(file=told, width=200)) as bar:
        if before:
            bar.load_state_dict({"episodes": before})
        train(CommonsEnv(GAME, 2), {}, others={(0,): walker}, episodes=6, callbacks=[bar])
        assert bar.state_dict() == {"episodes": before + 12}
    return told.getvalue()


def test_lines_count_episodes_from_where_a_stopped_training_was(monkeypatch):
    shown = [int(number) for number in re.findall(r"episode (\d+)/9", lines(monkeypatch, before=0))]
    assert (shown[0], shown[-1]) == (0, 5)
    shown = [int(number) for number in re.findall(r"episode (\d+)/9", lines(monkeypatch, before=6))]
    assert (shown[0], shown[-1]) == (3, 8)
