"""engine="torchrl": stock parts learn what the fast engine learns, are stopped and continue, and refuse."""

from collections import deque
from dataclasses import replace
from functools import partial
from io import BytesIO

import pytest
import torch
from dqn_parts import dqn_learner, learner_of_parts, make_learner
from test_population import weights
from torchrl import objectives
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler, RoundRobinWriter, SamplerWithoutReplacement
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives.value import GAE

from cprl import CommonsEnv, Game, Rules, algorithms, keys, maps
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.learners.reference import TorchRLReplayLearner, TorchRLRolloutLearner
from cprl.learners.replay import ReplayLearner
from cprl.objectives import LogCoshDQNLoss, PR2Loss
from cprl.policies.lanes import LaneActor
from cprl.values import Custom

GAME = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=23),
)
SPACES = GAME.spaces
REPLAY = DQNSettings(
    buffer_size=90, learning_rate=1e-3, hidden_cells=(16,), epsilon_hold_steps=20, epsilon_decay_steps=100
)
AS_RUN = replace(
    REPLAY,
    own_target_weights=True,
    relu_on_outputs=True,
    mean_over_all_outputs=True,
    glorot_uniform=True,
    adam_eps=1e-7,
)
ROLLOUT = RolloutSettings(
    rollout_steps=40, minibatch_size=10, epochs=4, learning_rate=1e-3, hidden_cells=(16,)
)
ONE_EPOCH = RolloutSettings(rollout_steps=10, minibatch_size=10, epochs=1, hidden_cells=(16,))
HOW = {"agents": (0, 1), "replicas": 2, "seed": 7}

OFF_POLICY = {
    "published DQN": (DQN(settings=REPLAY), objectives.DQNLoss),
    "DQN as run": (DQN(settings=AS_RUN), objectives.DQNLoss),
    "double DQN": (DQN(settings=REPLAY, double=True), objectives.DQNLoss),
    "Huber": (DQN(settings=REPLAY, loss_function="smooth_l1"), objectives.DQNLoss),
    "log-cosh": (DQN(settings=REPLAY, loss_function="log_cosh"), LogCoshDQNLoss),
    "C51": (
        algorithms.DistributionalDQN(settings=REPLAY, atoms=11, highest_return=20.0),
        objectives.DistributionalDQNLoss,
    ),
    "CQL": (algorithms.CQL(settings=REPLAY), objectives.DiscreteCQLLoss),
    "SAC": (algorithms.SAC(settings=REPLAY), objectives.DiscreteSACLoss),
    "IQL": (algorithms.IQL(settings=REPLAY), objectives.DiscreteIQLLoss),
    "PR2": (algorithms.PR2(settings=REPLAY), PR2Loss),
}
ON_POLICY = {
    "PPO": (PPO(settings=ROLLOUT), objectives.ClipPPOLoss),
    "A2C": (algorithms.A2C(settings=ONE_EPOCH), objectives.A2CLoss),
    "REINFORCE": (algorithms.Reinforce(settings=ONE_EPOCH), objectives.ReinforceLoss),
}
LOSSES = {name: loss for name, (_, loss) in {**OFF_POLICY, **ON_POLICY}.items()}
ALGORITHMS = {name: algorithm for name, (algorithm, _) in {**OFF_POLICY, **ON_POLICY}.items()}

DEMANDED = ("published DQN", "DQN as run", "double DQN", "PPO", "A2C")
UPDATES = {name: 200 if name in DEMANDED else 60 for name in LOSSES}
"""Updates after which weights are compared; fewer where an update takes long."""
FIRST = ("published DQN", "PPO")
"""All others are slow."""


def turns(actor, *, worlds=1):
    """Endless turns of `GAME` in so many worlds for each replica, played by an actor of both agents."""
    env = CommonsEnv(GAME, 2 * worlds, seed=3)
    moment = env.reset()
    while True:
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            action = actor.choose(moment[keys.OBSERVATION])
        now, moment = env.step_and_maybe_reset(moment.set(keys.ACTION, action))
        yield now


def take(learner, turn):
    """What a training does with a turn; the losses."""
    learner.store(turn)
    losses = learner.update()
    learner.end_episode(turn["next", "done"][:, 0])
    return losses


class Replayed(RandomSampler):
    """Gives out the places that another sampler drew for an agent."""

    def __init__(self):
        super().__init__()
        self.places = deque()

    def sample(self, storage, batch_size):
        return self.places.popleft(), {}


