"""Which social dilemma payoffs make, and with what certainty."""

import numpy as np
import pytest

from cprl.evaluation.schelling import dilemma


def of(reward, sucker, temptation, punishment, *, spread=0.0, replicas=4):
    """Two agents: R(0) is what the sucker gets, R(1) the reward, G(0) the punishment, G(1) the temptation."""
    noise = spread * np.linspace(-1, 1, replicas)[:, None]
    restrained, greedy = np.array([[sucker, reward]]), np.array([[punishment, temptation]])
    return dilemma(restrained + noise, greedy - noise)


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
    assert of(*payoffs).name == name


def test_margins_are_the_differences_that_define_them():
    found = of(3, 0, 5, 1)
    values = {name: getattr(found, name).value for name in ("restraint", "company", "fear", "greed")}
    # R(1) - G(0) = 3 - 1, R(1) - R(0) = 3 - 0, G(0) - R(0) = 1 - 0, G(1) - R(1) = 5 - 3.
    assert values == {"restraint": 2.0, "company": 3.0, "fear": 1.0, "greed": 2.0}


def test_with_several_agents_only_both_ends_count():
    restrained, greedy = np.array([[0.0, 9.0, 1.0, 4.0]] * 3), np.array([[1.0, 0.0, 9.0, 5.0]] * 3)
    assert dilemma(restrained, greedy).name == "prisoner's dilemma"  # 4 > 1, 4 > 0, 1 > 0, 5 > 4


def test_intervals_that_hold_0_leave_several_dilemmas():
    # Noise of ± 0.5 in both kinds gives fear 1 ± (t(3) = 3.18) x 0.745 / 2 = 1 ± 1.19; greed is 4 ± 1.19.
    assert of(5, 0, 9, 1, spread=0.5).candidates == ("prisoner's dilemma", "chicken")
    assert of(3, 0, 5, 1, spread=0.1).candidates == ("prisoner's dilemma",)


def test_one_replica_tells_nothing_for_certain():
    found = of(3, 0, 5, 1, replicas=1)
    assert found.name == "cannot be told"
    assert found.candidates[0] == "prisoner's dilemma"
    assert set(found.candidates) == {"prisoner's dilemma", "chicken", "stag hunt", "no dilemma"}


@pytest.mark.parametrize("shapes", [((3, 1), (3, 1)), ((3,), (3,)), ((3, 2), (2, 2))])
def test_payoffs_of_other_shapes_are_refused(shapes):
    restrained, greedy = map(np.zeros, shapes)
    with pytest.raises(ValueError, match=r"restrained is .* and greedy .*; allowed: \[R, N\]"):
        dilemma(restrained, greedy)
