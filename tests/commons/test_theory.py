"""Games with a known answer: equilibria, optima, and what apples can bear."""

from itertools import product
from math import sqrt

import numpy as np
import pytest
from boards import AS_RUN, CROSS, PUBLISHED
from exact_yields import TOLERANCE, exact_yield
from hypothesis import given, settings, strategies as st
from sharing_games import CallableWorth, PowerWorth, SharingGame, appropriation, herders
from yield_bounds import yield_bounds

from cprl import Map, Rules, maps, presets
from cprl.commons.near import sites_around
from cprl.commons.yields import sustainable_yield


@pytest.mark.parametrize(
    ("agents", "nash", "anarchy"),
    [(1, 1.7321, 1), (2, 2.1213, 1.0887), (5, 2.5355, 1.594), (10, 2.7386, 2.5298), (100, 2.9704, 19.8252)],
)
def test_herders_graze_more_animals_the_more_they_are(agents, nash, anarchy):
    # v = 10 - A^2, c = 1: 10 - A^2 - 2 A^2 / n = 1, so A* = sqrt(9 / (1 + 2 / n)), and A** = sqrt(3).
    game = herders(agents)
    assert game.nash_total == pytest.approx(sqrt(9 / (1 + 2 / agents)))
    assert game.nash_total == pytest.approx(nash, abs=5e-5)
    assert game.optimum_total == pytest.approx(sqrt(3))
    assert game.price_of_anarchy == pytest.approx(anarchy, abs=5e-5)


def test_eight_agents_put_64_tokens_where_36_were_best():
    game = appropriation()
    # 23 - 0.25 X - 0.25 X / 8 = 5, 23 - 0.5 X = 5, and 23 - 0.25 X = 5
    assert (game.nash_total, game.optimum_total, game.open_access_total) == (64, 36, 72)
    # Rents: 18 * 64 - 0.25 * 64^2 = 128 and 18 * 36 - 0.25 * 36^2 = 324.
    assert (game.surplus(64), game.surplus(36), game.surplus(72)) == (128, 324, 0)
    assert game.rent_share == pytest.approx(128 / 324)
    # One with 10 tokens that puts in 8: 8 * (23 - 16) in the resource and 2 * 5 outside.
    assert game.payoffs([8] * 8).tolist() == [66] * 8
    # Nobody else puts in anything: 23 - 0.5 x = 5 at x = 36, but it has 10.
    assert game.best_response(0) == 10
    few = appropriation(tokens=5)
    assert few.nash_total == 8 * 5, "all that they have"
    assert few.optimum_total == 36


NORMAL = {"allow_subnormal": False}  # another test may have told the processor to drop them


@settings(deadline=None)
@given(
    agents=st.integers(2, 200),
    top=st.floats(0.5, 100, **NORMAL),
    factor=st.floats(0.01, 100, **NORMAL),
    power=st.floats(1, 6, **NORMAL),
    cost=st.floats(0, 0.9, **NORMAL),
)
def test_two_or_more_take_more_than_is_best_for_all(agents, top, factor, power, cost):
    worth = PowerWorth(top=top, factor=factor, power=power)
    game = SharingGame(agents=agents, worth=worth, cost=cost * top)
    assert game.optimum_total < game.nash_total < game.open_access_total
    assert game.price_of_anarchy > 1
    own = game.nash_total / agents
    assert game.best_response(game.nash_total - own) == pytest.approx(own, rel=1e-6), "an equilibrium"
    around = [game.surplus(game.optimum_total * by) for by in (0.9, 1, 1.1)]
    assert max(around) == around[1], "the best total"


@settings(deadline=None, max_examples=30)
@given(agents=st.integers(1, 50), power=st.floats(1, 4, **NORMAL), cost=st.floats(0, 5, **NORMAL))
def test_a_function_of_ones_own_gives_what_the_closed_form_gives(agents, power, cost):
    closed = PowerWorth(top=10, factor=0.5, power=power)
    own = CallableWorth(function=lambda total: 10 - 0.5 * total**power, most=closed.most)
    games = [SharingGame(agents=agents, worth=worth, cost=cost) for worth in (own, closed)]
    for name in ("nash_total", "optimum_total", "open_access_total", "price_of_anarchy"):
        found, wanted = (getattr(game, name) for game in games)
        assert found == pytest.approx(wanted, rel=1e-5), name


