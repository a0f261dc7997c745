"""Stored runs play fresh worlds, alone and among each other, and the numbers are those of the episodes."""

import json
import os
import shutil
from dataclasses import replace
from math import isnan
from pathlib import Path

import matplotlib
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from PIL import Image
from stored_runs import C51, CORRIDORS, MEADOW, PPO, SAC, SEED, an_experiment, command, ran, told, values

import cprl
from cprl import CommonsEnv, Game, Observation, maps, presets
from cprl.envs.make_env import spaces_of
from cprl.evaluation import draw_gains, gains
from cprl.evaluation.evaluate import differences
from cprl.evaluation.lanes import Fresh, Part, Turns, agents_of
from cprl.learners.base import EVALUATION, lane_seeds
from cprl.measuring.evaluate import evaluate
from cprl.measuring.metrics import with_unit
from cprl.measuring.movement import trace
from cprl.measuring.statistics import agents_without_harvest, over_replicas, social_measures
from cprl.networks.mlp import MLPNetwork
from cprl.policies.assignment import AgentPolicies
from cprl.policies.lanes import LaneActor, random_agents
from cprl.population import Frozen, Scripted
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.recipe import start_run
from cprl.system.process import one_thread
from cprl.training import train
from cprl.training.agents import Population, StoredAgent, stored_policies


@pytest.fixture(scope="module")
def learned(alike, tmp_path_factory):
    """Beside two DQN agents one that draws its actions, among whom one of those is frozen."""
    folder = tmp_path_factory.mktemp("mixed")
    mixed = ran(folder / "mixed", MEADOW, [PPO, Frozen(os.path.relpath(alike), 1, replica=2)])
    return {"alike": alike, "mixed": mixed}


def test_a_run_of_scripted_agents_gives_the_numbers_worked_by_hand(corridors):
    found = cprl.evaluate_run(corridors["greedy"], episodes=4)
    assert list(found.trained) == list(found.random) == [0, 1]
    measures = found.measures()
    assert values(measures) == pytest.approx(
        {
            "collective_return": 5,
            "efficiency": 5 / 3,
            "equality": 1 - 2 * 1 / (2 * 2 * 5),
            "sustainability": ((1 + 3) / 2 + (1 + 2 + 3) / 3) / 2,
            "survival_steps": 3,
            "peace": 2,
            "peacefulness": 3,
            "stock_left": 0,
            "yield_share": 1,  # nothing grows, and all 5 are taken
            "agent_0/return": 2,
            "agent_1/return": 3,
        }
    )
    assert measures["equality"].estimate.low == measures["equality"].estimate.high == pytest.approx(0.9)
    assert {one.episodes for one in measures.values()} == {8}


def test_what_is_undefined_is_counted_apart_and_in_no_mean(corridors):
    found = cprl.evaluate_run(corridors["sustainable"], episodes=3, replicas=[1])
    measures = found.measures()
    assert values(measures)["collective_return"] == 0
    for name in ("equality", "sustainability"):
        assert measures[name].estimate is None
        assert str(measures[name]) == "undefined in all 3"
    assert agents_without_harvest(found.trained) == (6, 6)
    some = over_replicas({0: [1.0, float("nan")], 4: [float("nan")] * 2, 5: [2.0, 5.0]})
    assert (some.undefined, some.episodes, some.estimate.replicas) == (3, 6, 2)
    assert some.estimate.value == (1 + 3.5) / 2, "the mean of means of replicas, not 8 / 3 nor anything / 6"
    assert str(some).endswith("], undefined in 3 of 6")
    assert str(over_replicas({0: [2.0, float("nan")]})) == "2, undefined in 1 of 2", "without an interval"
    with pytest.raises(ValueError, match=r"episodes by replica are \{0: 1, 1: 0\}"):
        over_replicas({0: [1.0], 1: []})


@pytest.mark.integration
@pytest.mark.parametrize("name", ["alike", "mixed"])
def test_greedy_agents_play_what_the_policy_of_the_loaded_run_plays(name, learned):
    found = cprl.evaluate_run(learned[name], episodes=4, greedy=True, seed=SEED)
    loaded = cprl.load(learned[name])
    means = []
    for replica in loaded.replicas:
        env = CommonsEnv(MEADOW, 4, seed=SEED, first_world=4 * replica)
        alone = evaluate(env, loaded.policy(replica, worlds=4))
        assert told(alone) == told(found.trained[replica])
        means.append(np.mean([episode.harvest.sum() for episode in alone]))
    assert values(found.measures())["collective_return"] == pytest.approx(np.mean(means))


