"""The pool of GovSim: what is left doubles, the last units go by lot, its measures are worked by hand."""

import json
from dataclasses import replace

import pytest
import torch
from fishing_pool import MEASURES, FishingPool
from language_runs import language
from model_server import served
from small_learners import ALGORITHMS
from torchrl.envs.utils import check_env_specs

import cprl
from cprl import Fresh
from cprl.envs import make_env
from cprl.evaluation.populations import play_population
from cprl.measuring.playing import evaluate
from cprl.population import Learning, Scripted
from cprl.runs.episodes import read_episodes
from cprl.values import custom_of

POOL = FishingPool()
METRICS = tuple(map(custom_of, MEASURES))


def asking(*wanted):
    """The episode of one world in which agents always want so much."""

    def policy(tensordict):
        actions = torch.tensor([wanted]).expand(*tensordict.batch_size, -1)
        return tensordict.set(("agents", "action"), actions.contiguous())

    (episode,) = evaluate(make_env(POOL, worlds=1, seed=3), policy, metrics=METRICS)
    return episode


def measured(episode):
    return [episode.metrics[measure.__name__] for measure in MEASURES]


def test_it_is_an_environment():
    check_env_specs(make_env(POOL, worlds=3, seed=0))


def test_ten_each_last_for_ever_and_twenty_each_one_round():
    episode = asking(10, 10, 10, 10, 10)  # 100 - 50 = 50, which double to 100, twelve times
    assert episode.harvest.tolist() == [120] * 5
    assert measured(episode) == [12, 1, 1, 0]
    assert episode.metrics["equality"] == 1
    episode = asking(20, 20, 20, 20, 20)
    assert measured(episode) == [1, 0, 100 / 600, 1]
    episode = asking(12, 12, 12, 12, 12)  # 40 -> 80, 20 -> 40, then 40 of 60 that are wanted
    assert measured(episode)[:2] == [3, 0]
    assert episode.harvest.sum() == 60 + 60 + 40


def test_over_usage_counts_who_takes_more_than_an_equal_share_of_what_regrows():
    episode = asking(11, 10, 9, 0, 0)  # 70 are left, which are 100 again, twelve times
    assert measured(episode) == [12, 1, 30 / 50, 1 / 5]
    assert episode.violations.tolist() == [12, 0, 0, 0, 0]
    episode = asking(30, 9, 9, 1, 1)  # 100 -> 50 -> 100: shares of 10
    assert episode.violations.tolist() == [12, 0, 0, 0, 0]
    episode = asking(
        0, 0, 20, 20, 20
    )  # 100 -> 80 -> 40: shares of 10, 8 and 4; then 40 of 60 that are wanted
    assert episode.steps == 3
    assert episode.metrics["over_usage"] == 3 / 5


def test_below_five_units_the_pool_has_collapsed_and_with_five_it_has_not():
    assert asking(20, 20, 20, 20, 16).steps == 1
    assert asking(20, 20, 20, 20, 15).steps == 2  # 5 are left, 10 in the second round, and all are wanted
    assert asking(0, 0, 0, 0, 0).harvest.sum() == 0


def test_the_last_units_go_to_one_unit_after_the_other_by_lot_and_to_nobody_beyond_its_wish():
    shares = [asking(100, 100, 100, 3, 0).harvest.tolist() for _ in range(2)]
    assert shares[0] == shares[1], "the seed says who"
    assert sum(shares[0]) == 100
    assert shares[0][3] <= 3
    assert shares[0][4] == 0


def test_agents_observe_the_pool_and_what_each_took_themselves_first():
    env = make_env(POOL, worlds=1, seed=3)
    start = env.reset()
    assert start["agents", "observation"][0, 2].tolist() == [100, 0, 0, 0, 0, 0, 0]
    start["agents", "action"] = torch.tensor([[1, 2, 3, 4, 5]])
    after = env.step(start)["next", "agents", "observation"][0]
    assert after[0].tolist() == [100, 1, 1, 2, 3, 4, 5]
    assert after[2].tolist() == [100, 1, 3, 4, 5, 1, 2]


def test_language_agents_fish_among_others_and_say_numbers():
    with served(lambda request: '{"action": 10}') as server:
        spec = language(server.url, every_steps=1, fallback="random", instructions=POOL.about)
        table = play_population(POOL, (spec,) * 5, Fresh(episodes=1, replicas=(0, 1)))
        first = server.requests[0]["messages"]
        assert "You fish in a lake with 4 others." in first[0]["content"]
        assert first[1]["content"] == "Turn 1. You observe: 100 0 0 0 0 0 0"
        assert len(server.requests) == 2 * 5 * 12
    assert table["harvest"].to_pylist() == [120] * 10


def test_with_talk_all_others_read_in_the_next_round_what_an_agent_says():
    def answer(request):
        prompt = request["messages"][1]["content"]
        heard = prompt.partition("Turn")[0].splitlines()
        return json.dumps({"action": 10, "message": f"{heard[0][:-1]}, {len(heard) - 1} spoke"})

    with served(answer) as server:
        young = language(server.url, every_steps=1, fallback="random", instructions=POOL.about)
        old = replace(young, instructions="You are old.")  # an actor of its own
        agents = (young, old, young, Scripted(), young)
        play_population(replace(POOL, talk=True), agents, Fresh(episodes=1, replicas=(0,)))
        prompts = [request["messages"][1]["content"] for request in server.requests]
        assert '"message" is a text' in server.requests[0]["messages"][0]["content"]
    firsts = [prompt for prompt in prompts if "Turn 1." in prompt]
    assert sorted(prompt.splitlines()[0] for prompt in firsts) == [
        f"You are agent {n}." for n in (0, 1, 2, 4)
    ]
    assert {len(prompt.splitlines()) for prompt in firsts} == {2}, (
        "nobody has spoken, in whatever order they act"
    )
    (second,) = [prompt for prompt in prompts if "Turn 2." in prompt and "You are agent 2." in prompt]
    assert second.splitlines()[1:-1] == [
        f'Agent {agent} says: "You are agent {agent}, 0 spoke"' for agent in (0, 1, 4)
    ]


@pytest.mark.integration
def test_learning_agents_train_in_it(tmp_path):
    experiment = cprl.Experiment(
        name="pool",
        game=POOL,
        agents=(Learning(ALGORITHMS["DQN"]),) * 4 + (Scripted(),),
        episodes=2,
        metrics=METRICS,
        evaluation_episodes=2,
        engine="eager",
    )
    run = cprl.run(experiment, tmp_path / "run", watch="off")
    assert set(read_episodes(run).column_names) >= {
        "rounds_survived",
        "has_survived",
        "share_of_optimum",
        "over_usage",
    }
