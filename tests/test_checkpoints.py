"""Whatever stops a training, it goes on bit for bit; what cannot be read is refused by name."""

import io
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import train_and_die
from dqn_parts import make_learner
from rich.console import Console

from cprl.algorithms import PPO, RolloutSettings
from cprl.commons.spaces import Spaces
from cprl.learners.lanes import SAMPLING, lane_seeds
from cprl.policies.rng import DRAWN_AHEAD, LaneRng
from cprl.runs.checkpoints import Checkpointer, checkpoints_in, read_checkpoint
from cprl.runs.episodes import EpisodeTable, read_episodes
from cprl.runs.files import write_atomically
from cprl.runs.weights import load_weights

SCRIPT = Path(train_and_die.__file__)
EPISODES = 25


class Dying:
    """Ends the training after so many turns of this process."""

    def __init__(self, turns):
        self.left = turns

    def on_step(self, batch):
        self.left -= 1
        if self.left == 0:
            raise ZeroDivisionError

    def on_episode(self, episode, learning):
        """Nothing."""


def assert_same_run(run, other):
    """Episodes and weights are the same, bit for bit."""
    assert read_episodes(run).equals(read_episodes(other))
    mine, theirs = (load_weights(one / "checkpoints" / "final.pt") for one in (run, other))
    assert set(mine) == set(theirs)
    for lane, weights in mine.items():
        for name, value in weights.items():
            assert torch.equal(value, theirs[lane][name]), (lane, name)


@pytest.fixture(scope="module")
def in_one_go(tmp_path_factory):
    run = tmp_path_factory.mktemp("one_go") / "run"
    train_and_die.main(run, every_s=1000, episodes=EPISODES)
    return run


@pytest.mark.integration
@pytest.mark.parametrize(
    "engine", ["lane_axis", *(pytest.param(name, marks=pytest.mark.slow) for name in ("vmapped", "list"))]
)
def test_a_training_that_was_ended_goes_on_bit_for_bit(engine, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train_and_die.main(whole, every_s=1000, episodes=12, engine=engine)
    for turns in (7, 60, 130):  # before learning starts, amid an episode, and later
        with pytest.raises(ZeroDivisionError):
            train_and_die.main(parts, every_s=1e-9, episodes=12, engine=engine, callbacks=[Dying(turns)])
        assert (parts / "episodes.arrows").exists()
    train_and_die.main(parts, every_s=1000, episodes=12, engine=engine)
    assert_same_run(parts, whole)


@pytest.mark.integration
def test_a_training_that_was_ended_before_its_first_checkpoint_begins_anew(tmp_path, in_one_go):
    with pytest.raises(ZeroDivisionError):
        train_and_die.main(tmp_path / "run", every_s=1000, episodes=EPISODES, callbacks=[Dying(80)])
    assert read_episodes(tmp_path / "run").num_rows > 0
    train_and_die.main(tmp_path / "run", every_s=1000, episodes=EPISODES)
    assert_same_run(tmp_path / "run", in_one_go)


def started(run, every_s="0.05"):
    process = subprocess.Popen(
        [sys.executable, SCRIPT, str(run), every_s],
        stdout=subprocess.PIPE,
        text=True,
        stderr=subprocess.STDOUT,
    )
    for line in process.stdout:
        if line.startswith("training"):
            return process
    raise AssertionError(f"it ended with {process.wait()} before it began")


@pytest.mark.integration
@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)], ids=str
)
def test_a_signal_ends_it_after_the_step_with_the_line_that_goes_on(number, tmp_path, in_one_go):
    run = tmp_path / "run"
    process = started(run, "1000")
    time.sleep(0.3)
    process.send_signal(number)
    told, _ = process.communicate(timeout=60)
    # An unhandled KeyboardInterrupt ends Python by SIGINT, or with 1 where TorchRL is imported.
    allowed = {signal.SIGTERM: (143,), signal.SIGINT: (-number, 1)}[number]
    assert process.returncode in allowed, told
    assert "Stopping after this step" in told
    assert f"To resume: python {SCRIPT} {run}" in told
    assert len(checkpoints_in(run / "checkpoints")) == 1
    train_and_die.main(run, every_s=1000, episodes=EPISODES)
    assert_same_run(run, in_one_go)


