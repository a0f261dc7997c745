"""What an episode could give: a planner that sees all, and a bound that nobody passes."""

from dataclasses import replace

import pytest

from cprl import Game, Rules, maps, presets
from cprl.institutions import Tax
from cprl.measuring.possible import KNOWN, computed, possible
from cprl.theory import Planner, best_planner, planned_harvest, yield_bounds

ROW = Game(
    map=maps.parse(
        """
        >.A.A
        #####
        A.A.<
        """
    ),
    rules=Rules(regrow_prob=(0.0,), window_rows=3, window_columns=3, episode_steps=30),
)
"""Two agents in corridors of their own, two apples in each, and nothing grows."""
CROSS = Game(
    map=maps.parse(
        """
        ..A..
        .AAA.
        >.A..
        """
    ),
    rules=Rules(window_rows=3, window_columns=3, episode_steps=300, regrow_before_bites=True),
)
"""One agent and an isolated cross, which bears a tenth of an apple a turn."""


@pytest.mark.integration
def test_where_nothing_grows_a_planner_takes_all():
    assert planned_harvest(ROW, Planner(), episodes=3).tolist() == [4.0, 4.0, 4.0]
    could = possible(ROW)
    assert (could.best_known, could.error, could.at_most, could.policy) == (4.0, 0.0, 4.0, "planner")


@pytest.mark.integration
def test_a_planner_keeps_what_grows_and_takes_the_rest_at_the_end():
    # Greedy, an agent gets 5 apples and the board is bare. At most 5 + 300 * 0.1 = 35 can be had on average;
    # a planner that looks only a turn ahead takes all at once, too.
    harvest = planned_harvest(CROSS, Planner(), episodes=20)
    assert 25 < harvest.mean() < 35
    assert planned_harvest(CROSS, Planner(patience_steps=1), episodes=5).mean() < 10
    assert planned_harvest(CROSS, Planner(), episodes=20).tolist() == harvest.tolist(), "the same again"
    assert planned_harvest(CROSS, Planner(), episodes=3).tolist() == harvest[:3].tolist(), (
        "whatever the batch"
    )


@pytest.mark.integration
def test_institutions_and_beams_do_not_change_what_a_board_could_give():
    taxed = replace(ROW, institutions=(Tax(rate=0.5),))
    assert planned_harvest(taxed, Planner(), episodes=2).tolist() == [4.0, 4.0]
    game = presets.game("commons", variant="as_run")
    quiet = replace(game, rules=replace(game.rules, may_fire=False), institutions=(Tax(),))
    assert possible(quiet) == possible(game) == KNOWN["commons", "as_run"]


def test_boards_with_a_name_are_looked_up_and_other_rules_are_not():
    game = presets.game("single_basic", variant="as_run")
    # Tests that shorten all boards to 20 turns leave what they looked up in the cache of `possible`.
    shorter = replace(game, rules=replace(game.rules, episode_steps=23))
    could = possible(shorter)
    assert could.at_most == pytest.approx(13 + 23 * 0.5)
    assert could.best_known < 13 + 23 * 0.5 < KNOWN["single_basic", "as_run"].best_known


@pytest.mark.integration
def test_known_harvests_lie_below_their_bounds():
    assert {board for board, _ in KNOWN} == set(presets.BOARDS)
    for (board, variant), known in KNOWN.items():
        game = presets.game(board, variant=variant)
        assert 0 < known.best_known < known.at_most
        if board != "commons":  # whose bound takes seconds
            bound = yield_bounds(game.map, game.rules).at_most
            assert known.at_most == pytest.approx(len(game.map.sites) + 1000 * bound, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("board", presets.BOARDS)
def test_known_harvests_are_those_that_are_computed(board):
    found, known = computed(presets.game(board, variant="as_run")), KNOWN[board, "as_run"]
    assert found.best_known == pytest.approx(known.best_known, abs=0.05)
    assert found.at_most == pytest.approx(known.at_most, abs=0.05)


@pytest.mark.parametrize(
    ("call", "answer"),
    [
        (lambda: planned_harvest("commons"), "game is 'commons'; allowed: a cprl.Game"),
        (lambda: best_planner(["commons"]), r"game is \['commons'\]; allowed: a cprl.Game"),
        (lambda: planned_harvest(ROW, "best"), "planner is 'best'; allowed: a Planner"),
        (lambda: planned_harvest(ROW, episodes=0), "episodes is 0; allowed: an integer"),
        (lambda: Planner(patience_steps=0), "patience_steps is 0; allowed: a number of at least 1"),
        (
            lambda: Planner(growth_weight_steps=-1),
            "growth_weight_steps is -1; allowed: a number",
        ),
        (lambda: possible(None), "game is None; allowed: a cprl.Game"),
    ],
)
def test_anything_else_is_refused(call, answer):
    with pytest.raises(ValueError, match=answer):
        call()


def test_the_best_candidate_is_chosen_once():
    assert best_planner(ROW) is best_planner(ROW)
