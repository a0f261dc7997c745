"""DQN with a recurrent network: the sequences that its replay buffer gives, and what is learned from them."""

from dataclasses import replace

import pytest
import torch
from dqn_parts import make_learner
from test_population import GAME

from cprl import CommonsEnv, Custom
from cprl.algorithms import DQN, DQNSettings
from cprl.networks import GRU, LSTM, MLP, Conv
from cprl.policies.assignment import AgentPolicies
from cprl.training.collectors import StepCollector

SMALL = GRU(encoder=MLP(hidden_cells=(6,)), recurrent_cells=5)
LONG = LSTM(encoder=MLP(hidden_cells=(6,)), recurrent_cells=5)
CONV = GRU(encoder=Conv(channels=(3,), hidden_cells=(6,)), recurrent_cells=5)
SETTINGS = DQNSettings(
    buffer_size=60,
    batch_size=4,
    learning_starts=8,
    sequence_steps=6,
    learning_rate=1e-3,
    epsilon_hold_steps=0,
    epsilon_decay_steps=60,
    target_every_episodes=2,
)
DQNS = {
    "GRU": DQN(settings=SETTINGS, network=SMALL),
    "LSTM, double, log-cosh": DQN(settings=SETTINGS, network=LONG, double=True, loss_function="log_cosh"),
    "convolutions": DQN(settings=replace(SETTINGS, tau=0.1), network=CONV),
}
FOUR = (0, 1, 2, 3)


def made(algorithm, *, replicas=2, engine="eager"):
    return make_learner(algorithm, GAME.spaces, agents=FOUR, replicas=replicas, engine=engine)


def play(learner, steps):
    """Plays and stores so many turns; returns each, as it was played."""
    turns = iter(
        StepCollector(CommonsEnv(GAME, learner.replicas, seed=3), AgentPolicies({FOUR: learner.actor}))
    )
    played = []
    for _ in range(steps):
        played.append(next(turns).clone())
        learner.store(played[-1])
    return played


