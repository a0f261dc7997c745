"""Updates: each word trains every lane as TorchRL's loss and torch's optimiser train it alone; algorithms say
theirs, for losses of users it is found."""

import warnings
from copy import deepcopy
from dataclasses import replace
from functools import partial

import dqn_parts as parts
import pytest
import torch
from c51 import C51
from dqn_parts import KINDS, MEADOW as GAME, dqn_learner, dqn_loss, make_learner
from iql import IQL
from loss_parts import MAKE_LOSS, in_order, networks, weights_of
from ring_parts import ACTIONS, SHAPE, filled
from small_learners import weights
from torch import nn
from torchrl.objectives import HardUpdate, SoftUpdate

from cprl import CommonsEnv
from cprl.algorithms import (
    DQN,
    MADDPG,
    QMIX,
    SAC,
    VDN,
    DQNSettings,
    RolloutSettings,
)
from cprl.algorithms.base import OffPolicy, OnPolicy, TeamAlgorithm
from cprl.learners.draw import Draw
from cprl.learners.networks import LaneNetworks
from cprl.learners.optimizers import UpdateRule
from cprl.learners.transitions import Horizon
from cprl.networks import GRU, Conv
from cprl.networks.mlp import MLPNetwork
from cprl.networks.stacked import StackedMLP
from cprl.training import Schedule, train

UPDATES = ("list", "vmapped", "stacked")
OPTIMIZERS = {
    "adam": partial(torch.optim.Adam, eps=1e-6),
    "adamw": partial(torch.optim.AdamW, eps=1e-6),
    "rmsprop": partial(torch.optim.RMSprop, eps=1e-6),
    "keras_rmsprop": partial(torch.optim.RMSprop, eps=1e-6, alpha=0.9),
    "sgd": torch.optim.SGD,
}
RULES = [
    *({"optimizer": name} for name in OPTIMIZERS),
    {"tau": 0.1},
    {"optimizer": "sgd", "loss_share": 0.25},
    {"optimizer": "sgd", "max_grad_norm": 1e-3},
]


def trained(update, lanes, *, steps=40, compile=False, **of_rule):
    """The networks of lanes after some steps, in which targets are copied for lane after lane."""
    rule = UpdateRule(learning_rate=1e-2, adam_eps=1e-6, **of_rule)
    together = LaneNetworks(networks(lanes, torch.float64), MAKE_LOSS, rule, update=update, compile=compile)
    ring = filled(lanes)
    for step in range(steps):
        together.learn(Draw.of(ring.sample()))
        if rule.tau is None:
            together.copy_to_targets(torch.tensor([step % 20 == lane for lane in lanes]))
    return together


def by_hand(lane, *, optimizer="adam", tau=None, loss_share=1.0, max_grad_norm=None):
    """The weights of a lane that is trained alone, and its targets."""
    loss, ring = MAKE_LOSS(networks([lane], torch.float64)[0]), filled([lane])
    updater = SoftUpdate(loss, tau=tau) if tau else HardUpdate(loss, value_network_update_interval=0)
    optimizer = OPTIMIZERS[optimizer](loss.parameters(), lr=1e-2)
    for step in range(40):
        optimizer.zero_grad()
        (loss(ring.sample()[0])["loss"] * loss_share).backward()
        if max_grad_norm:
            nn.utils.clip_grad_norm_(loss.parameters(), max_grad_norm)
        optimizer.step()
        if tau or step % 20 == lane:
            updater.step()
    groups = loss.value_network_params, loss.target_value_network_params
    return [in_order(group.flatten_keys(".").values()) for group in groups]


