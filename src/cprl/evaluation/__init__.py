"""Evaluation: agents of stored runs play in fresh worlds, without learning, with each other or with others.

Modules, in the order in which one reads them:
    populations     play_population: stored and scripted agents play; their episodes become a table
    pages           the printed tables that several kinds of evaluation share
    evaluate        evaluate_run: all replicas of a run, compared with the random policy
    cross_play      crossplay: one focal agent of a run among background agents of another run
    scenarios       run_scenarios: agents of a run among named backgrounds that they never met
    fresh           one fresh episode of a run to be filmed or shown, by default a typical one
    video_files     pictures as a GIF or an MP4
    film            an episode as a recording for the viewer, or as a GIF or MP4
    play            an episode in which a person plays among trained or scripted agents
"""

from cprl.evaluation.cross_play import by_focal_agent, crossplay, draw_gains, gains
from cprl.evaluation.evaluate import evaluate_run
from cprl.evaluation.populations import play_population
from cprl.evaluation.scenarios import (
    Scenario,
    draw_scenarios,
    run_scenarios,
    scenario_advantages,
    scenarios_of,
)
from cprl.system.defaults import Fresh

__all__ = [
    "Fresh",
    "Scenario",
    "by_focal_agent",
    "crossplay",
    "draw_gains",
    "draw_scenarios",
    "evaluate_run",
    "gains",
    "play_population",
    "run_scenarios",
    "scenario_advantages",
    "scenarios_of",
]
