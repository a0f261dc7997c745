"""What TorchRL users look for: optimisers, soft targets, several updates a step, returns of several steps,
transforms of the replay buffer."""

from copy import deepcopy
from dataclasses import replace
from functools import partial

import pytest
import torch
from dqn_parts import dqn_learner, dqn_loss, make_learner, write
from test_lanes import ENGINES, SHAPE, filled, networks, row, transition
from torchrl.envs.transforms import MultiStepTransform, RewardScaling
from torchrl.objectives import HardUpdate, SoftUpdate

from cprl import CommonsEnv, Game, Rules, maps
from cprl.algorithms import CQL, DQN, IQL, MADDPG, PR2, QMIX, SAC, VDN, DistributionalDQN
from cprl.custom import Custom
from cprl.learners.engine import FunctionalEngine, UpdateRule
from cprl.learners.ring import Horizon, Ring, TransitionForm
from cprl.learners.settings import DQNSettings
from cprl.training import train

GAME = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=12, freeze_steps=2),
)
SETTINGS = DQNSettings(
    buffer_size=150, batch_size=4, learning_rate=1e-3, hidden_cells=(8,), target_every_episodes=2
)
OPTIMIZERS = {
    "adam": partial(torch.optim.Adam, eps=1e-6),
    "adamw": partial(torch.optim.AdamW, eps=1e-6),
    "rmsprop": partial(torch.optim.RMSprop, eps=1e-6),
    "keras_rmsprop": partial(torch.optim.RMSprop, eps=1e-6, alpha=0.9),
    "sgd": torch.optim.SGD,
}


def weights_by_hand(lane, optimizer, *, tau=None, steps=40):
    """A lane trained alone by TorchRL's loss, torch's optimiser and TorchRL's `SoftUpdate`."""
    loss = dqn_loss(networks([lane], torch.float64)[0], gamma=0.9)
    updater = SoftUpdate(loss, tau=tau) if tau else HardUpdate(loss, value_network_update_interval=steps)
    optimizer = optimizer(loss.parameters(), lr=1e-2)
    buffer = filled([lane])
    for _ in range(steps):
        optimizer.zero_grad()
        loss(buffer.sample()[0])["loss"].backward()
        optimizer.step()
        updater.step()
    groups = loss.value_network_params, loss.target_value_network_params
    return [[value.detach() for value in group.flatten_keys(".").values()] for group in groups]


def weights_in(update, lane):
    named = update.weights(lane)
    groups = []
    for group in ("value_network_params:", "target_value_network_params:"):
        own = {name.removeprefix(group): value for name, value in named.items() if name.startswith(group)}
        groups.append(list(own.values()))
    return groups


def assert_same_sums(update, lane, by_hand, tolerance):
    """Of all weights and of their squares, whatever their order and form."""
    for mine, theirs in zip(weights_in(update, lane), by_hand, strict=True):
        mine, theirs = (
            torch.cat([value.flatten() for value in group]).sort().values for group in (mine, theirs)
        )
        torch.testing.assert_close(mine, theirs, rtol=tolerance, atol=tolerance)


@pytest.mark.integration
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_each_optimiser_changes_every_lane_as_torchs_own_does(engine, name):
    update, _ = by_engine(engine, optimizer=name)
    for lane in range(3):
        assert_same_sums(update, lane, weights_by_hand(lane, OPTIMIZERS[name]), 1e-9)


def by_engine(engine, *, steps=40, **how):
    update = ENGINES[engine](
        networks([0, 1, 2], torch.float64),
        partial(dqn_loss, gamma=0.9),
        UpdateRule(learning_rate=1e-2, adam_eps=1e-6, **how),
    )
    buffer = filled([0, 1, 2])
    losses = [update.update(buffer) for _ in range(steps)]
    return update, losses