@pytest.mark.integration
@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("rule", RULES, ids=str)
def test_every_update_trains_each_lane_as_torch_and_torchrl_train_it_alone(update, rule):
    together = trained(update, [0, 1, 2], **rule)
    start = in_order(networks([0], torch.float64)[0].parameters())
    assert not torch.equal(weights_of(together, 0)[0], start)
    for lane in range(3):
        torch.testing.assert_close(weights_of(together, lane), by_hand(lane, **rule), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("update", UPDATES)
def test_targets_begin_with_weights_of_their_own_and_change_for_the_marked_lanes_alone(update):
    rule, targets = UpdateRule(learning_rate=1e-3), networks([10, 11])
    together = LaneNetworks(networks([0, 1]), MAKE_LOSS, rule, update=update, target_networks=targets)
    for lane in range(2):
        weights, targets = weights_of(together, lane)
        assert torch.equal(weights, in_order(networks([lane])[0].parameters()))
        assert torch.equal(targets, in_order(networks([10 + lane])[0].parameters()))
    together.learn(Draw.of(filled([0, 1]).sample()))
    together.copy_to_targets(torch.tensor([False, True]))
    assert torch.equal(weights_of(together, 0)[1], in_order(networks([10])[0].parameters()))
    assert torch.equal(*weights_of(together, 1))


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
@pytest.mark.parametrize("update", ["list", "stacked"])
def test_networks_continue_from_their_state_with_every_optimiser(update, optimizer):
    first, second = (trained(update, [0, 1], steps=0, optimizer=optimizer) for _ in range(2))
    ring, same = filled([0, 1]), filled([0, 1])
    for _ in range(5):
        first.learn(Draw.of(ring.sample()))
        same.places()
    second.load_state_dict(deepcopy(first.state_dict()))
    for _ in range(5):
        assert torch.equal(first.learn(Draw.of(ring.sample())), second.learn(Draw.of(same.sample())))


def test_the_stacked_networks_give_what_each_gives():
    each = networks([0, 1, 2], relu_on_outputs=True)
    stacked = StackedMLP(each)
    windows = torch.randint(0, 256, (3, 7, *SHAPE), dtype=torch.uint8)
    expected = torch.stack([network(seen) for network, seen in zip(each, windows, strict=True)])
    torch.testing.assert_close(stacked(windows), expected)
    torch.testing.assert_close(stacked(windows[:, 0]), expected[:, 0])
    pairs = stacked.make_stack([stacked, StackedMLP(networks([3, 4, 5], relu_on_outputs=True))])
    torch.testing.assert_close(pairs(windows.expand(2, *windows.shape))[0], expected)
    with pytest.raises(ValueError, match="2 architectures"):
        StackedMLP([each[0], MLPNetwork(SHAPE, ACTIONS, hidden_cells=(8,))])


def test_a_failing_compile_falls_back_with_one_warning(monkeypatch):
    def run(*_):
        raise RuntimeError("no C++ compiler")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: run)
    with pytest.warns(RuntimeWarning, match="torch.compile failed, updates run uncompiled.*no C") as caught:
        together = trained("stacked", [0, 1], compile=True)
    assert len(caught) == 1
    eager = trained("stacked", [0, 1])
    assert all(map(torch.equal, weights_of(together, 1), weights_of(eager, 1)))


# Which word is taken.

SETTINGS = DQNSettings(
    buffer_size=150, batch_size=4, learning_rate=1e-3, hidden_cells=(8,), target_every_episodes=2
)
ROLLOUTS = RolloutSettings(rollout_steps=8, minibatch_size=4)


CELLS = GRU(recurrent_cells=4)
VMAPPED = [kind for kind in KINDS if kind is not C51]
"""All whose losses torch vmaps; that of C51 reads a number in Python."""
WITH_NETWORKS = [(kind, network) for kind in VMAPPED for network in (None, Conv(channels=(2,)))]
WITH_NETWORKS += [(kind, CELLS) for kind in KINDS if kind.can_be_recurrent]


