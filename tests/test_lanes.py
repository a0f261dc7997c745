"""Many independent learners in one step: three engines that agree with each other and each lane alone."""

from functools import partial

import numpy as np
import pytest
import torch
from dqn_parts import dqn_loss, write
from tensordict import TensorDict, assert_close
from torch import nn
from torchrl.objectives import DQNLoss

from cprl.learners.engine import FunctionalEngine, ListEngine, UpdateRule
from cprl.learners.ring import Ring, TransitionForm
from cprl.networks.mlp import MLPNetwork
from cprl.networks.stacked import StackedMLP

SHAPE = (3, 4, 5)
FORM = TransitionForm(observation_shape=SHAPE)
ACTIONS = 6
ENGINES = {
    "list": ListEngine,
    "vmapped": partial(FunctionalEngine, batching="vmapped", compile=False),
    "lane_axis": partial(FunctionalEngine, batching="lane_axis", compile=False),
}
COMPILED = {
    "vmapped, compiled": partial(FunctionalEngine, batching="vmapped", compile=True),
    "lane_axis, compiled": partial(FunctionalEngine, batching="lane_axis", compile=True),
}
PRECISION = {torch.float32: 1e-5, torch.float64: 1e-10}


def networks(lanes, dtype=torch.float32, **how):
    """The network of each lane, by the lane's number alone."""
    made = []
    for lane in lanes:
        torch.manual_seed(lane)
        made.append(MLPNetwork(SHAPE, ACTIONS, hidden_cells=(16, 16), **how).to(dtype))
    return made


def transition(lane, step):
    """What a lane sees, by its number and the step alone; episodes end at times of its own."""
    chance = np.random.default_rng([lane, step])

    def window(*when):
        return torch.from_numpy(np.random.default_rng([lane, *when]).integers(0, 256, SHAPE, np.uint8))

    done = step % (5 + lane) == 4
    return {
        "observation": torch.from_numpy(
            np.random.default_rng([lane, step, 1]).integers(0, 256, SHAPE, np.uint8)
        ),
        "action": torch.tensor(int(chance.integers(ACTIONS))),
        "next": {
            "observation": window(step + 1, 2 if done else 1),
            "reward": torch.tensor([float(chance.random() < 0.3)]),
            "done": torch.tensor([done]),
            "terminated": torch.tensor([done and lane % 2 == 0]),
        },
    }


def row(lanes, step):
    return torch.stack([TensorDict(transition(lane, step)).auto_batch_size_(0) for lane in lanes])


def filled(lanes, *, steps=60, transitions=40):
    buffer = Ring(FORM, seeds=[(7, lane) for lane in lanes], transitions=transitions, batch_size=4)
    for step in range(steps):
        write(buffer, row(lanes, step))
    return buffer


def trained(engine, lanes, *, dtype=torch.float32, steps=200, lr=1e-3, **of_rule):
    """The update after so many steps, targets copied for lane after lane on the way, and the losses."""
    rule = UpdateRule(learning_rate=lr, **of_rule)
    update = engine(networks(lanes, dtype), partial(dqn_loss, gamma=0.9), rule)
    buffer, losses = filled(lanes), []
    for step in range(steps):
        losses.append(update.update(buffer))
        update.copy_to_targets(torch.tensor([step % 20 == lane for lane in lanes]))
    return update, torch.stack(losses)


def assert_same_course(one, other, lanes, other_lanes, precision):
    """The lanes named first in one are, in this order, those named in the other."""
    for lane, other_lane in zip(lanes, other_lanes, strict=True):
        for mine, theirs in zip(in_order(one, lane), in_order(other, other_lane), strict=True):
            scale = theirs.abs().max()
            assert (mine - theirs).abs().max() <= precision * scale, (lane, mine, theirs)


def in_order(update, lane):
    """Weights and targets of a lane, layer by layer, as [out, in] and [out], whatever the engine."""
    named = update.weights(lane)
    parts = []
    for group in ("value_network_params", "target_value_network_params"):
        own = [(name, value) for name, value in named.items() if name.startswith(f"{group}:")]
        weights = [value for name, value in own if "weight" in name]
        biases = [value for name, value in own if "bias" in name]
        stacked = isinstance(update, FunctionalEngine) and not update._vmapped
        parts += [value.T if stacked else value for value in weights]
        parts += [value.reshape(-1) for value in biases]
    return parts


@pytest.mark.integration
@pytest.mark.parametrize(
    "dtype", [torch.float64, pytest.param(torch.float32, marks=pytest.mark.slow)], ids=str
)
@pytest.mark.parametrize("engine", [pytest.param("vmapped", marks=pytest.mark.slow), "lane_axis"])
def test_both_fast_engines_end_where_a_list_of_torchrl_losses_ends(engine, dtype):
    lanes = [0, 1, 2, 3, 4]
    reference, losses = trained(ListEngine, lanes, dtype=dtype)
    update, their_losses = trained(ENGINES[engine], lanes, dtype=dtype)
    assert_same_course(update, reference, range(5), range(5), PRECISION[dtype])
    torch.testing.assert_close(their_losses, losses, rtol=PRECISION[dtype] * 10, atol=1e-7)
    start = networks(lanes, dtype)[0]
    assert (in_order(update, 0)[0] - start.linears[0].weight).abs().max() > 0.01, "it learned something"


