"""Stored runs play fresh worlds, alone and among each other, and the numbers are those of the episodes."""

import json
import os
import shutil
from dataclasses import replace
from math import isnan, nan

import matplotlib
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from matrix_games import prisoners_dilemma
from PIL import Image
from places import ROOT
from random_agents import random_agents
from stored_runs import (
    C51,
    CORRIDORS,
    DQN,
    MEADOW,
    PPO,
    SAC,
    SEED,
    an_experiment,
    command,
    ran,
    returns,
    stored,
    told,
    values,
)

import cprl
from cprl import CommonsEnv, Fresh, Game, Observation, maps, presets
from cprl.envs.make_env import spaces_of
from cprl.evaluation import (
    Scenario,
    by_focal_agent,
    draw_gains,
    gains,
    play_population,
    run_scenarios,
    scenarios_of,
)
from cprl.evaluation.cross_play import CELL_LABELS, CROSS_PLAY_RETURNS
from cprl.evaluation.populations import agents_of, join_tables, play_fresh, table_note
from cprl.experimental.empirical_game import play_empirical_game
from cprl.experimental.movement import trace
from cprl.experimental.schelling import schelling
from cprl.experimental.territory import territory_of
from cprl.measuring.playing import evaluate, turns
from cprl.measuring.registry import INCOME_EQUALITY, with_unit
from cprl.measuring.statistics import estimates
from cprl.measuring.table import all_metrics, where
from cprl.networks.mlp import MLPNetwork
from cprl.policies.actors import LaneActor
from cprl.policies.joint_policy import JointPolicy
from cprl.population import Frozen, Scripted
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.recipe import start_run
from cprl.system.process import one_thread
from cprl.training import Schedule, train
from cprl.training.agents import Population
from cprl.training.stored import StoredAgent, refuse_unlike, stored_policies


@pytest.fixture(scope="module")
def learned(alike, tmp_path_factory):
    """Beside two DQN agents one that draws its actions, among whom one of those is frozen."""
    folder = tmp_path_factory.mktemp("mixed")
    mixed = ran(folder / "mixed", MEADOW, [PPO, Frozen(os.path.relpath(alike), 1, replica=2)])
    return {"alike": alike, "mixed": mixed}


