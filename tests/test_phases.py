"""Change points that were planted are found; the published phases are, or the docs say why not."""

import numpy as np
import pytest

from cprl.measuring.phases import PHASES, change_points, phases

EPISODES = np.arange(5000)
CORNERS = [0, 600, 1500, 2600, 4999]
COURSES = {  # values at the corners, straight lines between them
    "collective_return": [300, 560, 340, 470, 470],
    "equality": [0.90, 0.92, 0.83, 0.87, 0.87],
    "survival_steps": [1000, 1000, 620, 820, 820],
    "peacefulness": [830, 860, 560, 740, 740],
}


def society(replicas, noise, seed=0):
    """The study's story with planted corners, and a noise of each replica's own."""
    chance = np.random.default_rng(seed)
    metrics = {}
    for name, course in COURSES.items():
        curve = np.interp(EPISODES, CORNERS, course)
        own = chance.normal(0, noise * np.ptp(curve), (replicas, len(EPISODES)))
        metrics[name] = curve + own
    return metrics


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_planted_change_points_are_found_within_their_intervals(noise):
    found = change_points(EPISODES, society(8, noise), number=3, resamples=40)
    for change, planted in zip(found, CORNERS[1:-1], strict=True):
        assert abs(change.episode - planted) <= 100
        assert change.low - 50 <= planted <= change.high + 50
        assert change.low <= change.episode <= change.high


def test_steps_are_found_as_well_as_corners():
    step = np.where(EPISODES < 2000, 1.0, 3.0) + np.random.default_rng(1).normal(0, 0.5, len(EPISODES))
    (found,) = change_points(EPISODES, {"peace": step}, number=1)
    assert abs(found.episode - 2000) <= 50
    assert np.isnan([found.low, found.high]).all(), "one series has no replicas to resample"


def test_the_more_replicas_agree_the_surer_the_change_point():
    def width(spread):
        chance = np.random.default_rng(2)
        turns = 2000 + spread * chance.normal(size=8)
        curves = np.stack([np.maximum(0.0, EPISODES - turn) for turn in turns])
        (found,) = change_points(EPISODES, {"peace": curves}, number=1, resamples=60)
        return found.high - found.low

    assert width(20) <= 50 < width(500)


def test_the_studys_story_gets_the_studys_names():
    metrics = society(8, 0.05)
    told = phases(EPISODES, metrics, change_points(EPISODES, metrics, number=3, resamples=2))
    assert tuple(phase.label for phase in told) == PHASES
    assert (told[0].first, told[-1].last) == (0, 4999)
    assert told[1].change["survival_steps"] == pytest.approx(-1.0, abs=0.15)


def test_another_story_gets_no_names():
    rising = {name: np.linspace(0, 1, 5000) for name in COURSES}
    told = phases(EPISODES, rising, change_points(EPISODES, rising, number=3, resamples=2))
    assert [phase.label for phase in told[1:]] == [None, None, None]
    falling = {name: np.linspace(1, 0, 5000) for name in COURSES}
    assert phases(EPISODES, falling, [])[0].label is None


def test_what_cannot_be_divided_is_refused():
    with pytest.raises(ValueError, match=r"episodes 0 to 700 are too few for 4 phases of 200 or more"):
        change_points(np.arange(701), {"peace": np.zeros(701)}, number=3)
    with pytest.raises(ValueError, match="metrics have 10 episodes, episodes 5000"):
        change_points(EPISODES, {"peace": np.zeros(10)})
    with pytest.raises(ValueError, match="a metric is undefined in some episode of all replicas"):
        change_points(EPISODES, {"peace": np.full(5000, np.nan)})
