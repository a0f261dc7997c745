"""Engines: every one trains each lane as TorchRL's loss and torch's optimiser train it alone; algorithms name
theirs, a trial finds it for losses of users."""

import warnings
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial

import dqn_parts as parts
import pytest
import torch
from dqn_parts import KINDS, dqn_learner, dqn_loss, make_learner
from dqn_parts import MEADOW as GAME
from test_population import weights
from test_ring import ACTIONS, SHAPE, filled
from torch import nn
from torchrl.envs.transforms import RewardScaling
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate, SoftUpdate

from cprl import CommonsEnv
from cprl.algorithms import DQN, IQL, MADDPG, QMIX, SAC, VDN, DistributionalDQN, DQNSettings, RolloutSettings
from cprl.algorithms.base import OffPolicy, OnPolicy, TeamAlgorithm
from cprl.learners import lanes
from cprl.learners.engine import WAYS, FunctionalEngine, ListEngine, UpdateRule
from cprl.learners.ring import Horizon, TransitionForm
from cprl.learners.trial import fitting_engine, trial_batch
from cprl.networks import GRU, Conv
from cprl.networks.mlp import MLPNetwork
from cprl.networks.stacked import StackedMLP
from cprl.training import train
from cprl.values import Custom

ENGINES = {
    "list": ListEngine,
    "vmapped": partial(FunctionalEngine, batching="vmapped", compile=False),
    "lane_axis": partial(FunctionalEngine, batching="lane_axis", compile=False),
}
COMPILED = partial(FunctionalEngine, batching="lane_axis", compile=True)
MAKE_LOSS = partial(dqn_loss, gamma=0.9)
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


def networks(lanes, dtype=torch.float32, **options):
    """The network of each lane, by the lane's number alone."""
    made = []
    for lane in lanes:
        torch.manual_seed(lane)
        made.append(MLPNetwork(SHAPE, ACTIONS, hidden_cells=(16, 16), **options).to(dtype))
    return made


def trained(engine, lanes, *, steps=40, **of_rule):
    """An engine after some steps, in which targets are copied for lane after lane."""
    rule = UpdateRule(learning_rate=1e-2, adam_eps=1e-6, **of_rule)
    update, ring = engine(networks(lanes, torch.float64), MAKE_LOSS, rule), filled(lanes)
    for step in range(steps):
        update.update(ring)
        if rule.tau is None:
            update.copy_to_targets(torch.tensor([step % 20 == lane for lane in lanes]))
    return update


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


def in_order(tensors):
    """All numbers, whatever the order and form of layers."""
    return torch.cat([tensor.detach().flatten() for tensor in tensors]).sort().values


def weights_of(update, lane):
    """The weights of a lane and its targets."""
    named = update.weights(lane)
    groups = ("value_network_params:", "target_value_network_params:")
    return [in_order([named[name] for name in named if name.startswith(group)]) for group in groups]


@pytest.mark.integration
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("rule", RULES, ids=str)
def test_every_engine_trains_each_lane_as_torch_and_torchrl_train_it_alone(engine, rule):
    update = trained(ENGINES[engine], [0, 1, 2], **rule)
    start = in_order(networks([0], torch.float64)[0].parameters())
    assert not torch.equal(weights_of(update, 0)[0], start)
    for lane in range(3):
        torch.testing.assert_close(weights_of(update, lane), by_hand(lane, **rule), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("engine", ENGINES)
def test_targets_begin_with_weights_of_their_own_and_change_for_the_marked_lanes_alone(engine):
    rule = UpdateRule(learning_rate=1e-3)
    update = ENGINES[engine](networks([0, 1]), MAKE_LOSS, rule, target_networks=networks([10, 11]))
    for lane in range(2):
        weights, targets = weights_of(update, lane)
        assert torch.equal(weights, in_order(networks([lane])[0].parameters()))
        assert torch.equal(targets, in_order(networks([10 + lane])[0].parameters()))
    update.update(filled([0, 1]))
    update.copy_to_targets(torch.tensor([False, True]))
    assert torch.equal(weights_of(update, 0)[1], in_order(networks([10])[0].parameters()))
    assert torch.equal(*weights_of(update, 1))


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
@pytest.mark.parametrize("engine", ["list", "lane_axis"])
def test_an_engine_continues_from_its_state_with_every_optimiser(engine, optimizer):
    first, second = (trained(ENGINES[engine], [0, 1], steps=0, optimizer=optimizer) for _ in range(2))
    ring, same = filled([0, 1]), filled([0, 1])
    for _ in range(5):
        first.update(ring)
        same.draw()
    second.load_state_dict(deepcopy(first.state_dict()))
    for _ in range(5):
        assert torch.equal(first.update(ring), second.update(same))


def test_the_stacked_networks_give_what_each_gives():
    each = networks([0, 1, 2], relu_on_outputs=True)
    stacked = StackedMLP(each)
    windows = torch.randint(0, 256, (3, 7, *SHAPE), dtype=torch.uint8)
    expected = torch.stack([network(seen) for network, seen in zip(each, windows, strict=True)])
    torch.testing.assert_close(stacked(windows), expected)
    torch.testing.assert_close(stacked(windows[:, 0]), expected[:, 0])
    pairs = stacked.stacked([stacked, StackedMLP(networks([3, 4, 5], relu_on_outputs=True))])
    torch.testing.assert_close(pairs(windows.expand(2, *windows.shape))[0], expected)
    with pytest.raises(ValueError, match="2 architectures"):
        StackedMLP([each[0], MLPNetwork(SHAPE, ACTIONS, hidden_cells=(8,))])


def test_a_failing_compile_falls_back_with_one_warning(monkeypatch):
    def run(*_):
        raise RuntimeError("no C++ compiler")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: run)
    with pytest.warns(RuntimeWarning, match="torch.compile failed, updates run uncompiled.*no C") as caught:
        update = trained(COMPILED, [0, 1])
    assert len(caught) == 1
    eager = trained(ENGINES["lane_axis"], [0, 1])
    assert all(map(torch.equal, weights_of(update, 1), weights_of(eager, 1)))