@pytest.mark.integration
@pytest.mark.parametrize("engine", ENGINES)
def test_soft_targets_move_as_torchrls_soft_update_moves_them(engine):
    update, _ = by_engine(engine, tau=0.1)
    for lane in range(3):
        by_hand = weights_by_hand(lane, OPTIMIZERS["adam"], tau=0.1)
        assert not torch.equal(by_hand[0][0], by_hand[1][0])
        assert_same_sums(update, lane, by_hand, 1e-9)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
@pytest.mark.parametrize("engine", ["list", "lane_axis"])
def test_an_engine_continues_from_its_state_with_every_optimiser(engine, optimizer):
    def new():
        rule = UpdateRule(learning_rate=1e-2, optimizer=optimizer)
        return ENGINES[engine](networks([0, 1]), partial(dqn_loss, gamma=0.9), rule)

    first, second, buffer, same = new(), new(), filled([0, 1]), filled([0, 1])
    for _ in range(5):
        first.update(buffer)
        same.draw()
    second.load_state_dict(deepcopy(first.state_dict()))
    for _ in range(5):
        assert torch.equal(first.update(buffer), second.update(same))


def played(learner, steps=40):
    """The losses of a learner that acts in a world of `GAME`."""
    env = CommonsEnv(GAME, learner.replicas, seed=3)
    moment, losses = env.reset(), []
    for _ in range(steps):
        moment["agents", "action"] = learner.actor.choose(moment["agents", "observation"])
        now, moment = env.step_and_maybe_reset(moment)
        learner.store(now)
        losses.append(learner.update())
        if now["next", "done"].any():
            learner.end_episode(now["next", "done"].flatten())
    return losses


def learner(settings=SETTINGS, **how):
    how = {"replicas": 2, "compile": False, **how}
    return dqn_learner(GAME.spaces, agents=(0, 1), settings=settings, **how)


def test_several_updates_a_step_are_each_from_a_sample_of_their_own():
    one, three = learner(), learner(replace(SETTINGS, updates_per_step=3))
    losses = played(three, steps=18)
    assert played(one, steps=18)[14] is None
    assert losses[14] is None
    assert three.engine.steps == 9
    assert one.engine.steps == 3
    assert losses[15].shape == (2, 2)
    assert three.buffer.rng.state_dict().keys() == one.buffer.rng.state_dict().keys()


def test_several_steps_an_update_are_counted_from_the_first_possible_one():
    """16 transitions are wanted first, the 16th is the first step that counts."""
    fourth = learner(replace(SETTINGS, steps_per_update=4, updates_per_step=2))
    losses = played(fourth, steps=30)
    assert [step for step, own in enumerate(losses, 1) if own is not None] == [19, 23, 27]
    assert fourth.engine.steps == 6
    again = learner(replace(SETTINGS, steps_per_update=4))
    again.load_state_dict(deepcopy(fourth.state_dict()))
    assert [step for step, own in enumerate(played(again, steps=4), 31) if own is not None] == [31]


@pytest.mark.parametrize("update_every", [1, 4, 6, 8])
def test_steps_an_update_and_updates_that_wait_for_several_steps_agree(update_every):
    """A loop that asks for k updates after every k steps gets as many as one that asks after each."""
    often = learner(replace(SETTINGS, steps_per_update=4, learning_starts=1))
    train(CommonsEnv(GAME, 2, seed=3), {(0, 1): often}, episodes=2, update_every=update_every)
    assert often.engine.steps == often.steps // update_every * update_every // 4


def test_with_tau_no_target_is_copied():
    soft = learner(replace(SETTINGS, tau=0.01))
    soft.engine.copy_to_targets = lambda which: pytest.fail("a target was copied")
    played(soft)
    for lane in range(4):
        own, target = weights_in(soft.engine, lane)
        assert not torch.equal(own[0], target[0])


def by_hand(lane, start, steps, *, n_steps, gamma):
    """What `n_steps` steps from one on come to, as one would write it down."""
    rewards, last = 0.0, start
    for ahead in range(n_steps):
        last = transition(lane, start + ahead)["next"]
        rewards += gamma**ahead * float(last["reward"])
        if last["done"]:
            break
    return rewards, last, ahead + 1


