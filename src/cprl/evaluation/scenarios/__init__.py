"""Scenarios: agents of a stored run among named backgrounds that they never met.

In the manner of Melting Pot (J. Z. Leibo et al., "Scalable Evaluation of Multi-Agent Reinforcement Learning
with Melting Pot", 2021): focal agents, which are judged, share a board with background agents, which are part
of the test. A focal majority receives one of the background agents ("resident mode"); a focal minority is one
agent among background agents ("visitor mode").

Modules, in the order in which one reads them:
    scenario     Scenario: a background on a board, and how many agents are focal
    backgrounds  the named backgrounds, scripted and stored; scenarios_of a game
    score        Score, Scores: episodes, returns, social metrics, advantages
    suite        run_scenarios: a stored run in scenarios, beside random and greedy agents in its place
    tables       scores as tables for the terminal
    picture      draw_scenarios: returns per scenario with their intervals
"""

from cprl.evaluation.scenarios.backgrounds import scenarios_of
from cprl.evaluation.scenarios.picture import draw_scenarios
from cprl.evaluation.scenarios.scenario import Scenario
from cprl.evaluation.scenarios.score import Score, Scores
from cprl.evaluation.scenarios.suite import run_scenarios

__all__ = ["Scenario", "Score", "Scores", "draw_scenarios", "run_scenarios", "scenarios_of"]
