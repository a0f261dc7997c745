"""Evaluation: the agents of stored runs in fresh worlds, with their own run or among others.

Modules, in the order in which one reads them:
    lanes           stored and scripted agents of all replicas side by side, in fresh worlds; play, together:
                    what they did, one tidy table; play_population
    pages           what is printed and drawn of such a table, whatever its kind
    evaluate        evaluate_run: all replicas of a run, beside the random policy
    cross_play      crossplay: a focal agent of one run among background agents of another; gains
    schelling       what restrained and greedy agents get, by how many of the others are restrained
    scenarios       run_scenarios: a run among named backgrounds that it never met
    fresh           fresh episodes that are shown, by default a typical one
    film            an episode, every step recorded, or as a GIF or an MP4
    film_pictures   the pictures of a film, and its files
    show            episodes side by side on an HTML page
    sandbox         an HTML page with sliders, whose agents play at once
    export          episodes for other programs: CSV, Minari
    play            a person among trained or scripted agents
"""

from cprl.evaluation.cross_play import by_focal_agent, crossplay, draw_gains, gains
from cprl.evaluation.evaluate import evaluate_run
from cprl.evaluation.lanes import play_population
from cprl.evaluation.scenarios import Scenario, advantages, draw_scenarios, run_scenarios, scenarios_of
from cprl.evaluation.schelling import dilemma, draw_schelling, margins, payoffs_of, schelling
from cprl.system.defaults import Fresh

__all__ = [
    "Fresh",
    "Scenario",
    "advantages",
    "by_focal_agent",
    "crossplay",
    "dilemma",
    "draw_gains",
    "draw_scenarios",
    "draw_schelling",
    "evaluate_run",
    "gains",
    "margins",
    "payoffs_of",
    "play_population",
    "run_scenarios",
    "scenarios_of",
    "schelling",
]
