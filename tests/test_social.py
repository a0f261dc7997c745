"""The social metrics against an episode worked by hand, at their edges, and over episodes at random."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cprl.measuring import social

# Two agents, four steps.  harvest  in play
#   step 1                    1 0      yes yes
#   step 2                    1 1      yes yes
#   step 3                    0 0      yes no
#   step 4                    1 0      yes no
HARVEST = torch.tensor([[1, 0], [1, 1], [0, 0], [1, 0]], dtype=torch.float32)
IN_PLAY = torch.tensor([[1, 1], [1, 1], [1, 0], [1, 0]], dtype=torch.bool)
BY_HAND = {
    "collective_return": 4.0,  # R = 3, 1
    "efficiency": 1.0,  # 4 apples / 4 steps
    "equality": 0.75,  # gaps |3-1| + |1-3| = 4; 1 - 4 / (2 * 2 agents * 4 apples)
    "sustainability": (7 / 3 + 2) / 2,  # agent 0 at steps 1, 2, 4; agent 1 at step 2
    "survival_steps": 4.0,
    "peace": 1.5,  # (2 agents * 4 steps - 2 agent-steps out) / 4 steps
    "peacefulness": 3.0,  # 6 agent-steps in play / 2 agents
}
EMPTY = torch.zeros(4, 2)


def values(metrics):
    return {name: value.item() for name, value in metrics.items()}


def share(harvest, **board):
    return social.summary(harvest, None, **board)["yield_share"]


def test_each_metric_is_what_we_work_out_by_hand():
    metrics = social.summary(HARVEST, IN_PLAY)
    assert values(metrics) == pytest.approx(BY_HAND, rel=1e-15)
    assert tuple(metrics) == social.METRICS
    assert {(metric.dtype, metric.shape) for metric in metrics.values()} == {(torch.float64, ())}


def test_the_yield_share_sets_the_harvest_against_what_the_map_bears():
    # 4 apples of 0.5 per step * 4 steps + 6 at first = 8
    assert share(HARVEST, sustainable_yield=0.5, first_stock=6).item() == 0.5
    assert share(HARVEST, sustainable_yield=0.1, first_stock=0).item() == 4 / (0.1 * 4), "not of float32"
    assert share(HARVEST, sustainable_yield=0, first_stock=0).isnan(), "a share of nothing"
    yields, stocks = torch.tensor([0.0, 0.5, 1.0]), torch.tensor([4, 6, 0])
    shares = share(HARVEST.expand(3, 4, 2), sustainable_yield=yields, first_stock=stocks)
    assert shares.tolist() == [1.0, 0.5, 1.0], "a yield for each episode"


def test_agents_without_a_harvest_leave_equality_and_sustainability_undefined_or_are_left_out():
    metrics = social.summary(torch.stack([HARVEST, EMPTY]), None)
    assert metrics["equality"].isnan().tolist() == [False, True]
    assert metrics["sustainability"].isnan().tolist() == [False, True]
    alone = social.summary(HARVEST * torch.tensor([1, 0]), None)
    assert alone["sustainability"].item() == pytest.approx(7 / 3)


def test_an_episode_without_steps_has_no_value_per_step():
    none = torch.zeros(0, 2)
    metrics = values(social.summary(none, none.bool()))
    undefined = {name for name, value in metrics.items() if math.isnan(value)}
    assert undefined == {"efficiency", "equality", "sustainability", "peace"}
    assert metrics["survival_steps"] == metrics["peacefulness"] == 0


def test_episodes_of_unlike_length_are_measured_in_one_batch_and_padding_is_never_read():
    played = torch.arange(7) < torch.tensor([[4], [2]])
    harvest = torch.cat([HARVEST, torch.full((3, 2), torch.nan)])
    in_play = torch.cat([IN_PLAY, torch.ones(3, 2, dtype=torch.bool)])
    both = social.summary(harvest.expand(2, 7, 2), in_play.expand(2, 7, 2), played=played)
    short = social.summary(HARVEST[:2], IN_PLAY[:2])
    assert {name: value[0].item() for name, value in both.items()} == pytest.approx(BY_HAND)
    assert {name: value[1].item() for name, value in both.items()} == values(short)


def test_a_long_sum_of_float32_loses_no_apple():
    harvest = torch.full((3, 1), 2.0**24)
    harvest[1:] = 1  # a float32 sum would stay at 2**24
    assert social.summary(harvest, None)["collective_return"].item() == 2**24 + 2


episodes = st.tuples(st.integers(1, 12), st.integers(1, 5), st.integers(0, 2**32 - 1))


@settings(max_examples=60, deadline=None)
@given(episodes)
def test_metrics_stay_in_their_ranges(episode):
    steps, agents, seed = episode
    chance = torch.Generator().manual_seed(seed)
    harvest = (torch.rand(steps, agents, generator=chance) < 0.2).float()
    in_play = torch.rand(steps, agents, generator=chance) < 0.7
    metrics = values(social.summary(harvest, in_play))
    assert 0 <= metrics["peace"] <= agents
    assert 0 <= metrics["peacefulness"] <= steps
    assert metrics["efficiency"] * steps == pytest.approx(harvest.sum().item())
    if harvest.sum() == 0:
        assert math.isnan(metrics["equality"])
    else:
        assert 1 / agents - 1e-12 <= metrics["equality"] <= 1
        assert 1 <= metrics["sustainability"] <= steps


@given(st.permutations(range(4)))
@settings(max_examples=10, deadline=None)
def test_agents_numbers_do_not_matter(order):
    harvest = torch.tensor([[1.0, 0, 0, 1], [1, 1, 0, 0], [1, 0, 0, 1]])
    in_play = harvest > 0
    shuffled = social.summary(harvest[:, order], in_play[:, order])
    assert values(shuffled) == pytest.approx(values(social.summary(harvest, in_play)))


def test_equality_is_one_when_all_have_the_same_and_one_nth_when_one_has_all():
    assert social.summary(torch.ones(5, 3), None)["equality"].item() == 1
    one_has_all = torch.tensor([[1.0, 0, 0, 0]])
    assert social.summary(one_has_all, None)["equality"].item() == pytest.approx(1 / 4)


@pytest.mark.parametrize(
    ("harvest", "in_play", "board", "field"),
    [
        (-HARVEST, IN_PLAY, {}, "harvest"),
        (HARVEST / 0, IN_PLAY, {}, "harvest"),
        (HARVEST, IN_PLAY, {"first_stock": 3}, "first_stock"),
        (None, IN_PLAY, {"sustainable_yield": 1, "first_stock": 3}, "harvest"),
        (None, None, {}, "played"),
    ],
)
def test_what_cannot_be_measured_is_refused(harvest, in_play, board, field):
    with pytest.raises(ValueError, match=field):
        social.summary(harvest, in_play, **board)