# Which way of updating is taken.

SETTINGS = DQNSettings(
    buffer_size=150, batch_size=4, learning_rate=1e-3, hidden_cells=(8,), target_every_episodes=2
)
ROLLOUTS = RolloutSettings(rollout_steps=8, minibatch_size=4)


CELLS = GRU(recurrent_cells=4)
WITH_NETWORKS = [(kind, network) for kind in KINDS for network in (None, Conv(channels=(2,)))]
WITH_NETWORKS += [(kind, CELLS) for kind in KINDS if kind.can_be_recurrent]


@pytest.mark.parametrize(("kind", "network"), WITH_NETWORKS, ids=str)
def test_the_way_that_an_algorithm_names_is_the_first_that_a_trial_finds(kind, network, monkeypatch):
    steps = {"sequence_steps": 4} if network is CELLS else {}
    settings = ROLLOUTS if issubclass(kind, OnPolicy) else DQNSettings(buffer_size=50, **steps)
    algorithm = kind(settings=settings, network=network)
    reward = "team" if issubclass(kind, TeamAlgorithm) else "individual"
    named = partial(make_learner, algorithm, GAME.spaces, agents=(0, 1), replicas=2, reward_kind=reward)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learner = named(engine="eager")
        monkeypatch.setattr(kind, "batching", None)
        found = named(engine="eager")
    assert found.engine.batching == learner.engine.batching
    torch.testing.assert_close(weights(found), weights(learner), rtol=0, atol=0)  # a trial changes nothing


def test_no_trial_is_made_for_algorithms_that_name_their_way_but_for_what_users_change_of_them(monkeypatch):
    @dataclass(frozen=True, kw_only=True)
    class Own(DQN):
        """With a loss that may be another one."""

    trials = []
    monkeypatch.setattr(lanes, "fitting_engine", lambda *given: trials.append(given) or "list")
    own_network = Custom("test_engines:own_network")
    for algorithm, count in ((DQN, 0), (Own, 1), (partial(DQN, network=own_network), 2)):
        settings = DQNSettings(buffer_size=50)
        make_learner(algorithm(settings=settings), GAME.spaces, agents=(0, 1), replicas=2)
        assert len(trials) == count


class OwnNetwork(nn.Module):
    """A user's."""

    def __init__(self, actions=ACTIONS):
        super().__init__()
        self.layers = nn.Sequential(nn.Flatten(-3), nn.LazyLinear(6), nn.Tanh(), nn.Linear(6, actions))
        self(torch.zeros(1, *SHAPE))

    def forward(self, observation):
        return self.layers(observation.float() / 255)


def own_network(spaces, outputs):
    return MLPNetwork(spaces.observation_shape, outputs)


class OverAllLanes(DQNLoss):
    """A loss that divides by what all transitions of a call have in common: with a lane axis, all lanes."""

    def forward(self, tensordict):
        out = super().forward(tensordict)
        return out.set("loss", out["loss"] / tensordict["next", "reward"].mean())


class LookingAtNumbers(DQNLoss):
    """A loss that asks for a number in Python, which cannot be vmapped."""

    def forward(self, tensordict):
        out = super().forward(tensordict)
        if float(tensordict["next", "reward"].sum()) < -1:
            return out.set("loss", 2 * out["loss"])
        return out


def loss_of(kind):
    def make(network):
        actor = QValueActor(network, spec=None, action_space="categorical")
        loss = kind(actor, delay_value=True, loss_function="l2", action_space="categorical")
        loss.make_value_estimator(gamma=0.9)
        return loss

    return make


