"""Tragedy and combat of made-up replicas, and of the published curves."""

import numpy as np
import pytest

from cprl.measuring.combat import METRICS, combat
from cprl.measuring.published import curve, published_experiment

EPISODES = np.arange(4800)


def replicas(course, *, number=20, noise=25.0, seed=0):
    """Replicas of a course through (episode, level), the same for all metrics, each about a level of its own
    that wanders over 100 episodes, as those of experiment 5 do."""
    rng = np.random.default_rng(seed)
    own = rng.normal(0, noise, (number, len(EPISODES) + 99))
    sums = np.cumsum(np.pad(own, ((0, 0), (1, 0))), axis=1)
    wandering = (sums[:, 100:] - sums[:, :-100]) / 10
    level = np.interp(EPISODES, *zip(*course, strict=True))
    return dict.fromkeys(METRICS, level + wandering)


def test_the_published_curves_show_tragedy_and_combat():
    study = published_experiment("commons")
    at = np.arange(0.0, 4740.0)
    found = combat({name: np.interp(at, *curve(study.curves[name]))[None] for name in METRICS})
    assert found.tragedy.tolist() == found.combat.tolist() == [True]
    assert found.fall[0] == pytest.approx(0.34, abs=0.01)
    assert found.rise[0] == pytest.approx(0.57, abs=0.01)


def test_a_fall_that_is_half_made_good_is_combat():
    course = [(0, 300), (600, 560), (1500, 340), (2600, 470), (4799, 470)]
    metrics = replicas(course)
    metrics["peacefulness"] = np.minimum(metrics["peacefulness"], 520)
    found = combat(metrics)
    assert found.tragedy.all()
    assert found.combat.all()
    assert np.abs(found.tragedy_at + 150 - 1500).max() < 400


def test_a_fall_that_lasts_is_a_tragedy_without_combat():
    found = combat(replicas([(0, 300), (600, 560), (1500, 340), (4799, 340)]))
    assert found.tragedy.all()
    assert not found.combat.any(), "a level that only wanders does not recover"


def test_a_level_that_wanders_or_rises_is_no_tragedy():
    for course in ([(0, 450), (4799, 450)], [(0, 300), (4799, 560)]):
        found = combat(replicas(course))
        assert not found.tragedy.any()
        assert not found.combat.any()


def test_one_metric_that_does_not_fall_is_enough_to_speak_of_no_tragedy():
    metrics = replicas([(0, 300), (600, 560), (1500, 340), (2600, 470), (4799, 470)])
    found = combat({**metrics, "survival_steps": np.full_like(metrics["survival_steps"], 1000.0)})
    assert not found.tragedy.any()


def test_a_recovery_in_more_peace_than_before_is_no_combat():
    metrics = replicas([(0, 300), (600, 560), (1500, 340), (2600, 470), (4799, 470)])
    metrics["peacefulness"] += np.where(EPISODES > 1700, 300, 0)
    found = combat(metrics)
    assert found.tragedy.all()
    assert not found.combat.any()


def test_a_training_that_ends_with_its_tragedy_shows_no_combat():
    found = combat(replicas([(0, 560), (4799, 300)], number=2))
    assert found.tragedy.all()
    assert np.isnan(found.rise).all()
    assert not found.combat.any()


def test_curves_without_a_tragedy_to_look_for_are_refused():
    whole = replicas([(0, 1), (4799, 1)], number=2)
    with pytest.raises(ValueError, match="metrics lack 'peacefulness'; allowed: at least"):
        combat({name: whole[name] for name in METRICS[:2]})
    with pytest.raises(ValueError, match=r"is \[2, 800\]; allowed: \[R, E\], at least 900 episodes"):
        combat({name: own[:, :800] for name, own in whole.items()})
    with pytest.raises(ValueError, match="holds NaN or infinity; allowed: finite numbers"):
        combat({**whole, "peacefulness": np.full((2, 4800), np.nan)})
