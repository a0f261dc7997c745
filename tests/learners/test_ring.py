"""The replay buffer of many lanes: what is kept, what is drawn, returns of several steps, memory."""

import pytest
import torch
from dqn_parts import write
from ring_parts import SHAPE, filled, row, transition
from tensordict import TensorDict, assert_close
from torchrl.envs.transforms import MultiStepTransform

from cprl.learners.ring import Ring, stored_bytes
from cprl.learners.transitions import Horizon, TransitionForm

FORM = TransitionForm(observation_shape=SHAPE)


@pytest.mark.integration
@pytest.mark.parametrize("lanes", [[0], [0, 1, 2, 9]])
def test_every_transition_kept_is_what_came_and_the_last_ones_are_kept(lanes):
    ring = filled(lanes, steps=0, transitions=30)
    for step in range(100):
        write(ring, row(lanes, step))
        oldest, written = ring.oldest()
        assert written == step + 1
        for place, lane in enumerate(lanes):
            # Episodes are shorter here than one in fifty, so room for windows may run out before that for
            # transitions; what is left is the newest.
            numbers = torch.arange(int(oldest[place]), written)
            assert len(numbers) >= min(written, 24)
            stored = ring.get((numbers % 30).expand(len(lanes), -1))[place]
            for number, turn in zip(numbers.tolist(), stored, strict=True):
                assert_close(turn, TensorDict(transition(lane, number)).auto_batch_size_(0))


def test_lanes_draw_for_themselves_and_uniformly():
    ring = filled([0, 1, 2], steps=30, transitions=20)
    drawn = torch.stack([ring.places()[0] for _ in range(3000)])
    assert not torch.equal(drawn[:, 0], drawn[:, 1])
    counts = torch.stack([torch.bincount(drawn[:, lane].flatten(), minlength=20) for lane in range(3)])
    assert (counts - 600).abs().max() < 6 * 600**0.5
    alone = filled([1], steps=30, transitions=20)
    assert torch.equal(torch.stack([alone.places()[0] for _ in range(3000)])[:, 0], drawn[:, 1])


def test_a_ring_goes_on_as_it_was_from_its_state_and_a_sample_is_what_is_drawn():
    lanes = [0, 1, 2]
    ring, other, same = filled(lanes, steps=73), filled(lanes, steps=5), filled(lanes, steps=73)
    assert_close(filled(lanes, steps=73).sample(), same.get(*same.places()))
    other.load_state_dict(ring.state_dict())
    for step in range(73, 120):
        assert_close(ring.sample(), other.sample())
        for one in (ring, other):
            write(one, row(lanes, step))


def by_hand(lane, start, *, n_steps, gamma):
    """The return of `n_steps` steps from one on, the last of them, and their number."""
    total, last = 0.0, {}
    for ahead in range(n_steps):
        last = transition(lane, start + ahead)["next"]
        total += gamma**ahead * float(last["reward"])
        if last["done"]:
            break
    return total, last, ahead + 1


@pytest.mark.integration
@pytest.mark.parametrize(
    ("lanes", "n_steps"),
    [([0], 2), ([0], 7), ([0, 1, 2, 9], 3), pytest.param([0, 1, 2, 9], 7, marks=pytest.mark.slow)],
)
def test_returns_of_several_steps_are_what_one_works_out_by_hand(lanes, n_steps):
    gamma, transitions, steps, terminals = 0.9, 30, [], 0
    ring = filled(lanes, steps=0, transitions=transitions, batch_size=16, horizon=Horizon(n_steps, gamma))
    for step in range(100):
        write(ring, row(lanes, step))
        oldest, written = ring.oldest()
        if written < n_steps:
            continue
        index, column = ring.places()
        batch = ring.get(index, column)
        for place, lane in enumerate(lanes):
            for drawn, turn in zip(index[place].tolist(), batch[place], strict=True):
                number = written - 1 - (written - 1 - drawn) % transitions
                assert int(oldest[place]) <= number <= written - n_steps, "whole, and its steps are over"
                total, last, count = by_hand(lane, number, n_steps=n_steps, gamma=gamma)
                assert float(turn["next", "reward"]) == pytest.approx(total, rel=1e-6)
                assert int(turn["steps_to_next_obs"]) == count
                assert torch.equal(turn["observation"], transition(lane, number)["observation"])
                for name in ("observation", "done", "terminated"):
                    assert torch.equal(turn["next", name], last[name]), name
                steps.append(count)
                terminals += bool(last["terminated"])
    assert min(steps) < n_steps
    assert terminals > 0


def test_returns_of_several_steps_are_those_of_torchrls_multi_step_transform():
    """But that it leaves "done" and "terminated" those of the first step."""
    gamma, n_steps, lanes = 0.9, 4, [0, 1]
    ours = filled(lanes, steps=36, horizon=Horizon(n_steps, gamma))
    whole = MultiStepTransform(n_steps, gamma)._inv_call(
        torch.stack([row(lanes, step) for step in range(36)], 1)
    )
    got = ours.get(torch.arange(whole.shape[1]).expand(2, -1))
    assert whole.shape[1] == 36 - n_steps, "the newest are held back"
    torch.testing.assert_close(got["next", "reward"], whole["next", "reward"])
    assert torch.equal(got["next", "observation"], whole["next", "observation"])
    assert torch.equal(got["steps_to_next_obs"].squeeze(-1), whole["steps_to_next_obs"].view(2, -1))


def test_what_it_takes_is_told_before_and_what_cannot_fit_is_refused(caplog):
    assert stored_bytes(TransitionForm(observation_shape=(3, 7, 15)), 20, 100_000) < 0.8e9
    with caplog.at_level("INFO", logger="cprl"):
        Ring(FORM, seeds=[(0,), (1,)], transitions=10_000, batch_size=8)
    assert "Replay buffers of 2 learners x 10,000 transitions: 0.00 GiB of " in caplog.text
    taken = sum(field.numel() * field.element_size() for field in filled([0, 1]).fields.values())
    assert taken == stored_bytes(FORM, 2, 40)
    with pytest.raises(MemoryError, match=r"200 learners x 10,000,000 .* take [\d.]+ GiB; .* are free"):
        Ring(FORM, seeds=[(lane,) for lane in range(200)], transitions=10_000_000, batch_size=8)