def test_a_run_of_scripted_agents_gives_the_numbers_worked_by_hand(corridors):
    found = cprl.evaluate_run(corridors["greedy"], Fresh(episodes=4))
    assert set(zip(*(found[name].to_pylist() for name in ("policy", "replica")), strict=True)) == {
        (policy, replica) for policy in ("trained", "random") for replica in (0, 1)
    }
    assert values(found, policy="trained") == pytest.approx(
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
    levels = cprl.estimates(found, by="policy")
    equality = levels["trained", "equality"]
    assert equality.low == equality.high == pytest.approx(0.9)
    assert {one.episodes for one in levels.values()} == {8}


def test_what_is_undefined_is_counted_apart_and_in_no_mean(corridors):
    found = cprl.evaluate_run(corridors["sustainable"], Fresh(episodes=3, replicas=(1,)))
    levels = cprl.estimates(found, by="policy")
    assert levels["trained", "collective_return"].value == 0
    for name in ("equality", "sustainability"):
        assert isnan(levels["trained", name].value)
        assert str(levels["trained", name]).startswith("undefined in all 3")
    some = own_estimate({0: [1.0, nan], 4: [nan] * 2, 5: [2.0, 5.0]})
    assert (some.undefined, some.episodes, some.replicas) == (3, 6, 2)
    assert some.value == (1 + 3.5) / 2, "the mean of means of replicas, not 8 / 3 nor anything / 6"
    assert "], undefined in 3 of 6" in str(some)
    assert str(own_estimate({0: [2.0, nan]})).startswith("2.00, undefined in 1 of 2"), "without an interval"


def own_estimate(by_replica):
    """The estimate of an own metric, from its values in the episodes of each replica."""
    rows = [
        {"replica": replica, "episode": episode, "agent": 0, "own": value}
        for replica, values in by_replica.items()
        for episode, value in enumerate(values)
    ]
    return estimates(pa.Table.from_pylist(rows), "own")["own"]


@pytest.mark.integration
@pytest.mark.parametrize("name", ["alike", "mixed"])
def test_greedy_agents_play_what_the_policy_of_the_loaded_run_plays(name, learned):
    found = cprl.evaluate_run(learned[name], Fresh(episodes=4, greedy=True, seed=SEED))
    loaded = cprl.load(learned[name])
    means = []
    for replica in loaded.replicas:
        env = CommonsEnv(MEADOW, 4, seed=SEED, first_world=4 * replica)
        alone = evaluate(env, loaded.policy(replica, worlds=4))
        assert told(alone) == told(found, replica, policy="trained")
        means.append(np.mean([episode.harvest.sum() for episode in alone]))
    assert values(found, policy="trained")["collective_return"] == pytest.approx(np.mean(means))


@pytest.mark.parametrize(("worlds", "of_policy"), [(4, 1), (2, 4)])
@pytest.mark.parametrize("name", ["alike", "mixed"])
def test_a_policy_for_another_number_of_worlds_is_refused(name, worlds, of_policy, learned):
    loaded = cprl.load(learned[name])
    with pytest.raises(ValueError, match=f"the policy plays {of_policy} world.* has {worlds}"):
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
        fresh = Fresh(episodes=2, greedy=greedy)
        one, other = (cprl.evaluate_run(run, fresh) for run in (loaded, own))
        for replica in loaded.replicas:
            assert told(one, replica, policy="trained") == told(other, replica, policy="trained")


def test_agents_explore_with_the_runs_epsilon_for_evaluation(learned, tmp_path):
    always = shutil.copytree(learned["alike"], tmp_path / "always")
    text = json.loads((always / "recipe.json").read_text())
    for agent in text["experiment"]["agents"]:
        agent["algorithm"]["settings"]["epsilon_evaluation"] = 1.0
    (always / "recipe.json").write_text(json.dumps(text))
    manifest = json.loads((always / "manifest.json").read_text())
    del manifest["experiment"]  # which is of the recipe before
    (always / "manifest.json").write_text(json.dumps(manifest))
    by_chance = cprl.evaluate_run(always, Fresh(episodes=2))
    explored = told(by_chance, 0, policy="trained")
    assert explored == told(by_chance, 0, policy="random"), "with epsilon 1 every action is random"
    greedy = cprl.evaluate_run(always, Fresh(episodes=2, greedy=True))
    assert explored != told(greedy, 0, policy="trained")


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
    found = cprl.evaluate_run(undecided, Fresh(episodes=2))
    for replica in (0, 1):
        assert told(found, replica, policy="trained") == told(found, replica, policy="random")
    greedy = cprl.evaluate_run(undecided, Fresh(episodes=2, greedy=True))
    assert told(greedy, 0, policy="trained") != told(greedy, 0, policy="random")


def test_an_evaluation_computes_in_one_thread_and_leaves_their_number_as_it_was():
    env, threads = CommonsEnv(presets.game("two_complex"), 1, seed=0), []
    random = JointPolicy(random_agents(spaces_of(env), (0, 1), replicas=1, seed=0))

    def policy(batch):
        threads.append(torch.get_num_threads())
        return random(batch)

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        evaluate(env, policy)
        trace(env, policy)
        next(turns(env, policy))
        assert set(threads) == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_an_agent_values_actions_alone_as_among_others_to_the_last_bit():
    spaces = presets.game("two_complex").spaces
    shape = spaces.observation_shape
    torch.manual_seed(0)
    agents = [StoredAgent(spec=DQN, network=MLPNetwork(shape, 8)) for _ in range(8)]
    seen = torch.randint(0, 256, (8, 1, *shape), dtype=torch.uint8)

    def values(lanes):
        network = stored_policies(
            [[agents[lane] for lane in lanes]], spaces, replicas=lanes, worlds=1, seed=0
        )
        (actor,) = (own for own in network.modules() if isinstance(own, LaneActor))
        return actor.action_values(seen[lanes])

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
        train(env, agents.learners, Schedule(episodes=9), others=agents.others, checkpointer=checkpoints)
    fresh = Fresh(episodes=3, greedy=True)
    found = cprl.evaluate_run(run, fresh)
    assert "training-000000000030" in table_note(found, "weights")
    now = evaluate(CommonsEnv(MEADOW, 6, seed=fresh.seed), agents.policy(3))
    assert told(now) == [*told(found, 0, policy="trained"), *told(found, 1, policy="trained")]


def test_a_matrix_of_scripted_agents_gives_the_numbers_worked_by_hand(corridors):
    found = cprl.crossplay(list(corridors.values()), Fresh(episodes=2))
    wanted = {  # focal, background, all together: each the mean of focal agents 0 and 1
        ("greedy", "greedy"): ((2 + 3) / 2, (3 + 2) / 2, 5),
        ("greedy", "sustainable"): ((2 + 3) / 2, 0, (2 + 3) / 2),
        ("sustainable", "greedy"): (0, (3 + 2) / 2, (3 + 2) / 2),
        ("sustainable", "sustainable"): (0, 0, 0),
    }
    levels = cprl.estimates(found, [*CROSS_PLAY_RETURNS, *all_metrics(found)], by=CELL_LABELS)
    assert set(levels.labels) == set(wanted)
    for at, means in wanted.items():
        assert tuple(levels[(*at, number)].value for number in CROSS_PLAY_RETURNS) == means
    visit = where(found, focal="greedy", background="sustainable")
    of_agents = cprl.estimates(visit, ["focal/return", "stock_left"], by="focal_agent")
    assert [of_agents[agent, "focal/return"].value for agent in (0, 1)] == [2, 3]
    assert [of_agents[agent, "stock_left"].value for agent in (0, 1)] == [3, 2]
    assert levels["greedy", "sustainable", "equality"].value == 0.5, "one of two has everything"
    assert levels["greedy", "sustainable", "collective_return"].episodes == 2 * 2 * 2
    at_home = levels["sustainable", "sustainable", "equality"]
    assert (at_home.undefined, at_home.episodes) == (4, 4), "each episode once"
    self_play = where(found, focal="greedy", background="greedy")
    assert set(self_play["focal_agent"].to_pylist()) == {-1}
    in_turn = cprl.estimates(by_focal_agent(found), CROSS_PLAY_RETURNS, by=(*CELL_LABELS, "focal_agent"))
    assert [in_turn["greedy", "greedy", agent, "focal/return"].value for agent in (0, 1)] == [2, 3]
    assert [in_turn["greedy", "greedy", agent, "background/return"].value for agent in (0, 1)] == [3, 2]


def test_games_are_unlike_in_fields_that_a_refusal_names():
    rules, observation = replace(MEADOW.rules, freeze_steps=7), Observation(agents_apart=True)
    other = replace(MEADOW, rules=rules, observation=observation)
    with pytest.raises(ValueError, match=r"rules\.freeze_steps was 2, is 7.*observation\.agents_apart"):
        refuse_unlike("one and another", MEADOW, other)
    refuse_unlike("one and another", MEADOW, replace(MEADOW))


def test_each_cell_is_what_the_loaded_runs_agents_play_with_one_focal_agent(learned):
    fresh = Fresh(episodes=3, seed=SEED, greedy=True)
    found = cprl.crossplay(learned.values(), fresh)
    names = ("focal/return", "background/return", "stock_left")
    loaded = {name: cprl.load(run) for name, run in learned.items()}
    for focal, background in (("alike", "mixed"), ("mixed", "alike")):
        cell, means = where(found, focal=focal, background=background), []
        for replica in range(3):
            numbers = []
            for agent in range(2):
                mixed = agents_of(loaded[background])
                mixed[agent] = agents_of(loaded[focal])[agent]
                alone = play_fresh(replace(fresh, replicas=(replica,)), loaded[background], mixed)
                assert told(alone, replica) == told(cell, replica, focal_agent=agent)
                numbers += [
                    (returns[agent], returns[1 - agent], stock_left)
                    for _, returns, _, stock_left in told(alone, replica)
                ]
            means.append(np.mean(numbers, 0))
        assert [*values(cell, names).values()] == pytest.approx(np.mean(means, 0))
        assert {one.replicas for one in cprl.estimates(cell, names).values()} == {3}
    at_home = cprl.evaluate_run(learned["mixed"], fresh)
    diagonal = where(found, focal="mixed", background="mixed")
    assert told(diagonal, 2) == told(at_home, 2, policy="trained")


@pytest.mark.integration
def test_on_the_diagonal_a_cross_seed_agent_is_of_the_next_replica(learned):
    runs = list(learned.values())
    fresh = Fresh(episodes=2, seed=SEED, greedy=True, replicas=(0, 2))
    found = cprl.crossplay(runs, fresh, diagonal="cross_seed")
    loaded = cprl.load(learned["alike"])
    cell = where(found, focal="alike", background="alike")
    for background, focal in ((0, 2), (2, 0)):
        mixed = [agents_of(loaded)[0], agents_of(loaded, {background: focal})[1]]
        alone = play_fresh(replace(fresh, replicas=(background,)), loaded, mixed)
        assert told(alone, background) == told(cell, background, focal_agent=1)
    usual = cprl.crossplay(runs, fresh)
    for at in ({"focal": "alike", "background": "mixed"}, {"focal": "mixed", "background": "alike"}):
        assert returns(usual, **at) == returns(found, **at)


def test_runs_have_given_names_those_of_their_directories_or_their_paths(corridors, tmp_path):
    copy = shutil.copytree(corridors["greedy"], tmp_path / "greedy")
    fresh = Fresh(episodes=1)
    found = cprl.crossplay([corridors["greedy"], copy], fresh)
    assert found["focal"].unique().to_pylist() == [str(corridors["greedy"]), str(copy)]
    found = cprl.crossplay({"bites": corridors["greedy"], "waits": corridors["sustainable"]}, fresh)
    assert (
        cprl.estimates(found, "background/return", by=CELL_LABELS)[
            "waits", "bites", "background/return"
        ].value
        == 2.5
    )


def exploited():
    """A cross-play of two replicas in which greedy agents exploit sustainable ones."""
    among_their_like = {0: [[5, 5], [7, 7]], 1: [[5, 5], [7, 7]]}
    returns = {
        # focal agents 0 and 1, each in replicas 0 and 1; the focal agent's return stands at its index
        ("greedy", "sustainable"): {0: [[9, 2], [12, 4]], 1: [[3, 9], [4, 10]]},
        ("sustainable", "greedy"): {0: [[1, 2], [1, 3]], 1: [[2, 1], [3, 1]]},
        ("sustainable", "sustainable"): among_their_like,
        ("greedy", "greedy"): {0: [[2, 2], [2, 2]], 1: [[2, 2], [2, 2]]},
    }
    rows = [
        {
            "focal": focal,
            "background": background,
            "focal_agent": focal_agent,
            "replica": replica,
            "episode": 0,
            "agent": agent,
            "role": "focal" if agent == focal_agent else "background",
            "return": float(value),
        }
        for (focal, background), by_agent in returns.items()
        for focal_agent, of_replicas in by_agent.items()
        for replica, both in enumerate(of_replicas)
        for agent, value in enumerate(both)
    ]
    return join_tables([pa.Table.from_pylist(rows)], fresh="2 replicas, 1 episode each", diagonal="self")


def test_gains_are_differences_from_the_diagonal_paired_by_replica():
    found = gains(exploited())
    assert set(found.labels) == {("greedy", "sustainable"), ("sustainable", "greedy")}
    # Greedy among sustainable agents: focal (9 + 9) / 2 - 5 = 4 and (12 + 10) / 2 - 7 = 4 in replicas 0 and
    # 1; background (2 + 3) / 2 - 5 = -2.5 and (4 + 4) / 2 - 7 = -3.
    greedy = found.of("greedy", "sustainable")
    focal, background = greedy["focal/return"], greedy["background/return"]
    assert (focal.value, focal.low, focal.high) == (4, 4, 4)
    assert background.value == -2.75
    # Student's t for 1 degree of freedom at 97.5 % is 12.706; the standard error is 0.25.
    assert background.high == pytest.approx(-2.75 + 12.706 * 0.25, abs=1e-3)
    # Sustainable among greedy agents: focal 1 - 2; background 2 - 2 = 0 and 3 - 2 = 1.
    sustainable = found.of("sustainable", "greedy")
    assert [one.value for one in sustainable.values()] == [-1, 0.5]
    at_home = cprl.estimates(exploited(), "focal/return", by=CELL_LABELS)
    assert [at_home[name, name, "focal/return"].value for name in ("greedy", "sustainable")] == [2, 6]


@pytest.mark.integration
def test_the_picture_of_gains_has_a_row_for_each_focal_run(tmp_path):
    path = draw_gains(exploited(), tmp_path / "new" / "gains.png")
    with pytest.raises(ValueError, match=r"path is '.*gains\.jpg'"):
        draw_gains(exploited(), tmp_path / "gains.jpg")
    with Image.open(path) as picture:
        assert min(picture.size) > 500
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    blue, red = (colours == shade(1.0)).all(1).sum(), (colours == shade(0.0)).all(1).sum()
    assert min(blue, red) > 1000, "the largest gain and the largest loss"


def shade(at):
    return np.round(255 * np.array(matplotlib.colormaps["RdBu"](at)[:3]))


def rows_of(text):
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in text.splitlines() if "│" in line]