@pytest.mark.integration
def test_the_compiled_step_ends_there_too():
    lanes = [0, 1, 2]
    reference, _ = trained(ListEngine, lanes)
    update, _ = trained(COMPILED["lane_axis, compiled"], lanes)
    assert update._compiled.enabled, "it really was compiled"
    assert_same_course(update, reference, range(3), range(3), 1e-5)


@pytest.mark.integration
@pytest.mark.parametrize(
    "dtype", [torch.float64, pytest.param(torch.float32, marks=pytest.mark.slow)], ids=str
)
@pytest.mark.parametrize(
    "engine", [pytest.param(name, marks=[pytest.mark.slow] * (name != "lane_axis")) for name in ENGINES]
)
def test_a_lanes_course_does_not_change_when_other_lanes_are_added(engine, dtype):
    many, losses = trained(ENGINES[engine], [3, 0, 1, 2, 5], dtype=dtype)
    for place, lane in enumerate([3, 0]):
        alone, own_losses = trained(ENGINES[engine], [lane], dtype=dtype)
        assert_same_course(many, alone, [place], [0], PRECISION[dtype])
        torch.testing.assert_close(losses[:, [place]], own_losses, rtol=PRECISION[dtype] * 10, atol=1e-7)


@pytest.mark.parametrize("engine", ENGINES)
def test_targets_change_for_the_marked_lanes_alone(engine):
    update, _ = trained(ENGINES[engine], [0, 1, 2], steps=15)
    before = [in_order(update, lane) for lane in range(3)]
    half = len(before[0]) // 2
    for _ in range(3):
        update.update(filled([0, 1, 2]))
    update.copy_to_targets(torch.tensor([False, True, False]))
    for lane in range(3):
        weights, targets = in_order(update, lane)[:half], in_order(update, lane)[half:]
        same = [torch.equal(*pair) for pair in zip(weights, targets, strict=True)]
        kept = [torch.equal(*pair) for pair in zip(before[lane][half:], targets, strict=True)]
        assert all(same) == (lane == 1)
        assert all(kept) == (lane != 1)


