"""Agents with recurrent networks: what they remember, when they forget it, and how they learn from it, from
rollouts and from the sequences of a replay buffer."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from c51 import C51
from cql import CQL
from dqn_parts import learn, make_learner
from iql import IQL
from matrix_games import stag_hunt
from network_parts import VECTORS
from recall_game import Recall
from recurrent_learners import CONV, DQNS, FOUR, LONG, ON_POLICY, REPLAY, ROLLOUTS, SEQUENCES, SMALL, specs
from small_learners import GAME, Returns, population
from stock_collector import stock_collector
from stored_runs import returns
from tensordict import TensorDict
from torch import nn
from torchrl.envs import RewardScaling
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import GRUModule, LSTMModule, set_recurrent_mode

import cprl
from cprl import CommonsEnv, Custom, Experiment
from cprl.algorithms import (
    DQN,
    LOLA,
    MADDPG,
    PPO,
    PR2,
    QMIX,
    SAC,
    VDN,
    DQNSettings,
    LOLASettings,
    RolloutSettings,
)
from cprl.envs import make_env, spaces_of
from cprl.evaluation.film import record_episode
from cprl.evaluation.play import open_session
from cprl.experimental.movement import trace
from cprl.measuring.playing import evaluate
from cprl.networks import GRU, LSTM, MLP
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.policies.joint_policy import JointPolicy
from cprl.population import Learning
from cprl.training import Schedule, train
from cprl.training.training import StepCollector


def learner_of(algorithm, *, replicas=2, engine="eager"):
    return make_learner(algorithm, GAME.spaces, agents=FOUR, replicas=replicas, engine=engine)


def sequences(batch, steps, cells, *, seed=0):
    """States [batch, steps, cells] of which every third or so begins a sequence, and which do."""
    chance = torch.Generator().manual_seed(seed)
    is_init = torch.rand(batch, steps, generator=chance) < 0.3
    is_init[:, 0] = True
    return torch.rand(batch, steps, cells, generator=chance) - 0.5, is_init


def with_weights_of(network, layer):
    """A layer of torch with the weights of a network's recurrent one."""
    for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
        getattr(layer, f"{name}_l0").data.copy_(getattr(network.cell, name).data)
    return layer


@pytest.mark.parametrize(
    ("kind", "layer", "module", "names"),
    [(SMALL, nn.GRU, GRUModule, ["hidden"]), (LONG, nn.LSTM, LSTMModule, ["hidden", "memory"])],
)
def test_recurrent_layers_equal_those_of_torch_and_torchrl(kind, layer, module, names):
    """Torch's over a whole sequence, and TorchRL's module, which splits it where an episode begins."""
    network = kind.make(VECTORS, 3)
    layer = with_weights_of(network, layer(6, 5, batch_first=True))
    seen = torch.rand(4, 9, 6)
    given, is_init = sequences(4, 9, 5 * len(names))
    outputs, after = network(seen, given, torch.zeros(4, 9, dtype=torch.bool))
    first = tuple(part[None].contiguous() for part in given[:, 0].chunk(len(names), -1))
    expected, last = layer(network.encoder(seen), first if len(names) > 1 else first[0])
    torch.testing.assert_close(after[..., :5], expected)
    if len(names) > 1:
        torch.testing.assert_close(after[:, -1, 5:], last[1][0])
    torch.testing.assert_close(outputs, network.head(expected))
    played = module(
        **{layer._get_name().lower(): layer},
        in_keys=["seen", *names, "is_init"],
        out_keys=["out", *(("next", name) for name in names)],
    )
    entries = {"seen": network.encoder(seen), "is_init": is_init[..., None]}
    entries |= {name: torch.zeros(4, 9, 1, 5) for name in names}
    with set_recurrent_mode(True):
        out = played(TensorDict(entries, [4, 9]))["out"]
    torch.testing.assert_close(network(seen, torch.zeros(4, 9, 5 * len(names)), is_init)[1][..., :5], out)