@pytest.mark.integration
@pytest.mark.parametrize(
    ("lanes", "n_steps"),
    [([0], 2), ([0], 7), ([0, 1, 2, 9], 3), pytest.param([0, 1, 2, 9], 7, marks=pytest.mark.slow)],
)
def test_returns_of_several_steps_are_what_one_works_out_by_hand(lanes, n_steps):
    gamma, transitions = 0.9, 30
    form = TransitionForm(observation_shape=SHAPE, horizon=Horizon(n_steps, gamma))
    buffer = Ring(form, seeds=[(7, lane) for lane in lanes], transitions=transitions, batch_size=16)
    shorter, terminal = 0, 0
    for step in range(100):
        write(buffer, row(lanes, step))
        oldest, written = buffer.oldest()
        if written < n_steps:
            continue
        index = buffer.draw()
        batch = buffer.get(index)
        for place, lane in enumerate(lanes):
            for drawn, found in zip(index[place].tolist(), batch[place], strict=True):
                newest = written - 1 - (written - 1 - drawn) % transitions
                assert int(oldest[place]) <= newest <= written - n_steps, "whole, and its steps are over"
                rewards, last, count = by_hand(lane, newest, step, n_steps=n_steps, gamma=gamma)
                assert float(found["next", "reward"]) == pytest.approx(rewards, rel=1e-6)
                assert int(found["steps_to_next_obs"]) == count
                assert torch.equal(found["observation"], transition(lane, newest)["observation"])
                for name in ("observation", "done", "terminated"):
                    assert torch.equal(found["next", name], last[name]), name
                shorter += count < n_steps
                terminal += bool(last["terminated"])
    assert shorter > 0
    assert terminal > 0


def test_returns_of_several_steps_are_those_of_torchrls_multi_step_transform():
    """But that it leaves "done" and "terminated" those of the first step."""
    gamma, n_steps, lanes = 0.9, 4, [0, 1]
    ours = filled(lanes, steps=0, transitions=40)
    ours.horizon = Horizon(n_steps, gamma)
    rows = [row(lanes, step) for step in range(36)]
    for one in rows:
        write(ours, one)
    whole = MultiStepTransform(n_steps, gamma)._inv_call(torch.stack(rows, 1))
    index = torch.arange(whole.shape[1]).expand(2, -1)
    got = ours.get(index)
    assert whole.shape[1] == 36 - n_steps, "the newest are held back"
    torch.testing.assert_close(got["next", "reward"], whole["next", "reward"])
    assert torch.equal(got["next", "observation"], whole["next", "observation"])
    assert torch.equal(got["steps_to_next_obs"].squeeze(-1), whole["steps_to_next_obs"].view(2, -1))


def test_a_target_bootstraps_by_the_discount_of_its_steps():
    """target = sum of r + gamma**steps max Q'(s'), without the last term behind a terminal state."""
    n_steps, gamma = 3, 0.9
    buffer = filled([0, 1], steps=40)
    buffer.horizon = Horizon(n_steps, gamma)
    batch = buffer.sample()
    made = networks([0, 1])
    update = FunctionalEngine(
        made,
        partial(dqn_loss, gamma=gamma),
        UpdateRule(learning_rate=0.1),
        batching="lane_axis",
        compile=False,
    )
    losses = update.update_from(batch)
    for lane, network in enumerate(networks([0, 1])):
        own = batch[lane]
        with torch.no_grad():
            value = network(own["observation"]).gather(-1, own["action"][:, None])
            best = network(own["next", "observation"]).amax(-1, keepdim=True)
            discount = gamma ** own["steps_to_next_obs"] * ~own["next", "terminated"]
            wanted = (value - own["next", "reward"] - discount * best).square().mean()
        assert float(losses[lane]) == pytest.approx(float(wanted), rel=1e-5)


