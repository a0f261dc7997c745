"""Schedules that do not depend on how long an episode lasts, and losses of the turns in play alone."""

from copy import deepcopy
from dataclasses import replace

import dqn_parts as parts
import pytest
import torch
from dqn_parts import MEADOW as GAME
from loss_parts import MAKE_LOSS, networks, weights_of
from ring_parts import filled
from torchrl.envs import ExcludeTransform, TransformedEnv

from cprl import CommonsEnv
from cprl.algorithms import A2C, DQN, IPPO, MAPPO, PPO, DQNSettings, RolloutSettings
from cprl.learners.draw import Draw
from cprl.learners.networks import LaneNetworks
from cprl.learners.optimizers import UpdateRule
from cprl.learners.rollouts import advantages
from cprl.networks import GRU
from cprl.policies.joint_policy import JointPolicy
from cprl.population import Learning
from cprl.training import Schedule, train
from cprl.training.agents import Population
from cprl.training.training import StepCollector

REPLAY = DQNSettings(buffer_size=60, learning_starts=4, batch_size=4, learning_rate=1e-2, hidden_cells=(8,))
ROLLOUTS = RolloutSettings(rollout_steps=8, minibatch_size=4, epochs=2, hidden_cells=(8,))


def learner(settings, algorithm=DQN, engine="eager", **lanes):
    lanes = {"agents": (0, 1), "replicas": 2, "seed": 7, **lanes}
    return parts.make_learner(algorithm(settings=settings), GAME.spaces, engine=engine, **lanes)


def played(made, steps, seed=3):
    return parts.played(made, CommonsEnv(GAME, made.replicas, seed=seed), steps)


def after(made):
    """The weights of the first lane and its targets."""
    return weights_of(made.lane_networks, 0)


@pytest.mark.parametrize("settings", [DQNSettings, RolloutSettings])
def test_a_learning_rate_falls_along_a_line_and_stays_at_its_end(settings):
    falls = settings(learning_rate=0.5, learning_rate_end=0.1, learning_rate_decay_steps=40)
    rates = [falls.learning_rate_at(step) for step in (0, 10, 20, 40, 90)]
    assert rates == pytest.approx([0.5, 0.4, 0.3, 0.1, 0.1])
    assert replace(falls, learning_rate_end=None).learning_rate_at(40) == 0.5
    assert replace(falls, learning_rate_end=0.9).learning_rate_at(20) == pytest.approx(0.7), "or rises"


@pytest.mark.parametrize("update", ["list", "vmapped", "stacked"])
@pytest.mark.parametrize("optimizer", ["adam", "adamw", "rmsprop", "keras_rmsprop", "sgd"])
def test_a_rate_that_changes_gives_the_steps_of_such_a_constant_rate(optimizer, update):
    """Each step is compared with that of networks in the same state whose rule has the rate as a constant."""
    rule = UpdateRule(learning_rate=0.05, optimizer=optimizer, adam_eps=1e-6, decays=True)
    falling = LaneNetworks(networks([0, 1], torch.float64), MAKE_LOSS, rule, update=update)
    ring = filled([0, 1])
    for rate in (0.04, 0.03, 0.0):
        batch, state = ring.sample(), deepcopy(falling.state_dict())
        constant = UpdateRule(learning_rate=rate, optimizer=optimizer, adam_eps=1e-6)
        alike = LaneNetworks(networks([0, 1], torch.float64), MAKE_LOSS, constant, update=update)
        alike.load_state_dict(state)
        falling.learning_rate = rate
        for each in (falling, alike):
            each.learn(Draw.of(batch))
        for lane in range(2):
            found, wanted = (weights_of(each, lane) for each in (falling, alike))
            torch.testing.assert_close(found, wanted, rtol=1e-7, atol=1e-9)  # float32 holds a rate


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
@pytest.mark.parametrize(("settings", "algorithm"), [(REPLAY, DQN), (ROLLOUTS, PPO)])
def test_agents_learn_by_the_rate_of_their_step_and_no_more_when_it_is_0(settings, algorithm, engine):
    falls = replace(settings, learning_rate_end=0, learning_rate_decay_steps=16)
    made = learner(falls, algorithm, engine)
    first = deepcopy(made.networks())
    played(made, 15)
    half = deepcopy(made.networks())
    assert made.lane_networks.learning_rate == pytest.approx(settings.learning_rate / 16)
    played(made, 20)
    assert made.lane_networks.learning_rate == 0
    for name, network in made.networks().items():
        moved = [
            not torch.equal(then, now)
            for then, now in zip(first[name].parameters(), half[name].parameters(), strict=True)
        ]
        assert any(moved), "it learned while its rate was above 0"
        if algorithm is DQN:  # PPO learned from the second rollout at its 16th step, with a rate of 0
            again = zip(half[name].parameters(), network.parameters(), strict=True)
            assert any(not torch.equal(*pair) for pair in again) is False


