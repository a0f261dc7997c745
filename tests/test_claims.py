"""Curves under the published windows, claims with their verdicts, combat over runs: made-up results."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cprl import presets
from cprl.algorithms import DQN
from cprl.measuring.published import curve, published_experiment
from cprl.population import Learning, Scripted
from cprl.reporting import claims, curves
from cprl.reporting.appendix import appendix
from cprl.reporting.claims_alone import of_experiment_1, of_experiment_2, of_experiment_3, of_experiment_4
from cprl.reporting.claims_many import combat_section, of_experiment_5
from cprl.reporting.measures import of_training
from cprl.reporting.random_play import returns_by_chance
from cprl.reporting.result import Result, study_of

EPISODES = np.arange(4800.0)
COURSE = [0, 600, 1500, 2600, 4799]


def a_result(tmp_path, recipe, metrics, *, name="made_up", algorithm=None):
    agents = [] if algorithm is None else [Learning(algorithm)]
    result = Result(
        path=tmp_path / name,
        recipe={},
        experiment=SimpleNamespace(agents=agents, game=None),
        report={},
        curves=metrics,
        study=published_experiment(recipe),
    )
    result.of_agents = lambda column: None  # no table of episodes
    return result


def society(levels, *, replicas=8, seed=0):
    """Return, survival and peacefulness through the same levels, as shares of their own highest."""
    rng = np.random.default_rng(seed)
    course = np.interp(EPISODES, COURSE, levels) + rng.normal(0, 0.05, (replicas, len(EPISODES)))
    equality = 0.9 - 0.02 * course + rng.normal(0, 0.01, course.shape)
    return {
        "collective_return": 560 * course,
        "survival_steps": 1000 * course,
        "peacefulness": 860 * course,
        "equality": equality,
    }


FELL_AND_ROSE = [0.6, 1.0, 0.6, 0.85, 0.85]
FELL = [0.6, 1.0, 0.6, 0.6, 0.6]


@pytest.mark.parametrize(("recipe", "window"), [("single_basic", 150), ("two_against_random", 50)])
def test_ours_are_running_means_over_the_window_of_the_published_curve(tmp_path, recipe, window):
    """Of 0, 1, 2 .. the mean over the w episodes from e on is e + (w - 1) / 2."""
    ramp = np.tile(np.arange(3000.0), (2, 1))
    found = curves.beside(a_result(tmp_path, recipe, {"collective_return": ramp}), "collective_return")
    np.testing.assert_allclose(found.ours, np.tile(found.at + (window - 1) / 2, (2, 1)))
    at, values = curve(published_experiment(recipe).curves["collective_return"])
    kept = at <= 3000 - window
    np.testing.assert_array_equal(found.published, values[kept])
    short = {"collective_return": ramp[:, :window]}
    assert curves.beside(a_result(tmp_path, recipe, short), "collective_return") is None


def test_a_run_repeats_the_study_if_its_game_and_agents_do_whatever_its_name():
    game = presets.game("two_complex", variant="as_run")
    learner = Learning(DQN(settings=replace(presets.dqn_settings("two_complex"), gamma=0.999)))

    def number(agents, game=game, name="trial"):
        found = study_of(name, SimpleNamespace(game=game, agents=agents))
        return found and found.number

    assert number((learner, learner)) == 3
    assert number((learner, Scripted("random"))) == 4
    assert number((learner,), presets.game("single_basic")) == 1
    assert number((learner,) * 4, presets.game("commons")) == 5
    alone = presets.game("single_complex")
    rules = replace(alone.rules, episode_steps=40)
    assert number((), replace(alone, rules=rules), name="single_complex") == 2, "by the name of the recipe"
    by_chance = (Scripted("random"),)
    assert number(by_chance, alone, name="single_basic") is None, "on another map"
    assert number(by_chance * 2, name="commons") is None, "of two agents"
    assert number(by_chance * 2, name="two_against_random") == 4
    assert number(by_chance * 4, None, name="commons") is None, "a game without a map"
    assert number((learner, Scripted("greedy"))) is None
    assert number((Scripted("random"),) * 2) is None
    peaceful = replace(game, rules=replace(game.rules, may_fire=False))
    assert number((learner, learner), peaceful) is None, "the study has a beam"
    harsh = replace(game, rules=replace(game.rules, freeze_steps=50))
    assert number((learner, learner), harsh) is None


def test_combat_is_told_of_every_run_with_the_settings_in_which_they_differ(tmp_path):
    settings = presets.dqn_settings("commons", variant="as_run")
    slower = replace(settings, target_every_episodes=10)
    results = [
        a_result(tmp_path, "commons", society(FELL_AND_ROSE), name="ten", algorithm=DQN(settings=slower)),
        a_result(tmp_path, "commons", society(FELL), name="three", algorithm=DQN(settings=settings)),
        a_result(tmp_path, "single_basic", society(FELL), name="alone"),
    ]
    for result in results[:2]:
        result.experiment.game = presets.game("commons", variant="as_run")
    results[1].study = None  # a trial of some study, on the same board
    text = combat_section(results)
    head, _, published, ten, three, total = [line for line in text if line.startswith("|")]
    assert head.split(" | ")[1] == "target_every_episodes"
    assert "| **0.34** | **0.57** | **0.86** |" in published
    assert ten.startswith("| ten | 10 | **")
    assert ten.endswith("| 8 of 8 [0.63, 1.00] | not contradicted |")
    assert three.endswith("| 0 of 8 [0.00, 0.37] | contradicted |")
    assert total.endswith("| 8 of 16 [0.25, 0.75] | cannot be told with 16 runs |")
    assert combat_section(results[2:]) == []


def test_the_claims_on_four_agents_are_judged_by_what_their_curves_show(tmp_path):
    result = a_result(tmp_path, "commons", society(FELL_AND_ROSE))
    found = {one.claim: one for one in of_experiment_5(result)}
    assert found["tragedy"].verdict == found["combat follows"].verdict == "not contradicted"
    assert found["exploration: peacefulness rises"].verdict == "not contradicted"
    assert found["exploration: equality falls slowly"].verdict == "not contradicted"
    assert found["survival falls to 612 steps"].published == "612.1"
    assert found["equality about 0.87 in the end"].verdict == "not contradicted"
    theirs = float(found["combat is volatile, cultivation is not"].published)
    assert theirs > 1, "the published curve is as the study says"
    short = {name: own[:, :1000] for name, own in society(FELL).items()}
    told = {one.claim for one in of_experiment_5(a_result(tmp_path, "commons", short))}
    assert "equality about 0.87 in the end" not in told, "1,000 episodes do not reach the study's last phase"


def test_a_longer_training_is_compared_over_as_many_episodes_as_the_study_had(tmp_path):
    whole = {name: own.repeat(2, 1)[:, :6000] for name, own in society(FELL).items()}
    longer = {name: np.concatenate([own, np.zeros((8, 3000))], 1) for name, own in whole.items()}

    def row(metrics):
        result = a_result(tmp_path, "single_basic", metrics)
        return next(line for line in appendix([result]) if line.startswith("| made_up"))

    assert row(longer) == row(whole)
    assert "too few" not in row(longer)


def test_claims_on_more_episodes_than_there_were_have_no_verdict(tmp_path):
    short = {name: own[:, :300] for name, own in society(FELL).items()}
    short |= {"return_0": short["collective_return"], "return_1": short["collective_return"] / 2}

    def told(claims_of, recipe, *others, curves=short):
        result = a_result(tmp_path, recipe, curves)
        result.measures = SimpleNamespace(training=of_training(curves), trained={}, random={})
        result.of_agents = lambda column: curves["equality"][..., None].repeat(2, -1)
        return {one.claim: one.verdict for one in claims_of(result, *others)}

    few = "too few episodes"
    assert set(told(of_experiment_1, "single_basic").values()) == {few}
    assert told(of_experiment_2, "single_complex") == {"no dip": few}
    two = told(of_experiment_3, "two_complex", [])
    assert two == {"both earn almost the same": few, "two manage the resource sustainably": few}
    assert set(told(of_experiment_4, "two_against_random", []).values()) == {few}
    four = told(of_experiment_5, "commons")
    assert four["survival falls to 612 steps"] == few
    longer = {name: own[:, :2000] for name, own in society(FELL).items()}
    assert told(of_experiment_5, "commons", curves=longer)["survival falls to 612 steps"] != few
    early = told(of_experiment_1, "single_basic", curves=longer)
    assert early.pop("then it recovers") == few, "before 6,000 episodes"
    assert few not in early.values()


def test_each_kind_of_claim_has_a_measure_an_interval_and_a_verdict():
    # Mean 3, interval of the mean 3 +- 1.96, of one run 3 +- 4.81.
    values = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    assert claims.number("c", "m", values, published=8.0).verdict == "contradicted"
    assert claims.number("c", "m", values, published=8.0).ours == "3 [1.037, 4.963], one run [-1.809, 7.809]"
    assert claims.side("c", "m", values, above=1).verdict == "not contradicted"
    assert claims.side("c", "m", values, below=1).verdict == "contradicted"
    assert claims.more("c", "m", values + 1, values, paired=True).verdict == "not contradicted"
    assert claims.more("c", "m", values + 1, values, paired=False).verdict == "cannot be told with 5 runs"
    assert claims.alike("c", "m", values, within=(0, 5)).verdict == "not contradicted"
    assert claims.rule("c", "m", values > 2).ours == "3 of 5 [0.15, 0.95]"


def test_random_play_of_a_game_is_played_once_and_always_the_same():
    game = presets.game("single_basic", variant="as_run")
    short = replace(game, rules=replace(game.rules, episode_steps=30))
    whole = returns_by_chance(short, episodes=2_600)
    assert whole.shape == (2_600,)
    assert returns_by_chance(short, episodes=2_600) is whole, "played once"
    returns_by_chance.cache_clear()
    np.testing.assert_array_equal(returns_by_chance(short, episodes=2_600), whole)
    assert 0 < whole.mean() < 30
