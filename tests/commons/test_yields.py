"""The sustainable yield is a lower bound of what a map bears, which a harvest in a known way reaches."""

from dataclasses import fields, replace
from itertools import product

import numpy as np
import pytest
from boards import AS_RUN, CROSS, PUBLISHED, Play
from hypothesis import given, settings, strategies as st

from cprl import Map, Rules, maps, presets
from cprl.commons import yields
from cprl.commons.batch import Batch
from cprl.commons.near import sites_around
from cprl.commons.yields import sustainable_yield
from cprl.institutions import Quota
from cprl.measuring.registry import constants_of

FAR = maps.crosses(height=7, width=30, centres=((3, 3), (3, 12), (3, 21)), starts=((0, 0, 0),))


@pytest.mark.parametrize(
    ("board", "rules", "expected"),
    [
        # All five sites of a cross are near each other. Two are harvested and have three apples near:
        # 2 x 0.05; with one it is 1 x 0.05 (four near), with three 3 x 0.01 (two near).
        (CROSS, AS_RUN, 0.1),
        # As published a harvested site also stands full for the turn in which it is bitten: 0.05 / 1.05 each.
        (CROSS, PUBLISHED, 2 * 0.05 / 1.05),
        (FAR, AS_RUN, 0.3),
        (CROSS, Rules(regrow_prob=(0.0,)), 0),
        (maps.parse("A...>...A"), PUBLISHED, 0),  # no apple is near another
        # Apples from nothing: three sites are harvested, each 1/2 without regrowth in the same turn.
        (maps.parse("AAA>"), Rules(regrow_prob=(1.0,)), 1.5),
        (maps.parse("AAA>"), Rules(regrow_prob=(1.0,), growth="before_bites"), 3),
        # Nothing grows under an agent, which has to leave the site for a turn.
        (
            maps.parse("AAA>"),
            Rules(regrow_prob=(1.0,), growth="before_bites", regrow_under_agents=False),
            1.5,
        ),
        # A pair whose probability falls. One harvested, its neighbour full: always one near, 0.2 / 1.2. Both
        # harvested: none or one near, so at least 0.2 each, 2 x 0.2 / 1.2.
        (maps.parse("AA>"), Rules(regrow_prob=(0.9, 0.2)), 2 * 0.2 / 1.2),
    ],
)
def test_yields_that_are_worked_by_hand(board, rules, expected):
    assert sustainable_yield(board, rules) == pytest.approx(expected)


@st.composite
def boards(draw, sites):
    cells = draw(st.permutations([(r, c) for r in range(4) for c in range(5)]))
    most = draw(st.integers(1, sites))
    return Map(height=4, width=5, sites=tuple(cells[1 : most + 1]), starts=((*cells[0], 0),))


RULES = st.builds(
    Rules,
    regrow_prob=st.lists(st.sampled_from([0.0, 0.01, 0.05, 0.2, 0.5, 1.0]), min_size=1, max_size=5).map(
        tuple
    ),
    regrow_radius_cells=st.sampled_from([1.0, 1.5, 2.0, 3.0]),
    growth=st.sampled_from(["from_start", "before_bites"]),
)


def bound_of(harvested, near, rules):
    """What these sites bear at least if they are harvested and no others are, worked out site by site."""
    most, total = max(map(len, near)), 0.0
    for k in np.flatnonzero(harvested):
        kept = sum(not harvested[other] for other in near[k])
        p = min(rules.regrow_prob[min(n, len(rules.regrow_prob) - 1)] for n in range(kept, most + 1))
        total += p if rules.growth == "before_bites" else p / (1 + p)
    return total


def best_set(board, rules):
    """The best of all sets of harvested sites, and its bound."""
    near = sites_around(board, rules)
    sets = [np.array(chosen, bool) for chosen in product((False, True), repeat=len(near))]
    bounds = [bound_of(chosen, near, rules) for chosen in sets]
    return sets[int(np.argmax(bounds))], max(bounds)