@pytest.mark.slow
def test_it_survives_sigkill_at_twenty_random_moments(tmp_path):
    run, chance = tmp_path / "run", random.Random(5)
    train_and_die.main(tmp_path / "one_go", every_s=1000)
    while_writing, moments = 0, []
    for kill in range(20):
        # Checkpoints follow each other without a pause in every second life: then it mostly dies writing one.
        process = started(run, "1e-9" if kill % 2 else "0.05")
        time.sleep(chance.uniform(0.0, 0.25))
        process.kill()
        process.communicate()
        while_writing += any((run / "checkpoints").glob("training.*.partial"))
        kept = checkpoints_in(run / "checkpoints")
        moments.append((read_checkpoint(kept[-1])["steps"] if kept else 0, read_episodes(run).num_rows))
        assert len(kept) <= 3
    print("\n".join(f"| {n + 1} | {steps} | {rows} |" for n, (steps, rows) in enumerate(moments)))
    print(f"killed while a checkpoint was written: {while_writing}")
    assert while_writing >= 1
    assert [steps for steps, _ in moments] == sorted(steps for steps, _ in moments), "nothing kept was lost"
    train_and_die.main(run, every_s=1000)
    assert_same_run(run, tmp_path / "one_go")


def test_two_writers_of_a_file_do_not_notice_each_other(tmp_path):
    path = tmp_path / "table"

    def write_slowly(file):
        file.write(b"fir")
        write_atomically(path, lambda other: other.write(b"second"))
        assert path.read_bytes() == b"second"
        file.write(b"st")

    write_atomically(path, write_slowly)
    assert path.read_bytes() == b"first"
    assert [*tmp_path.iterdir()] == [path]


def test_what_killed_processes_left_half_written_is_removed_by_the_next_one(tmp_path):
    run = tmp_path / "run"
    left = [run / f"recipe.json.{8 * '0'}.partial", run / "checkpoints" / f"training.{8 * 'f'}.partial"]
    left[1].parent.mkdir(parents=True)
    for path in [*left, run / "of_mine.partial"]:
        path.touch()
    with Checkpointer(run):
        assert not any(path.exists() for path in left)
    assert (run / "of_mine.partial").exists()


class State:
    """Stands for a training."""

    is_ending = is_over = False

    def __init__(self, steps=0):
        self.steps, self.loaded = steps, None

    def state_dict(self):
        return {"steps": self.steps, "numbers": torch.arange(5)}

    def load_state_dict(self, state):
        self.steps, self.loaded = state["steps"], state


def quiet(run, **how):
    return Checkpointer(run, console=Console(file=io.StringIO()), **how)


def test_the_newest_two_are_kept_and_the_newest_is_gone_on_from(tmp_path):
    checkpoints = quiet(tmp_path)
    for steps in (3, 20, 100):
        checkpoints.save(State(steps))
    kept = checkpoints_in(tmp_path / "checkpoints")
    assert [read_checkpoint(path)["steps"] for path in kept] == [20, 100]
    training = State()
    checkpoints.restore(training)
    assert training.steps == 100
    checkpoints.done()
    assert checkpoints_in(tmp_path / "checkpoints") == []


def test_it_saves_at_its_interval_and_not_before(tmp_path):
    often, seldom = quiet(tmp_path / "a", every_s=1e-9), quiet(tmp_path / "b", every_s=1000)
    (tmp_path / "a").mkdir()
    for steps in (1, 2):
        often.after_step(State(steps))
        seldom.after_step(State(steps))
    assert len(checkpoints_in(tmp_path / "a" / "checkpoints")) == 2
    assert checkpoints_in(tmp_path / "b" / "checkpoints") == []
    with pytest.raises(ValueError, match="every_s is 0"):
        quiet(tmp_path, every_s=0)


