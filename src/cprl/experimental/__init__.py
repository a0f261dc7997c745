"""The waiting room: what is here works and is tested, and may change from one version to the next.

Nothing outside imports it but commands and recipes. What carries the library stands in the other packages.

Modules, in the order in which one reads them:
    movement        where agents go, which cells they share or keep, and who tags whom
    territory       territory_of: where the agents of a stored run go and whom they tag, beside random play
    empirical_game  play_empirical_game: the game whose strategies are runs; pairwise_game: of a cross-play;
                    analyse: which runs last in it, by alpha-rank, equilibria and replicator dynamics
"""

from cprl.experimental.empirical_game import Analysis, analyse, draw_egta, pairwise_game, play_empirical_game
from cprl.experimental.territory import draw_visits, territory_of

__all__ = [
    "Analysis",
    "analyse",
    "draw_egta",
    "draw_visits",
    "pairwise_game",
    "play_empirical_game",
    "territory_of",
]