def both(algorithm, worlds):
    """The fast engine's learner, and the stock one that is handed the places that the fast one draws."""
    how = {"worlds": worlds, **HOW}
    fast = make_learner(algorithm, SPACES, engine="eager", **how)
    samplers = [Replayed() for _ in range(4)]
    kind = TorchRLReplayLearner if isinstance(algorithm.settings, DQNSettings) else TorchRLRolloutLearner
    stock = learner_of_parts(kind, algorithm, SPACES, options={"make_sampler": samplers.__getitem__}, **how)
    if isinstance(algorithm.settings, DQNSettings):
        draw = fast.buffer.draw

        def recorded():
            places, columns = draw()
            # A stock buffer holds the worlds of a turn one after the other.
            world = (columns.unsqueeze(-1) == fast.buffer.columns[:, None]).long().argmax(-1)
            for sampler, own in zip(samplers, places * worlds + world, strict=True):
                sampler.places.append(own)
            return places, columns

        fast.buffer.draw = recorded
    else:
        following, size = fast.rng.next, algorithm.settings.minibatch_size

        def recorded():
            numbers = following()
            for sampler, own in zip(samplers, numbers.argsort(-1), strict=True):
                sampler.places.extend(own.split(size))
            return numbers

        fast.rng.next = recorded
    return fast, stock


@pytest.mark.integration
@pytest.mark.parametrize(
    ("name", "worlds"),
    [
        *(pytest.param(name, 1, marks=[] if name in FIRST else pytest.mark.slow) for name in ALGORITHMS),
        *((name, 2) for name in FIRST),
    ],
)
def test_from_the_same_draws_both_engines_have_the_same_weights_after_updates(name, worlds):
    fast, stock = both(ALGORITHMS[name], worlds)
    settings, each = ALGORITHMS[name].settings, worlds
    if name in ON_POLICY:
        each = settings.epochs * settings.rollout_steps * worlds // settings.minibatch_size
    first = weights(stock)
    torch.testing.assert_close(weights(fast), first, rtol=0, atol=0)
    played, updates = turns(fast.actor, worlds=worlds), 0
    while updates < UPDATES[name]:
        turn = next(played)
        losses = take(fast, turn), take(stock, turn)
        assert (losses[0] is None) == (losses[1] is None)
        if losses[0] is not None:
            torch.testing.assert_close(*losses, rtol=1e-4, atol=1e-5)
            updates += each
    last = weights(stock)
    torch.testing.assert_close(weights(fast), last, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(fast.values(turn), stock.values(turn), equal_nan=True, rtol=1e-4, atol=1e-5)
    assert all((first[name] - last[name]).abs().max() > 1e-4 for name in last if "support" not in name)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_part_is_torchrls_or_torchs_own(name):
    algorithm = ALGORITHMS[name]
    learner = make_learner(algorithm, SPACES, engine="torchrl", **HOW)
    on_policy = name in ON_POLICY
    assert type(learner) is (TorchRLRolloutLearner if on_policy else TorchRLReplayLearner)
    buffers = learner.buffer.each
    assert len(buffers) == len(learner.engine.losses) == 4
    for buffer in buffers:
        assert type(buffer) is TensorDictReplayBuffer
        assert type(buffer.storage) is LazyTensorStorage
        assert type(buffer.sampler) is (SamplerWithoutReplacement if on_policy else RandomSampler)
        assert isinstance(buffer.writer, RoundRobinWriter)
    assert all(isinstance(loss, LOSSES[name]) for loss in learner.engine.losses)
    assert all(type(optimizer) is torch.optim.Adam for optimizer in learner.engine.optimizers)
    if on_policy:
        assert all(type(estimator) is GAE for estimator in learner.estimators)
    else:
        assert all(type(updater) is objectives.HardUpdate for updater in learner.engine.updaters)


def stock(algorithm):
    return make_learner(algorithm, SPACES, engine="torchrl", **HOW)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("adam", torch.optim.Adam),
        ("adamw", torch.optim.AdamW),
        ("rmsprop", torch.optim.RMSprop),
        ("keras_rmsprop", torch.optim.RMSprop),
        ("sgd", torch.optim.SGD),
    ],
)
def test_the_optimiser_its_rate_and_its_epsilon_are_those_of_the_settings(name, kind):
    settings = replace(REPLAY, optimizer=name, adam_eps=1e-3)
    for optimizer in stock(DQN(settings=settings)).engine.optimizers:
        (group,) = optimizer.param_groups
        assert type(optimizer) is kind
        assert group["lr"] == settings.learning_rate
        assert group.get("eps", 1e-3) == 1e-3


RESUMED = {
    **ALGORITHMS,
    "everything of replay": DQN(
        settings=replace(
            REPLAY,
            tau=0.05,
            updates_per_step=2,
            optimizer="rmsprop",
            replay_transforms=(
                Custom(
                    "torchrl.envs.transforms:RewardScaling",
                    {"loc": 0.0, "scale": 0.5, "in_keys": [["next", "reward"]]},
                ),
            ),
        )
    ),
}


def leaves(state):
    """Every entry of a state, by where it stands."""
    return dict(torch.utils._pytree.tree_flatten_with_path(state)[0])


