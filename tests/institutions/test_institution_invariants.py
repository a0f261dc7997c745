"""Invariants of games with institutions, on random boards, rules, institutions and actions."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from boards import assert_same, kept, only_quirks, play_on, played as played_without, random_actions
from governed import (
    EVERYTHING,
    FINES,
    MEDIATIONS,
    boundaries,
    governed_games,
    levies,
    random_decisions,
    random_play,
    taxes,
)
from hypothesis import given, settings, strategies as st
from random_games import games

from cprl import Observation, institutions as law, presets
from cprl.commons.batch import Batch
from cprl.commons.world import PLAYING
from cprl.institutions.arrays import state_arrays

# Random walls and boundaries may part all agents from all apples.
pytestmark = [
    pytest.mark.filterwarnings("ignore:no agent can harvest:UserWarning"),
    pytest.mark.filterwarnings("ignore:Quota.window_steps is .* nobody ever harvests:UserWarning"),
]

SEEDS = st.integers(0, 2**32 - 1)
AS_RUN = {
    "clashes": "pairwise",
    "growth": "before_bites",
    "quirks": only_quirks(freeze_counts_tag_turn=True, ends_one_turn_late=True, picture_shows_old_stock=True),
}
QUICK = settings(max_examples=60, deadline=None)
PAYMENTS = ("reward", "fines", "transfers", "violated", "counts", "in_force", "ballots_due")
"""What institutions write into the output of a turn."""


def check_untouched(game, seed):
    plain = replace(game, institutions=())
    actions = random_actions(30, 2, game, seed=seed)
    cells = len(game.cell_channels)
    for moment, (worlds, turn, *_) in zip(
        random_play(game, turns=30, seed=seed), played_without(plain, actions, seed=seed), strict=True
    ):
        assert_same(moment.worlds, worlds)
        payments = {name: getattr(turn, name) for name in PAYMENTS}
        assert_same(moment.turn._replace(observation=moment.turn.observation[:, :, :cells], **payments), turn)


@pytest.mark.integration
@settings(max_examples=90, deadline=None)
@given(game=governed_games(harmless=True) | governed_games(harmless=True, **AS_RUN), seed=SEEDS)
def test_payments_alone_leave_the_game_as_it_is_bit_for_bit(game, seed):
    check_untouched(game, seed)


@pytest.mark.integration
@QUICK
@given(game=governed_games(), seed=SEEDS)
def test_the_reward_is_the_harvest_less_fines_plus_transfers_and_an_ended_world_pays_nothing(game, seed):
    ended = np.zeros(2, bool)
    for moment in random_play(game, seed=seed):
        turn = moment.turn
        expected = turn.harvest.astype(np.float64) - turn.fines + turn.transfers
        np.testing.assert_allclose(turn.reward, expected, rtol=1e-5, atol=1e-6)
        assert (turn.fines >= 0).all()
        assert (turn.transfers >= 0).all()
        for flow in (turn.fines, turn.transfers, turn.reward, turn.violated):
            assert not flow[ended].any()
        ended = moment.worlds.ended[:, 0] != PLAYING


@pytest.mark.integration
@QUICK
@given(game=governed_games(), seed=SEEDS)
def test_counts_add_up(game, seed):
    moments = [moment.turn for moment in random_play(game, seed=seed)]
    for before, moment in itertools.pairwise(moments):
        grown = moment.counts - before.counts
        assert (grown >= 0).all()
        assert np.array_equal(grown[..., law.COUNT_NAMES.index("violations")], moment.violated)
    for moment in moments:
        counts = {name: moment.counts[..., n] for n, name in enumerate(law.COUNT_NAMES)}
        assert (moment.counts >= 0).all()
        assert (counts["detections"] <= counts["violations"]).all()
        assert (counts["returns_to_violation"] <= counts["violations"]).all()
        assert not counts["returns_to_violation"][counts["sanctions"] == 0].any()


def with_one(strategy):
    """Games with one institution of a strategy that is a function of the game."""
    apart = Observation(agents_apart=True)
    return games().flatmap(
        lambda game: strategy(game).map(lambda own: replace(game, observation=apart, institutions=(own,)))
    )


def sums(game, seed):
    """Of each turn: harvest, fines and transfers [T, B, N] of a whole episode, and the last counts."""
    moments = random_play(game, turns=game.rules.episode_steps, seed=seed)[1:]
    assert (moments[-1].worlds.ended != PLAYING).all()
    flows = [(moment.turn.harvest, moment.turn.fines, moment.turn.transfers) for moment in moments]
    counts = {name: moments[-1].turn.counts[..., n] for n, name in enumerate(law.COUNT_NAMES)}
    return *np.array(flows, np.float64).swapaxes(0, 1), counts


def close(one, other):
    np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


@QUICK
@given(game=with_one(lambda _: taxes()), seed=SEEDS)
def test_a_tax_takes_what_is_owed_by_the_end_and_gives_it_back_at_once_or_not_at_all(game, seed):
    harvest, fines, transfers, _ = sums(game, seed)
    (tax,) = game.institutions
    if not tax.brackets:
        close(fines.sum(0), tax.rate * harvest.sum(0))
    if tax.redistribution == "none":
        assert not transfers.any()
    else:
        close(transfers.sum(-1), fines.sum(-1))
        close(transfers, transfers[..., :1].repeat(game.agents, -1))


@QUICK
@given(game=with_one(lambda game: levies(game.agents)), seed=SEEDS)
def test_levies_take_their_rates_of_each_harvest_and_keep_nothing(game, seed):
    harvest, fines, transfers, _ = sums(game, seed)
    close(fines, 0.75 * harvest)
    close(transfers.sum(-1), fines.sum(-1))
    (own,) = game.institutions
    for group in own.groups:
        joint = 0.5 * harvest.sum(-1) * len(group) / game.agents
        close(transfers[..., list(group)].sum(-1), 0.25 * harvest[..., list(group)].sum(-1) + joint)


@QUICK
@given(game=with_one(lambda _: MEDIATIONS), seed=SEEDS)
def test_mediation_keeps_nothing(game, seed):
    _, fines, transfers, counts = sums(game, seed)
    close(fines.sum(-1), transfers.sum(-1))
    if game.institutions[0].refund:
        assert (fines.sum(0) > 0).sum() == (counts["unjust_tags"] > 0).sum()


@QUICK
@given(game=with_one(lambda game: boundaries(game.map, FINES, FINES)), seed=SEEDS)
def test_boundaries_charge_so_much_for_each_bite_and_step(game, seed):
    harvest, fines, transfers, counts = sums(game, seed)
    (own,) = game.institutions
    close(fines.sum(0), own.bite_fine * counts["foreign_bites"] + own.step_fine * counts["trespasses"])
    assert not transfers.any()
    assert (counts["own_bites"] + counts["foreign_bites"] <= harvest.sum(0)).all()


FINED_LIMITS = (
    st.builds(law.Quota, share=st.sampled_from([0.0, 0.5]), window_steps=st.integers(1, 9), fine=FINES)
    | st.builds(law.ClosedSeason, period_steps=st.just(5), closed_steps=st.integers(0, 5), fine=FINES)
    | st.builds(law.ClosedPatches, below=st.integers(0, 4), fine=FINES)
    | st.builds(law.Rotation, window_steps=st.integers(1, 9), fine=FINES)
)


@QUICK
@given(game=with_one(lambda _: FINED_LIMITS), seed=SEEDS)
def test_limits_charge_so_much_for_each_bite_beyond_them(game, seed):
    _, fines, transfers, counts = sums(game, seed)
    (own,) = game.institutions
    close(fines.sum(0), own.fine * (counts["excess_bites"] + counts["closed_bites"]))
    assert not transfers.any()


@QUICK
@given(game=games(), seed=SEEDS, share=st.sampled_from([0.3, 1.0]), window=st.integers(1, 9))
def test_nobody_harvests_more_than_a_quota_in_a_window(game, seed, share, window):
    game = replace(game, institutions=(law.Quota(share=share, window_steps=window),))
    most = share * game.law_parameters["quotas"]["window_yield"][0]
    harvest, fines, _, counts = sums(game, seed)
    for first in range(0, len(harvest), window):
        assert (harvest[first : first + window].sum(0) <= most + 1e-6).all()
    assert not fines.any()
    assert not counts["excess_bites"].any()


@QUICK
@given(game=games(), seed=SEEDS, window=st.integers(1, 9))
def test_nobody_harvests_in_the_window_of_another(game, seed, window):
    game = replace(game, institutions=(law.Rotation(window_steps=window),))
    harvest, fines, _, counts = sums(game, seed)
    whose = np.arange(len(harvest)) // window % game.agents
    of_another = whose[:, None] != np.arange(game.agents)
    assert not harvest[np.broadcast_to(of_another[:, None], harvest.shape)].any()
    assert not fines.any()
    assert not counts["closed_bites"].any()


@pytest.mark.integration
@QUICK
@given(game=with_one(lambda game: boundaries(game.map, st.none(), st.none())), seed=SEEDS)
def test_nobody_harvests_in_the_region_of_others(game, seed):
    (own,) = game.institutions
    for moment in random_play(game, seed=seed)[1:]:
        for world, agent in np.argwhere(moment.turn.harvest > 0):
            row, col = moment.worlds.row[world, agent], moment.worlds.col[world, agent]
            assert own.regions[row][col] in ("." + own.signs_of(agent))


@pytest.mark.integration
@QUICK
@given(game=games(), seed=SEEDS, cost=FINES, monitor=st.sampled_from([None, 0]))
def test_inspection_costs_the_same_in_every_turn_until_the_end(game, seed, cost, monitor):
    never_broken = law.Quota(share=1e6, fine=0)
    game = replace(game, institutions=(law.Monitoring(cost=cost, monitor=monitor), never_broken))
    for before, moment in zip(*(random_play(game, seed=seed)[n:] for n in (0, 1)), strict=False):
        is_playing = before.worlds.ended[:, 0] == PLAYING
        close(moment.turn.fines.sum(-1), cost * is_playing)


@QUICK
@given(game=games(), seed=SEEDS)
def test_fines_without_recovery_are_those_of_so_many_sanctions(game, seed):
    levels = (0.5, 2.0, 7.0)
    own = law.GraduatedSanctions(freeze_steps=(1, 2), fines=levels, recovery_steps=None)
    game = replace(game, institutions=(own,))
    _, fines, _, counts = sums(game, seed)
    owed = np.cumsum([0, *levels, *[levels[-1]] * 99])
    close(fines.sum(0), owed[counts["sanctions"]])


@QUICK
@given(game=games(), seed=SEEDS)
def test_only_the_sanctioner_fires(game, seed):
    game = replace(game, institutions=(law.Sanctioner(agents=(0,)),))
    for moment in random_play(game, seed=seed):
        assert not moment.turn.fired[:, 1:].any()


@pytest.mark.integration
@QUICK
@given(game=governed_games(ballots=False), seed=SEEDS, order=st.randoms(use_true_random=False))
def test_the_order_of_institutions_changes_no_move_and_no_payment(game, seed, order):
    shuffled = list(game.institutions)
    order.shuffle(shuffled)
    other = replace(game, institutions=tuple(shuffled))
    for one, two in zip(random_play(game, seed=seed), random_play(other, seed=seed), strict=True):
        assert_same(one.worlds, two.worlds)
        for name in ("fines", "transfers", "reward", "violated", "counts"):
            mine, theirs = getattr(one.turn, name), getattr(two.turn, name)
            np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-6, err_msg=name)


def test_the_order_of_institutions_is_that_of_ballots_and_of_what_is_shown():
    ballots = [replace(EVERYTHING, institutions=EVERYTHING.institutions[::step]) for step in (1, -1)]
    titles, backwards = ([ballot.title for ballot in game.ballots] for game in ballots)
    assert titles == backwards[::-1] == ["the quota's share", "the tax rate", "who monitors", "who may fire"]
    assert ballots[0].decisions == ballots[1].decisions == 3 * 2 * 3 * 3


def begun(game, seed, *, worlds=2, turns=20):
    """A new batch, its output, and so many actions and decisions for it."""
    batch = Batch(game, worlds, seed=seed)
    choices = [draw(turns, worlds, game, seed=seed) for draw in (random_actions, random_decisions)]
    return batch, batch.begin(), *choices


@pytest.mark.integration
@QUICK
@given(game=governed_games(), seed=SEEDS)
def test_at_an_episodes_begin_everything_but_what_is_in_force_is_as_in_a_new_world(game, seed):
    batch, output, actions, decisions = begun(game, seed)
    new = batch.state()
    play_on(batch, output, actions, decisions)
    batch.begin(output)
    again = batch.state()
    apart = {name for name in new if not np.array_equal(new[name], again[name])}
    # A quota that is voted on begins with the share in force.
    assert apart <= {"episode", *(("in_force", "allowed") if game.ballots else ())}


@pytest.mark.integration
@QUICK
@given(game=governed_games(), seed=SEEDS)
def test_an_episode_does_not_know_what_was_done_in_the_one_before(game, seed):
    second_episodes = []
    for was_idle in (False, True):
        batch, output, actions, decisions = begun(game, seed)
        first = np.full_like(actions, game.actions.index("stay")) if was_idle else actions
        play_on(batch, output, first, decisions)
        batch.begin(output)
        second_episodes.append([kept(batch, output), *play_on(batch, output, actions, decisions)])
    for one, other in zip(*second_episodes, strict=True):
        assert_same(one, other)


@pytest.mark.integration
@QUICK
@given(game=governed_games(), seed=SEEDS, turns=st.integers(0, 25))
def test_a_state_that_is_loaded_plays_on_bit_for_bit(game, seed, turns):
    batch, output, actions, decisions = begun(game, seed, turns=40)
    play_on(batch, output, actions[:turns], decisions[:turns])
    other = Batch(game, 2, seed=5)
    shown = other.load(batch.state())
    assert {name for name, *_ in state_arrays(batch.law)} <= set(batch.state())
    assert np.array_equal(shown.observation, output.observation), "planes of institutions, too"
    for name in ("fines", "transfers", "reward", "violated"):
        assert not getattr(shown, name).any(), name
    for name in ("counts", "in_force"):
        assert np.array_equal(getattr(shown, name), getattr(output, name)), name
    rest = actions[turns:], decisions[turns:]
    for one, two in zip(play_on(batch, output, *rest), play_on(other, shown, *rest), strict=True):
        assert_same(one, two)


@pytest.mark.integration
@QUICK
@given(game=governed_games(), seed=SEEDS)
def test_a_world_of_a_batch_plays_as_it_would_alone(game, seed):
    batch, output, actions, decisions = begun(game, seed, worlds=3, turns=25)
    alone = Batch(game, 1, seed=seed, first_world=2)
    whole = play_on(batch, output, actions, decisions)
    its_choices = actions[:, 2:].copy(), decisions[:, 2:].copy()
    single = play_on(alone, alone.begin(), *its_choices)
    for one, other in zip(whole, single, strict=True):
        assert_same(one, other, rows=slice(2, 3))


@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_changes_nothing(threads):
    one, other = (random_play(EVERYTHING, worlds=7, turns=60, seed=4, threads=n) for n in (1, threads))
    for moment, threaded in zip(one, other, strict=True):
        assert_same(moment, threaded)


def test_everything_at_once_happens_somewhere():
    moments = random_play(EVERYTHING, worlds=20, turns=24, seed=1)
    counts = np.max([moment.turn.counts for moment in moments], (0, 1, 2))
    assert all(counts), dict(zip(law.COUNT_NAMES, counts.tolist(), strict=True))
    assert any(moment.turn.transfers.any() for moment in moments)
    assert len({tuple(row) for moment in moments for row in moment.turn.in_force.tolist()}) > 5


@pytest.mark.parametrize("variant", ["published", "as_run"])
def test_the_published_board_under_its_owners_plays_as_without_them_where_all_is_allowed(variant):
    game = presets.game("commons", variant=variant)
    as_the_rules_say = law.GraduatedSanctions(
        freeze_steps=(game.rules.freeze_steps,), fines=(0,), recovery_steps=None, on="tags"
    )
    harmless = (
        *(law.Boundaries(regions=("." * game.map.width,) * game.map.height), law.Quota(share=1e6)),
        *(law.ClosedSeason(closed_steps=0), law.ClosedPatches(below=0), law.Sanctioner(agents=(0, 1, 2, 3))),
    )
    check_untouched(replace(game, institutions=(*harmless, as_the_rules_say)), seed=3)
