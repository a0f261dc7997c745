"""The social metrics against an episode worked by hand, at their edges, and over episodes at random."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from cprl.measuring import social
from cprl.measuring.registry import compute_metrics

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


def summary(harvest, in_play=None):
    return social.summary(harvest, harvest >= 0 if in_play is None else in_play)


def values(metrics):
    return {name: value.item() for name, value in metrics.items()}


def test_each_metric_is_what_we_work_out_by_hand():
    metrics = summary(HARVEST, IN_PLAY)
    assert values(metrics) == pytest.approx(BY_HAND, rel=1e-15)
    assert list(metrics) == list(BY_HAND)
    assert {(metric.dtype, metric.shape) for metric in metrics.values()} == {(torch.float64, ())}


@pytest.mark.parametrize(
    ("sustainable_yield", "first_stock", "share"),
    [
        (0.5, 6, 0.5),  # 4 apples of 0.5 per step * 4 steps + 6 at first = 8
        (0.1, 0, 4 / (0.1 * 4)),  # and not that of float32
        (0, 0, math.nan),  # a share of nothing
        (torch.tensor([0.0, 0.5, 1.0]), torch.tensor([4, 6, 0]), [1.0, 0.5, 1.0]),  # of each episode
    ],
)
def test_the_yield_share_sets_the_harvest_against_what_the_map_bears(sustainable_yield, first_stock, share):
    totals = {"steps": 4.0, "harvest": HARVEST.sum(0).double().numpy()}
    bears = {"sustainable_yield": np.asarray(sustainable_yield), "first_stock": np.asarray(first_stock)}
    assert compute_metrics({**totals, **bears})["yield_share"].tolist() == pytest.approx(
        share, rel=1e-15, nan_ok=True
    )


def test_episodes_of_a_batch_are_measured_apart_and_those_without_a_harvest_have_no_equality():
    metrics = summary(torch.stack([HARVEST, EMPTY]), torch.stack([IN_PLAY, IN_PLAY]))
    assert {name: value[0].item() for name, value in metrics.items()} == pytest.approx(BY_HAND)
    assert metrics["equality"].isnan().tolist() == [False, True]
    assert metrics["sustainability"].isnan().tolist() == [False, True]
    alone = summary(HARVEST * torch.tensor([1, 0]))
    assert alone["sustainability"].item() == pytest.approx(7 / 3), "of those who harvested"


def test_an_episode_without_steps_has_no_value_per_step():
    metrics = values(summary(torch.zeros(0, 2)))
    undefined = {name for name, value in metrics.items() if math.isnan(value)}
    assert undefined == {"efficiency", "equality", "sustainability", "peace"}
    assert metrics["survival_steps"] == metrics["peacefulness"] == 0


def test_a_long_sum_of_float32_loses_no_apple():
    harvest = torch.full((3, 1), 2.0**24)
    harvest[1:] = 1  # a float32 sum would stay at 2**24
    assert summary(harvest)["collective_return"].item() == 2**24 + 2


episodes = st.tuples(st.integers(1, 12), st.integers(1, 5), st.integers(0, 2**32 - 1))


@settings(max_examples=60, deadline=None)
@given(episodes)
def test_metrics_stay_in_their_ranges(episode):
    steps, agents, seed = episode
    chance = torch.Generator().manual_seed(seed)
    harvest = (torch.rand(steps, agents, generator=chance) < 0.2).float()
    in_play = torch.rand(steps, agents, generator=chance) < 0.7
    metrics = values(summary(harvest, in_play))
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
    shuffled = summary(harvest[:, order], in_play[:, order])
    assert values(shuffled) == pytest.approx(values(summary(harvest, in_play)))


def test_equality_is_one_when_all_have_the_same_and_one_nth_when_one_has_all():
    assert summary(torch.ones(5, 3))["equality"].item() == 1
    assert summary(torch.tensor([[1.0, 0, 0, 0]]))["equality"].item() == pytest.approx(1 / 4)


@pytest.mark.parametrize("harvest", [-HARVEST, HARVEST / 0])
def test_what_is_no_harvest_is_refused(harvest):
    with pytest.raises(ValueError, match="harvest"):
        social.summary(harvest, IN_PLAY)