@pytest.mark.integration
@settings(max_examples=150, deadline=None)
@given(board=boards(sites=7), rules=RULES)
def test_no_set_of_harvested_sites_bears_less_than_is_claimed(board, rules):
    claimed, (_, best) = sustainable_yield(board, rules), best_set(board, rules)
    assert claimed <= best + 1e-9, "all sets were tried"
    first_alone = bound_of(np.arange(len(board.sites)) == 0, sites_around(board, rules), rules)
    assert claimed >= first_alone - 1e-9, "one site alone is a set, too"


def harvested_per_turn(board, rules, harvested, *, worlds=300, turns=300, rng):
    """Apples a turn of a harvest of some sites as soon as they are full, played without the game's code."""
    near = np.zeros((len(board.sites),) * 2)
    for k, others in enumerate(sites_around(board, rules)):
        near[k, others] = 1
    probs = np.array(rules.regrow_prob)
    full, taken = np.ones((worlds, len(board.sites)), bool), 0
    for turn in range(turns):
        p = probs[np.minimum(full @ near.T, len(probs) - 1).astype(int)]
        grows = ~full & (rng.random(full.shape) < p)
        bitten = harvested & (full | grows if rules.growth == "before_bites" else full)
        full = (full | grows) & ~bitten
        taken += bitten.sum() * (turn >= turns // 3)
    return taken / (worlds * (turns - turns // 3))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("growth", ["from_start", "before_bites"])
def test_a_harvest_of_the_best_set_bears_at_least_its_bound(seed, growth):
    rng = np.random.default_rng(seed)
    cells = rng.permutation([(r, c) for r in range(4) for c in range(5)]).tolist()
    board = Map(height=4, width=5, sites=tuple(map(tuple, cells[1:9])), starts=((*cells[0], 0),))
    rules = Rules(regrow_prob=(0.0, 0.02, 0.05, 0.3), growth=growth)
    chosen, best = best_set(board, rules)
    played = harvested_per_turn(board, rules, chosen, rng=rng)
    # About 60,000 world-turns: the standard error is below 0.01 x the mean + 0.002.
    assert played >= best * 0.97 - 0.004
    assert sustainable_yield(board, rules) <= played / 0.97 + 0.004


@pytest.mark.parametrize(("rules", "expected"), [(AS_RUN, 0.1), (PUBLISHED, 2 * 0.05 / 1.05)])
def test_two_agents_that_stay_on_two_sites_of_a_cross_harvest_its_yield(rules, expected):
    # Agent 0 steps right onto (0, 1), agent 1 down onto (1, 2); three sites stay full, so the chance is 0.05
    # whatever the other harvested site holds.
    play = Play(CROSS, worlds=64, seed=1, **vars(rules)).turn("forward")
    taken = sum(play.turn("stay").output.harvest.sum() for _ in range(900))
    # About 5,600 apples, each by chance: a standard deviation of 75, 1.3 %.
    assert taken / (64 * 900) == pytest.approx(expected, rel=0.05)


def test_a_rule_for_which_no_yield_is_proven_is_refused_by_name_and_has_no_share_of_a_yield(monkeypatch):
    assert {field.name for field in fields(Rules)} >= yields.PROVEN
    few = replace(presets.game("commons"), rules=replace(PUBLISHED, first_stock_share=0.5))
    with pytest.raises(ValueError, match=r"Rules\.first_stock_share is 0\.5, with which no yield"):
        sustainable_yield(few.map, few.rules)
    assert constants_of(few) == {}
    grows_anywhere = replace(PUBLISHED, first_stock_share=0.5, regrow_prob=(0.01, 0.1))
    assert sustainable_yield(few.map, grows_anywhere) > 0
    monkeypatch.setattr(yields, "PROVEN", yields.PROVEN - {"hits_to_tag"})
    game = presets.game("commons", variant="as_run")
    with pytest.raises(ValueError, match=r"Rules\.hits_to_tag is 2, with which no yield of a board"):
        Batch(replace(game, institutions=(Quota(),)), 1)
    assert constants_of(game) == {}
    assert constants_of(presets.game("commons"))["sustainable_yield"] > 0
