"""A governor sets a number of another institution, in each world by itself, every few turns."""

from functools import partial

import numpy as np
import pytest
import torch
from boards import Play
from torchrl.envs.utils import check_env_specs

from cprl import CommonsEnv, Custom, Game, Rules, keys, maps
from cprl.institutions import Boundaries, Governor, GraduatedSanctions, Quota, Tax, Vote
from cprl.measuring import social
from cprl.measuring.registry import (
    INSTITUTION_ENTRIES,
    OPTIONAL_ENTRIES,
    compute_metrics,
    metrics_for,
)
from cprl.measuring.welfare import welfare
from cprl.policies.governors import Constant, GovernorActor, StockRule

ROW = ">AAAA"
LOST = Tax(redistribution="none")
RATE = Governor(sets="tax.rate", options=(0.0, 0.5, 1.0), every_steps=2)
SHARE = Governor(sets="quota.share", options=(0.0, 0.5, 1.0), every_steps=2)


def ruled(play, *rule):
    play.batch.put_in_force(np.array(rule))
    return play


def in_force(play):
    return play.output.in_force[0].tolist()


def test_the_first_option_is_in_force_until_the_governor_sets_another():
    play = Play(ROW, institutions=[LOST, RATE])
    assert in_force(play.turn("forward")) == [0.0]
    assert play.fines == [0.0]
    assert in_force(ruled(play, 1).turn("forward")) == [0.5]
    assert play.fines == [0.5], "from the very turn on"
    assert in_force(play.turn("forward").again()) == [0.5], "also in the next episode"


def test_each_world_has_a_number_of_its_own():
    play = Play(ROW, worlds=3, institutions=[LOST, RATE])
    ruled(play, 2, 0, 1).turn("forward")
    assert play.output.fines[:, 0].tolist() == [1.0, 0.0, 0.5]


def test_a_quota_whose_window_opens_with_the_turn_has_the_new_share():
    play = Play(ROW, institutions=[Quota(window_steps=2), SHARE], regrow_prob=(0.5,))
    unit = play.batch.law.quotas.window_yield[0]
    assert play.batch.law.quotas.allowed[0, 0] == 0
    ruled(play, 2).turn("stay")
    assert play.batch.law.quotas.allowed[0, 0] == unit
    ruled(play, 1).turn("stay")
    assert play.batch.law.quotas.allowed[0, 0] == 0.5 * unit, "the window of the third turn"


OUTSIDE = Boundaries.drawn("........\n...0....", step_fine=1.0)
BOARD = "A.......\n>..^...."
"""Agent 1 stands in the region of agent 0, in the beam of agent 0."""
LEVEL = Governor(sets="sanctions.level", options=(0.0, 1.0, 2.0), every_steps=2)


@pytest.mark.parametrize(
    ("on", "acts", "fines"),
    [("violations", ("stay", "stay"), [11, 3, 21, 21]), ("tags", ("beam", "stay"), [10, 2, 20, 20])],
)
def test_a_governor_sets_the_level_of_a_first_offence(on, acts, fines):
    sanctions = GraduatedSanctions(freeze_steps=(0,), fines=(2, 10, 20), recovery_steps=None, on=on)
    play = Play(BOARD, institutions=[OUTSIDE, sanctions, LEVEL] if on != "tags" else [sanctions, LEVEL])
    paid = [
        ruled(play.again(), 1).turn(*acts).fines[1],
        ruled(play.again(), 0).turn(*acts).fines[1],
        ruled(play, 1).turn(*acts).fines[1],  # the second offence, one level higher
        ruled(play, 2).turn(*acts).fines[1],  # there is no higher level
    ]
    assert paid == fines


def test_agents_miss_as_many_turns_as_the_level_in_force_says_and_see_it():
    sanctions = GraduatedSanctions(freeze_steps=(1, 3, 5), fines=(0,), recovery_steps=None, on="tags")
    play = Play(BOARD, worlds=2, institutions=[sanctions, LEVEL])
    ruled(play, 1, 2).turn("beam", "stay")
    assert play.batch.now.out_steps[:, 1].tolist() == [3, 5]
    assert play.shown(2)[1] == [255, 128], "level 1 in force, and level 2 comes next"
    assert [ballot.title for ballot in play.game.in_force] == ["the level of a first offence"]