WRITTEN = [
    (
        ["evaluate", "{greedy}", "--episodes", 1],
        ["greedy: 2 replicas, 1 episode each, seed 30011", "Weights: "],
        [
            ["collective return, apples", "5.00 [5.00, 5.00]"],
            ["equality (1 - Gini), 0 to 1", "0.90 [0.90, 0.90]"],
        ],
        2 * 2 * 2,
        False,
    ),
    (
        ["visits", "{greedy}", "--episodes", 1, "--random"],
        ["Weights: "],
        [["exclusion (0 to 1)", "1.00 [1.00, 1.00]"], ["tags in one's own territory (0 to 1)", "-", "-"]],
        None,
        True,
    ),
    (
        ["crossplay", "bites={greedy}", "{sustainable}", "--episodes", 1],
        [
            "2 replicas, 1 episode each with focal agent at each index, seed 30011, diagonal: self",
            "focal: return, apples",
            "income of all agents together, apples",
            "sustainability, steps",
            "* not 0 by Holm's method for the 4 differences of both tables",
        ],
        [
            ["bites", "2.50 [2.50, 2.50]", "2.50 [2.50, 2.50]"],
            ["sustainable", "0 [0, 0]", "0 [0, 0]"],
            ["bites", "sustainable", "1", "3.00 [3.00, 3.00]", "0 [0, 0]", "3.00 [3.00, 3.00]"],
            ["sustainable", "0.50 [0.50, 0.50]", "undefined in all 2 episodes"],  # equality
            # In place of a sustainable agent, which gets nothing, a greedy one gets 2.5; the other as before.
            # Replicas are alike, so that of four differences those have a star that are not 0.
            ["bites", "", "+2.50 [+2.50, +2.50] *"],
            ["sustainable", "-2.50 [-2.50, -2.50] *", ""],
            ["bites", "", "+0 [+0, +0]"],
        ],
        (1 + 2 + 2 + 1) * 2 * 2,  # visits, replicas, agents
        True,
    ),
    (
        ["schelling", "{drawing}", "--episodes", 1, "--replicas", 0, 1],
        ["fear, G(0) - R(0)", "2 replicas, 1 episode each for each choice of restrained agents"],
        [],
        (1 + 2 + 1) * 2 * 2,
        True,
    ),
    (
        ["egta", "bites={greedy}", "{sustainable}", "--episodes", 1, "--resamples", 5],
        [
            "Empirical game: 2 replicas, 1 episode each for each choice of who plays where",
            "in 100% of the resamples",
            "from 100% of the starts",
        ],
        [["bites", "1.00 [1.00, 1.00]"], ["no agent gains by another run", "2 bites"]],
        (1 + 2 + 1) * 2 * 2,
        True,
    ),
    (
        ["scenarios", "{sustainable}", "--episodes", 1, "--scenarios", "minority_among_greedy"],
        [
            "Scenarios of sustainable: 2 replicas, 1 episode each in each placement, seed 30011",
            "* not 0 by Holm's method for the 2 differences of this table",
        ],
        # What is not 0 differs for certain; all together get 3 or 2, as one of them plays greedy.
        [
            ["minority_among_greedy", "0 [0, 0]"],
            ["minority_among_greedy", "2.50 [2.50, 2.50]", "0.50 [0.50, 0.50]"],
        ],
        3 * 2 * 2 * 2,  # who is focal, placements, replicas, agents
        True,
    ),
]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("words", "said", "rows", "episodes", "is_drawn"),
    WRITTEN,
    ids=[f"{words[0]} {words[1]}" for words, *_ in WRITTEN],
)
def test_a_command_prints_its_numbers_and_writes_its_files_once(
    words, said, rows, episodes, is_drawn, alike, corridors, tmp_path, monkeypatch, capsys
):
    if words[0] == "egta":
        pytest.importorskip("open_spiel")
        pytest.importorskip("nashpy")
    (tmp_path / "patch.txt").write_text(">.AA.<\n..AA..\n")
    places = {"alike": alike, "drawing": tmp_path / "patch.txt", **corridors}
    words = [str(word).format(**places) for word in words]
    files = {"--out": tmp_path / "new" / "episodes.parquet"} if episodes else {}
    files |= {"--figure": tmp_path / "new" / "figure.png"} if is_drawn else {}
    text = command(monkeypatch, capsys, *words, *(word for pair in files.items() for word in pair))
    assert [fragment for fragment in said if fragment not in text] == []
    printed = rows_of(text)
    assert [row for row in rows if row not in [cells[: len(row)] for cells in printed]] == []
    if episodes:
        assert pq.read_table(files["--out"]).num_rows == episodes
    if is_drawn:
        with Image.open(files["--figure"]) as picture:
            assert picture.width > 700
    for option, path in files.items():
        with pytest.raises(SystemExit, match=rf"cprl: .*{path.name} exists and is not overwritten"):
            command(monkeypatch, capsys, *words, option, path)
    if episodes:
        with pytest.raises(SystemExit, match=r"--out is .*a\.json'; allowed: .*\.parquet"):
            command(monkeypatch, capsys, *words, "--out", tmp_path / "a.json")
    if is_drawn:
        with pytest.raises(SystemExit, match=r"--figure is '.*a\.jpg'"):
            command(monkeypatch, capsys, *words, "--figure", tmp_path / "a.jpg")