@pytest.mark.integration
@pytest.mark.parametrize(
    ("name", "steps"),
    [
        *(pytest.param(name, 95, marks=[] if name == "PPO" else pytest.mark.slow) for name in RESUMED),
        ("published DQN", 1),
        pytest.param("everything of replay", 41, marks=pytest.mark.slow),
        pytest.param("PPO", 41, marks=pytest.mark.slow),
    ],
)
def test_a_stopped_learner_continues_bit_for_bit(name, steps):
    whole, stopped, again = (stock(RESUMED[name]) for _ in range(3))
    played = turns(LaneActor(None, SPACES.actions, seeds=[(r, a) for r in (0, 1) for a in (0, 1)], agents=2))
    before = [next(played).clone() for _ in range(steps)]
    after = [next(played).clone() for _ in range(35)]
    for turn in before:
        take(whole, turn)
        take(stopped, turn)
    kept = BytesIO()
    torch.save(stopped.state_dict(), kept)
    kept.seek(0)
    again.load_state_dict(torch.load(kept, weights_only=True))
    for turn in after:
        ours, theirs = take(whole, turn), take(again, turn)
        assert (ours is None) == (theirs is None)
        assert ours is None or torch.equal(ours, theirs)
        with set_exploration_type(ExplorationType.RANDOM):
            seen = turn[keys.OBSERVATION]
            assert torch.equal(whole.actor.choose(seen), again.actor.choose(seen))
    ours, theirs = leaves(whole.state_dict()), leaves(again.state_dict())
    assert ours.keys() == theirs.keys()
    for where, own in ours.items():
        other = theirs[where]
        assert torch.equal(own, other) if isinstance(own, torch.Tensor) else own == other, where


def test_a_loss_of_each_transition_learns_as_their_mean():
    def made(network, *, reduction):
        loss = DQN(settings=REPLAY).make_loss(network)
        loss.reduction = reduction
        return loss

    ends = []
    for reduction in ("none", "mean"):
        make_loss = partial(made, reduction=reduction)
        learner = dqn_learner(SPACES, settings=REPLAY, kind=TorchRLReplayLearner, make_loss=make_loss, **HOW)
        played = turns(learner.actor)
        losses = [take(learner, next(played)) for _ in range(20)]
        ends.append({**learner.engine.network_state(0), "loss": losses[-1]})
    assert all(torch.equal(value, ends[1][name]) for name, value in ends[0].items())


OTHER_SETTINGS = {"Tabular": algorithms.TabularSettings(), "LOLA": algorithms.LOLASettings()}
OTHER_SETTINGS |= dict.fromkeys(("MAPPO", "IPPO"), ROLLOUT)


@pytest.mark.parametrize("name", ["VDN", "QMIX", "MADDPG", *OTHER_SETTINGS])
def test_teams_and_tables_are_refused_by_name(name):
    kind, settings = getattr(algorithms, name), OTHER_SETTINGS.get(name, REPLAY)
    match = f'{name} does not support engine="torchrl", .*"compiled" or "eager"'
    with pytest.raises(ValueError, match=match):
        make_learner(kind(settings=settings), SPACES, engine="torchrl", reward_kind="team", **HOW)


def test_other_losses_networks_and_sizes_are_refused():
    with pytest.raises(ValueError, match="ClipPPOLoss is on-policy and cannot learn from a replay buffer"):
        learner_of_parts(
            TorchRLReplayLearner, PPO(settings=ROLLOUT), SPACES, parts={"settings": REPLAY}, **HOW
        )
    parts = {"make_network": partial(DQN(settings=REPLAY).make_network, SPACES)}
    with pytest.raises(ValueError, match="an agent has the networks"):
        learner_of_parts(TorchRLRolloutLearner, PPO(settings=ROLLOUT), SPACES, parts=parts, **HOW)
    with pytest.raises(
        MemoryError, match=r"4 agents x 1,000,000,000,000 transitions take .* smaller buffer_size"
    ):
        stock(DQN(settings=replace(REPLAY, buffer_size=10**12)))


@pytest.mark.parametrize("kind", [TorchRLReplayLearner, ReplayLearner])
def test_targets_are_refused_for_a_loss_that_has_none(kind):
    def without_targets(network):
        actor = DQN(settings=REPLAY).make_loss(network).value_network
        loss = objectives.DQNLoss(actor, delay_value=False, loss_function="l2", action_space="categorical")
        loss.make_value_estimator(gamma=0.9)
        return loss

    for changes, message in (
        ({}, None),
        ({"tau": 0.1}, r"tau is 0\.1"),
        ({"own_target_weights": True}, "own_target_weights is True"),
    ):
        settings = replace(REPLAY, **changes)
        make = partial(dqn_learner, SPACES, settings=settings, kind=kind, make_loss=without_targets, **HOW)
        if message is None:
            assert getattr(make().engine, "updaters", [None] * 4) == [None] * 4
            continue
        with pytest.raises(ValueError, match=message):
            make()