def test_agents_vote_on_one_thing_and_the_governor_sets_another():
    governor = Governor(sets="quota.share", options=(0.25, 0.75), every_steps=2)
    play = Play(ROW, institutions=[governor, Quota(), Vote(on=LOST, choices=(0.0, 0.5))], regrow_prob=(0.5,))
    assert play.game.decisions == 2
    assert [ballot.title for ballot in play.game.in_force] == ["the tax rate", "the quota's share"]
    ruled(play, 1).turn("stay", decisions=(1,))
    assert in_force(play) == [0.5, 0.75]
    assert play.game.entries_shown == ("in force 1", "quota left 0", "quota time 0", "in force 0")


def test_the_environment_reads_the_rule_and_shows_what_can_be_seen():
    game = Game(
        map=maps.parse(">AAAA\n>AAAA"),
        rules=Rules(regrow_prob=(0.0,), episode_steps=10),
        institutions=(Tax(), RATE),
    )
    env = CommonsEnv(game, worlds=2, seed=0)
    check_env_specs(env)
    moment = env.reset()
    assert moment[keys.SEEN].tolist() == [[1, 0, 1, 0, 0]] * 2
    moment[keys.ACTION] = torch.tensor([[0, 7], [7, 7]])
    moment[keys.RULE] = torch.tensor([1, 2])
    after = env.step(moment)["next"]
    assert after[keys.IN_FORCE].tolist() == [[0.5], [1.0]]
    seen = torch.tensor([[7 / 8, 1, 0, 0, 0.1], [1, 0, 1, 0, 0.1]])
    assert torch.allclose(after[keys.SEEN], seen)
    with pytest.raises(ValueError, match="rule"):
        env.step(moment.set(keys.RULE, torch.tensor([0, 3])))


def test_a_governor_sees_the_equality_of_the_harvests_of_the_episode_so_far():
    governor = Governor(sets="tax.rate", sees=("equality", "time"))
    apples = np.array([[3, 1, 0], [0, 0, 0], [2, 2, 2]])
    steps = np.array([4, 0, 2])
    seen = governor.observe(
        stock=apples[:, 0] / 9, elapsed_steps=steps, harvested=apples, violations=apples * 0, horizon_steps=8
    )
    assert seen[:, 1].tolist() == [0.5, 0.0, 0.25]
    assert seen[1, 0] == 1, "nobody has less than another"
    assert seen[::2, 0].tolist() == pytest.approx(social.equality(apples[::2]).tolist())


STOCKS = torch.tensor([[0.0], [0.3], [0.5], [1.0]])


@pytest.mark.parametrize(
    ("rule", "sets", "options"),
    [
        (StockRule(), "quota.share", [0, 1, 1, 2]),
        (StockRule(), "tax.rate", [2, 1, 1, 0]),
        (StockRule(), "sanctions.level", [2, 1, 1, 0]),
        (StockRule(lower=0.4, upper=0.6), "quota.share", [0, 0, 1, 2]),
        (Constant(0.5), "tax.rate", [1, 1, 1, 1]),
    ],
)
def test_rules_of_thumb_by_the_stock(rule, sets, options):
    governor = Governor(sets=sets, options=(0.0, 0.5, 1.0), sees=("stock",))
    rule.check(governor)
    assert rule.choose(governor, STOCKS).tolist() == options


def test_a_governor_decides_every_few_turns_and_not_before_its_first():
    governor = Governor(sets="tax.rate", options=(0.0, 0.5, 1.0), sees=("stock",), every_steps=3)
    actor = GovernorActor(governor, StockRule(), from_turn=2)
    decided = [int(actor.decide(torch.tensor([[stock / 10]]))) for stock in range(8)]
    assert decided == [0, 0, 0, 1, 1, 1, 1, 1]  # at turns 3 and 6: stocks of 0.3 and 0.6
    twin = GovernorActor(governor, StockRule())
    twin.load_state_dict(actor.state_dict())
    assert (twin.turns, twin.options_in_force.tolist()) == (8, [1])