@pytest.mark.parametrize("network", [SMALL, LONG, CONV])
def test_steps_one_by_one_give_what_a_sequence_gives(network):
    of_one = network.make(GAME.spaces, 8)
    seen = torch.randint(256, (2, 7, *GAME.observation_shape), dtype=torch.uint8)
    given, is_init = sequences(2, 7, *of_one.state_shape)
    outputs, after = of_one(seen, given, is_init)
    state = given[:, 0]
    for step in range(7):
        state = torch.where(is_init[:, step, None], given[:, step], state)
        output, state = of_one(seen[:, step], state)
        torch.testing.assert_close(output, outputs[:, step])
        torch.testing.assert_close(state, after[:, step])


@pytest.mark.parametrize("network", [SMALL, LONG, CONV])
def test_a_lane_of_a_stack_gives_and_learns_what_its_network_does_alone(network):
    networks = [network.make(GAME.spaces, 8) for _ in range(3)]
    stack = stack_lanes(networks)
    seen = torch.randint(256, (3, 7, *GAME.observation_shape), dtype=torch.uint8)
    given, is_init = sequences(3, 7, *stack.state_shape)
    outputs, after = stack(seen, given, is_init)
    flat = stack(seen.flatten(0, 1), given.flatten(0, 1), is_init.flatten())
    outputs.square().sum().backward()
    for lane, own in enumerate(networks):
        output, state = own(seen[lane], given[lane], is_init[lane])
        torch.testing.assert_close(outputs[lane], output)
        torch.testing.assert_close(after[lane], state)
        output.square().sum().backward()
        torch.testing.assert_close(stack.weights[2].grad[lane].T, own.cell.weight_hh.grad)
        torch.testing.assert_close(lane_state(stack, lane), dict(own.state_dict()), rtol=0, atol=0)
    torch.testing.assert_close(flat[0], outputs.flatten(0, 1))


def test_the_gradient_runs_through_time_and_ends_where_a_sequence_begins():
    network = SMALL.make(VECTORS, 3)
    seen = torch.rand(1, 6, 6, requires_grad=True)
    given, is_init = torch.zeros(1, 6, 5), torch.tensor([[True, False, False, True, False, False]])
    network(seen, given, is_init)[0][0, 5].sum().backward()
    reached = seen.grad[0].abs().sum(-1) > 0
    assert reached.tolist() == [False, False, False, True, True, True]


def batches(env, policy, steps, make=StepCollector):
    turns = iter(make(env, policy))
    return [next(turns).clone() for _ in range(steps)]


@pytest.mark.parametrize("kind", ["commons", "with transforms", "matrix", "own"])
def test_a_state_goes_from_turn_to_turn_and_is_zero_where_an_episode_begins(kind):
    env = {
        "commons": lambda: CommonsEnv(GAME, 2, seed=3),
        "with transforms": lambda: make_env(
            GAME, worlds=2, seed=3, transforms=[RewardScaling(0.0, 2.0, in_keys=[("agents", "reward")])]
        ),
        "matrix": lambda: make_env(stag_hunt(turns=5), worlds=2, seed=3),
        "own": lambda: make_env(Recall(turns=5), worlds=2, seed=3),
    }[kind]()
    learner = make_learner(
        ON_POLICY["PPO"], spaces_of(env), agents=range(spaces_of(env).agents), replicas=2, engine="eager"
    )
    policy = JointPolicy({learner.agents: learner.actor})
    played = batches(env, policy, 30)
    assert (played[0]["agents", "recurrent_state_before"] == 0).all()
    for before, now in pairwise(played):
        states, began = now["agents", "recurrent_state_before"], before["next", "done"][:, 0]
        assert (states[began] == 0).all()
        kept = before["agents", "recurrent_state"][~began]
        assert torch.equal(states[~began], kept)
        assert (kept != 0).any() or not len(kept)
    assert any(now["next", "done"].any() for now in played[:-1])


def test_rollouts_and_collectors_of_torchrl_carry_and_reset_states_too():
    env = CommonsEnv(GAME, 2, seed=3)
    learner = learner_of(ON_POLICY["PPO"])
    policy = JointPolicy({FOUR: learner.actor})
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        played = env.rollout(30, policy, break_when_any_done=False)
    (collected,) = batches(
        CommonsEnv(GAME, 2, seed=3), policy, 1, lambda *how: stock_collector(*how, steps=30)
    )
    for found in (played, collected):
        states = found["agents", "recurrent_state_before"]
        began = torch.cat([torch.ones(2, 1, dtype=torch.bool), found["next", "done"][:, :-1, 0]], 1)
        assert began.sum() > 2
        assert (states[began] == 0).all()
        assert ((states != 0).flatten(2).any(-1) == ~began).all()