@pytest.mark.parametrize(
    ("make_network", "make_loss", "way"),
    [
        (lambda: networks([0])[0], MAKE_LOSS, "lane_axis"),
        (OwnNetwork, MAKE_LOSS, "vmapped"),
        (lambda: networks([0])[0], loss_of(OverAllLanes), "vmapped"),
        (OwnNetwork, loss_of(LookingAtNumbers), "list"),
    ],
    ids=["ours", "own network", "a loss that would mix lanes", "a loss that cannot be vmapped"],
)
def test_a_trial_finds_the_fastest_way_and_warns_of_the_slow_one_alone(make_network, make_loss, way):
    trial = trial_batch(2, TransitionForm(observation_shape=SHAPE), ACTIONS)
    made = [make_network() for _ in range(2)]
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        assert fitting_engine(made, make_loss, trial) == way
    assert bool(warned) == (way not in WAYS)
    if warned:
        assert "many times slower" in str(warned[0].message)
        assert ".item()" in str(warned[0].message)


# What learners make of their settings.


def played(learner, steps=40):
    return parts.played(learner, CommonsEnv(GAME, 2, seed=3), steps)


def learner(engine="eager", algorithm=DQN, **settings):
    made = algorithm(settings=replace(SETTINGS, **settings))
    reward = "team" if algorithm in (VDN, QMIX) else "individual"
    return make_learner(
        made, GAME.spaces, agents=(0, 1), replicas=2, engine=engine, seed=7, reward_kind=reward
    )


def updates_in(losses):
    return [step for step, loss in enumerate(losses, 1) if loss is not None]


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_updates_come_from_the_first_possible_step_on_every_so_many_steps_and_so_many_at_once(engine):
    """16 transitions are wanted first, the 16th is the first step that counts."""
    often = learner(engine)
    assert updates_in(played(often, steps=18)) == [16, 17, 18]
    steps = []
    fourth = learner(engine, steps_per_update=4, updates_per_step=2)
    update = fourth.engine.update
    fourth.engine.update = lambda ring: steps.append(1) or update(ring)
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
    train(CommonsEnv(GAME, 2, seed=3), {(0, 1): often}, episodes=2, update_every=update_every)
    assert often.engine.steps == often.steps // update_every * update_every // 4


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_hard_targets_are_copied_every_so_many_episodes_of_each_replica_and_with_tau_never(engine):
    def copied(of):
        return [torch.equal(*weights_of(of.engine, lane)) for lane in range(4)]

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
    before = {name: value.clone() for name, value in soft.engine.weights(0).items()}
    played(soft, steps=1)
    now = soft.engine.weights(0)
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
    update = ENGINES["lane_axis"](networks([0, 1]), MAKE_LOSS, UpdateRule(learning_rate=0.1))
    losses = update.update_from(batch)
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
        (partial(DQNSettings, n_steps=17), "n_steps is 17.*learning_starts"),
        (partial(DQNSettings, n_steps=17, buffer_size=6), "n_steps is 17.*buffer_size"),
        *(
            (partial(learner, engine, algorithm=kind, relu_on_outputs=True), "relu_on_outputs is True")
            for kind in (SAC, IQL, DistributionalDQN)
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


class Counting(RewardScaling):
    """A transform with a state."""

    def __init__(self, **options):
        super().__init__(0.0, 10.0, in_keys=[("next", "reward")], **options)
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    def forward(self, tensordict):
        self.calls += 1
        return super().forward(tensordict)


def test_transforms_of_the_replay_buffer_run_with_torchrls_engine_alone():
    counting = (Custom("test_engines:Counting"),)
    made, plain = learner("torchrl", replay_transforms=counting), learner("torchrl")
    losses, plain_losses = played(made, 24), played(plain, 24)
    (transform,) = made.buffer.each[0].transform
    assert int(transform.calls) == 24 - SETTINGS.learning_starts + 1
    assert made.buffer.each[0].storage[:]["next", "reward"].max() == 1.0, "what is stored stays as it was"
    assert not torch.equal(losses[-1], plain_losses[-1])
    other = learner("torchrl", replay_transforms=counting)
    other.load_state_dict(made.state_dict())
    assert int(other.buffer.each[0].transform[0].calls) == int(transform.calls)
    with pytest.raises(ValueError, match=r'replay_transforms is .*engine="torchrl"'):
        learner(replay_transforms=counting)
    wrong = Custom("torchrl.envs:RewardScaling", {"loc": 0.0, "scale": 2.0})
    with pytest.raises(ValueError, match=r"torchrl.envs:RewardScaling cannot transform .*'reward' not found"):
        learner("torchrl", replay_transforms=(wrong,))
