"""The game whose strategies are stored runs: what is played, what it amounts to, told and drawn."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from stored_runs import MEADOW, SEED, command, ran

import cprl
from cprl import Game, Rules, maps
from cprl.evaluation import analyse, draw_egta, pairwise_game, play_empirical_game
from cprl.evaluation.empirical_game import egta_tables
from cprl.evaluation.lanes import shifted
from cprl.population import Scripted
from cprl.theory import PayoffTable, compositions

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


@pytest.fixture(scope="module")
def made(corridors):
    """A game of two runs that is played for nothing but its fields, to put payoffs in."""
    return play_empirical_game(corridors, episodes=1)


def with_payoffs(made, names, matrices):
    """A game of two agents with these payoffs, [S, S] by replica."""
    run = next(iter(made.runs.values()))
    return replace(
        made,
        runs=dict.fromkeys(names, run),
        payoffs=np.array([PayoffTable.of_pairs(own).payoffs for own in matrices]),
        fresh=replace(made.fresh, replicas=tuple(range(len(matrices)))),
    )


def test_payoffs_are_means_over_who_plays_where(made):
    # A greedy agent bites all of its corridor, 2 or 3 apples, whoever plays in the other; others bite none.
    assert made.payoffs == pytest.approx(np.array([[[2.5, np.nan], [2.5, 0], [np.nan, 0]]] * 2), nan_ok=True)
    assert made.payoff_table().pure_equilibria == [(2, 0)]
    assert made.names == ["greedy", "sustainable"]
    assert not made.is_reduction


def test_each_run_has_each_index_as_often_as_every_other():
    for counts in compositions(4, 3).tolist():
        choices = shifted(counts)
        assert len(choices) == (4 if max(counts) < 4 else 1)
        for run, count in enumerate(counts):
            at = [sum(who[index] == run for who in choices) for index in range(4)]
            assert at == [count * len(choices) / 4] * 4


@pytest.mark.integration
def test_of_two_agents_crossplay_makes_the_same_game(tmp_path):
    runs = scripted_runs(tmp_path, MEADOW, "greedy", "random")
    whole = play_empirical_game(runs, episodes=2, seed=SEED)
    pairs = pairwise_game(cprl.crossplay(runs, episodes=2, seed=SEED))
    assert pairs.payoffs == pytest.approx(whole.payoffs, nan_ok=True)
    assert not pairs.is_reduction


def test_of_more_agents_crossplay_makes_the_reduction(three):
    whole = play_empirical_game(three, episodes=2, seed=SEED)
    pairs = pairwise_game(cprl.crossplay(three, episodes=2, seed=SEED))
    assert (whole.agents, pairs.agents, pairs.of_agents) == (3, 2, 3)
    assert pairs.is_reduction
    for place in range(2):
        assert pairs.payoff_table([place]).pairs == pytest.approx(whole.payoff_table([place]).pairs)
    # 3 (4 - 2) + 2 choices of who plays where, 2 replicas, 2 episodes, 3 agents.
    assert len(whole.table()) == 8 * 2 * 2 * 3
    assert "greedy greedy random" in whole.table()["runs"].to_pylist()


@pytest.mark.integration
def test_certainty_is_the_share_of_resampled_replicas(made):
    pytest.importorskip("open_spiel")
    pytest.importorskip("nashpy")
    # In two of three replicas the second strategy gains 1 over the first whatever the other plays, in the
    # third it loses 1: of the means it gains unless the third is drawn twice or more, with chance 7 / 27.
    gains = np.array([[0.0, 0.0], [1.0, 1.0]])
    found = analyse(with_payoffs(made, ["a", "b"], [gains, gains, -gains]), resamples=400)
    assert found.rank.shares == pytest.approx([0, 1], abs=1e-4)
    assert found.pure == pytest.approx({(0, 2): 20 / 27}, abs=0.07)
    assert found.in_support == pytest.approx([7 / 27, 20 / 27], abs=0.07)
    assert (found.shares[1].low, found.shares[1].high) == pytest.approx((0, 1), abs=1e-4)
    one = analyse(with_payoffs(made, ["a", "b"], [gains]))
    assert np.isnan([one.shares[0].low, *one.pure.values(), *one.in_support]).all()
    assert one.resamples == 0
    assert all(list(table.columns) for table in egta_tables(one))


@pytest.mark.integration
@pytest.mark.parametrize("runs", [3, 4])
def test_analyses_are_drawn_for_any_number_of_runs(runs, made, tmp_path):
    pytest.importorskip("open_spiel")
    pytest.importorskip("nashpy")
    rng = np.random.default_rng(runs)
    game = with_payoffs(made, [f"run {own}" for own in range(runs)], rng.random((3, runs, runs)))
    found = analyse(game, resamples=3)
    drawn = draw_egta(found, tmp_path / "new" / "game.png")
    assert imread(drawn).shape[1] > 1000
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
    monkeypatch.setattr("cprl.evaluation.empirical_game.MOST_PROFILES", 7)
    with pytest.raises(ValueError, match="2 runs of 3 agents have 8 profiles"):
        play_empirical_game(three)