def test_one_alone_takes_what_is_best_and_at_a_corner_all_take_the_same():
    alone = herders(1)
    assert alone.nash_total == alone.optimum_total
    assert alone.price_of_anarchy == 1
    too_dear = herders(5, cost=11)
    assert too_dear.nash_total == too_dear.optimum_total == too_dear.open_access_total == 0
    assert too_dear.price_of_anarchy == 1
    own = CallableWorth(function=lambda total: 10 - total, most=10)
    assert SharingGame(agents=5, worth=own, cost=11).nash_total == 0
    capped = SharingGame(agents=4, worth=PowerWorth(), cost=1, most_each=0.1)
    assert capped.nash_total == capped.optimum_total == 0.4
    kinked = CallableWorth(function=lambda total: min(10 - total, 100 * (2 - total)), most=2)
    assert SharingGame(agents=2, worth=kinked, cost=1).optimum_total == pytest.approx(190 / 99), "at the kink"


def test_payoffs_have_any_leading_axes():
    game = herders(2)
    taken = np.array([[[1, 1], [0, 2]], [[0, 0], [4, 4]]])
    # v(2) = 6, less 1 each; v(0) = 10; v(8) = 0, so an animal costs 1 and brings nothing.
    assert game.payoffs(taken).tolist() == [[[5, 5], [0, 10]], [[0, 0], [-4, -4]]]
    assert game.payoffs(taken).sum(-1)[0].tolist() == [game.surplus(2)] * 2


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: exact_yield(presets.game("single_basic").map, PUBLISHED), "the board has 13 sites"),
        (lambda: appropriation(tokens=0), "tokens"),
        (lambda: herders(2).payoffs([1, 2, 3]), "taken"),
        (lambda: herders(2).payoffs([1, -1]), "taken"),
        (lambda: appropriation(2).payoffs([1, float("nan")]), "taken"),
        (lambda: CallableWorth(function=3, most=1), r"CallableWorth\.function"),
        *(
            (lambda function=function, most=most: CallableWorth(function=function, most=most), "function")
            for function, most in (
                (lambda a: a, 1),  # 0 at 0
                (lambda a: 1 + a, 1),  # it rises
                (lambda a: 1 / (1 + a), 1),  # less steep
                (lambda a: 10 - a, 2),  # 8 at most
                (lambda a: 5, 3),
                (lambda a: 1 / a, 3),  # it fails at 0
                (lambda a: "five", 3),
            )
        ),
    ],
)
def test_what_does_not_fit_is_refused(call, field):
    with pytest.raises(ValueError, match=field):
        call()


def test_a_cross_bears_a_tenth_of_an_apple_a_turn_and_keeps_three():
    found = exact_yield(CROSS, AS_RUN)
    # Three are kept, and each of the other two sites grows with 0.05 in any turn.
    assert found.per_step == pytest.approx(0.1, abs=TOLERANCE)
    assert found.kept == pytest.approx(3)
    assert sustainable_yield(CROSS, AS_RUN) == pytest.approx(found.per_step), "the lower bound is reached"
    one = exact_yield(CROSS, AS_RUN, bites_per_step=1, sees_growth=True)
    assert one.per_step == pytest.approx(0.09987, abs=5e-6)
    # Who chooses before it sees what grew waits on one site for 20 turns; meanwhile the other has grown.
    assert exact_yield(CROSS, AS_RUN, bites_per_step=1).per_step == pytest.approx(0.0975)
    assert exact_yield(CROSS, PUBLISHED).per_step == pytest.approx(2 * 0.05 / 1.05)


def test_a_pair_is_worked_by_hand():
    # Two sites near each other, 1/2 with one apple near and nothing with none: one is kept for ever.
    pair = maps.parse("AA>")
    rules = Rules(regrow_prob=(0.0, 0.5), growth="before_bites")
    assert exact_yield(pair, rules).per_step == pytest.approx(0.5)
    both = yield_bounds(pair, rules)
    assert (both.at_least, both.at_most, both.is_exact, both.stock.sum()) == (0.5, 0.5, True, 1)
    # Without growth in the turn of the bite a site is full, empty and perhaps full again: 0.5 / 1.5.
    late = Rules(regrow_prob=(0.0, 0.5))
    assert exact_yield(pair, late).per_step == pytest.approx(1 / 3)
    assert yield_bounds(pair, late).at_least == pytest.approx(1 / 3)
    assert yield_bounds(pair, late).at_most == pytest.approx(1 / 2)
    assert exact_yield(maps.parse("A>"), PUBLISHED).per_step == 0