@pytest.mark.parametrize(("worlds", "of_policy", "plays"), [(4, 1, "1 world"), (2, 4, "4 worlds")])
@pytest.mark.parametrize("name", ["alike", "mixed"])
def test_a_policy_for_another_number_of_worlds_is_refused(name, worlds, of_policy, plays, learned):
    loaded = cprl.load(learned[name])
    message = f"the policy plays {plays} and the environment has {worlds}; allowed: as many"
    with pytest.raises(ValueError, match=rf"{message}, e\.g\. run\.policy\(replica, worlds={worlds}\)"):
        loaded.env(worlds=worlds).rollout(3, loaded.policy(0, worlds=of_policy))
    assert loaded.env(worlds=worlds).rollout(3, loaded.policy(0, worlds=worlds)).batch_size[0] == worlds


class Own(torch.nn.Module):
    """A network of the user's own, which cannot be stacked with its like."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, observation):
        return self.network(observation)


def test_networks_that_do_not_stack_play_the_same(learned):
    loaded = cprl.load(learned["alike"])
    own = replace(loaded, networks={lane: Own(network) for lane, network in loaded.networks.items()})
    for greedy in (True, False):
        one, other = (cprl.evaluate_run(run, episodes=2, greedy=greedy) for run in (loaded, own))
        for replica in loaded.replicas:
            assert told(one.trained[replica]) == told(other.trained[replica])


def test_a_loaded_run_and_what_is_played_with_it_are_printed_in_a_line(learned):
    loaded = cprl.load(learned["alike"])
    for fact in (str(loaded.path), "'alike'", "3 episodes", "3 replicas", "2 agents"):
        assert fact in repr(loaded)
    played = cprl.evaluate_run(learned["alike"], episodes=1)
    pairs = cprl.crossplay(learned, episodes=1)
    for printed in (loaded, played, pairs, loaded.agent(0), played.trained[0][0]):
        assert len(repr(printed).replace(str(loaded.path), "RUN")) <= 300, printed


def test_agents_explore_with_the_runs_epsilon_for_evaluation(learned, tmp_path):
    always = shutil.copytree(learned["alike"], tmp_path / "always")
    text = json.loads((always / "recipe.json").read_text())
    for agent in text["experiment"]["agents"]:
        agent["algorithm"]["settings"]["epsilon_evaluation"] = 1.0
    (always / "recipe.json").write_text(json.dumps(text))
    by_chance = cprl.evaluate_run(always, episodes=2)
    assert told(by_chance.trained[0]) == told(by_chance.random[0]), "with epsilon 1 every action is random"
    assert told(by_chance.trained[0]) != told(cprl.evaluate_run(always, episodes=2, greedy=True).trained[0])


class Undecided(torch.nn.Module):
    """Gives every action the same logit."""

    def forward(self, observation):
        return torch.zeros(*observation.shape[:-3], len(MEADOW.actions))


def test_agents_that_learned_a_policy_draw_from_it(learned):
    loaded = cprl.load(learned["mixed"])
    undecided = replace(
        loaded,
        experiment=replace(loaded.experiment, agents=[PPO, PPO]),
        networks={f"replica_{replica}/agent_{agent}": Undecided() for replica in (0, 1) for agent in (0, 1)},
    )
    found = cprl.evaluate_run(undecided, episodes=2)
    for replica in (0, 1):
        assert told(found.trained[replica]) == told(found.random[replica])
    greedy = cprl.evaluate_run(undecided, episodes=2, greedy=True)
    assert told(greedy.trained[0]) != told(greedy.random[0])


def test_the_random_policy_draws_by_the_seeds_of_agents_in_evaluation(learned):
    found = cprl.evaluate_run(learned["mixed"], episodes=2, seed=SEED, replicas=[1])
    seeds = lane_seeds(SEED, replicas=[1], agents=[0, 1], purpose=EVALUATION)
    actor = LaneActor(None, len(MEADOW.actions), seeds=seeds, agents=2, worlds=2)
    env = CommonsEnv(MEADOW, 2, seed=SEED, first_world=2)
    assert told(evaluate(env, AgentPolicies({(0, 1): actor}), explore=True)) == told(found.random[1])


@pytest.mark.parametrize("name", ["alike", "mixed"])
def test_the_same_call_plays_the_same_whoever_drew_before_and_a_replica_the_same_alone(name, learned):
    first = cprl.evaluate_run(learned[name], episodes=2)
    torch.manual_seed(len(name))
    state = torch.get_rng_state()
    again = cprl.evaluate_run(learned[name], episodes=2, replicas=[2, 0])
    assert torch.equal(torch.get_rng_state(), state), "nothing of ours draws from torch's generator"
    assert list(again.trained) == [0, 2]
    for replica in (0, 2):
        assert told(again.trained[replica]) == told(first.trained[replica])
        assert told(again.random[replica]) == told(first.random[replica])
    other = cprl.evaluate_run(learned[name], episodes=2, seed=SEED)
    assert told(other.trained[0]) != told(first.trained[0])
    assert told(first.trained[0]) != told(first.trained[1]), "replicas play different worlds"


def test_an_evaluation_computes_in_one_thread_and_leaves_their_number_as_it_was():
    env, threads = CommonsEnv(presets.game("two_complex"), 1, seed=0), []
    random = AgentPolicies(random_agents(spaces_of(env), (0, 1), replicas=1, seed=0))

    def policy(batch):
        threads.append(torch.get_num_threads())
        return random(batch)

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        evaluate(env, policy)
        trace(env, policy)
        Turns(env, policy).play()
        assert set(threads) == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_an_agent_values_actions_alone_as_among_others_to_the_last_bit():
    spaces = presets.game("two_complex").spaces
    shape = spaces.observation_shape
    torch.manual_seed(0)
    agents = [StoredAgent(network=MLPNetwork(shape, 8), algorithm="DQN") for _ in range(8)]
    seen = torch.randint(0, 256, (8, 1, *shape), dtype=torch.uint8)

    def values(lanes):
        network = stored_policies(
            [[agents[lane] for lane in lanes]], spaces, replicas=lanes, worlds=1, seed=0
        )
        (actor,) = (own for own in network.modules() if isinstance(own, LaneActor))
        return actor.preferences(seen[lanes])

    with one_thread():
        together = values(range(8))
        assert all(torch.equal(values([lane]), together[[lane]]) for lane in range(8))


@pytest.mark.integration
def test_a_run_that_has_not_ended_plays_by_its_newest_checkpoint(tmp_path):
    env, members = CommonsEnv(MEADOW, 2, seed=3), [C51, SAC]
    agents = Population(env, members, seed=3, engine="eager")
    experiment = an_experiment("stopped", MEADOW, members, replicas=2)
    run = start_run(tmp_path / "stopped", "stopped", experiment.to_recipe)
    with pytest.raises(ValueError, match=r"has .* been trained"):
        cprl.evaluate_run(run)

    class Stopped(Exception):  # noqa: N818
        pass

    class Stops(Checkpointer):
        def after_step(self, training):
            if training.steps == 30:
                self.save(training)
                raise Stopped

    with pytest.raises(Stopped), Stops(run) as checkpoints:
        train(env, agents.learners, others=agents.others, episodes=9, checkpointer=checkpoints)
    found = cprl.evaluate_run(run, episodes=3, greedy=True)
    assert found.run.weights_from.name.startswith("training-000000000030")
    fresh = CommonsEnv(MEADOW, 6, seed=found.fresh.seed)
    now = evaluate(fresh, agents.policy(3))
    assert told(now) == told(found.trained[0] + found.trained[1])


def test_a_matrix_of_scripted_agents_gives_the_numbers_worked_by_hand(corridors):
    found = cprl.crossplay(list(corridors.values()), episodes=2)
    wanted = {  # focal, background, group: each the mean of focal agents 0 and 1
        ("greedy", "greedy"): ((2 + 3) / 2, (3 + 2) / 2, 5),
        ("greedy", "sustainable"): ((2 + 3) / 2, 0, (2 + 3) / 2),
        ("sustainable", "greedy"): (0, (3 + 2) / 2, (3 + 2) / 2),
        ("sustainable", "sustainable"): (0, 0, 0),
    }
    assert set(found.cells) == set(wanted)
    for at, returns in wanted.items():
        measures = found.cell(*at).measures()
        assert [measures[f"{who}/return"].estimate.value for who in ("focal", "background", "group")] == list(
            returns
        )
    visit = found.cell("greedy", "sustainable")
    assert [visit.measures(agent)["focal/return"].estimate.value for agent in (0, 1)] == [2, 3]
    assert [visit.measures(agent)["stock_left"].estimate.value for agent in (0, 1)] == [3, 2]
    assert visit.measures()["equality"].estimate.value == 0.5, "one of two has everything"
    assert visit.measures()["collective_return"].episodes == 2 * 2 * 2
    at_home = found.cell("sustainable", "sustainable").measures()
    assert (at_home["equality"].undefined, at_home["equality"].episodes) == (4, 4), "each episode once"
    with pytest.raises(ValueError, match=r"the cell is \('greedy', 'DQN'\)"):
        found.cell("greedy", "DQN")


def test_each_cell_is_what_the_loaded_runs_agents_play_with_one_focal_agent(learned):
    found = cprl.crossplay(learned.values(), episodes=3, seed=SEED, greedy=True)
    loaded = {name: cprl.load(run) for name, run in learned.items()}
    for focal, background in (("alike", "mixed"), ("mixed", "alike")):
        cell, means = found.cell(focal, background), []
        for replica in range(3):
            numbers = []
            for agent in range(2):
                mixed = agents_of(loaded[background])
                mixed[agent] = agents_of(loaded[focal])[agent]
                fresh = Fresh(replicas=(replica,), episodes=3, seed=SEED, greedy=True)
                alone = fresh.play(loaded[background], mixed)[replica]
                assert told(alone) == told(cell.by_agent[agent][replica])
                numbers += [(one.return_[agent], one.return_[1 - agent], one.stock_left) for one in alone]
            means.append(np.mean(numbers, 0))
        names = ("focal/return", "background/return", "stock_left")
        assert [values(cell.measures())[name] for name in names] == pytest.approx(np.mean(means, 0))
        assert {cell.measures()[name].estimate.replicas for name in names} == {3}
    diagonal = found.cell("mixed", "mixed")
    at_home = cprl.evaluate_run(learned["mixed"], episodes=3, seed=SEED, greedy=True)
    assert diagonal.is_self_play
    assert told(diagonal.by_agent[1][2]) == told(at_home.trained[2])


@pytest.mark.integration
def test_on_the_diagonal_a_cross_seed_agent_is_of_the_next_replica(learned):
    runs = list(learned.values())
    how = {"episodes": 2, "seed": SEED, "greedy": True}
    found = cprl.crossplay(runs, diagonal="cross_seed", replicas=[0, 2], **how)
    loaded, cell = cprl.load(learned["alike"]), found.cell("alike", "alike")
    for background, focal in ((0, 2), (2, 0)):
        mixed = [agents_of(loaded)[0], agents_of(loaded, {background: focal})[1]]
        fresh = Fresh(replicas=(background,), episodes=2, seed=SEED, greedy=True)
        alone = fresh.play(loaded, mixed)[background]
        assert told(alone) == told(cell.by_agent[1][background])
    assert not cell.is_self_play
    usual = cprl.crossplay(runs, replicas=[0, 2], **how)
    for at in (("alike", "mixed"), ("mixed", "alike")):
        assert values(usual.cell(*at).measures()) == values(found.cell(*at).measures())
    with pytest.raises(ValueError, match=r"the replicas are \[1\]"):
        cprl.crossplay(runs, diagonal="cross_seed", replicas=[1])


@pytest.mark.integration
@pytest.mark.parametrize(
    ("function", "runs", "given", "answer"),
    [
        ("evaluate_run", "alike", {"episodes": 0}, "episodes is 0"),
        ("evaluate_run", "alike", {"seed": 3}, r"seed is 3, the training seed of .*alike"),
        ("evaluate_run", "alike", {"replicas": [1, 9, 3]}, r"alike has no replicas \[3, 9\]"),
        ("crossplay", ["alike"], {}, "the number of runs is 1"),
        ("crossplay", ["alike", "mixed", "alike"], {}, "alike is given twice"),
        ("crossplay", ["alike", "mixed", "greedy"], {}, r"alike and greedy .* different games: Game\.map\."),
        ("crossplay", ["lonely", "alone"], {}, r"the game has 1 agent; .* use `cprl evaluate`"),
    ],
)
def test_what_does_not_fit_is_refused(function, runs, given, answer, learned, corridors, tmp_path):
    there = {**learned, **corridors}
    if "lonely" in runs:
        lonely = Game(map=maps.parse(">A"), rules=CORRIDORS.rules)
        there = {name: ran(tmp_path / name, lonely, [Scripted("greedy")], replicas=1) for name in runs}
    chosen = [there[name] for name in runs] if isinstance(runs, list) else there[runs]
    with pytest.raises(ValueError, match=answer):
        getattr(cprl, function)(chosen, **given)


def test_games_differ_in_what_a_message_tells():
    assert differences(MEADOW, MEADOW) == []
    other = Game(
        map=MEADOW.map,
        rules=replace(MEADOW.rules, freeze_steps=7),
        observation=Observation(agents_apart=True),
    )
    assert differences(MEADOW, other) == [
        "Game.rules.freeze_steps 2 and 7",
        "Game.observation.agents_apart False and True",
    ]
    assert "Game.map.sites differ" in differences(MEADOW, CORRIDORS), "forty cells would help nobody"


def test_runs_have_given_names_those_of_their_directories_or_their_paths(corridors, tmp_path):
    copy = shutil.copytree(corridors["greedy"], tmp_path / "greedy")
    found = cprl.crossplay([corridors["greedy"], copy], episodes=1)
    assert list(found.runs) == [str(corridors["greedy"]), str(copy)]
    found = cprl.crossplay({"bites": corridors["greedy"], "waits": corridors["sustainable"]}, episodes=1)
    assert found.cell("waits", "bites").measures()["background/return"].estimate.value == 2.5


def with_returns(played, returns):
    """The same cross-play with other returns: of both agents, by cell, focal agent and replica."""

    def part_of(at, focal, by_agent):
        played = played_of(at, focal, by_agent)
        return Part({"focal": at[0], "background": at[1], "focal_agent": focal}, played, ((focal,),))

    def played_of(at, focal, by_agent):
        episodes = played.cell(*at).by_agent[focal]
        return {
            replica: [replace(one, return_=np.array(own, dtype=float)) for one in episodes[replica]]
            for replica, own in enumerate(by_agent[focal])
        }

    parts = [part_of(at, focal, by_agent) for at, by_agent in returns.items() for focal in by_agent]
    return replace(played, parts=parts)


def exploited(corridors):
    """A cross-play of two replicas in which greedy agents exploit sustainable ones."""
    found = cprl.crossplay(list(corridors.values()), episodes=1, replicas=[0, 1])
    among_their_like = {0: [[5, 5], [7, 7]], 1: [[5, 5], [7, 7]]}
    return with_returns(
        found,
        {
            # focal agents 0 and 1, each in replicas 0 and 1; the focal agent's return stands at its index
            ("greedy", "sustainable"): {0: [[9, 2], [12, 4]], 1: [[3, 9], [4, 10]]},
            ("sustainable", "greedy"): {0: [[1, 2], [1, 3]], 1: [[2, 1], [3, 1]]},
            ("sustainable", "sustainable"): among_their_like,
            ("greedy", "greedy"): {0: [[2, 2], [2, 2]], 1: [[2, 2], [2, 2]]},
        },
    )


def test_gains_are_differences_from_the_diagonal_paired_by_replica(corridors):
    found = gains(exploited(corridors))
    assert set(found) == {("greedy", "sustainable"), ("sustainable", "greedy")}
    # Greedy among sustainable agents: focal (9 + 9) / 2 - 5 = 4 and (12 + 10) / 2 - 7 = 4 in replicas 0 and
    # 1; background (2 + 3) / 2 - 5 = -2.5 and (4 + 4) / 2 - 7 = -3.
    greedy = found["greedy", "sustainable"]
    assert (greedy.focal.value, greedy.focal.low, greedy.focal.high) == (4, 4, 4)
    assert greedy.background.value == -2.75
    # Student's t for 1 degree of freedom at 97.5 % is 12.706; the standard error is 0.25.
    assert greedy.background.high == pytest.approx(-2.75 + 12.706 * 0.25, abs=1e-3)
    # Sustainable among greedy agents: focal 1 - 2; background 2 - 2 = 0 and 3 - 2 = 1.
    sustainable = found["sustainable", "greedy"]
    assert (sustainable.focal.value, sustainable.background.value) == (-1, 0.5)
    at_home = [exploited(corridors).cell(name, name).mean_returns("focal").mean() for name in corridors]
    assert at_home == [2, 6]


@pytest.mark.integration
def test_the_picture_of_gains_has_a_row_for_each_focal_run(corridors, tmp_path):
    path = draw_gains(exploited(corridors), tmp_path / "new" / "gains.png")
    with pytest.raises(ValueError, match=r"path is '.*gains\.pdf'"):
        draw_gains(exploited(corridors), tmp_path / "gains.pdf")
    with Image.open(path) as picture:
        assert min(picture.size) > 500
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    blue, red = (colours == shade(1.0)).all(1).sum(), (colours == shade(0.0)).all(1).sum()
    assert min(blue, red) > 1000, "the largest gain and the largest loss"


def shade(at):
    return np.round(255 * np.array(matplotlib.colormaps["RdBu"](at)[:3]))


def test_the_command_evaluate_tells_every_metric_and_writes_the_episodes(
    learned, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "new" / "episodes.parquet"
    text = command(monkeypatch, capsys, "evaluate", learned["alike"], "--episodes", 2, "--out", out)
    found = cprl.evaluate_run(learned["alike"], episodes=2)
    rows = rows_of(text)
    for name, random in found.measures("random").items():
        cells = [with_unit(name, rewards="apples"), str(found.measures()[name]), str(random)]
        assert cells in rows
    assert "run's agents, epsilon 0.05" in text
    table = pq.read_table(out)
    assert table.num_rows == 2 * 3 * 2 * 2, "policies, replicas, episodes, agents"
    assert table.equals(found.table())
    with pytest.raises(SystemExit, match=r"cprl: .*episodes\.parquet exists and is not"):
        command(monkeypatch, capsys, "evaluate", learned["alike"], "--out", out)
    assert pq.read_table(out).equals(table)


def rows_of(text):
    """The cells of the rows of all tables."""
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in text.splitlines() if "│" in line]


@pytest.mark.integration
def test_the_command_crossplay_tells_a_matrix_for_each_number_and_draws_the_gains(
    corridors, tmp_path, monkeypatch, capsys
):
    out, figure = tmp_path / "cross.parquet", tmp_path / "gains.png"
    greedy, sustainable = corridors.values()
    words = ["crossplay", f"bites={greedy}", sustainable, "--episodes", 1, "--out", out, "--figure", figure]
    text = command(monkeypatch, capsys, *words)
    assert "2 replicas, 1 episode each with focal agent at each index, seed 30011, diagonal: self" in text
    for name in ("focal/return (apples)", "group/return (apples)", "sustainability (steps)"):
        assert name in (line.strip() for line in text.splitlines())
    for row in (
        ["bites", "2.5 [2.5, 2.5]", "2.5 [2.5, 2.5]"],
        ["sustainable", "0 [0, 0]", "0 [0, 0]"],
        ["bites", "sustainable", "1", "3 [3, 3]", "0 [0, 0]", "3 [3, 3]"],
        ["sustainable", "0.5 [0.5, 0.5]", "undefined in all 2"],  # equality
        # In place of a sustainable agent, which gets nothing, a greedy one gets 2.5; the other as before. All
        # replicas are alike, so that of four differences those have a star that are not 0.
        ["bites", "", "2.5 [2.5, 2.5] *"],
        ["sustainable", "-2.5 [-2.5, -2.5] *", ""],
        ["bites", "", "0 [0, 0]"],
    ):
        assert row in rows_of(text)
    assert text.count("* not 0 by Holm's method for all 4 differences") == 2
    agents = pq.read_table(out, columns=["focal", "background", "focal_agent"]).to_pylist()
    assert len(agents) == (1 + 2 + 2 + 1) * 2 * 2, "visits, replicas, agents"
    assert {row["focal_agent"] for row in agents if row["focal"] == row["background"]} == {-1}
    assert text.splitlines()[-1] == f"Figure: {figure}"
    assert figure.exists()
    for wrong, said in (
        (words, r"cross\.parquet exists and is not"),
        (["crossplay", greedy, sustainable, "--figure", figure], r"gains\.png exists and is not overwritten"),
        (["crossplay", greedy, sustainable, "--figure", tmp_path / "a.jpg"], r"--figure is '.*a\.jpg'"),
        (["crossplay", f"bites={greedy}", f"bites={sustainable}"], "bites names 2 runs"),
        (["crossplay", greedy], "the number of runs is 1"),
    ):
        with pytest.raises(SystemExit, match=f"cprl: .*{said}"):
            command(monkeypatch, capsys, *wrong)


def test_social_measures_are_those_of_the_docs(corridors):
    found = cprl.evaluate_run(corridors["greedy"], episodes=1)
    text = (Path(__file__).parents[1] / "docs" / "metrics.md").read_text()
    documented = [line.split("`")[1] for line in text.splitlines() if line.startswith("| `social/")]
    assert {f"social/{name}" for name in social_measures(found.trained)} == set(documented)
    (single,) = [one for name, one in social_measures({0: found.trained[0]}).items() if name == "peace"]
    assert str(single) == "2", "one replica alone has no interval"
    assert isnan(single.estimate.low)
