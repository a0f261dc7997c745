"""Agents that do not learn, in any mix, in fresh worlds."""

import pytest
from stored_runs import CORRIDORS, DQN, MEADOW, SEED, ran

import cprl
from cprl.envs.matrix import stag_hunt
from cprl.evaluation import play_population
from cprl.population import Frozen, Scripted


@pytest.fixture(scope="module")
def alike(tmp_path_factory):
    """Two DQN agents that learned a little, three replicas."""
    return ran(tmp_path_factory.mktemp("populations") / "alike", MEADOW, [DQN] * 2)


def returns(played):
    return {replica: [episode.return_.tolist() for episode in own] for replica, own in played.items()}


@pytest.mark.integration
def test_the_agents_of_a_run_play_as_in_its_evaluation(alike):
    agents = [Frozen(str(alike), agent, replica=None) for agent in range(2)]
    played = play_population(MEADOW, agents, episodes=4, replicas=3, seed=SEED)
    assert returns(played) == returns(cprl.evaluate_run(alike, episodes=4, seed=SEED).trained)
    on_the_runs_game = play_population(cprl.load(alike), agents, episodes=4, replicas=3, seed=SEED)
    assert returns(on_the_runs_game) == returns(played)


def test_scripted_agents_harvest_their_own_corridors():
    played = play_population(CORRIDORS, [Scripted("greedy"), Scripted("sustainable")], episodes=2, replicas=3)
    assert list(played) == [0, 1, 2]
    # Nothing regrows. The greedy agent bites both apples of its corridor; the sustainable one sees at most
    # two others near an apple, fewer than it spares, and bites none.
    assert returns(played) == dict.fromkeys(range(3), [[2.0, 0.0]] * 2)


def test_populations_meet_the_same_worlds():
    both = [play_population(MEADOW, [Scripted("random")] * 2, episodes=3, seed=seed) for seed in (5, 5, 6)]
    assert returns(both[0]) == returns(both[1]) != returns(both[2])


def test_games_without_a_board_are_played():
    played = play_population(stag_hunt(turns=3), [Scripted("random")] * 2, episodes=2, replicas=2)
    assert [[episode.steps for episode in own] for own in played.values()] == [[3, 3], [3, 3]]


@pytest.mark.parametrize(
    ("given", "answer"),
    [
        ({"where": "meadow"}, "where is 'meadow'"),
        ({"agents": [DQN, Scripted("random")]}, r"agents\[0\] is a Learning"),
        ({"agents": [Scripted("random")]}, "1 agents are specified for a game of 2 agents"),
        ({"replicas": 0}, "replicas is 0"),
        ({"episodes": 0}, "episodes is 0"),
    ],
)
def test_what_cannot_be_played_is_refused(given, answer):
    with pytest.raises(ValueError, match=answer):
        play_population(**{"where": MEADOW, "agents": [Scripted("random")] * 2, **given})


def test_the_seed_of_a_training_is_refused(alike):
    trained = cprl.load(alike).experiment.seed
    with pytest.raises(ValueError, match=f"seed is {trained}, the training seed of .*alike"):
        play_population(MEADOW, [Frozen(str(alike), 0), Scripted("random")], seed=trained)


def test_a_replica_that_a_run_does_not_have_is_refused(alike):
    with pytest.raises(ValueError, match="keeps no network of replica_3/agent_0"):
        play_population(MEADOW, [Frozen(str(alike), 0, replica=None), Scripted("random")], replicas=4)
