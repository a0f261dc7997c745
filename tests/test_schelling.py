"""Agents that do not learn in any mix, and what restrained and greedy ones get in all mixes."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from stored_runs import CORRIDORS, MEADOW, SEED

import cprl
from cprl import Game, Rules, maps
from cprl.envs.matrix import stag_hunt
from cprl.evaluation import play_population, schelling
from cprl.population import Frozen, Scripted


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


PATCH = Game(
    map=maps.parse(
        """
        >.AA.<
        ..AA..
        v.AA.^
        """
    ),
    rules=Rules(regrow_prob=(0.0, 0.05, 0.3), window_rows=6, window_columns=7, episode_steps=60),
)
"""Four agents around one patch that does not come back once it is bare."""


@pytest.fixture(scope="module")
def corridors():
    return schelling(CORRIDORS, episodes=2, replicas=3)


@pytest.fixture(scope="module")
def patch():
    return schelling(PATCH, episodes=3, replicas=2, seed=SEED)


def test_payoffs_are_means_over_who_is_restrained(corridors):
    # Nothing regrows. Greedy agents bite all that is in their corridors, 2 and 3 apples, restrained ones
    # none: they never see three others near an apple. One restrained agent is once agent 0 and once agent 1.
    assert sorted(corridors.by_mix) == [(), (0,), (0, 1), (1,)]
    assert corridors.restrained_payoffs.tolist() == [[0.0, 0.0]] * 3
    assert corridors.greedy_payoffs.tolist() == [[2.5, 2.5]] * 3
    assert corridors.group_payoffs.tolist() == [[5.0, 2.5, 0.0]] * 3
    assert corridors.dilemma().name == "no dilemma"
    assert corridors.measures(1)["collective_return"].estimate.value == 2.5


def test_each_agent_is_as_often_restrained_as_every_other(patch):
    assert sorted(map(len, patch.by_mix)) == [0, *[1] * 4, *[2] * 4, *[3] * 4, 4]
    for count in range(5):
        restrained = [agent for who in patch.by_mix if len(who) == count for agent in who]
        assert len({restrained.count(agent) for agent in range(4)}) == 1
    table = patch.table()
    assert len(table) == 14 * 2 * 3 * 4, "mixes, replicas, episodes, agents"
    assert set(table["restrained"].to_pylist()) >= {"", "0", "0 3", "0 1 2 3"}


def test_a_mix_is_the_population_of_its_agents(patch):
    agents = [Scripted("sustainable" if agent in (0, 3) else "greedy") for agent in range(4)]
    played = play_population(PATCH, agents, episodes=3, replicas=2, seed=SEED)
    for replica, episodes in patch.by_mix[0, 3].items():
        assert [one.return_.tolist() for one in episodes] == [one.return_.tolist() for one in played[replica]]
    # R(1): in each of the mixes (0, 1), (1, 2), (2, 3) and (0, 3) the two restrained agents.
    pairs = ((0, 1), (1, 2), (2, 3), (0, 3))
    own = [[one.return_[list(pair)].mean() for one in patch.by_mix[pair][0]] for pair in pairs]
    assert patch.restrained_payoffs[0, 1] == pytest.approx(np.mean(own))
    group = [sum(one.return_.sum() for one in patch.by_mix[pair][0]) for pair in pairs]
    assert patch.group_payoffs[0, 2] == pytest.approx(sum(group) / 12)


@pytest.mark.integration
def test_agents_of_runs_play_restrained_or_greedy(alike):
    found = schelling(cprl.load(alike), restrained="sustainable", greedy=str(alike), episodes=2, replicas=3)
    assert returns(found.by_mix[()]) == returns(cprl.evaluate_run(alike, episodes=2).trained)


def test_the_recipe_leaves_out_diagrams_of_trained_agents_that_are_not_there(tmp_path, monkeypatch, capsys):
    path = Path(__file__).parents[1] / "recipes" / "study" / "theory" / "schelling.py"
    spec = importlib.util.spec_from_file_location("schelling_recipe", path)
    recipe = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(recipe)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "commons").mkdir()
    (tmp_path / "commons" / "recipe.json").touch()
    asked = [(board, who) for board, rules, who in recipe.diagrams(Path()) if rules == "as run"]
    assert asked == [
        ("commons", "greedy"),
        ("commons", "territorial"),
        ("commons", "commons"),
        ("two_complex", "greedy"),
        ("two_complex", "territorial"),
    ]
    told = capsys.readouterr().out
    assert told == "two_complex holds no run; the diagram of two_complex with trained agents is left out\n"
    (tmp_path / "commons_as_run_trained.png").touch()
    monkeypatch.setattr(recipe, "schelling", None)  # it would be called
    with pytest.raises(FileExistsError, match=r"commons_as_run_trained\.png exists"):
        recipe.main(out=Path(), trained=Path())
