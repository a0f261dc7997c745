"""LoggerCallback: the numbers of episodes in any TorchRL logger."""

import contextlib
from pathlib import Path

import pytest
from matrix_game import MatrixGame, tit_for_tat
from test_any_game import play
from torchrl.record.loggers import CSVLogger

from cprl.measuring import EpisodeTracker
from cprl.runs import loggers
from cprl.runs.loggers import LoggerCallback, check_logger, make_logger
from cprl.training.collectors import StepCollector


def csv_of(folder):
    return CSVLogger("csv", str(folder / "logs"))


def files(folder):
    """What stands in each file of scalars, but for the speed."""
    scalars = folder / "logs" / "csv" / "scalars"
    paths = {path.relative_to(scalars).with_suffix("").as_posix(): path for path in scalars.rglob("*.csv")}
    return {name: path.read_text() for name, path in paths.items() if name != "time/env_steps_per_s"}


def test_each_episode_is_written_as_the_mean_of_the_replicas_and_of_each(tmp_path):
    with LoggerCallback(csv_of(tmp_path), replicas=2, agents=("row", "column")) as callback:
        play(MatrixGame(2), tit_for_tat, 12, callbacks=[callback])
    # Worlds play 5 and 6 turns: the first two episodes of both have ended after turns 6 and 12.
    assert files(tmp_path) == {
        "social/survival_steps": "0,5.5\n1,5.5\n",
        "replica_0/social/survival_steps": "0,5.0\n1,5.0\n",
        "replica_1/social/survival_steps": "0,6.0\n1,6.0\n",
        "row/return": "0,4.5\n1,4.5\n",
        "replica_0/row/return": "0,4.0\n1,4.0\n",
        "replica_1/row/return": "0,5.0\n1,5.0\n",
        "column/return": "0,9.0\n1,9.0\n",
        "replica_0/column/return": "0,8.5\n1,8.5\n",
        "replica_1/column/return": "0,9.5\n1,9.5\n",
        "row/loss": "0,0.5\n1,0.5\n",
        "time/env_steps": "0,6.0\n1,12.0\n",
    }
    rates = (tmp_path / "logs/csv/scalars/time/env_steps_per_s.csv").read_text().split()
    assert all(float(rate.split(",")[1]) > 0 for rate in rates)


def course(run, batches, *, first=0, state=None):
    """Logs batches; returns the states of tracker and callback after each."""
    tracker, callback = EpisodeTracker(2, 2), LoggerCallback(csv_of(run), replicas=2)
    if state:
        tracker.load_state_dict(state[0])
        callback.load_state_dict(state[1])
    states = []
    for batch in batches[first:]:
        callback.on_step(batch)
        for episode in tracker.add(batch):
            callback.on_episode(episode, {"agent_0/loss": float(episode.steps)})
        states.append((tracker.state_dict(), callback.state_dict()))
    return states


@pytest.fixture(scope="module")
def batches():
    played = []
    for batch in StepCollector(MatrixGame(2), tit_for_tat):
        played.append(batch)
        if len(played) == 40:
            return played
    raise AssertionError


@pytest.mark.parametrize("checkpoint", [0, 4, 10, 11, 22, 35])
def test_a_resumed_run_has_every_episode_once(checkpoint, tmp_path, batches):
    states = course(tmp_path / "whole", batches)
    course(tmp_path / "run", batches[: checkpoint + 1])
    course(tmp_path / "run", batches, first=checkpoint + 1, state=states[checkpoint])
    assert files(tmp_path / "run") == files(tmp_path / "whole")
    assert files(tmp_path / "whole")["social/survival_steps"].count("\n") == 6


def test_numbers_that_are_undefined_are_not_written(tmp_path):
    class Undefined(LoggerCallback):
        def on_episode(self, episode, learning):
            super().on_episode(episode, {"agent_0/loss": float("nan"), "agent_0/epsilon": 0.25})

    with Undefined(csv_of(tmp_path)) as callback:
        play(MatrixGame(1), tit_for_tat, 5, callbacks=[callback])
    assert "agent_0/loss" not in files(tmp_path)
    assert files(tmp_path)["agent_0/epsilon"] == "0,0.25\n"


@pytest.mark.parametrize("error", [None, RuntimeError("stop")])
def test_a_logger_of_the_users_is_taken_as_it_is_and_closed_at_the_end_and_by_an_error(error, tmp_path):
    class Noting(CSVLogger):
        is_closed = False

        def shutdown(self):
            self.is_closed = True

    logger = Noting("noting", str(tmp_path))
    check_logger(logger)
    assert make_logger(logger, tmp_path) is logger
    with contextlib.suppress(RuntimeError), LoggerCallback(logger) as callback:
        play(MatrixGame(1), tit_for_tat, 5, callbacks=[callback])
        assert not logger.is_closed
        if error:
            raise error
    assert logger.is_closed


def test_a_logger_that_cannot_be_made_is_refused_by_name_before_anything_is_written(tmp_path, monkeypatch):
    for name in ("mlflow", "csv"):
        with pytest.raises(ValueError, match="logger"):
            check_logger(name)
    with pytest.raises(TypeError, match="logger is a dict without log_metrics"):
        LoggerCallback({})
    monkeypatch.setattr(loggers, "find_spec", lambda name: None)
    for name in ("tensorboard", "wandb"):
        with pytest.raises(ModuleNotFoundError, match=f"needs the package {name}: pip install {name}"):
            make_logger(name, tmp_path / "run")
    assert not Path(tmp_path / "run").exists()