def test_the_table_of_an_evaluation_has_every_metric_and_its_file_every_episode(
    alike, tmp_path, monkeypatch, capsys
):
    found, out = cprl.evaluate_run(alike, Fresh(episodes=1)), tmp_path / "episodes.parquet"
    rows = rows_of(command(monkeypatch, capsys, "evaluate", alike, "--episodes", 1, "--out", out))
    rows = [[cell.removesuffix(" *") for cell in row] for row in rows]
    assert pq.read_table(out).equals(found)
    numbers = [*all_metrics(found), "agent_0/return", "agent_1/return"]
    levels = cprl.estimates(found, numbers, by="policy")
    more = cprl.differences(found, numbers, by="policy", reference={"policy": "random"})
    for name in numbers:
        trained, random = (str(levels[policy, name]) for policy in ("trained", "random"))
        change = more.get(("trained", name))
        of_difference = "" if change is None else f"{change:+}"
        assert [with_unit(name, rewards="apples"), trained, random, of_difference] in rows
    both = [returns(found, policy=policy) for policy in ("trained", "random")]
    values = [np.sum(both[0][replica]) - np.sum(both[1][replica]) for replica in both[0]]
    assert more["trained", "collective_return"].value == pytest.approx(np.mean(values))


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (["crossplay", "bites={greedy}", "bites={sustainable}"], "bites names 2 runs"),
        (["visits", "{greedy}", "--random"], "allowed: with --figure"),
    ],
)
def test_words_that_do_not_fit_are_refused(words, answer, corridors, monkeypatch, capsys):
    with pytest.raises(SystemExit, match=f"cprl: .*{answer}"):
        command(monkeypatch, capsys, *(word.format(**corridors) for word in words))