def test_a_pair_bears_less_where_nothing_grows_under_agents():
    rules = Rules(regrow_prob=(0.0, 0.5), growth="before_bites", regrow_under_agents=False)
    bounds = yield_bounds(maps.parse("AA>"), rules)
    assert (bounds.at_least, bounds.at_most) == pytest.approx((1 / 3, 1 / 2))


@pytest.mark.parametrize(("regrow_by", "per_step"), [("count", 0.5), ("share", 1.0), ("share_with_own", 0.4)])
def test_the_bounds_follow_what_growth_depends_on(regrow_by, per_step):
    # By count the middle site grows with 0.5 between two apples. By share the other two do beside one, 0.5
    # each; or with 0.2 each where the site itself, empty, counts as the half of those near.
    rules = Rules(
        regrow_prob=(0.0, 0.2, 0.5), regrow_radius_cells=1, regrow_by=regrow_by, growth="before_bites"
    )
    bounds = yield_bounds(maps.parse("AAA>"), rules)
    assert (bounds.at_least, bounds.at_most) == pytest.approx((per_step, per_step))


def test_the_bounds_of_a_map_with_a_river_are_refused():
    with pytest.raises(ValueError, match=r"Map\.river"):
        yield_bounds(maps.parse("~A>"), PUBLISHED)


@st.composite
def boards(draw):
    cells = draw(st.permutations([(r, c) for r in range(3) for c in range(4)]))
    most = draw(st.integers(1, 5))
    return Map(height=3, width=4, sites=tuple(cells[1 : most + 1]), starts=((*cells[0], 0),))


@pytest.mark.integration
@settings(deadline=None, max_examples=25)
@given(
    board=boards(),
    probs=st.lists(st.sampled_from([0.0, 0.05, 0.2, 0.5, 1.0]), min_size=1, max_size=5),
    growth=st.sampled_from(["from_start", "before_bites"]),
)
def test_the_exact_yield_lies_between_the_bounds(board, probs, growth):
    rules = Rules(regrow_prob=tuple(probs), growth=growth)
    exact = exact_yield(board, rules).per_step
    bounds = yield_bounds(board, rules)
    assert sustainable_yield(board, rules) - 1e-8 <= bounds.at_least <= exact + 1e-8
    assert exact <= bounds.at_most + 1e-8
    if growth == "before_bites":
        assert bounds.is_exact or list(probs) != sorted(probs)
    assert exact_yield(board, rules, bites_per_step=1).per_step <= min(exact, 1) + 1e-8
    assert exact_yield(board, rules, sees_growth=True).per_step >= exact - 1e-8


@settings(deadline=None, max_examples=25)
@given(board=boards(), probs=st.lists(st.sampled_from([0.0, 0.05, 0.2, 0.5, 1.0]), min_size=1, max_size=5))
def test_no_stock_grows_faster_than_the_bound(board, probs):
    rules = Rules(regrow_prob=tuple(probs), growth="before_bites")
    growths = [
        sum(
            probs[min(sum(stock[other] for other in others), len(probs) - 1)]
            for full, others in zip(stock, sites_around(board, rules), strict=True)
            if not full
        )
        for stock in product((0, 1), repeat=len(board.sites))
    ]
    bound = yield_bounds(board, rules).at_most
    assert bound >= max(growths) - 1e-8
    if list(probs) == sorted(probs):
        assert bound == pytest.approx(max(growths), abs=1e-8)


def test_what_is_kept_is_worth_its_own_growth_where_more_apples_near_mean_less():
    cross = maps.parse(".A.\nAAA\n.A>")
    rules = Rules(regrow_prob=(0.05, 0.02), growth="before_bites")
    bounds, exact = yield_bounds(cross, rules), exact_yield(cross, rules).per_step
    assert bounds.at_least == pytest.approx(0.25)
    assert bounds.at_most == pytest.approx(exact) == pytest.approx(0.25)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("board", "per_step"), [("single_basic", 0.5), ("single_complex", 0.9), ("commons", 2.51)]
)
def test_the_boards_as_run_bear_exactly_so_much(board, per_step):
    game = presets.game(board, variant="as_run")
    found = yield_bounds(game.map, game.rules)
    assert found.is_exact
    assert found.at_least == pytest.approx(per_step)


def test_a_search_that_stops_early_leaves_bounds_apart():
    game = presets.game("single_basic", variant="as_run")
    found = yield_bounds(game.map, game.rules, nodes=2)
    assert found.at_least <= 0.5 <= found.at_most
    assert not found.is_exact
