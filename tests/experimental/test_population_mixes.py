"""Agents of any kinds in all mixes: populations put together, the dilemma of restrained and greedy ones, the
game whose strategies are stored runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from boards import module_at
from matplotlib.image import imread
from matrix_games import stag_hunt
from places import RECIPES
from stored_runs import CORRIDORS, MEADOW, SEED, command, episodes_of, ran, returns

import cprl
from cprl import Fresh, Game, Rules, maps
from cprl.evaluation import play_population
from cprl.evaluation.populations import rotations, table_note
from cprl.experimental.empirical_game import (
    analyse_games,
    draw_egta,
    egta_tables,
    games_in,
    mean_game,
    pairwise_game,
    play_empirical_game,
)
from cprl.experimental.payoff_table import PayoffTable, compositions
from cprl.experimental.schelling import (
    between_the_ends,
    candidates,
    dilemma,
    margins,
    payoffs_of,
    schelling,
)
from cprl.population import Frozen, Scripted


@pytest.mark.integration
def test_the_agents_of_a_run_play_as_in_its_evaluation(alike):
    agents = [Frozen(str(alike), agent, replica=None) for agent in range(2)]
    fresh = Fresh(episodes=4, seed=SEED)
    played = play_population(MEADOW, agents, fresh)
    assert returns(played) == returns(cprl.evaluate_run(alike, fresh), policy="trained")
    assert set(returns(played)) == {0, 1, 2}, "the replicas that the run has"
    on_the_runs_game = play_population(cprl.load(alike), agents, fresh)
    assert returns(on_the_runs_game) == returns(played)
    some = play_population(MEADOW, agents, replace(fresh, replicas=(0, 2)))
    assert returns(some) == {replica: returns(played)[replica] for replica in (0, 2)}


def test_scripted_agents_harvest_their_own_corridors():
    played = play_population(CORRIDORS, [Scripted("greedy"), Scripted("sustainable")], Fresh(episodes=2))
    # Nothing regrows. The greedy agent bites both apples of its corridor; the sustainable one sees at most
    # two others near an apple, fewer than it spares, and bites none.
    assert returns(played) == dict.fromkeys(range(8), [[2.0, 0.0]] * 2)


def test_populations_meet_the_same_worlds():
    worlds = [Fresh(episodes=3, seed=seed) for seed in (5, 5, 6)]
    both = [play_population(MEADOW, [Scripted("random")] * 2, fresh) for fresh in worlds]
    assert returns(both[0]) == returns(both[1]) != returns(both[2])


def test_games_without_a_board_are_played():
    fresh = Fresh(episodes=2, replicas=(0, 1))
    played = play_population(stag_hunt(turns=3), [Scripted("random")] * 2, fresh)
    assert episodes_of(played, "steps") == {0: [[3, 3], [3, 3]], 1: [[3, 3], [3, 3]]}


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
FRESH = Fresh(episodes=3, replicas=(0, 1), seed=SEED)


@pytest.fixture(scope="module")
def diagram():
    return schelling(CORRIDORS, Fresh(episodes=2, replicas=(0, 1, 2)))


@pytest.fixture(scope="module")
def patch():
    return schelling(PATCH, FRESH)


def test_payoffs_are_means_over_who_is_restrained(diagram):
    # Nothing regrows. Greedy agents bite all that is in their corridors, 2 and 3 apples, restrained ones
    # none: they never see three others near an apple. One restrained agent is once agent 0 and once agent 1.
    assert sorted(set(diagram["restrained"].to_pylist())) == ["", "0", "0 1", "1"]
    payoffs = payoffs_of(diagram)
    assert payoffs.cooperators.tolist() == [[0.0, 0.0]] * 3
    assert payoffs.defectors.tolist() == [[2.5, 2.5]] * 3
    assert payoffs.group.tolist() == [[5.0, 2.5, 0.0]] * 3
    assert dilemma(margins(payoffs.cooperators, payoffs.defectors)) == "no dilemma"
    by_mix = cprl.estimates(diagram, "collective_return", by="restrained_agents")
    assert by_mix[1, "collective_return"].value == 2.5


def test_all_mixes_are_in_the_table(patch):
    assert len(patch) == 14 * 2 * 3 * 4, "mixes, replicas, episodes, agents"
    mixes = sorted(set(patch["restrained"].to_pylist()), key=len)
    assert [len(mix.split()) for mix in mixes] == [0, *[1] * 4, *[2] * 4, *[3] * 4, 4]
    assert set(mixes) >= {"", "0", "0 3", "0 1 2 3"}


def test_a_mix_is_the_population_of_its_agents(patch):
    agents = [Scripted("sustainable" if agent in (0, 3) else "greedy") for agent in range(4)]
    played = play_population(PATCH, agents, FRESH)
    assert returns(patch, restrained="0 3") == returns(played)
    # R(1): in each of the mixes (0, 1), (1, 2), (2, 3) and (0, 3) the two restrained agents.
    pairs = {(0, 1): "0 1", (1, 2): "1 2", (2, 3): "2 3", (0, 3): "0 3"}
    episodes = {pair: np.array(returns(patch, restrained=name)[0]) for pair, name in pairs.items()}
    own = [of_mix[:, list(pair)].mean(1) for pair, of_mix in episodes.items()]
    payoffs = payoffs_of(patch)
    assert payoffs.cooperators[0, 1] == pytest.approx(np.mean(own))
    group = [of_mix.sum() for of_mix in episodes.values()]
    assert payoffs.group[0, 2] == pytest.approx(sum(group) / 12)


@pytest.mark.integration
def test_agents_of_runs_play_restrained_or_greedy(alike):
    fresh = Fresh(episodes=2)
    found = schelling(cprl.load(alike), fresh, restrained="sustainable", greedy=str(alike))
    assert returns(found, restrained="") == returns(cprl.evaluate_run(alike, fresh), policy="trained")


def test_the_recipe_leaves_out_diagrams_of_trained_agents_that_are_not_there(tmp_path, monkeypatch, capsys):
    recipe = module_at(RECIPES / "study" / "theory" / "schelling.py")
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


@pytest.mark.parametrize(
    ("pulls", "said"),
    [
        ([15, 18, -15, 37], " at the ends, not at 2 of 3"),
        ([15, 18, 20, 37], ""),
        ([15, 0.5, -15, 37], " at the ends, not at 2 of 3, not shown at 1 of 3"),
        ([-5, -5, 3, 9], ""),
        ([-5, 0.5, 3, 9], ""),
        ([-5, 3, -3, 9], " at the ends, not at 1 of 3"),
        ([9, 3, -3, -9], ""),
        ([9, -3, -3, 9], " at the ends, not at 1 and 2 of 3"),
        ([9, -9], ""),
    ],
)
def test_a_dilemma_of_the_ends_is_not_said_of_points_between_them_that_show_something_else(pulls, said):
    noise = np.linspace(-1, 1, 4)[:, None]
    restrained = np.full((4, len(pulls)), 50.0)
    assert between_the_ends(restrained, restrained + pulls + noise) == said


def of(reward, sucker, temptation, punishment, *, spread=0.0, replicas=4):
    """Two agents: R(0) is what the sucker gets, R(1) the reward, G(0) the punishment, G(1) the temptation."""
    noise = spread * np.linspace(-1, 1, replicas)[:, None]
    restrained, greedy = np.array([[sucker, reward]]), np.array([[punishment, temptation]])
    return margins(restrained + noise, greedy - noise)


@pytest.mark.parametrize(
    ("payoffs", "name"),
    [
        ((3, 0, 5, 1), "prisoner's dilemma"),
        ((3, 1, 5, 0), "chicken"),
        ((4, 0, 3, 1), "stag hunt"),
        ((4, 2, 3, 1), "no dilemma"),  # harmony: neither fear nor greed
        ((1, 0, 5, 3), "no dilemma"),  # greed of all is better than restraint of all
        ((3, 3, 5, 1), "no dilemma"),  # the only restrained agent is as well off: 3 > 3 is false
        ((3, 0, 3, 0), "no dilemma"),  # G(0) = R(0) and G(1) = R(1): nothing pulls
    ],
)
def test_dilemmas_have_their_names(payoffs, name):
    assert dilemma(of(*payoffs)) == name


def test_margins_are_the_differences_that_define_them():
    values = {name: margin.value for (name,), margin in of(3, 0, 5, 1).items()}
    # R(1) - G(0) = 3 - 1, R(1) - R(0) = 3 - 0, G(0) - R(0) = 1 - 0, G(1) - R(1) = 5 - 3.
    assert values == {"restraint": 2.0, "company": 3.0, "fear": 1.0, "greed": 2.0}


def test_with_several_agents_only_both_ends_count():
    restrained, greedy = np.array([[0.0, 9.0, 1.0, 4.0]] * 3), np.array([[1.0, 0.0, 9.0, 5.0]] * 3)
    assert dilemma(margins(restrained, greedy)) == "prisoner's dilemma"  # 4 > 1, 4 > 0, 1 > 0, 5 > 4


def test_intervals_that_hold_0_leave_several_dilemmas():
    # Noise of ± 0.5 in both kinds gives fear 1 ± (t(3) = 3.18) x 0.745 / 2 = 1 ± 1.19; greed is 4 ± 1.19.
    assert candidates(of(5, 0, 9, 1, spread=0.5)) == ("prisoner's dilemma", "chicken")
    assert candidates(of(3, 0, 5, 1, spread=0.1)) == ("prisoner's dilemma",)


def test_one_replica_tells_nothing_for_certain():
    found = of(3, 0, 5, 1, replicas=1)
    assert dilemma(found) == "cannot be told"
    assert candidates(found)[0] == "prisoner's dilemma"
    assert set(candidates(found)) == {"prisoner's dilemma", "chicken", "stag hunt", "no dilemma"}


@pytest.mark.parametrize("shapes", [((3, 1), (3, 1)), ((3,), (3,)), ((3, 2), (2, 2))])
def test_payoffs_of_other_shapes_are_refused(shapes):
    restrained, greedy = map(np.zeros, shapes)
    with pytest.raises(ValueError, match=r"cooperators is .* and defectors .*; allowed: \[R, N\]"):
        margins(restrained, greedy)


THREE = Game(
    map=maps.parse(
        """
        >.AA.<
        v.AA..
        """
    ),
    rules=Rules(regrow_prob=(0.0, 0.05, 0.3), window_rows=6, window_columns=7, episode_steps=12),
)
"""Three agents around one patch."""


def scripted_runs(folder, game, *policies, replicas=2):
    return {
        name: ran(folder / name, game, [Scripted(name)] * game.agents, replicas=replicas) for name in policies
    }


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    return scripted_runs(tmp_path_factory.mktemp("three"), THREE, "greedy", "random")


def of_pairs(*matrices):
    """Games of two agents with these payoffs, [S, S] by replica."""
    return [PayoffTable.from_pairs(matrix) for matrix in matrices]


def test_payoffs_are_means_over_who_plays_where(corridors):
    # A greedy agent bites all of its corridor, 2 or 3 apples, whoever plays in the other; others bite none.
    names, games = games_in(play_empirical_game(corridors, Fresh(episodes=1)))
    assert names == ["greedy", "sustainable"]
    payoffs = [game.payoffs for game in games]
    assert payoffs == pytest.approx(np.array([[[2.5, np.nan], [2.5, 0], [np.nan, 0]]] * 2), nan_ok=True)
    assert mean_game(games).pure_equilibria == [(2, 0)]


def test_each_run_has_each_index_as_often_as_every_other():
    for counts in compositions(4, 3).tolist():
        choices = rotations(counts)
        assert len(choices) == (4 if max(counts) < 4 else 1)
        for run, count in enumerate(counts):
            at = [sum(who[index] == run for who in choices) for index in range(4)]
            assert at == [count * len(choices) / 4] * 4


@pytest.mark.integration
def test_of_two_agents_crossplay_makes_the_same_game(tmp_path):
    runs = scripted_runs(tmp_path, MEADOW, "greedy", "random")
    fresh = Fresh(episodes=2, seed=SEED)
    _, whole = games_in(play_empirical_game(runs, fresh))
    pairs = pairwise_game(cprl.crossplay(runs, fresh))
    for game, of_whole in zip(games_in(pairs)[1], whole, strict=True):
        assert game.payoffs == pytest.approx(of_whole.payoffs, nan_ok=True)
    assert table_note(pairs, "heading").startswith("Empirical game: ")


def test_of_more_agents_crossplay_makes_the_reduction(three):
    fresh = Fresh(episodes=2, seed=SEED)
    table = play_empirical_game(three, fresh)
    _, whole = games_in(table)
    pairs = pairwise_game(cprl.crossplay(three, fresh))
    names, games = games_in(pairs)
    assert names == ["greedy", "random"]
    assert [(game.agents, of_whole.agents) for game, of_whole in zip(games, whole, strict=True)] == [
        (2, 3)
    ] * 2
    assert table_note(pairs, "heading").startswith("Pairwise reduction of the empirical game: ")
    for game, of_whole in zip(games, whole, strict=True):
        assert game.pairs == pytest.approx(of_whole.pairs)
    # 3 (4 - 2) + 2 choices of who plays where, 2 replicas, 2 episodes, 3 agents.
    assert len(table) == 8 * 2 * 2 * 3
    assert "greedy greedy random" in table["runs"].to_pylist()
    assert "2 greedy, 1 random" in table["composition"].to_pylist()


@pytest.mark.integration
def test_certainty_is_the_share_of_resampled_replicas():
    pytest.importorskip("open_spiel")
    pytest.importorskip("nashpy")
    # In two of three replicas the second strategy gains 1 over the first whatever the other plays, in the
    # third it loses 1: of the means it gains unless the third is drawn twice or more, with chance 7 / 27.
    gains = np.array([[0.0, 0.0], [1.0, 1.0]])
    found = analyse_games(["a", "b"], of_pairs(gains, gains, -gains), resamples=400)
    assert found.rank.shares == pytest.approx([0, 1], abs=1e-4)
    assert found.pure == pytest.approx({(0, 2): 20 / 27}, abs=0.07)
    assert found.in_support == pytest.approx([7 / 27, 20 / 27], abs=0.07)
    assert (found.shares[1].low, found.shares[1].high) == pytest.approx((0, 1), abs=1e-4)
    one = analyse_games(["a", "b"], of_pairs(gains))
    assert np.isnan([one.shares[0].low, *one.pure.values(), *one.in_support]).all()
    assert one.resamples == 0
    assert all(table.head for table in egta_tables(one))


@pytest.mark.integration
@pytest.mark.parametrize("runs", [2, 3, 4])
def test_analyses_are_drawn_for_any_number_of_runs(runs, tmp_path):
    pytest.importorskip("open_spiel")
    pytest.importorskip("nashpy")
    rng = np.random.default_rng(runs)
    names = [f"run {own}" for own in range(runs)]
    found = analyse_games(names, of_pairs(*rng.random((3, runs, runs))), resamples=3)
    drawn = draw_egta(found, tmp_path / "new" / "game.png")
    height, width, _ = imread(drawn).shape
    assert width > 1000
    assert (height > 0.6 * width) == (runs < 4), "two and three have a phase portrait"
    with pytest.raises(FileExistsError):
        draw_egta(found, drawn)


@pytest.mark.integration
def test_the_command_tells_all_compositions_of_more_agents(three, tmp_path, monkeypatch, capsys):
    pytest.importorskip("open_spiel")
    pytest.importorskip("nashpy")
    words = ["egta", three["greedy"], three["random"], "--episodes", 1, "--resamples", 3]
    printed = command(monkeypatch, capsys, *words, "--figure", tmp_path / "game.png")
    assert "2 greedy, 1 random" in printed
    assert "Nash equilibrium of pairs (nashpy)" in printed
    assert "Pairwise reduction" in command(monkeypatch, capsys, *words, "--pairwise")


def test_more_profiles_than_alpha_rank_takes_are_refused_before_play(three, monkeypatch):
    monkeypatch.setattr("cprl.experimental.empirical_game.MOST_PROFILES", 7)
    with pytest.raises(ValueError, match="2 runs of 3 agents have 8 profiles"):
        play_empirical_game(three)
