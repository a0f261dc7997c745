"""Change points and phases of artificial curves with known change points, and how figures draw them."""

import numpy as np
import pytest
from drawings import CORNERS, COURSES, EPISODES, society
from phases import PHASES, UNNAMED, change_points, phases, training_phases
from published_figures import bands_of, published_bands


@pytest.mark.integration
@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_known_change_points_are_found(noise):
    changes = change_points(EPISODES, society(8, noise), number=3)
    assert changes == pytest.approx(CORNERS[1:-1], abs=100)


def test_steps_are_found_as_well_as_corners():
    step = np.where(EPISODES < 2000, 1.0, 3.0) + np.random.default_rng(1).normal(0, 0.5, len(EPISODES))
    assert change_points(EPISODES, {"peace": step}, number=1) == pytest.approx([2000], abs=50)


def test_curves_with_the_studys_pattern_get_its_labels():
    metrics = society(8, 0.05)
    found = phases(EPISODES, metrics, change_points(EPISODES, metrics, number=3))
    assert tuple(phase.label for phase in found) == PHASES
    assert (found[0].first, found[-1].last) == (0, 4999)
    assert found[1].change["survival_steps"] == pytest.approx(-1.0, abs=0.15)


def test_curves_with_another_pattern_get_no_labels():
    rising = {name: np.linspace(0, 1, 5000) for name in COURSES}
    found = phases(EPISODES, rising, change_points(EPISODES, rising, number=3))
    assert [phase.label for phase in found[1:]] == [None, None, None]
    falling = {name: np.linspace(1, 0, 5000) for name in COURSES}
    assert phases(EPISODES, falling, [])[0].label is None


def test_curves_that_cannot_be_divided_are_refused():
    with pytest.raises(ValueError, match="episodes are 0 to 700"):
        change_points(np.arange(701), {"peace": np.zeros(701)}, number=3)
    with pytest.raises(ValueError, match="a metric is NaN in some episode of all replicas"):
        change_points(EPISODES, {"peace": np.full(5000, np.nan)})


def test_phases_need_enough_episodes_a_group_and_numbers_in_every_window(monkeypatch):
    at = np.linspace(0, CORNERS[-1], 1200).astype(int)
    curves = {name: values[:, at] for name, values in society(2, 0.05).items()}
    curves |= {"return_0": np.ones((2, 1200)), "return_1": np.ones((2, 1200))}
    found = training_phases(curves)
    assert bands_of(found)[0][2] == "exploration"
    assert {name for _, _, name in bands_of(found)} <= {*PHASES, UNNAMED}
    nobody = curves["equality"].copy()
    nobody[:, 300:450] = np.nan
    assert training_phases({**curves, "equality": nobody}) is None
    alone = {name: values for name, values in curves.items() if name != "return_1"}
    assert training_phases(alone) is None
    monkeypatch.setattr("phases.EPISODES", range(1000, 1001))
    for episodes, has_phases in ((999, False), (1000, True), (1001, False)):
        assert (
            bool(training_phases({name: values[:, :episodes] for name, values in curves.items()}))
            == has_phases
        )


def test_the_published_phases_end_with_the_figure():
    assert published_bands(1600) == [(0, 450, "exploration"), (450, 1500, "tragedy"), (1500, 1600, "combat")]