@pytest.mark.parametrize("algorithm", [DQN, CQL, SAC, PR2, DistributionalDQN, VDN, QMIX, MADDPG])
def test_every_algorithm_of_replay_learns_from_returns_of_several_steps(algorithm):
    settings = replace(SETTINGS, n_steps=3, tau=0.05, updates_per_step=2)
    how = {"reward_kind": "team"} if algorithm in (VDN, QMIX) else {}
    made = make_learner(
        algorithm(settings=settings), GAME.spaces, agents=(0, 1), replicas=1, engine="eager", **how
    )
    losses = played(made, steps=25)
    assert torch.isfinite(losses[-1]).all()


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
@pytest.mark.parametrize("algorithm", [SAC, IQL, DistributionalDQN])
def test_relu_on_outputs_is_refused_where_no_q_values_act(algorithm, engine):
    made = algorithm(settings=replace(SETTINGS, relu_on_outputs=True))
    message = r"settings\.relu_on_outputs is True"
    with pytest.raises(ValueError, match=message):
        make_learner(made, GAME.spaces, agents=(0,), replicas=1, engine=engine)


def test_a_loss_that_takes_no_notice_of_the_steps_is_refused():
    def make_loss(network):
        loss = dqn_loss(network, gamma=SETTINGS.gamma)
        forward = loss.forward
        loss.forward = lambda batch: forward(batch.exclude("steps_to_next_obs"))
        return loss

    with pytest.raises(ValueError, match="n_steps is 3"):
        learner(replace(SETTINGS, n_steps=3), make_loss=make_loss)
    with pytest.raises(ValueError, match="DiscreteIQLLoss does not read"):  # of TorchRL 0.14.1
        make_learner(IQL(settings=replace(SETTINGS, n_steps=3)), GAME.spaces, agents=(0,), replicas=1)
    with pytest.raises(ValueError, match=r"DQNLoss has gamma 0\.5 and the settings have gamma 0\.995"):
        learner(replace(SETTINGS, n_steps=3), make_loss=partial(dqn_loss, gamma=0.5))


class Counting(RewardScaling):
    """A transform with a state."""

    def __init__(self, **how):
        super().__init__(0.0, 10.0, in_keys=[("next", "reward")], **how)
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    def forward(self, tensordict):
        self.calls += 1
        return super().forward(tensordict)


def torchrl_learner(**settings):
    algorithm = DQN(settings=replace(SETTINGS, **settings))
    return make_learner(algorithm, GAME.spaces, agents=(0, 1), replicas=2, engine="torchrl")


def test_transforms_of_the_replay_buffer_run():
    transforms = (Custom("test_engine_options:Counting"),)
    made, plain = torchrl_learner(replay_transforms=transforms), torchrl_learner()
    losses, plain_losses = played(made, 24), played(plain, 24)
    (counting,) = made.buffer.each[0].transform
    assert int(counting.calls) == 24 - SETTINGS.learning_starts + 1
    assert made.buffer.each[0].storage[:]["next", "reward"].max() == 1.0, "what is stored stays as it was"
    assert not torch.equal(losses[-1], plain_losses[-1])
    other = torchrl_learner(replay_transforms=transforms)
    other.load_state_dict(made.state_dict())
    assert int(other.buffer.each[0].transform[0].calls) == int(counting.calls)


def test_a_transform_that_does_not_fit_is_refused_by_name():
    wrong = Custom("torchrl.envs:RewardScaling", {"loc": 0.0, "scale": 2.0})
    with pytest.raises(ValueError, match=r"torchrl.envs:RewardScaling cannot transform .*'reward' not found"):
        torchrl_learner(replay_transforms=(wrong,))


def test_the_fast_engine_refuses_transforms_by_name():
    with pytest.raises(ValueError, match=r'replay_transforms is .*engine="torchrl"'):
        learner(replace(SETTINGS, replay_transforms=(Custom("test_engine_options:Counting"),)))


@pytest.mark.parametrize(("name", "other"), [("learning_starts", {}), ("buffer_size", {"buffer_size": 6})])
def test_returns_of_more_steps_than_are_stored_at_first_are_refused(name, other):
    with pytest.raises(ValueError, match=f"n_steps is 17.*{name}"):
        DQNSettings(n_steps=17, **other)