def test_a_spoilt_checkpoint_is_refused_by_name_and_the_one_before_taken(tmp_path):
    checkpoints = quiet(tmp_path)
    first, second = checkpoints.save(State(1)), checkpoints.save(State(2))
    content = second.read_bytes()
    second.write_bytes(content[:-10])
    with pytest.raises(ValueError, match=rf"{second.name} is truncated or was changed: its checksum is"):
        read_checkpoint(second)
    training = State()
    checkpoints.restore(training)
    assert training.steps == 1
    first.write_bytes(first.read_bytes().replace(b"numbers", b"nombres"))
    with pytest.raises(ValueError, match=f"no checkpoint can be read: .*{second.name}.*{first.name}"):
        checkpoints.restore(State())


def test_a_foreign_file_is_refused_and_none_of_its_code_is_run(tmp_path):
    class Harmful:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harm"),)

    checkpoints = quiet(tmp_path)
    state = State(1)
    state.state_dict = lambda: {"steps": 1, "harm": Harmful()}
    path = checkpoints.save(state)
    with pytest.raises(ValueError, match=f"{path.name} is not the state of a training"):
        read_checkpoint(path)
    assert not (tmp_path / "harm").exists()
    with pytest.raises(ValueError, match=r"notes\.pt is not a checkpoint"):
        read_checkpoint(tmp_path / "notes.pt")


def test_a_full_disk_leaves_the_checkpoints_before(tmp_path, monkeypatch):
    checkpoints = quiet(tmp_path)
    checkpoints.save(State(1))

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoints.save(State(2))
    (kept,) = checkpoints_in(tmp_path / "checkpoints")
    assert read_checkpoint(kept)["steps"] == 1
    assert list((tmp_path / "checkpoints").iterdir()) == [kept]


@pytest.mark.integration
def test_a_table_goes_on_behind_the_rows_of_a_checkpoint(tmp_path):
    with pytest.raises(ZeroDivisionError):
        train_and_die.main(tmp_path / "run", every_s=1000, callbacks=[Dying(200)])
    rows = read_episodes(tmp_path / "run")
    path = tmp_path / "run" / "episodes.parquet"

    def resume(behind):
        with EpisodeTable(path, resumable=True) as table:
            table.load_state_dict({"rows": behind})
            raise KeyboardInterrupt

    with pytest.raises(ValueError, match=f"holds {rows.num_rows} rows up to there; the checkpoint has 1000"):
        resume(1000)
    with pytest.raises(ValueError, match="holds 4 rows up to there; the checkpoint has 3"):
        resume(3)
    assert read_episodes(tmp_path / "run").equals(rows), "what cannot be gone on with is left as it is"
    with pytest.raises(KeyboardInterrupt):
        resume(6)
    assert read_episodes(tmp_path / "run").equals(rows.slice(0, 6))


def test_few_numbers_of_rollout_learners_are_drawn_ahead_and_earlier_states_hold_more():
    spaces = Spaces(agents=2, observation_shape=(3, 2, 2), actions=3)

    def learner():
        algorithm = PPO(settings=RolloutSettings(hidden_cells=(4,)))
        return make_learner(algorithm, spaces, agents=(0, 1), replicas=1, engine="eager", seed=4)

    seeds = lane_seeds(4, replicas=range(1), agents=(0, 1), purpose=SAMPLING)
    before, now = LaneRng(seeds, 250, ahead=DRAWN_AHEAD), learner()
    for _ in range(70):  # more than are drawn ahead
        assert torch.equal(now.rng.next(), before.next())
    state = now.state_dict()
    assert state["draws"]["numbers"].numel() <= 2 * 2**14
    resumed = learner()
    resumed.load_state_dict({**state, "draws": before.state_dict()})
    for _ in range(DRAWN_AHEAD):  # past those of the state
        assert torch.equal(resumed.rng.next(), now.rng.next())