def of_lane(played, name, lane, after=False):
    """An entry of a lane in each turn."""
    turns = [turn["next"] if after else turn for turn in played]
    found = [turn["agents", name] if ("agents", name) in turn.keys(True) else turn[name] for turn in turns]
    return torch.stack([own.flatten(0, 1)[lane] if own.ndim > 2 else own[lane // 4] for own in found])


@pytest.mark.integration
@pytest.mark.parametrize("steps", [17, 200])
def test_a_sequence_is_what_was_played_from_some_turn_on(steps):
    """Also where the ring has come round three times; episodes last up to 12 turns, sequences 6."""
    learner = made(DQNS["GRU"])
    played = play(learner, steps)
    batch, starts = learner.buffer.sample(), []
    assert batch.batch_size == torch.Size([8, 4, 6])
    for lane in range(8):
        actions = torch.stack([turn["agents", "action"].flatten()[lane] for turn in played])
        seen = of_lane(played, "observation", lane)
        before = of_lane(played, "recurrent_state_before", lane)
        after = of_lane(played, "recurrent_state", lane)
        done = of_lane(played, "done", lane, after=True)[:, 0]
        for own in batch[lane]:
            fits = [
                place
                for place in range(max(0, steps - 60), steps - 5)
                if torch.equal(own["recurrent_state"], before[place : place + 6])
                and torch.equal(own["action"], actions[place : place + 6])
                and torch.equal(own["observation"], seen[place : place + 6])
            ]
            assert fits
            now = slice(fits[0], fits[0] + 6)
            starts.append(fits[0])
            assert torch.equal(own["next", "done"][:, 0], done[now])
            assert torch.equal(own["next", "recurrent_state"], after[now])
            seen_next = of_lane(played, "observation", lane, after=True)
            assert torch.equal(own["next", "observation"], seen_next[now])
            began = torch.cat([torch.tensor([True]), done[now][:-1]])
            assert torch.equal(own["is_init"], began)
            assert torch.equal(own["next", "is_init"], began)
    assert len(set(starts)) > 8 if steps > 20 else set(starts) <= set(range(12))


def test_every_turn_is_sampled_once_enough_follow_it():
    learner = made(DQNS["GRU"], replicas=1)
    play(learner, 100)
    oldest, written = learner.buffer.oldest()
    drawn = torch.cat([learner.buffer.draw() for _ in range(200)], 1)
    places = {int(place) % 60 for place in range(int(oldest[0]), written - 5)}
    assert set(drawn.flatten().tolist()) == places


@pytest.mark.integration
@pytest.mark.parametrize("double", [False, True])
def test_the_loss_is_that_of_a_network_that_goes_through_the_turns_by_itself(double):
    """One step of the network after the other, with the state of the one before, for the network and its
    targets, whose sequences are of the observations after each turn."""
    learner = made(replace(DQNS["GRU"], double=double))
    targets = learner.networks()  # copied to the targets at the end of an episode, which nobody tells here
    play(learner, 40)
    for _ in range(3):
        learner.update()
    networks, batch = learner.networks(), learner.buffer.sample()

    def values(network, turns):
        found, state = [], None
        for turn in turns:
            state = turn["recurrent_state"] if turn["is_init"] else state
            output, state = network(turn["observation"], state)
            found.append(output)
        return torch.stack(found)

    wanted = []
    for own, target, sequences in zip(networks.values(), targets.values(), batch, strict=True):
        errors = []
        for sequence in sequences:
            chosen = values(own, sequence).gather(-1, sequence["action"][:, None])[:, 0]
            after = values(target, sequence["next"])
            best = (values(own, sequence["next"]) if double else after).argmax(-1, keepdim=True)
            goes_on = ~sequence["next", "terminated"][:, 0]
            bootstrap = 0.995 * after.gather(-1, best)[:, 0] * goes_on
            errors.append(chosen - sequence["next", "reward"][:, 0] - bootstrap)
        wanted.append(torch.cat(errors).square().mean())
    found = learner.engine.update_from(batch)
    torch.testing.assert_close(found, torch.stack(wanted).detach())


@pytest.mark.parametrize("name", DQNS)
def test_the_fastest_engine_is_chosen_without_a_warning(name, recwarn):
    assert type(made(DQNS[name]).engine).__name__ == "FunctionalEngine"
    assert not recwarn.list


def test_the_value_after_a_turn_knows_the_turns_before():
    learner = made(DQNS["GRU"], replicas=1)
    played = play(learner, 30)
    network = learner.networks()["replica_0/agent_2"]
    state, place = torch.zeros(5), max(t for t, turn in enumerate(played[:-1]) if turn["next", "done"].any())
    for turn in played[place + 1 :]:
        _, state = network(turn["agents", "observation"][0, 2], state)
    expected, _ = network(played[-1]["next", "agents", "observation"][0, 2], state)
    assert len(played[place + 1 :]) > 1
    torch.testing.assert_close(learner.values(played[-1])[0, 2], expected.max())


SEQUENCES = {"sequence_steps": 4}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: made(DQN(settings=DQNSettings(), network=SMALL)), "sequence_steps is 1"),
        (lambda: made(DQN(settings=DQNSettings(**SEQUENCES))), "sequence_steps is 4"),
        (lambda: made(DQNS["GRU"], engine="torchrl"), "sequence_steps is 6"),
        (lambda: DQNSettings(sequence_steps=4, n_steps=2), "sequence_steps is 4"),
        (lambda: DQNSettings(sequence_steps=17), "sequence_steps is 17"),
        (
            lambda: DQNSettings(**SEQUENCES, replay_transforms=(Custom("torchrl.envs:RewardScaling"),)),
            "sequence_steps is 4",
        ),
    ],
)
def test_what_does_not_fit_is_refused_by_name(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()