@pytest.mark.parametrize("engine", ENGINES)
def test_targets_can_start_from_weights_of_their_own(engine):
    make_loss = partial(dqn_loss, gamma=0.9)
    update = ENGINES[engine](
        networks([0, 1]), make_loss, UpdateRule(learning_rate=1e-3), target_networks=networks([10, 11])
    )
    for lane in range(2):
        parts = in_order(update, lane)
        own, target = networks([lane])[0], networks([10 + lane])[0]
        assert torch.equal(parts[0], own.linears[0].weight)
        assert torch.equal(parts[len(parts) // 2], target.linears[0].weight)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_loss_can_be_weighed(engine):
    _, plain = trained(ENGINES[engine], [0, 1], steps=1)
    _, weighed = trained(ENGINES[engine], [0, 1], steps=1, loss_share=0.25)
    torch.testing.assert_close(weighed, plain * 0.25)


def test_the_stacked_networks_give_what_each_gives():
    each = networks([0, 1, 2], relu_on_outputs=True)
    stacked = StackedMLP(each)
    windows = torch.randint(0, 256, (3, 7, *SHAPE), dtype=torch.uint8)
    expected = torch.stack([network(seen) for network, seen in zip(each, windows, strict=True)])
    torch.testing.assert_close(stacked(windows), expected)
    torch.testing.assert_close(stacked(windows[:, 0]), expected[:, 0])
    with pytest.raises(ValueError, match="2 architectures"):
        StackedMLP([each[0], MLPNetwork(SHAPE, ACTIONS, hidden_cells=(8,))])


@pytest.mark.integration
def test_a_users_own_network_is_vmapped():
    class Own(nn.Module):
        def __init__(self, lane):
            super().__init__()
            torch.manual_seed(lane)
            self.features = nn.Sequential(nn.Conv2d(3, 4, 2), nn.Tanh(), nn.Flatten(-3))
            self.head = nn.LazyLinear(ACTIONS)

        def forward(self, observation):
            shape = observation.shape[:-3]
            seen = observation.reshape(-1, *SHAPE).float() / 255
            return self.head(self.features(seen)).reshape(*shape, ACTIONS)

    def both():
        made = [Own(lane) for lane in range(3)]
        for network in made:
            network(torch.zeros(1, *SHAPE))
        return made

    make_loss, rule = partial(dqn_loss, gamma=0.9), UpdateRule(learning_rate=1e-3)
    fast = FunctionalEngine(both(), make_loss, rule, batching="vmapped", compile=False)
    plain = ListEngine(both(), make_loss, rule)
    for update in (fast, plain):
        buffer = filled([0, 1, 2])
        for _ in range(50):
            update.update(buffer)
    for lane in range(3):
        for mine, theirs in zip(fast.weights(lane).values(), plain.weights(lane).values(), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)


def test_it_is_torchrls_loss(monkeypatch):
    calls = []
    forward = DQNLoss.forward
    monkeypatch.setattr(DQNLoss, "forward", lambda *given: calls.append(given[0]) or forward(*given))
    update, _ = trained(ENGINES["lane_axis"], [0, 1], steps=3)
    assert len(calls) == 3
    assert all(call is update.loss.module for call in calls)
    assert type(update.loss.module) is DQNLoss


def test_a_failing_compile_falls_back_with_one_warning(monkeypatch):
    def broken(*_, **__):
        def run(*_):
            raise RuntimeError("no C++ compiler")

        return run

    monkeypatch.setattr(torch, "compile", broken)
    engine = COMPILED["lane_axis, compiled"]
    with pytest.warns(RuntimeWarning, match="torch.compile failed, updates run uncompiled.*no C") as caught:
        update, _ = trained(engine, [0, 1], steps=20)
    assert len(caught) == 1
    reference, _ = trained(ENGINES["lane_axis"], [0, 1], steps=20)
    assert_same_course(update, reference, range(2), range(2), 0)


class Remembered:
    """A buffer as one would write it down: a list for each lane."""

    def __init__(self, lanes, transitions):
        self.lanes, self.most, self.rows = lanes, transitions, [[] for _ in lanes]

    def add(self, step):
        for lane, kept in zip(self.lanes, self.rows, strict=True):
            kept.append(TensorDict(transition(lane, step)))
            del kept[: -self.most]


@pytest.mark.integration
@pytest.mark.parametrize("lanes", [[0], [0, 1, 2, 9]])
def test_every_transition_kept_is_what_came_and_the_last_ones_are_kept(lanes):
    buffer, remembered = filled(lanes, steps=0, transitions=30), Remembered(lanes, 30)
    for step in range(100):
        write(buffer, row(lanes, step))
        remembered.add(step)
        oldest, written = buffer.oldest()
        assert written == step + 1
        for place in range(len(lanes)):
            kept = remembered.rows[place]
            # Episodes are shorter here than one in fifty, so room for windows may run out before that
            # for transitions; what is left is the newest.
            numbers = torch.arange(int(oldest[place]), written)
            assert len(numbers) >= min(len(kept), 24)
            index = (numbers % 30).expand(len(lanes), -1)
            got = buffer.get(index)[place]
            for one, expected in zip(got, kept[-len(numbers) :], strict=True):
                for key in ("observation", "action", ("next", "observation")):
                    assert torch.equal(one[key], expected[key]), (step, key)
                for key in (("next", name) for name in ("reward", "done", "terminated")):
                    assert torch.equal(one[key], expected[key]), (step, key)


def test_lanes_draw_for_themselves_and_uniformly():
    buffer = filled([0, 1, 2], steps=30, transitions=20)
    drawn = torch.stack([buffer.draw() for _ in range(3000)])
    assert not torch.equal(drawn[:, 0], drawn[:, 1])
    counts = torch.stack([torch.bincount(drawn[:, lane].flatten(), minlength=20) for lane in range(3)])
    assert (counts - 600).abs().max() < 6 * 600**0.5
    alone = filled([1], steps=30, transitions=20)
    again = torch.stack([alone.draw() for _ in range(3000)])
    assert torch.equal(again[:, 0], drawn[:, 1])


def test_a_sample_of_the_buffer_is_what_the_fast_step_gathers():
    buffer, same = filled([0, 1, 2]), filled([0, 1, 2])
    index = same.draw()
    assert_close(buffer.sample(), same.get(index))


def test_a_buffer_goes_on_as_it_was_from_its_state():
    lanes = [0, 1, 2]
    buffer, other = filled(lanes, steps=73), filled(lanes, steps=5)
    other.load_state_dict(buffer.state_dict())
    for step in range(73, 120):
        assert_close(buffer.sample(), other.sample())
        for one in (buffer, other):
            write(one, row(lanes, step))


def test_what_it_takes_is_told_before_and_what_cannot_fit_is_refused(caplog):
    assert TransitionForm(observation_shape=(3, 7, 15)).stored_bytes(20, 100_000) < 0.8e9
    with caplog.at_level("INFO", logger="cprl"):
        Ring(FORM, seeds=[(0,), (1,)], transitions=10_000, batch_size=8)
    assert "Replay buffers of 2 learners x 10,000 transitions: 0.00 GiB of " in caplog.text
    buffer = filled([0, 1])
    taken = sum(field.numel() * field.element_size() for field in buffer.fields.values())
    assert taken == FORM.stored_bytes(2, 40)
    with pytest.raises(MemoryError, match=r"200 learners x 10,000,000 .* take [\d.]+ GiB; .* are free"):
        Ring(FORM, seeds=[(lane,) for lane in range(200)], transitions=10_000_000, batch_size=8)