def test_a_rollout_is_evaluated_as_it_was_played_across_rollouts_and_episodes():
    """The logits of `_batch` are those by which agents acted; so are those of any minibatch's own states."""
    env = CommonsEnv(GAME, 2, seed=3)
    learner = learner_of(ON_POLICY["PPO"])
    policy = JointPolicy({FOUR: learner.actor})
    turns = iter(StepCollector(env, policy))
    for _ in range(3):  # episodes last 12 turns, rollouts 20
        acted = []
        for _ in range(20):
            batch = next(turns)
            learner.store(batch)
            before = batch["agents", "recurrent_state_before"]
            acted.append(learner.actor.action_values(batch["agents", "observation"], before))
        found = learner.memory._batch(learner.lane_networks)
        chances = torch.stack(acted, 1).flatten(0, 0).transpose(1, 2).flatten(0, 1)  # [R, T, S, A] to lanes
        chosen = chances.gather(-1, found["action"].unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(found["action_log_prob"], chosen.log())
        assert found["is_init"][:, [0, 10]].all()
        half = found[:, 10:]
        network = learner.networks()["replica_1/agent_2"]
        logits, _ = network(half["observation"][6], half["recurrent_state"][6], half["is_init"][6])
        own = logits.log_softmax(-1).gather(-1, half["action"][6][:, None])[:, 0]
        torch.testing.assert_close(own, half["action_log_prob"][6])
        assert (half["recurrent_state"][6, 0] != 0).any()
        learner.memory.rollout.size = 0  # the same weights play on


def test_the_critic_goes_on_from_rollout_to_rollout_and_values_the_state_after_each_turn():
    """Its values are those of its network over the whole history, the last observation of an episode too."""
    env = make_env(Recall(turns=7), worlds=1)
    settings = replace(ROLLOUTS, rollout_steps=10, minibatch_size=5)
    learner = make_learner(
        PPO(settings=settings, network=SMALL), spaces_of(env), agents=(0,), replicas=1, engine="eager"
    )
    policy = JointPolicy({(0,): learner.actor})
    turns, played = iter(StepCollector(env, policy)), []
    critic = dict(learner.lane_networks.parts)["critic"]

    def wanted(history):
        """The value after the latest turn, step by step since its episode began."""
        since = [place for place, own in enumerate(history[:-1]) if own["next", "done"].any()]
        state = torch.zeros(1, 1, 5)
        for own in history[since[-1] + 1 if since else 0 :]:
            _, state = critic(own["agents", "observation"], state)
        return critic(history[-1]["next", "agents", "observation"], state)[0]

    for _ in range(30):
        played.append(next(turns))
        learner.store(played[-1])
        torch.testing.assert_close(learner.values(played[-1]), wanted(played)[0])
        if learner.memory.rollout.is_full:
            memory = learner.memory
            _, _, next_value, _ = memory.states.evaluate(learner.lane_networks, memory.rollout.fields)
            torch.testing.assert_close(next_value[0, 0, -1:], wanted(played)[0])
            learner.memory.rollout.size = 0
            torch.testing.assert_close(learner.values(played[-1]), wanted(played)[0])


def play(learner, steps):
    """Plays and stores so many turns; returns each, as it was played."""
    env = CommonsEnv(GAME, learner.replicas, seed=3)
    played = batches(env, JointPolicy({FOUR: learner.actor}), steps)
    for turn in played:
        learner.store(turn)
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
    learner = learner_of(DQNS["GRU"])
    played = play(learner, steps)
    batch, starts = learner.memory.buffer.sample(), []
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
    learner = learner_of(DQNS["GRU"], replicas=1)
    play(learner, 100)
    oldest, written = learner.memory.buffer.oldest()
    drawn = torch.cat([learner.memory.buffer.places()[0] for _ in range(200)], 1)
    places = {int(place) % 60 for place in range(int(oldest[0]), written - 5)}
    assert set(drawn.flatten().tolist()) == places


@pytest.mark.integration
@pytest.mark.parametrize("double", [False, True])
def test_the_loss_is_that_of_a_network_that_goes_through_the_turns_by_itself(double):
    """One step of the network after the other, with the state of the one before, for the network and its
    targets, whose sequences are of the observations after each turn."""
    learner = learner_of(replace(DQNS["GRU"], double=double))
    targets = learner.networks()  # copied to the targets at the end of an episode, which nobody tells here
    play(learner, 40)
    for _ in range(3):
        learner.update()
    networks, batch = learner.networks(), learner.memory.buffer.sample()

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
    found = learn(learner, batch)
    torch.testing.assert_close(found, torch.stack(wanted).detach())


def test_the_value_of_dqn_after_a_turn_knows_the_turns_before():
    learner = learner_of(DQNS["GRU"], replicas=1)
    played = play(learner, 30)
    network = learner.networks()["replica_0/agent_2"]
    state, place = torch.zeros(5), max(t for t, turn in enumerate(played[:-1]) if turn["next", "done"].any())
    for turn in played[place + 1 :]:
        _, state = network(turn["agents", "observation"][0, 2], state)
    expected, _ = network(played[-1]["next", "agents", "observation"][0, 2], state)
    assert len(played[place + 1 :]) > 1
    torch.testing.assert_close(learner.values(played[-1])[0, 2], expected.max())


@pytest.mark.parametrize("name", ["PPO", "MAPPO"])
def test_members_that_share_a_recurrent_network_each_have_a_state(name):
    agents = population(specs(name, shares=True))
    played = batches(CommonsEnv(GAME, 2, seed=9), agents.policy(1), 4)[-1]
    states = played["agents", "recurrent_state"]
    assert len({tuple(own) for own in states.flatten(0, 1).tolist()}) == 8


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A run of recurrent agents of two sizes beside others that are not."""
    folder = tmp_path_factory.mktemp("recurrent")
    larger = replace(ON_POLICY["PPO"], network=LSTM(encoder=MLP(hidden_cells=(4,)), recurrent_cells=7))
    made = ON_POLICY["PPO"], larger, DQN(settings=REPLAY), ON_POLICY["PPO"]
    how = {"replicas": 2, "episodes": 3, "seed": 3, "evaluation_episodes": 2, "engine": "eager"}
    experiment = Experiment(name="recurrent", game=GAME, agents=[Learning(each) for each in made], **how)
    return experiment, cprl.run(experiment, folder / "run", watch="off")


@pytest.mark.integration
def test_a_stored_run_is_loaded_evaluated_filmed_and_played_against(ran):
    experiment, run = ran
    loaded = cprl.load(run)
    assert loaded.experiment == experiment
    fresh = cprl.Fresh(episodes=3)
    found = cprl.evaluate_run(run, fresh)
    for replica in (0, 1):
        alone = evaluate(
            loaded.env(3, seed=fresh.seed, first_world=3 * replica),
            loaded.policy(replica, worlds=3, seed=fresh.seed),
            explore=True,
        )
        for one, other in zip(returns(found, policy="trained")[replica], alone, strict=True):
            assert np.array_equal(one, other.return_)
    recording, _ = record_episode(run)
    assert recording.stat().st_size > 10_000
    session = open_session(str(run), agent=2, steps=5)
    for _ in range(5):
        session.act("forward")
    assert session.has_ended
    moved = trace(loaded.env(2, seed=5), loaded.policy(worlds=2), explore=False)
    greedy = evaluate(loaded.env(2, seed=5), loaded.policy(worlds=2))
    assert [int(own.steps) for own in greedy] == moved.played.sum(0).tolist()


def test_states_of_other_policies_are_refused(ran):
    policy = cprl.load(ran[1]).policy()
    moment = cprl.load(ran[1]).env().reset()
    moment["agents", "recurrent_state"] = torch.zeros(1, 4, 5)
    with pytest.raises(ValueError, match=r"is \[1, 4, 5\]"):
        policy(moment)


OF_ONE_SIZE = GRU(recurrent_cells=4), LSTM(recurrent_cells=3)
OF_TURNS = (C51, CQL, SAC, IQL, PR2, VDN, QMIX, MADDPG, LOLA)


@pytest.mark.parametrize("network", [SMALL, LONG])
@pytest.mark.parametrize("kind", OF_TURNS)
def test_algorithms_that_learn_from_single_transitions_are_refused_by_name(kind, network):
    settings = LOLASettings() if kind is LOLA else REPLAY
    refused = rf"{kind.__name__}.network is (GRU|LSTM).*does not learn from sequences"
    with pytest.raises(ValueError, match=refused):
        kind(settings=settings, network=network)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: GRU(encoder=MLP(hidden_cells=())), "GRU.encoder is a MLP"),
        (lambda: GRU(encoder=SMALL), "GRU.encoder is a GRU"),
        (lambda: SMALL.make(VECTORS, 3, relu_on_outputs=True), "relu_on_outputs is True"),
        (lambda: learner_of(ON_POLICY["PPO"], engine="torchrl"), "recurrent"),
        (lambda: learner_of(DQNS["GRU"], engine="torchrl"), "sequence_steps is 6"),
        (lambda: learner_of(DQN(settings=DQNSettings(), network=SMALL)), "sequence_steps is 1"),
        (lambda: learner_of(DQN(settings=SEQUENCES)), "sequence_steps is 6"),
        # Four gates of three units are as many numbers as three gates of four.
        (lambda: stack_lanes([cell.make(GAME.spaces, 8) for cell in OF_ONE_SIZE]), "2 architectures"),
        (lambda: replace(SEQUENCES, n_steps=2), "sequence_steps is 6"),
        (lambda: DQNSettings(sequence_steps=17), "sequence_steps is 17"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()


STACKED = Custom(
    "torchrl.envs.transforms:CatFrames", arguments={"N": 3, "dim": -3, "in_keys": [["agents", "observation"]]}
)


def test_latest_observations_are_stacked_by_a_transform():
    """CatFrames: three windows, the oldest first; an episode begins with its first one three times."""
    env = make_env(GAME, worlds=2, seed=3, transforms=[STACKED])
    assert spaces_of(env).observation_shape == (9, 3, 5)
    plain = CommonsEnv(GAME, 2, seed=3)
    seen, carried, bare, began = [], env.reset(), plain.reset(), torch.ones(2, 1)
    for turn in range(26):
        now = carried["agents", "observation"].unflatten(2, (3, 3))
        assert torch.equal(now[:, :, -1], bare["agents", "observation"])
        if not began.any():
            assert torch.equal(now[:, :, :-1], seen[-1][:, :, 1:])
        if began.all():
            assert torch.equal(now, now[:, :, -1:].expand_as(now))
        seen.append(now)
        action = torch.full((2, 4), turn % 8)
        carried["agents", "action"], bare["agents", "action"] = action, action.clone()
        batch, carried = env.step_and_maybe_reset(carried)
        _, bare = plain.step_and_maybe_reset(bare)
        began = batch["next", "done"]


BY_ROLLOUTS = RolloutSettings(rollout_steps=64, minibatch_size=32, learning_rate=1e-2, gamma=0.9)
BY_REPLAY = DQNSettings(
    batch_size=16,
    learning_rate=3e-3,
    gamma=0.9,
    buffer_size=4000,
    learning_starts=64,
    epsilon_hold_steps=0,
    epsilon_decay_steps=1000,
    epsilon_end=0.02,
    target_every_episodes=10,
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "settings", "episodes"), [(PPO, BY_ROLLOUTS, 500), (DQN, BY_REPLAY, 600)]
)
def test_memory_is_what_a_game_of_recall_needs(algorithm, settings, episodes):
    """The cue of the first of four turns says which of two actions pays in the last: 1, blindly 0.5."""

    def reached(network, **changes):
        env = make_env(Recall(turns=4), worlds=8)
        made = algorithm(settings=replace(settings, **changes), network=network)
        learner = make_learner(made, spaces_of(env), agents=(0,), replicas=8, engine="eager")
        returns = Returns()
        train(env, {(0,): learner}, Schedule(episodes=episodes), callbacks=[returns])
        return [float(np.mean(own[-100:])) for own in returns.of.values()]

    turns = {"sequence_steps": 6} if algorithm is DQN else {}
    for kind in (GRU, LSTM):
        remembering = reached(kind(encoder=MLP(hidden_cells=(8,)), recurrent_cells=8), **turns)
        assert sorted(remembering)[1] > 0.9, (kind, remembering)
    assert max(reached(MLP(hidden_cells=(16,)))) < 0.7
