"""Evaluation: the agents of stored runs in fresh worlds, with their own run or in cross-play.

Modules, in the order in which one reads them:
    evaluate    evaluate_run: all replicas of a run, beside the random policy
    cross_play  crossplay: a focal agent of one run among background agents of another
    gains       what a focal agent gains over the agent whose place it takes, and what it costs the others
    populations play_population: scripted and stored agents in any mix
    respondable which runs, replicas, agents and seeds best responses can be measured with
    responses   play_responses: what trained best responses gain over the agents whose place they take
    schelling   what restrained and greedy agents get, by how many of the others are restrained
    empirical_game  play_empirical_game: the game whose strategies are runs; pairwise_game: of a cross-play
    egta        analyse: which runs last in it, by alpha-rank, equilibria and replicator dynamics
    scenarios   run_scenarios: a run among named backgrounds that it never met
    territory   territory_of: where the agents of a run go and whom they tag
    film        an episode, every step recorded
    film_video  the same as a GIF or an MP4, several runs side by side
    lanes       stored agents of all replicas side by side
    same_game   whether two runs can play together
    words       what a word names: a board, and who plays
    tables      tables for the terminal
    responses_table  what best responses gain, as tables for the terminal
    turns            one episode of one world, turn by turn
    episode_picture  the board with the stock and the harvests so far
    video_files      GIF and MP4 out of pictures
    gains_picture    gains as two matrices
    schelling_picture  a Schelling diagram
    egta_tables      an empirical game for the terminal
    egta_picture     the dynamics of an empirical game, and its alpha-rank
    visits_picture   a map for each agent of where it spends its time
"""

from cprl.evaluation.cross_play import Cell, CrossPlay, crossplay
from cprl.evaluation.egta import Analysis, analyse
from cprl.evaluation.egta_picture import draw_egta
from cprl.evaluation.empirical_game import EmpiricalGame, pairwise_game, play_empirical_game
from cprl.evaluation.evaluate import Evaluation, evaluate_run
from cprl.evaluation.gains import Gain, gains
from cprl.evaluation.gains_picture import draw_gains
from cprl.evaluation.populations import play_population
from cprl.evaluation.responses import Exploitability, Response, play_responses
from cprl.evaluation.scenarios import Scenario, Score, Scores, draw_scenarios, run_scenarios, scenarios_of
from cprl.evaluation.schelling import SchellingDiagram, schelling
from cprl.evaluation.schelling_picture import draw_schelling
from cprl.evaluation.territory import Territory, territory_of
from cprl.evaluation.visits_picture import draw_visits

__all__ = [
    "Analysis",
    "Cell",
    "CrossPlay",
    "EmpiricalGame",
    "Evaluation",
    "Exploitability",
    "Gain",
    "Response",
    "Scenario",
    "SchellingDiagram",
    "Score",
    "Scores",
    "Territory",
    "analyse",
    "crossplay",
    "draw_egta",
    "draw_gains",
    "draw_scenarios",
    "draw_schelling",
    "draw_visits",
    "evaluate_run",
    "gains",
    "pairwise_game",
    "play_empirical_game",
    "play_population",
    "play_responses",
    "run_scenarios",
    "scenarios_of",
    "schelling",
    "territory_of",
]