@pytest.mark.integration
@pytest.mark.parametrize(("kind", "network"), WITH_NETWORKS, ids=str)
def test_an_own_loss_of_an_algorithm_that_says_nothing_learns_the_same_and_is_no_list(kind, network):
    """Each lane learns what it would by the word that the algorithm says."""
    steps = {"sequence_steps": 4} if network is CELLS else {}
    settings = ROLLOUTS if issubclass(kind, OnPolicy) else DQNSettings(buffer_size=50, adam_eps=1e-3, **steps)
    algorithm = kind(settings=settings, network=network)
    own = parts.changed(algorithm, make_loss=algorithm.make_loss)
    reward = "team" if issubclass(kind, TeamAlgorithm) else "individual"
    how = {"agents": (0, 1), "replicas": 2, "reward": reward, "engine": "eager", "seed": 1}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        said, found = (make_learner(each, GAME.spaces, **how) for each in (algorithm, own))
    assert found.lane_networks.update == "vmapped"
    torch.testing.assert_close(weights(found), weights(said), rtol=0, atol=0)  # the look changes nothing
    for each in (said, found):
        train(CommonsEnv(GAME, 2, seed=3), {(0, 1): each}, Schedule(episodes=2))
    torch.testing.assert_close(weights(found), weights(said), rtol=1e-4, atol=1e-5)


# What learners make of their settings.


def played(learner, steps=40):
    return parts.played(learner, CommonsEnv(GAME, 2, seed=3), steps)


def learner(engine="eager", algorithm=DQN, **settings):
    made = algorithm(settings=replace(SETTINGS, **settings))
    reward = "team" if algorithm in (VDN, QMIX) else "individual"
    return make_learner(made, GAME.spaces, agents=(0, 1), replicas=2, engine=engine, seed=7, reward=reward)


def learner_in_worlds(engine, *, worlds, **settings):
    algorithm = DQN(settings=replace(SETTINGS, **settings))
    return make_learner(algorithm, GAME.spaces, agents=(0, 1), replicas=1, worlds=worlds, engine=engine)


def updates_in(losses):
    return [step for step, loss in enumerate(losses, 1) if loss is not None]


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_updates_come_from_the_first_possible_step_on_every_so_many_steps_and_so_many_at_once(engine):
    """16 transitions are wanted first, the 16th is the first step that counts."""
    often = learner(engine)
    assert updates_in(played(often, steps=18)) == [16, 17, 18]
    fourth = learner(engine, steps_per_update=4, updates_per_step=2)
    steps = parts.watch_steps(fourth, lambda draw: 1)
    losses = played(fourth, steps=30)
    assert updates_in(losses) == [19, 23, 27]
    assert losses[18].shape == (2, 2)
    assert len(steps) == 6
    again = learner(engine, steps_per_update=4)
    again.load_state_dict(deepcopy(fourth.state_dict()))
    assert updates_in(played(again, steps=4)) == [1]


@pytest.mark.parametrize("update_every", [1, 4, 6, 8])
def test_steps_an_update_and_updates_that_wait_for_several_steps_agree(update_every):
    """A loop that asks for k updates after every k steps gets as many as one that asks after each."""
    often = learner(steps_per_update=4, learning_starts=1)
    train(CommonsEnv(GAME, 2, seed=3), {(0, 1): often}, Schedule(episodes=2, update_every=update_every))
    assert often.lane_networks.updates == often.steps // update_every * update_every // 4


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_hard_targets_are_copied_every_so_many_episodes_of_each_replica_and_with_tau_never(engine):
    def copied(of):
        return [torch.equal(*weights_of(of.lane_networks, lane)) for lane in range(4)]

    hard, soft = learner(engine, own_target_weights=True), learner(engine, tau=0.01)
    assert copied(hard) == [False] * 4, "targets begin with weights of their own"
    assert copied(soft) == [True] * 4
    for each in (hard, soft):
        played(each, steps=20)
    hard._episodes.zero_()
    assert copied(hard) == [False] * 4
    for ended, expected in (([1, 0], [0, 0]), ([1, 0], [1, 0]), ([0, 1], [1, 0]), ([0, 1], [1, 1])):
        hard.end_episode(torch.tensor(ended, dtype=torch.bool))
        assert copied(hard) == [bool(flag) for flag in expected for _ in range(2)]
    for _ in range(4):
        soft.end_episode(torch.tensor([True, True]))
    assert copied(soft) == [False] * 4


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_soft_targets_move_by_tau_after_every_update(engine):
    soft = learner(engine, tau=0.25)
    played(soft, steps=SETTINGS.learning_starts - 1)
    before = {name: value.clone() for name, value in parts.weights_at(soft.lane_networks, 0).items()}
    played(soft, steps=1)
    now = parts.weights_at(soft.lane_networks, 0)
    for target in [name for name in now if name.startswith("target_")]:
        wanted = before[target] + 0.25 * (now[target.removeprefix("target_")] - before[target])
        torch.testing.assert_close(now[target], wanted)


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_the_mean_over_all_outputs_is_the_loss_divided_by_their_number(engine):
    steps = SETTINGS.learning_starts
    plain, of_all = (played(learner(engine, mean_over_all_outputs=word), steps)[-1] for word in (False, True))
    torch.testing.assert_close(of_all, plain / len(GAME.actions))