@pytest.mark.parametrize("algorithm", [A2C, PPO, IPPO, MAPPO])
def test_the_weight_of_the_entropy_falls_along_a_line_and_stays_at_its_end(algorithm):
    falls = algorithm(settings=ROLLOUTS, entropy_coeff=0.5, entropy_coeff_end=0.1, entropy_decay_steps=40)
    weights = [falls.entropy_coeff_at(step) for step in (0, 10, 20, 40, 90)]
    assert weights == pytest.approx([0.5, 0.4, 0.3, 0.1, 0.1])
    assert replace(falls, entropy_coeff_end=None).entropy_coeff_at(40) == 0.5
    with pytest.raises(ValueError, match="entropy_coeff_end"):
        replace(falls, entropy_coeff=0.0)


@pytest.mark.parametrize(
    ("algorithm", "engine"),
    [
        *((PPO, "eager"), (PPO, "torchrl"), (A2C, "eager"), (IPPO, "eager"), (MAPPO, "eager")),
        pytest.param(PPO, "compiled", marks=pytest.mark.integration),
    ],
)
def test_agents_learn_with_the_weight_of_the_entropy_of_their_step(algorithm, engine):
    """Two updates, of which the second has another weight: as with that weight from a state on."""
    is_team = algorithm in (IPPO, MAPPO)
    lanes = {"engine": engine, "are_teams": is_team, "reward": "team" if algorithm is MAPPO else "individual"}

    def made(**entropy):
        whole = algorithm(settings=ROLLOUTS, **entropy)
        return parts.make_learner(whole, GAME.spaces, agents=(0, 1), replicas=2, seed=7, **lanes)

    falling = made(entropy_coeff=2.0, entropy_coeff_end=0.0, entropy_decay_steps=16)
    played(falling, 15)
    none = made(entropy_coeff=0.0)
    some = made(entropy_coeff=2.0)
    for other, weight in ((none, 0.0), (some, 2.0)):
        other.load_state_dict(deepcopy(falling.state_dict()))
        other.lane_networks.set_entropy_coeff(weight)
    for each in (falling, none, some):
        played(each, 1)
    ends = [
        [weight for network in each.networks().values() for weight in network.state_dict().values()]
        for each in (falling, none, some)
    ]
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-5, atol=1e-6)
    assert any(not torch.allclose(*pair, rtol=1e-4) for pair in zip(ends[0], ends[2], strict=True))