PLAYS = {
    "evaluate_run": lambda runs, fresh: cprl.evaluate_run(runs["mixed"], fresh),
    "run_scenarios": lambda runs, fresh: run_scenarios(
        runs["alike"], fresh, scenarios=["minority_among_greedy"]
    ),
    "crossplay": cprl.crossplay,
    "play_empirical_game": play_empirical_game,
}


@pytest.mark.parametrize("play", PLAYS.values(), ids=PLAYS)
def test_replicas_play_the_same_alone_and_whoever_drew_before(play, learned):
    everything = play(learned, Fresh(episodes=2))
    torch.manual_seed(7)
    state = torch.get_rng_state()
    alone = play(learned, Fresh(episodes=2, replicas=(2, 0)))
    assert torch.equal(torch.get_rng_state(), state), "nothing of ours draws from torch's generator"
    assert alone["replica"].unique().to_pylist() == [0, 2]
    replica = np.array(everything["replica"])
    assert repr(alone.to_pydict()) == repr(everything.filter(replica != 1).to_pydict())
    first, second = (everything.filter(replica == number)["return"] for number in (0, 1))
    assert first != second, "replicas play different worlds"
    assert play(learned, Fresh(episodes=2, seed=SEED))["return"] != everything["return"]


FULL = replace(MEADOW, observation=Observation(area="full"))
ALONE = presets.game("single_basic")
RANDOM = [Scripted("random")] * 2
TRAINED_IN = Fresh(seed=3)


