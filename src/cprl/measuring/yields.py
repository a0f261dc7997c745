"""What a board can bear, as yield_share counts it."""

from torchrl.envs import EnvBase

from cprl.commons.yields import sustainable_yield
from cprl.envs.unwrap import commons_of
from cprl.measuring.reported import reported_by


def yield_of(env: EnvBase) -> dict[str, float | None]:
    """The arguments of an `EpisodeTracker` for yield_share; None in a game that has no board of cprl, or does
    not report the harvest."""
    commons = commons_of(env)
    if commons is None or "harvest" not in reported_by(env):
        return {"sustainable_yield": None, "first_stock": None}
    game = commons.game
    return {
        "sustainable_yield": sustainable_yield(game.map, game.rules),
        "first_stock": float(len(game.map.sites)),
    }