def test_a_target_bootstraps_by_the_discount_of_its_steps():
    """target = sum of r + gamma**steps max Q'(s'), without the last term behind a terminal state."""
    ring = filled([0, 1], steps=40, horizon=Horizon(3, 0.9))
    batch = ring.sample()
    together = LaneNetworks(networks([0, 1]), MAKE_LOSS, UpdateRule(learning_rate=0.1), update="stacked")
    losses = together.learn(Draw.of(batch))
    for turns, network, loss in zip(batch, networks([0, 1]), losses.tolist(), strict=True):
        with torch.no_grad():
            value = network(turns["observation"]).gather(-1, turns["action"][:, None])
            best = network(turns["next", "observation"]).amax(-1, keepdim=True)
            discount = 0.9 ** turns["steps_to_next_obs"] * ~turns["next", "terminated"]
            expected = (value - turns["next", "reward"] - discount * best).square().mean()
        assert loss == pytest.approx(float(expected), rel=1e-5)


OF_SEVERAL_STEPS = [kind for kind in KINDS if issubclass(kind, OffPolicy) and kind is not IQL]


@pytest.mark.parametrize("algorithm", OF_SEVERAL_STEPS)
def test_every_algorithm_of_replay_learns_from_returns_of_several_steps(algorithm):
    losses = played(learner(algorithm=algorithm, n_steps=3, tau=0.05, updates_per_step=2), steps=25)
    assert torch.isfinite(losses[-1]).all()
    assert MADDPG in OF_SEVERAL_STEPS


def ignores_steps(network):
    loss = dqn_loss(network, gamma=SETTINGS.gamma)
    forward = loss.forward
    loss.forward = lambda batch: forward(batch.exclude("steps_to_next_obs"))
    return loss


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (partial(learner, algorithm=IQL, n_steps=3), "DiscreteIQLLoss does not read"),  # of TorchRL 0.14.1
        (partial(learner, "torchrl", n_steps=3), "n_steps is 3"),
        *(
            (partial(learner_in_worlds, engine, worlds=16, buffer_size=size), "in 16 worlds: 32 or more")
            for engine in ("eager", "torchrl")
            for size in (8, 16)
        ),
        (partial(DQNSettings, n_steps=17), "n_steps is 17.*learning_starts"),
        (partial(DQNSettings, n_steps=17, buffer_size=6), "n_steps is 17.*buffer_size"),
        *(
            (partial(learner, engine, algorithm=kind, relu_on_outputs=True), "relu_on_outputs is True")
            for kind in (SAC, IQL, C51)
            for engine in ("eager", "torchrl")
        ),
    ],
)
def test_settings_that_an_algorithm_or_engine_cannot_have_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("make_loss", "message"),
    [(ignores_steps, "n_steps is 3"), (partial(dqn_loss, gamma=0.5), r"gamma 0\.5 .* gamma 0\.995")],
)
def test_losses_that_cannot_learn_from_returns_of_several_steps_are_refused(make_loss, message):
    settings = replace(SETTINGS, n_steps=3)
    with pytest.raises(ValueError, match=message):
        dqn_learner(GAME.spaces, agents=(0, 1), replicas=2, settings=settings, make_loss=make_loss)
