"""What a board can bear, as yield_share counts it."""

from collections.abc import Mapping

from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.commons.yields import sustainable_yield
from cprl.envs.unwrap import commons_of
from cprl.measuring.reported import reported_by


def yield_of_game(game: Game) -> dict[str, float]:
    """The sustainable yield of a game, in apples a turn, and its first stock."""
    return {
        "sustainable_yield": sustainable_yield(game.map, game.rules),
        "first_stock": float(len(game.map.sites)),
    }


def yield_of(env: EnvBase) -> Mapping[str, float | None]:
    """The arguments of an `EpisodeTracker` for yield_share; None in a game that has no board of cprl, or does
    not report the harvest."""
    commons = commons_of(env)
    if commons is None or "harvest" not in reported_by(env):
        return {"sustainable_yield": None, "first_stock": None}
    return yield_of_game(commons.game)
