"""engine="torchrl": stock parts learn what the fast engine learns, are stopped and continue, and refuse."""

import inspect
from collections import deque
from dataclasses import replace
from functools import partial
from io import BytesIO

import pytest
import torch
from c51 import C51
from cql import CQL
from dqn_parts import make_learner
from iql import IQL
from places import ROOT
from same_runs import assert_same_training
from torchrl import objectives
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler, RoundRobinWriter, SamplerWithoutReplacement
from torchrl.envs.utils import ExplorationType, set_exploration_type

import cprl
from cprl import CommonsEnv, Game, Rules, algorithms, keys, maps
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.learners import plain
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.learners.plain import PlainNetworks, PlainReplay, PlainRollouts, train_plainly
from cprl.objectives import LogCoshDQNLoss, PR2Loss
from cprl.policies.actors import LaneActor
from cprl.population import Learning
from cprl.training import Schedule, Training
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
SCHEDULES = replace(
    REPLAY, target_every_updates=7, learning_rate_end=1e-5, learning_rate_decay_steps=60, optimizer="adamw"
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
    "DQN by schedules": (DQN(settings=SCHEDULES), objectives.DQNLoss),
    "C51": (
        C51(settings=REPLAY, atoms=11, highest_return=20.0),
        objectives.DistributionalDQNLoss,
    ),
    "CQL": (CQL(settings=REPLAY), objectives.DiscreteCQLLoss),
    "SAC": (algorithms.SAC(settings=REPLAY), objectives.DiscreteSACLoss),
    "IQL": (IQL(settings=REPLAY), objectives.DiscreteIQLLoss),
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


def weights(learner):
    """The acting weights of all agents, by their names."""
    networks = learner.networks().items()
    return {
        f"{name}/{key}": value for name, network in networks for key, value in network.state_dict().items()
    }


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


def buffers(learner):
    """The stock buffers of a learner."""
    memory = learner.memory
    return (memory.buffer if isinstance(memory, PlainReplay) else memory.buffers).each


class Replayed(RandomSampler):
    """Gives out the places that another sampler drew for an agent."""

    def __init__(self):
        super().__init__()
        self.places = deque()

    def sample(self, storage, batch_size):
        return self.places.popleft(), {}


def both(algorithm, worlds):
    """The fast engine's learner, and the stock one that is handed the places that the fast one draws."""
    fast, stock = (
        make_learner(algorithm, SPACES, engine=engine, worlds=worlds, **HOW)
        for engine in ("eager", "torchrl")
    )
    samplers = [Replayed() for _ in range(4)]
    for buffer, sampler in zip(buffers(stock), samplers, strict=True):
        buffer.set_sampler(sampler)
    if isinstance(algorithm.settings, DQNSettings):
        ring = fast.memory.buffer
        draw = ring.places

        def recorded():
            places, columns = draw()
            # A stock buffer holds the worlds of a turn one after the other.
            world = (columns.unsqueeze(-1) == ring.columns[:, None]).long().argmax(-1)
            for sampler, own in zip(samplers, places * worlds + world, strict=True):
                sampler.places.append(own)
            return places, columns

        ring.places = recorded
    else:
        rng, size = fast.memory.rng, algorithm.settings.minibatch_size
        following = rng.next

        def recorded():
            numbers = following()
            for sampler, own in zip(samplers, numbers.argsort(-1), strict=True):
                sampler.places.extend(own.split(size))
            return numbers

        rng.next = recorded
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


@pytest.mark.integration
@pytest.mark.parametrize(("name", "worlds"), [*((name, 1) for name in FIRST), *((name, 2) for name in FIRST)])
def test_agents_that_play_for_themselves_end_with_the_same_weights_by_both_engines(name, worlds):
    """Each engine's agents act by their own weights, and so come by turns of their own."""
    learners = both(ALGORITHMS[name], worlds)
    for learner in learners:  # the fast one first: the other one is handed what it drew
        train_plainly(CommonsEnv(GAME, 2 * worlds, seed=3), learner, episodes=12)
    fast, stock = learners
    assert fast.steps == stock.steps > 5 * 23
    torch.testing.assert_close(weights(fast), weights(stock), rtol=1e-5, atol=1e-5)


@pytest.mark.integration
@pytest.mark.parametrize("name", FIRST)
def test_a_plain_training_is_that_of_the_training_loop(name):
    def stock_collector(env, policy):
        return Collector(
            env, policy, frames_per_batch=2, total_frames=-1, auto_register_policy_transforms=False
        )

    by_page, by_loop = (make_learner(ALGORITHMS[name], SPACES, engine="torchrl", **HOW) for _ in range(2))
    train_plainly(CommonsEnv(GAME, 2, seed=3), by_page, episodes=4)
    env, learners = CommonsEnv(GAME, 2, seed=3), {(0, 1): by_loop}
    Training(env, learners, Schedule(episodes=2), make_collector=stock_collector).run()
    assert by_page.steps == by_loop.steps == 46
    torch.testing.assert_close(weights(by_page), weights(by_loop), rtol=0, atol=0)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_part_is_torchrls_or_torchs_own(name):
    learner = stock(ALGORITHMS[name])
    on_policy = name in ON_POLICY
    networks = learner.lane_networks
    assert type(learner.memory) is (PlainRollouts if on_policy else PlainReplay)
    assert type(networks) is PlainNetworks
    assert len(buffers(learner)) == len(networks.losses) == 4
    for buffer in buffers(learner):
        assert type(buffer) is TensorDictReplayBuffer
        assert type(buffer.storage) is LazyTensorStorage
        assert type(buffer.sampler) is (SamplerWithoutReplacement if on_policy else RandomSampler)
        assert isinstance(buffer.writer, RoundRobinWriter)
    assert all(isinstance(loss, LOSSES[name]) for loss in networks.losses)
    adam = torch.optim.AdamW if name == "DQN by schedules" else torch.optim.Adam
    assert all(type(optimizer) is adam for optimizer in networks.optimizers)
    if not on_policy:
        assert all(type(targets) is objectives.HardUpdate for targets in networks.targets)


def test_advantages_are_torchrls(monkeypatch):
    made = []

    class Noted(plain.GAE):
        def __init__(self, **options):
            super().__init__(**options)
            made.append(options)

    monkeypatch.setattr(plain, "GAE", Noted)
    learner = stock(ALGORITHMS["A2C"])
    made.clear()
    played = turns(learner.actor)
    for _ in range(ONE_EPOCH.rollout_steps):
        losses = take(learner, next(played))
    assert losses is not None
    assert len(made) == 4
    assert {(options["gamma"], options["lmbda"], options["average_gae"]) for options in made} == {
        (ONE_EPOCH.gamma, ONE_EPOCH.gae_lambda, True)
    }


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
    for optimizer in stock(DQN(settings=settings)).lane_networks.optimizers:
        (group,) = optimizer.param_groups
        assert type(optimizer) is kind
        assert group["lr"] == settings.learning_rate
        assert group.get("eps", 1e-3) == 1e-3


RESUMED = {
    **ALGORITHMS,
    "everything of replay": DQN(settings=replace(REPLAY, tau=0.05, updates_per_step=2, optimizer="rmsprop")),
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


@pytest.mark.integration
@pytest.mark.parametrize("name", FIRST)
def test_a_run_in_several_worlds_that_is_stopped_and_resumed_equals_a_whole_one(name, tmp_path, stopped):
    experiment = cprl.Experiment(
        name="plain",
        game=GAME,
        agents=(Learning(ALGORITHMS[name]),) * 2,
        replicas=2,
        worlds=2,
        episodes=6,
        seed=3,
        evaluation_episodes=1,
        engine="torchrl",
        callbacks=[Custom("own_parts:Bored", arguments={"from_episode": 7, "epsilon": 0.4})],
    )
    whole = cprl.run(experiment, tmp_path / "whole", watch="off")
    stopped(32, experiment, tmp_path / "parts")
    parts = cprl.run(experiment, tmp_path / "parts", watch="off", resume=True)
    assert_same_training(parts, whole)


@pytest.mark.integration
@pytest.mark.parametrize("name", [*FIRST, "SAC"])
def test_nothing_draws_from_torchs_global_generator(name):
    learner, state = stock(ALGORITHMS[name]), torch.get_rng_state()
    played = turns(learner.actor)
    for _ in range(45):
        take(learner, next(played))
    assert torch.equal(torch.get_rng_state(), state)


class OfEachTransition(DQN):
    """Its loss is one number for each transition."""

    reduction = "none"

    def make_loss(self, network):
        loss = super().make_loss(network)
        loss.reduction = self.reduction
        return loss


class OfTheMean(OfEachTransition):
    reduction = "mean"


def test_a_loss_of_each_transition_learns_as_their_mean():
    ends = []
    for kind in (OfEachTransition, OfTheMean):
        learner = stock(kind(settings=REPLAY))
        played = turns(learner.actor)
        losses = [take(learner, next(played)) for _ in range(20)]
        ends.append({**learner.lane_networks.network_state(0), "loss": losses[-1]})
    assert all(torch.equal(value, ends[1][name]) for name, value in ends[0].items())


OTHER_SETTINGS = {"Tabular": algorithms.TabularSettings(), "LOLA": algorithms.LOLASettings()}
OTHER_SETTINGS |= dict.fromkeys(("MAPPO", "IPPO"), ROLLOUT)


@pytest.mark.parametrize("name", ["VDN", "QMIX", "MADDPG", *OTHER_SETTINGS])
def test_teams_and_tables_are_refused_by_name(name):
    kind, settings = getattr(algorithms, name), OTHER_SETTINGS.get(name, REPLAY)
    match = f'{name} does not support engine="torchrl", .*"compiled" or "eager"'
    with pytest.raises(ValueError, match=match):
        kind(settings=settings).make_learner(Lanes(SPACES, reward="team", **HOW), "torchrl")


class PPOFromReplay(DQN):
    def make_loss(self, network):
        critic = PPO(settings=ROLLOUT).make_network(SPACES)
        return PPO(settings=ROLLOUT).make_loss(critic)


class PPOWithoutCritic(PPO):
    def make_network(self, spaces):
        return DQN(settings=REPLAY).make_network(spaces)


def test_other_losses_networks_and_sizes_are_refused():
    with pytest.raises(ValueError, match="ClipPPOLoss is on-policy and cannot learn from a replay buffer"):
        stock(PPOFromReplay(settings=REPLAY))
    with pytest.raises(ValueError, match="an agent has the networks"):
        stock(PPOWithoutCritic(settings=ROLLOUT))
    with pytest.raises(
        MemoryError, match=r"4 agents x 1,000,000,000,000 transitions take .* smaller buffer_size"
    ):
        stock(DQN(settings=replace(REPLAY, buffer_size=10**12)))


class WithoutTargets(DQN):
    def make_loss(self, network):
        actor = super().make_loss(network).value_network
        loss = objectives.DQNLoss(actor, delay_value=False, loss_function="l2", action_space="categorical")
        loss.make_value_estimator(gamma=self.settings.gamma)
        return loss


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_targets_are_refused_for_a_loss_that_has_none(engine):
    for changes, message in (
        ({}, None),
        ({"tau": 0.1}, r"tau is 0\.1"),
        ({"own_target_weights": True}, "own_target_weights is True"),
    ):
        algorithm = WithoutTargets(settings=replace(REPLAY, **changes))
        make = partial(make_learner, algorithm, SPACES, engine=engine, **HOW)
        if message is None:
            targets = make().lane_networks.targets
            assert not targets or targets == [None] * 4
            continue
        with pytest.raises(ValueError, match=message):
            make()


def test_the_docs_show_the_update_of_a_learner_as_it_is():
    page = (ROOT / "docs" / "algorithms.md").read_text()
    block = page.split("So the update of every algorithm is\n\n```python\n")[1].split("```")[0]
    lines = [line.strip() for line in inspect.getsource(Learner.update).splitlines()]
    assert [line.strip() for line in block.splitlines()][1:] == lines[1:]