INCOMES = np.array([[3.0, 1.0], [0.0, 0.0]])


def sums(incomes, steps):
    return incomes.sum(-1) * 10


@pytest.mark.parametrize(
    ("objective", "wanted"),
    [
        ("income", [2, 0]),
        ("lowest_income", [1, 0]),
        ("income_times_equality", [1.5, 0]),  # 1 - Gini of 3 and 1: 1 - 4 / 16
        (Custom("test_governor:sums"), [40, 0]),
    ],
)
def test_what_a_governor_wants_of_a_period_of_two_turns(objective, wanted):
    def welfare_of(stock, **more):
        governor = Governor(sets="tax.rate", objective=objective, every_steps=2, **more)
        game = Play(ROW, institutions=[LOST, governor]).game
        return welfare(game, INCOMES, np.array([2, 2]), np.array(stock) * len(game.map.sites)).tolist()

    assert welfare_of([1.0, 1.0]) == wanted
    assert welfare_of([0.4, 1.0], least_stock=0.5) == [0, 0]


def test_an_episode_has_the_mean_of_what_was_in_force_and_the_objective_of_the_whole():
    play = Play(ROW, institutions=[LOST, Governor(sets="tax.rate", every_steps=2, least_stock=0.4)])
    assert metrics_for((*OPTIONAL_ENTRIES, *INSTITUTION_ENTRIES), play.game)[-2:] == (
        "governor/rule",
        "governor/objective",
    )
    totals = {"rules": np.array([[1.5]]), "steps": np.array([4]), "objective": partial(welfare, play.game)}
    paid = {"harvest": [[3.0, 1.0]], "fines": [[0.5, 0.5]], "transfers": [[0.0, 0.0]], "stock_left": [2]}
    found = compute_metrics(totals | {name: np.array(values) for name, values in paid.items()})
    assert found["governor/rule"].tolist() == [0.375]
    assert found["governor/objective"].tolist() == [0.75]
    found = compute_metrics(
        totals | {name: np.array(values) for name, values in paid.items()} | {"stock_left": 1}
    )
    assert found["governor/objective"].tolist() == [0], "the stock fell below 0.4 of four sites"


@pytest.mark.parametrize(
    ("field", "governor", "others"),
    [
        ("sets", RATE, [Quota(share=0.5)]),
        ("sets", RATE, [Vote(on=Tax())]),
        ("sets", Governor(sets="quota.share"), [Tax()]),
        ("options", RATE, [Tax(brackets=((0, 0.5),))]),
        ("options", Governor(sets="tax.rate", options=(0.5, 1.5)), [Tax()]),
        ("every_steps", Governor(sets="tax.rate", every_steps=11), [Tax()]),
        ("Governor", RATE, [Tax(), RATE]),
        ("sets", LEVEL, [Tax()]),
        ("options", LEVEL, [GraduatedSanctions(freeze_steps=(1, 2), fines=(0, 1))]),
        ("options", Governor(sets="sanctions.level", options=(0.0, 0.5)), [GraduatedSanctions()]),
    ],
)
def test_a_governor_that_the_game_does_not_fit_is_refused(field, governor, others):
    with pytest.raises(ValueError, match=field):
        Play(ROW, institutions=[*others, governor], episode_steps=10, regrow_prob=(0.5,))


@pytest.mark.parametrize(
    ("field", "wrong"),
    [
        ("sets", {"sets": "quota.fine"}),
        ("options", {"options": (0.5,)}),
        ("sees", {"sees": ()}),
        ("sees", {"sees": ("stock", "stock")}),
        ("objective", {"objective": "harvest"}),
        ("least_stock", {"least_stock": 2.0}),
    ],
)
def test_a_governor_that_makes_no_sense_is_refused(field, wrong):
    with pytest.raises(ValueError, match=field):
        Governor(**{"sets": "tax.rate", **wrong})
    with pytest.raises(ValueError, match="lower"):
        StockRule(lower=0.5, upper=0.5)
