"""A replica that learns from many worlds: what it stores, samples, learns and counts, beside work by hand."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from dqn_parts import MEADOW, learn, make_learner, watch_steps, weights_at
from torch.nn import functional

import cprl
from cprl import CommonsEnv, Experiment, Game, Rules, Study, algorithms, maps
from cprl.algorithms import DQN, PPO, DQNSettings, LOLASettings, RolloutSettings
from cprl.commands.recipe_command import parse_command
from cprl.envs.make_env import make_env
from cprl.learners.ring import Ring
from cprl.learners.transitions import Horizon, LaneTurn, TransitionForm
from cprl.measuring.series import Series
from cprl.measuring.tracker import Episode
from cprl.networks import GRU
from cprl.population import Learning, Team
from cprl.runs.episodes import read_episodes, read_table
from cprl.runs.schedule import Schedule
from cprl.training.agents import Population
from cprl.training.training import Training

WORLDS = 3
SETTINGS = DQNSettings(
    buffer_size=150,
    batch_size=8,
    learning_rate=1e-3,
    hidden_cells=(8,),
    epsilon_hold_steps=20,
    epsilon_decay_steps=100,
    target_every_episodes=4,
    steps_per_update=3,
)
ROLLOUTS = RolloutSettings(rollout_steps=10, minibatch_size=10, learning_rate=1e-3, hidden_cells=(8,))
SEQUENCES = replace(SETTINGS, sequence_steps=4, hidden_cells=(32, 32))
CELLS = GRU(recurrent_cells=5)
AGENTS = {
    "DQN": (Learning(DQN(settings=SETTINGS)),) * 2,
    "DQN, three steps": (Learning(DQN(settings=replace(SETTINGS, n_steps=3, tau=0.1))),) * 2,
    "DQN, recurrent": (Learning(DQN(settings=SEQUENCES, network=CELLS)),) * 2,
    "PPO": (Learning(PPO(settings=ROLLOUTS)),) * 2,
    "PPO, recurrent": (
        Learning(PPO(settings=replace(ROLLOUTS, minibatch_size=30, hidden_cells=(32, 32)), network=CELLS)),
    )
    * 2,
    "QMIX": (Team(algorithms.QMIX(settings=SETTINGS), agents=(0, 1), reward="team"),),
    "LOLA": (Team(algorithms.LOLA(settings=LOLASettings(rollout_steps=10, critic_epochs=2)), agents=(0, 1)),),
    "tabular": (Learning(algorithms.Tabular(settings=algorithms.TabularSettings(epsilon_decay_steps=100))),)
    * 2,
}
EXACT = {"DQN", "DQN, three steps", "QMIX", "tabular"}
"""Those whose products do not depend on how many replicas are beside them."""


class Record:
    def __init__(self):
        self.episodes = []

    def on_episode(self, episode, learning):
        self.episodes.append((episode, learning))


def training(agents, *, replicas=2, first=0, worlds=WORLDS, game=MEADOW, callbacks=(), **length):
    env = make_env(game, worlds=replicas * worlds, seed=4, first_world=first * worlds)
    population = Population(env, agents, seed=4, worlds=worlds, first_replica=first, engine="eager")
    schedule = Schedule(worlds=worlds, **(length or {"steps": 40 * worlds}))
    made = Training(env, population.learners, schedule, others=population.others, callbacks=callbacks)
    return population, made


def weights(learners):
    states = [learner.state_dict()["networks"] for learner in learners]
    return {
        f"{lane}/{name}": value.clone()
        for state in states
        for lane, network in state.items()
        for name, value in network.items()
    }


@pytest.mark.integration
@pytest.mark.parametrize("name", AGENTS)
def test_a_replica_of_many_worlds_is_what_it_would_be_alone_and_goes_on_from_its_state(name):
    both, alone = training(AGENTS[name]), training(AGENTS[name], replicas=1, first=1)
    stopped, resumed = training(AGENTS[name]), training(AGENTS[name])
    before = weights(both[0].learners.values())
    for _, run in (both, alone):
        run.run()
    after, of_one = (weights(population.learners.values()) for population, _ in (both, alone))
    assert set(of_one) == {lane for lane in after if lane.startswith("replica_1")}
    tolerance = {"rtol": 0, "atol": 0} if name in EXACT else {"rtol": 1e-4, "atol": 1e-5}
    torch.testing.assert_close({lane: after[lane] for lane in of_one}, of_one, **tolerance)
    assert any(not torch.equal(after[lane], before.get(lane)) for lane in of_one)
    for _ in range(17):
        stopped[1].step()
    resumed[1].load_state_dict(stopped[1].state_dict())
    resumed[1].run()
    torch.testing.assert_close(weights(resumed[0].learners.values()), after, rtol=0, atol=0)
    assert both[1].steps == resumed[1].steps == 40 * WORLDS


def test_steps_are_counted_over_worlds_and_episodes_over_the_replica():
    settings = replace(SETTINGS, steps_per_update=1, learning_starts=10)
    record = Record()
    population, run = training((Learning(DQN(settings=settings)),) * 2, episodes=7, callbacks=[record])
    (learner,) = population.learners.values()
    updates = watch_steps(learner, lambda draw: run.steps)
    while not run.is_over:
        run.step()
        assert learner.steps == run.steps
        assert learner.actor.epsilon == pytest.approx(settings.epsilon(run.steps))
    turns = run.steps // WORLDS
    assert updates == [WORLDS * turn for turn in range(4, turns + 1) for _ in range(WORLDS)]
    episodes = [episode for episode, _ in record.episodes]
    for replica in range(2):
        of_replica = [episode for episode in episodes if episode.replica == replica]
        assert [episode.episode for episode in of_replica] == list(range(7))
        worlds = [episode.world for episode in of_replica]
        assert {world // WORLDS for world in worlds} == {replica}
        assert worlds[:3] == sorted(worlds[:3]), "of one turn in the order of their worlds"
    assert run.episodes_played == 14
    assert all(np.isfinite(learning["agent_1/loss"]) for _, learning in record.episodes)


def test_a_training_of_steps_ends_with_the_turn_that_has_them():
    _, run = training(AGENTS["DQN"], steps=100)
    run.run()
    assert run.steps == 102
    with pytest.raises(ValueError, match="episodes is 3 and steps 4"):
        training(AGENTS["DQN"], steps=4, episodes=3)


def test_fewer_updates_than_turns_and_targets_by_the_episodes_of_a_replica():
    settings = replace(SETTINGS, steps_per_update=7, learning_starts=10)
    population, run = training((Learning(DQN(settings=settings)),) * 2, steps=300)
    (learner,) = population.learners.values()
    updates, copies = watch_steps(learner, lambda draw: run.steps), []
    copy = learner.lane_networks.copy_to_targets
    learner.lane_networks.copy_to_targets = lambda due: copies.append((run.steps, due.tolist())) or copy(due)
    run.run()
    # From the turn on that has 10 steps, 12, of which the steps of that turn count.
    assert updates == [
        next(s for s in range(9, 400, 3) if s >= 9 + 7 * nth) for nth in range(1, len(updates) + 1)
    ]
    assert len(updates) == (300 - 9) // 7
    # All three worlds end with their clock, of 12 turns: episodes 3, 6, 9, .., and 4, 8 and 12 are crossed.
    assert [steps for steps, _ in copies] == [36 * nth for nth in (2, 3, 4, 6, 7, 8)]
    assert all(all(due) for _, due in copies)


def row(lanes, worlds, step):
    """A turn of lanes in worlds whose observation says the lane, world and step; ends differ by world."""
    world, lane = np.divmod(np.arange(lanes * worlds), lanes)
    done = (step + 1) % (5 + world) == 0
    now, following = (np.stack([lane, world, np.full_like(lane, at)], 1) for at in (step, step + 1))
    fields = (
        now.astype(np.uint8),
        lane * 100 + world,
        following.astype(np.uint8),
        (step + world).astype(np.float32),
    )
    return LaneTurn(*fields, done, done & (world == 1))


@pytest.mark.parametrize("horizon", [None, Horizon(3, 0.9)])
def test_a_ring_samples_every_transition_of_every_world_evenly(horizon):
    lanes, worlds, turns = 2, 3, 20
    form = TransitionForm(observation_shape=(3,), horizon=horizon)
    columns = torch.arange(lanes * worlds).view(worlds, lanes).T
    ring = Ring(form, seeds=[(7, 0), (7, 1)], transitions=62, batch_size=50, columns=columns)
    assert ring.capacity == turns
    for step in range(43):
        ring.write(row(lanes, worlds, step))
    oldest = ring.oldest()[0]
    stored = {
        (world, step)
        for world in range(worlds)
        for step in range(int(oldest[2 * world]), 43 - (2 if horizon else 0))
    }
    assert len({int(oldest[2 * world]) for world in range(worlds)}) > 1 or len(stored) >= 54
    counts = [dict.fromkeys(stored, 0) for _ in range(lanes)]
    for _ in range(400):
        batch = ring.sample()
        for lane in range(lanes):
            seen = batch["observation"][lane].long()
            assert (seen[:, 0] == lane).all()
            assert torch.equal(batch["action"][lane], 100 * lane + seen[:, 1])
            ahead = batch["next", "observation"][lane].long() - seen
            assert (ahead[:, :2] == 0).all()
            if horizon is None:
                assert (ahead[:, 2] == 1).all()
                assert torch.equal(batch["next", "reward"][lane, :, 0], (seen[:, 1] + seen[:, 2]).float())
            for _, world, step in seen.tolist():
                counts[lane][world, step] += 1
    for of_lane in counts:
        expected = 400 * 50 / len(stored)
        assert all(abs(count - expected) < 6 * expected**0.5 for count in of_lane.values())
    assert counts[0] != counts[1]


def turns_of(worlds, count, game=MEADOW):
    """So many turns of random play, each a batch [B]."""
    return CommonsEnv(game, worlds, seed=3).rollout(count, break_when_any_done=False).unbind(1)


def learner_of(algorithm, worlds, **how):
    return make_learner(
        algorithm, MEADOW.spaces, engine="eager", agents=(0, 1), replicas=1, worlds=worlds, **how
    )


def linear(network, seen):
    """The outputs of a network without hidden layers for observations [n, C, X, Y]."""
    (layer,) = network.linears
    return functional.linear(seen.flatten(1).float() / 255, layer.weight, layer.bias)


def test_an_update_of_dqn_in_two_worlds_is_the_one_by_hand():
    settings = DQNSettings(
        buffer_size=40, batch_size=6, hidden_cells=(), learning_rate=0.5, optimizer="sgd", gamma=0.9,
        learning_starts=10, steps_per_update=22,
    )  # fmt: skip
    learner, played = learner_of(DQN(settings=settings), 2), turns_of(2, 15)
    networks = learner.networks()
    for turn in played:
        learner.store(turn)
    numbers = learner.memory.buffer.rng.next().clone()  # by which the update would draw
    learner.memory.buffer.rng._used -= 1
    losses = learner.update()
    for agent in range(2):
        network = networks[f"replica_0/agent_{agent}"]
        # The numbers count through the 15 transitions of world 0, then those of world 1.
        drawn = [divmod(int(number * 30), 15) for number in numbers[agent]]
        assert len({world for world, _ in drawn}) == 2
        errors = []
        for world, step in drawn:
            turn = played[step][world]
            after = turn["next"]
            with torch.no_grad():
                best = linear(network, after["agents", "observation"][agent][None]).max()
            reward, goes_on = after["agents", "reward"][agent, 0], ~after["terminated"][0]
            value = linear(network, turn["agents", "observation"][agent][None])[
                0, turn["agents", "action"][agent]
            ]
            errors.append((reward + 0.9 * goes_on * best - value) ** 2)
        loss = torch.stack(errors).mean()
        loss.backward()
        torch.testing.assert_close(losses[0, agent], loss.detach())
        found = learner.networks()[f"replica_0/agent_{agent}"]
        for own, wanted in zip(found.parameters(), network.parameters(), strict=True):
            torch.testing.assert_close(
                own.detach(), wanted.detach() - 0.5 * wanted.grad, rtol=1e-5, atol=1e-6
            )


def test_an_update_of_ppo_in_two_worlds_is_the_one_by_hand():
    settings = RolloutSettings(
        rollout_steps=14, minibatch_size=28, epochs=1, hidden_cells=(), learning_rate=0.5, optimizer="sgd",
        gamma=0.9, gae_lambda=0.8, max_grad_norm=None,
    )  # fmt: skip
    algorithm = PPO(settings=settings, entropy_coeff=0.0, critic_coeff=0.5)
    learner, played = learner_of(algorithm, 2), turns_of(2, 14)
    actors = learner.networks()
    critics = [
        {
            name: value.clone()
            for name, value in weights_at(learner.lane_networks, agent).items()
            if "critic" in name
        }
        for agent in range(2)
    ]
    for turn in played:
        learner.store(turn)
    learner.update()
    for agent in range(2):
        actor = actors[f"replica_0/agent_{agent}"]
        weight, bias = (
            next(value for name, value in critics[agent].items() if name.endswith(part))
            for part in ("weights.0", "biases.0")
        )

        def value_of(seen, weight=weight, bias=bias):
            return (seen.flatten().float() / 255 @ weight + bias.flatten())[0]

        advantages, chances = [], []
        for world in range(2):
            gain = 0.0
            for turn in reversed(played):
                now, after = turn[world], turn[world]["next"]
                value = value_of(now["agents", "observation"][agent])
                following = value_of(after["agents", "observation"][agent])
                reward = after["agents", "reward"][agent, 0]
                delta = reward + 0.9 * following * ~after["terminated"][0] - value
                gain = delta + 0.9 * 0.8 * ~after["done"][0] * gain
                logits = linear(actor, now["agents", "observation"][agent][None])[0]
                chances.append(logits.log_softmax(-1)[now["agents", "action"][agent]])
                advantages.append(gain)
        gains = torch.stack(advantages)
        gains = (gains - gains.mean()) / (gains.std() + 1e-8)
        chances = torch.stack(chances)
        (-gains.detach() * (chances - chances.detach()).exp()).mean().backward()
        found = learner.networks()[f"replica_0/agent_{agent}"]
        for own, wanted in zip(found.parameters(), actor.parameters(), strict=True):
            torch.testing.assert_close(
                own.detach(), wanted.detach() - 0.5 * wanted.grad, rtol=1e-4, atol=1e-6
            )


def in_two_orders(algorithm):
    """Two learners that have stored the same turns of three worlds, the second with its worlds permuted."""
    one, other = (learner_of(algorithm, 3) for _ in range(2))
    for turn in turns_of(3, 14):
        one.store(turn)
        other.store(turn[torch.tensor([2, 0, 1])])
    return one, other


def test_the_same_experience_in_another_order_of_worlds_gives_the_same_update():
    whole = RolloutSettings(rollout_steps=14, minibatch_size=42, epochs=2, hidden_cells=(8,))
    one, other = in_two_orders(PPO(settings=whole))
    torch.testing.assert_close(one.update(), other.update(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(weights([one]), weights([other]), rtol=0, atol=1e-5)

    one, other = in_two_orders(DQN(settings=replace(SETTINGS, learning_starts=30)))
    places = torch.arange(14).repeat(2, 3)
    for learner in (one, other):  # of all that is stored
        worlds = learner.memory.buffer.columns.repeat_interleave(14, 1)
        learn(learner, learner.memory.buffer.get(places, worlds))
    torch.testing.assert_close(weights([one]), weights([other]), rtol=0, atol=1e-5)


def test_worlds_that_settings_do_not_fit_are_refused_by_name():
    def made(algorithm, **how):
        return Experiment(name="x", game=MEADOW, agents=(Learning(algorithm),) * 2, episodes=1, **how)

    with pytest.raises(ValueError, match=r"agents\[0\].algorithm.settings: .*minibatch_size is 40"):
        made(PPO(settings=RolloutSettings(rollout_steps=20, minibatch_size=40)), worlds=3)
    made(PPO(settings=RolloutSettings(rollout_steps=20, minibatch_size=40)), worlds=4)
    with pytest.raises(ValueError, match="buffer_size is 100; allowed in 64 worlds: 128 or more"):
        made(DQN(settings=DQNSettings(buffer_size=100)), worlds=64)
    with pytest.raises(ValueError, match="worlds is 4194304"):
        made(DQN(settings=SETTINGS), worlds=2**22)
    with pytest.raises(ValueError, match="episodes is 1 and steps 5"):
        made(DQN(settings=SETTINGS), steps=5)


@pytest.mark.integration
def test_what_compiled_pieces_of_a_rollout_say_is_what_the_networks_say():
    """Also where episodes end within the rollout, in some worlds earlier than in others."""
    short = Game(
        map=maps.parse(">A<"),
        rules=Rules(
            regrow_prob=(0.0, 0.0, 0.0), window_rows=3, window_columns=5, episode_steps=9, freeze_steps=2
        ),
    )
    settings = RolloutSettings(rollout_steps=20, minibatch_size=10, hidden_cells=(8,))
    compiled, eager = (
        make_learner(PPO(settings=settings), short.spaces, agents=(0, 1), replicas=1, worlds=4, engine=engine)
        for engine in ("compiled", "eager")
    )
    turns = turns_of(4, 20, short)
    for turn in turns:
        compiled.store(turn)
        eager.store(turn)
    ends = {tuple(turn["next", "done"].flatten().tolist()) for turn in turns}
    assert len(ends) > 2, "they end at times of their own"
    columns = compiled.memory.rollout.fields
    seen, following = columns["observation"], columns["next_observation"]
    assert torch.equal(seen[1, 2], torch.stack([turn["agents", "observation"][2, 1] for turn in turns]))
    actors, critics = (partial(compiled.lane_networks.outputs, part=part) for part in (0, 1))
    by_networks = actors(seen), critics(seen), critics(following)
    torch.testing.assert_close(
        compiled.memory._evaluate(compiled.lane_networks), by_networks, rtol=1e-4, atol=1e-5
    )
    torch.testing.assert_close(compiled.update(), eager.update(), rtol=1e-4, atol=1e-5)


# A whole run


def experiment(**changes):
    length = {} if {"steps", "episodes"} & set(changes) else {"episodes": 20}
    values = {
        "replicas": 2,
        "worlds": WORLDS,
        "evaluation_episodes": 2,
        "engine": "eager",
        **length,
        **changes,
    }
    return Experiment(name="many", game=MEADOW, agents=AGENTS["DQN"], **values)


def rows_of(run):
    return read_episodes(run).sort_by([(name, "ascending") for name in ("replica", "episode", "agent")])


def written(table):
    """A table as text, in which what is undefined is the same."""
    return repr(table.to_pydict())


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("many") / "run"
    return cprl.run(experiment(), out)


@pytest.mark.integration
def test_a_run_has_a_row_for_each_episode_of_each_replica_with_its_world(finished):
    rows = rows_of(finished).to_pydict()
    places = list(zip(rows["replica"], rows["episode"], rows["agent"], strict=True))
    assert places == [(r, e, a) for r in range(2) for e in range(20) for a in range(2)]
    assert {world // WORLDS == replica for world, replica in zip(rows["world"], rows["replica"], strict=True)}
    assert set(rows["world"]) == set(range(2 * WORLDS))
    report = json.loads((finished / "report.json").read_text())
    turns, left = divmod(report["steps"], WORLDS)
    assert (report["worlds"], left) == (WORLDS, 0)
    assert turns * WORLDS >= sum(rows["steps"][: 20 * 2 : 2])
    evaluation = read_table(finished / "evaluation" / "trained.parquet")
    assert "world" not in evaluation.column_names
    assert evaluation.num_rows == 2 * 2 * 2
    assert (finished / "run.rrd").exists()
    again = cprl.load(finished)
    assert again.experiment == experiment()


@pytest.mark.integration
@pytest.mark.parametrize(
    ("short", "whole"), [({"episodes": 5}, {"episodes": 20}), ({"steps": 60}, {"steps": 200})]
)
def test_a_run_that_is_extended_equals_one_that_was_begun_as_long(short, whole, tmp_path):
    """Also where more episodes end in the last turn than were asked for."""
    longer = cprl.run(experiment(**whole), tmp_path / "whole", watch="off")
    run = cprl.run(experiment(**short), tmp_path / "run", watch="off", keep_checkpoint=True)
    before = rows_of(run)
    cprl.run(experiment(**whole), run, resume=True, watch="off")
    assert written(rows_of(run)) == written(rows_of(longer))
    assert before.num_rows < rows_of(run).num_rows
    for path in ("evaluation/trained.parquet", "evaluation/random.parquet"):
        assert written(read_table(run / path)) == written(read_table(longer / path))
    with pytest.raises(ValueError, match=r"worlds"):
        cprl.run(experiment(**whole, worlds=2), run, resume=True, watch="off")


@pytest.mark.integration
def test_a_study_varies_worlds_and_its_table_counts_the_steps_of_replicas(tmp_path):
    study = Study(experiment(steps=60, replicas=1), {"worlds": [1, 3]})
    results = cprl.run_study(study, tmp_path / "study")
    table = results.table
    assert {name: lengths["steps"] for name, lengths in table.lengths.items()} == {
        "worlds=1": (60, 60),
        "worlds=3": (60, 60),
    }
    assert not table.missing_runs


@pytest.mark.integration
def test_steps_in_which_no_episode_ends_make_a_finished_run_and_a_table_says_so(tmp_path, capsys, curves):
    run = cprl.run(experiment(steps=30), tmp_path / "run", watch="off")
    assert "No training curve: a replica has ended no episode in 30 steps" in capsys.readouterr().out
    assert json.loads((run / "report.json").read_text())["episodes"] == [0, 0]
    assert not (run / "figures").exists()
    study = Study(experiment(steps=30, replicas=1), conditions={"long": {"steps": 90}, "short": {}})
    table = cprl.run_study(study, tmp_path / "study").table
    (short,) = table.missing_runs
    assert (short.condition, "is too short: replica 0 ended no episode" in short.reason) == ("short", True)
    assert table.replicas == {"long": 1, "short": 0}


def test_words_say_worlds_and_steps_in_place_of_episodes(monkeypatch):
    def of(*words):
        made, _ = parse_command(lambda: experiment(), ["recipe.py", *words])
        return made

    assert of("--worlds", "7").worlds == 7
    assert (of("--steps", "900").steps, of("--steps", "900").episodes) == (900, None)
    assert of("--episodes", "3").episodes == 3
    with pytest.raises(ValueError, match="episodes is 3 and steps 900"):
        of("--steps", "900", "--episodes", "3")
    assert experiment(steps=30).length.episodes == 3  # of 12 turns


def test_numbers_of_many_worlds_are_means_over_the_episodes_of_each_in_turn():
    series = Series(2, 3)

    def add(replica, number, value):
        ended = {"steps": 1, "terminated": False, "return_": np.zeros(1), "metrics": {}}
        episode = Episode(world=3 * replica, replica=replica, episode=number, **ended)
        return series.add(episode, {"a": value, "b": np.nan})

    for number in range(3):
        assert add(0, number, number) is None
    assert add(1, 0, 4.0) is None
    assert add(0, 3, 100.0) is None
    other = Series(2, 3)
    other.load_state_dict(series.state_dict())
    for each in (series, other):
        series = each
        assert add(1, 1, np.nan) is None
        found = add(1, 2, 6.0)
        assert found["a"].tolist() == [1.0, 5.0]
        assert np.isnan(found["b"]).all()


@pytest.mark.integration
def test_several_threads_change_the_last_bits_at_most(tmp_path):
    alike = {"replicas": 1, "steps": 120, "engine": "compiled"}
    runs = [
        cprl.run(experiment(**alike), tmp_path / f"{threads}", threads=threads, watch="off")
        for threads in (1, 2)
    ]
    one, two = (
        {lane: network.state_dict() for lane, network in cprl.load(run).networks.items()} for run in runs
    )
    torch.testing.assert_close(one, two, rtol=0, atol=1e-5)
    reports = [json.loads((run / "report.json").read_text()) for run in runs]
    assert [report["threads"] for report in reports] == [1, 2]
    with pytest.raises(ValueError, match="threads is 0"):
        cprl.run(experiment(), tmp_path / "none", threads=0)