@pytest.mark.parametrize(
    ("play", "answer"),
    [
        (lambda _: Fresh(episodes=0), "episodes is 0"),
        (
            lambda runs: cprl.evaluate_run(runs["alike"], TRAINED_IN),
            r"seed is 3, the training seed of .*alike",
        ),
        (lambda runs: cprl.evaluate_run(runs["alike"], Fresh(replicas=(1, 9, 3))), r"no replicas \[3, 9\]"),
        (lambda runs: cprl.crossplay([runs["alike"]]), "the number of runs is 1"),
        (lambda runs: cprl.crossplay([runs["alike"], runs["mixed"], runs["alike"]]), "alike is given twice"),
        (lambda runs: cprl.crossplay([runs["alike"], runs["greedy"]]), "alike and greedy .* Game.map"),
        (lambda runs: cprl.crossplay([runs["lonely"], runs["alone"]]), "the game has 1 agent"),
        (
            lambda runs: cprl.crossplay(
                [runs["alike"], runs["mixed"]], Fresh(replicas=(1,)), diagonal="cross_seed"
            ),
            r"the replicas are \[1\]",
        ),
        (lambda _: play_population("meadow", RANDOM), "game_or_run is 'meadow'"),
        (lambda _: play_population(MEADOW, [DQN, *RANDOM[1:]]), r"agents\[0\] is a Learning"),
        (lambda _: play_population(MEADOW, RANDOM[1:]), "1 agents are specified for a game of 2"),
        (lambda _: Fresh(replicas=(-1,)), "replicas"),
        (
            lambda runs: play_population(MEADOW, among(runs["alike"]), TRAINED_IN),
            "seed is 3, the training seed",
        ),
        (
            lambda runs: play_population(MEADOW, among(runs["alike"]), Fresh(replicas=(0, 3))),
            r"no replicas \[3\]",
        ),
        (lambda _: schelling(ALONE), "the game has 1 agent"),
        (lambda _: schelling(CORRIDORS, restrained="kind"), "restrained is 'kind'"),
        (lambda _: schelling(CORRIDORS, greedy="sustainable"), "greedy is 'sustainable'"),
        (lambda _: schelling(CORRIDORS, restrained="territorial"), "greedy is 'greedy'"),
        (
            lambda runs: schelling(MEADOW, restrained=str(runs["alike"]), greedy=f"{runs['alike']}/"),
            "greedy is '.*alike/'",
        ),
        (lambda runs: scenes(runs["greedy"], "among_wolves"), "a scenario is 'among_wolves'"),
        (lambda runs: scenes(runs["greedy"], *["minority_among_greedy"] * 2), "is given twice"),
        (lambda runs: scenes(runs["alike"], scenarios_of(CORRIDORS)[0]), "different games: Game.map"),
        (lambda runs: scenes(runs["greedy"], its_like(CORRIDORS, runs["alike"])), "the background .*alike"),
        (lambda _: scenarios_of(prisoners_dilemma(turns=2)), "the game is a MatrixGame"),
        (lambda _: scenarios_of(ALONE), "the game has 1 agent"),
        (lambda _: scenarios_of(FULL), "Observation.area is 'full'"),
        (lambda runs: territory_of(runs["matrix"]), "plays a game without a board of cprl"),
    ],
)
def test_what_cannot_be_played_is_refused_by_name(play, answer, learned, corridors, odd):
    cprl.trust("matrix_games:MatrixGame")
    with pytest.raises(ValueError, match=answer):
        play({**learned, **corridors, **odd})


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """Two runs of one agent, and one of a game without a board."""
    folder, lonely = tmp_path_factory.mktemp("odd"), Game(map=maps.parse(">A"), rules=CORRIDORS.rules)
    return {
        "lonely": stored(folder / "lonely", lonely),
        "alone": stored(folder / "alone", lonely),
        "matrix": stored(folder / "matrix", prisoners_dilemma(turns=2), "random"),
    }


def scenes(run, *scenarios):
    return run_scenarios(run, scenarios=scenarios)


def among(run):
    return [Frozen(str(run), 0, replica=None), Scripted("random")]


def its_like(game, run):
    background = tuple(Frozen(str(run), agent, replica=None) for agent in range(2))
    return Scenario(name="its_like", game=game, focal="minority", background=background)


def test_social_measures_are_those_of_the_docs(corridors):
    found = where(cprl.evaluate_run(corridors["greedy"], Fresh(episodes=1)), policy="trained")
    text = (ROOT / "docs" / "metrics.md").read_text()
    documented = [line.split("`")[1] for line in text.splitlines() if line.startswith("| `social/")]
    of_institutions = {f"social/{INCOME_EQUALITY}"}
    assert {f"social/{name}" for name in all_metrics(found)} == set(documented) - of_institutions
    single = cprl.estimates(where(found, replica=0), "peace")["peace"]
    assert str(single) == "2.00", "one replica alone has no interval"
    assert isnan(single.low)