def test_a_turn_of_several_worlds_is_as_many_steps_of_the_fall():
    falls = replace(REPLAY, learning_rate_end=0, learning_rate_decay_steps=80)
    made = learner(falls, replicas=1, worlds=4)
    parts.played(made, CommonsEnv(GAME, 4, seed=3), 10)
    assert made.steps == 40
    assert made.lane_networks.learning_rate == pytest.approx(REPLAY.learning_rate / 2)


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_targets_are_copied_every_so_many_updates_however_long_episodes_last(engine):
    made = learner(replace(REPLAY, target_every_updates=5, target_every_episodes=1), engine=engine)
    copied = []
    for _ in range(4):
        played(made, 5)
        made.end_episode(torch.tensor([True, True]))
        weights, targets = after(made)
        copied.append((made.lane_networks.updates, torch.equal(weights, targets)))
    # The first update is that of the 4th step.
    assert copied == [(2, False), (7, False), (12, False), (17, False)]
    (before, _), changed = after(made), []
    for _ in range(10):
        targets_before = after(made)[1]
        played(made, 1)
        changed.append(not torch.equal(targets_before, after(made)[1]))
    assert [step for step, did in enumerate(changed, 18) if did] == [20, 25]
    assert not torch.equal(before, after(made)[0])


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_schedules_go_on_from_a_state(engine):
    settings = replace(
        REPLAY, target_every_updates=6, learning_rate_end=1e-3, learning_rate_decay_steps=40, optimizer="sgd"
    )

    def trained(made, steps):
        train(CommonsEnv(GAME, 2, seed=3), {(0, 1): made}, Schedule(steps=steps))
        return made

    first = trained(learner(settings, engine=engine), 18)
    again = learner(settings, engine=engine)
    again.load_state_dict(deepcopy(first.state_dict()))
    assert again.lane_networks.learning_rate == first.lane_networks.learning_rate
    for each in (first, again):
        trained(each, 11)
    torch.testing.assert_close(after(first), after(again), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("algorithm", "network"),
    [(PPO, None), (A2C, None), (PPO, GRU(recurrent_cells=4)), (IPPO, None), (MAPPO, None)],
)
def test_turns_out_of_play_have_no_part_in_a_masked_loss(algorithm, network):
    """Whatever an agent did while out of play, its weights are the same; without the mask they differ."""

    def weights(only_in_play, action):
        settings = replace(ROLLOUTS, only_in_play=only_in_play, hidden_cells=(32, 32))
        is_team = algorithm in (IPPO, MAPPO)
        made = algorithm(settings=settings, network=network)
        reward = "team" if algorithm is MAPPO else "individual"
        lanes = {"agents": (0, 1), "replicas": 1, "seed": 7, "reward": reward, "are_teams": is_team}
        made = parts.make_learner(made, GAME.spaces, engine="eager", **lanes)
        turns = StepCollector(CommonsEnv(GAME, 1, seed=3), JointPolicy({(0, 1): made.actor}))
        out = torch.tensor([[False, True], [True, False]])
        for step, turn in zip(range(16), turns, strict=False):
            marked = out[step % 2] if step in (2, 3, 9) else torch.tensor([False, False])
            turn["agents", "in_play"] = ~marked[None]
            turn["agents", "action"] = torch.where(marked[None], action, turn["agents", "action"])
            made.store(turn)
            made.update()
        return after_rollouts(made)

    def after_rollouts(made):
        return torch.cat([value.flatten() for value in made.lane_networks.params.values()])

    torch.testing.assert_close(weights(True, 0), weights(True, 3), rtol=0, atol=0)
    assert not torch.equal(weights(False, 0), weights(False, 3))


def test_a_minibatch_of_turns_out_of_play_alone_changes_nothing_and_is_finite():
    made = learner(replace(ROLLOUTS, only_in_play=True, optimizer="sgd"), PPO)
    batch = made.memory.example(len(made.lanes))
    batch["in_play"] = torch.zeros_like(batch["in_play"])
    before = {name: value.clone() for name, value in made.lane_networks.params.items()}
    losses = parts.learn(made, batch)
    assert torch.equal(losses, torch.zeros_like(losses))
    assert all(torch.equal(before[name], value) for name, value in made.lane_networks.params.items())


def test_advantages_are_normalised_over_turns_in_play():
    shape = (1, 1, 6)
    columns = {
        "reward": torch.tensor([1.0, 2.0, 50.0, 4.0, -70.0, 3.0]).view(shape),
        "done": torch.ones(shape, dtype=torch.bool),
        "terminated": torch.ones(shape, dtype=torch.bool),
        "in_play": torch.tensor([True, True, False, True, False, True]).view(shape),
    }
    value = torch.zeros(*shape, 1)
    advantage, _ = advantages(columns, value, value, settings=ROLLOUTS, time_dim=2, over=(1, 2, 3))
    counted = advantage[columns["in_play"]]
    assert counted.mean().item() == pytest.approx(0, abs=1e-6)
    assert counted.std().item() == pytest.approx(1, abs=1e-6)


def test_what_schedules_cannot_be_is_refused_by_name():
    with pytest.raises(ValueError, match=r"target_every_updates is 10; allowed with tau 0\.1"):
        DQNSettings(tau=0.1, target_every_updates=10)
    with pytest.raises(ValueError, match="target_every_updates is 0; allowed"):
        DQNSettings(target_every_updates=0)
    with pytest.raises(ValueError, match="only_in_play is True"):
        learner(replace(ROLLOUTS, only_in_play=True), PPO, "torchrl")


def test_a_game_that_does_not_say_who_is_in_play_cannot_mask_turns():
    env = CommonsEnv(GAME, 1, seed=3)
    masked = Learning(PPO(settings=replace(ROLLOUTS, only_in_play=True)))
    Population(env, [masked, masked], engine="eager")
    unmarked = TransformedEnv(CommonsEnv(GAME, 1, seed=3), ExcludeTransform(("agents", "in_play")))
    with pytest.raises(ValueError, match="only_in_play is True; allowed in a game without the entry"):
        Population(unmarked, [masked, masked], engine="eager")
