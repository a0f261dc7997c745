"""Checkpoints are written whole, kept in twos, and gone on from; what cannot be read is refused by name."""

import os

import pytest
import torch
from dqn_parts import make_learner

from cprl.algorithms import PPO, RolloutSettings
from cprl.commons.spaces import Spaces
from cprl.learners.lanes import SAMPLING, lane_seeds
from cprl.policies.rng import DRAWN_AHEAD, LaneRng
from cprl.runs.checkpoints import Checkpointer, checkpoints_in, read_checkpoint
from cprl.runs.files import write_atomically


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
    for path in [*left, run / "foreign.partial"]:
        path.touch()
    with Checkpointer(run):
        assert not any(path.exists() for path in left)
    assert (run / "foreign.partial").exists()


class State:
    """Stands for a training."""

    is_ending = is_over = False

    def __init__(self, steps=0):
        self.steps, self.loaded = steps, None

    def state_dict(self):
        return {"steps": self.steps, "numbers": torch.arange(5)}

    def load_state_dict(self, state):
        self.steps, self.loaded = state["steps"], state


def test_the_newest_two_are_kept_and_the_newest_is_gone_on_from(tmp_path):
    checkpoints = Checkpointer(tmp_path)
    for steps in (3, 20, 100):
        checkpoints.save(State(steps))
    paths = checkpoints_in(tmp_path / "checkpoints")
    assert [read_checkpoint(path)["steps"] for path in paths] == [20, 100]
    training = State()
    checkpoints.restore(training)
    assert training.steps == 100
    checkpoints.done()
    assert checkpoints_in(tmp_path / "checkpoints") == []


def test_it_saves_at_its_interval_and_not_before(tmp_path):
    often, seldom = Checkpointer(tmp_path / "a", every_s=1e-9), Checkpointer(tmp_path / "b", every_s=1000)
    (tmp_path / "a").mkdir()
    for steps in (1, 2):
        often.after_step(State(steps))
        seldom.after_step(State(steps))
    assert len(checkpoints_in(tmp_path / "a" / "checkpoints")) == 2
    assert checkpoints_in(tmp_path / "b" / "checkpoints") == []
    with pytest.raises(ValueError, match="every_s is 0"):
        Checkpointer(tmp_path, every_s=0)


def test_a_spoilt_checkpoint_is_refused_by_name_and_the_one_before_taken(tmp_path):
    checkpoints = Checkpointer(tmp_path)
    first, second = checkpoints.save(State(1)), checkpoints.save(State(2))
    content = second.read_bytes()
    second.write_bytes(content[:-10])
    with pytest.raises(ValueError, match=rf"{second.name} is damaged or was changed: its checksum is"):
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

    checkpoints = Checkpointer(tmp_path)
    state = State(1)
    state.state_dict = lambda: {"steps": 1, "harm": Harmful()}
    path = checkpoints.save(state)
    with pytest.raises(ValueError, match=f"{path.name} is not the state of a training"):
        read_checkpoint(path)
    assert not (tmp_path / "harm").exists()
    with pytest.raises(ValueError, match=r"notes\.pt is not a checkpoint"):
        read_checkpoint(tmp_path / "notes.pt")


def test_a_full_disk_leaves_the_checkpoints_before(tmp_path, monkeypatch):
    checkpoints = Checkpointer(tmp_path)
    checkpoints.save(State(1))

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoints.save(State(2))
    (path,) = (tmp_path / "checkpoints").iterdir()
    assert read_checkpoint(path)["steps"] == 1


def test_few_numbers_of_rollout_learners_are_drawn_ahead():
    spaces = Spaces(agents=2, observation_shape=(3, 2, 2), actions=3)

    algorithm = PPO(settings=RolloutSettings(hidden_cells=(4,)))
    learner = make_learner(algorithm, spaces, agents=(0, 1), replicas=1, engine="eager", seed=4)
    seeds = lane_seeds(4, replicas=range(1), agents=(0, 1), purpose=SAMPLING)
    many = LaneRng(seeds, 250, ahead=DRAWN_AHEAD)
    for _ in range(70):  # more than are drawn ahead
        assert torch.equal(learner.rng.next(), many.next())
    assert learner.state_dict()["draws"]["numbers"].numel() <= 2 * 2**14
