"""Games as JSON that `static/game.js` plays exactly as `CommonsEnv` does; others are refused by name."""

from typing import Any, Final

from cprl.commons.game import Game
from cprl.commons.near import near_cells
from cprl.commons.rules import Rules
from cprl.institutions import Quota
from cprl.values import refusal

_HERE: Final = "in a game that is played in a browser"
_AS_THEY_ARE: Final = (
    "hits_to_tag",
    "freeze_steps",
    "may_fire",
    "window_rows",
    "window_columns",
    "episode_steps",
    "shuffle_starts",
)
"""The fields of `Rules` that game.js reads as they are."""
_COMPUTED: Final = (
    "regrow_prob",
    "regrow_radius_cells",
    "regrow_norm",
    "beam_length_cells",
    "beam_width_cells",
    "window_rows_behind",
)
"""Those from which the JSON is computed, and one that scripted agents do not read. Of all other fields
game.js has the defaults."""


def playable(game: Game) -> dict[str, Any]:
    """Return a game as JSON for `tablesOf` of static/game.js.

    Numbers that Python rounds are in it, e.g. the thresholds of growth, so that none can differ on the page.

    Raises:
        ValueError: for a rule, an observation, a map or an institution that game.js cannot play.
    """
    _check(game)
    board = game.map
    rules = game.rules
    longest = max(board.height, board.width, rules.window_rows, rules.window_columns)
    return {
        **{name: getattr(rules, name) for name in _AS_THEY_ARE},
        "height": board.height,
        "width": board.width,
        "walls": board.walls,
        "sites": board.sites,
        "starts": board.starts,
        "near_steps": near_cells(rules, rows=longest, cols=longest),
        "near_reach": int(rules.regrow_radius_cells),
        "regrow_below": game.tables.regrow_below.tolist(),
        "beam_lengths": rules.beam_lengths_cells,
        "beam_half_width": rules.beam_width_cells // 2,
        "quota": _quota(game),
    }


def _check(game: Game) -> None:
    """Raise a ValueError for a part of a game that game.js cannot play."""
    for name, value in game.rules.changed.items():
        if name not in _AS_THEY_ARE + _COMPUTED:
            raise refusal(f"Rules.{name}", value, f"{getattr(Rules(), name)!r} {_HERE}")
    if game.observation.area != "window":
        raise refusal("Observation.area", game.observation.area, f"'window' {_HERE}")
    if game.map.spawns:
        raise refusal("Map.spawns", game.map.spawns, f"no spawn places {_HERE}")
    names = [type(institution).__name__ for institution in game.institutions]
    if names not in ([], ["Quota"]):
        raise refusal("Game.institutions", ", ".join(names), f"none, or one Quota {_HERE}")


def _quota(game: Game) -> dict[str, Any] | None:
    """Return the quota of a game, None without one; `unit`: the apples of a window at a share of 1."""
    for quota in game.institutions:
        assert isinstance(quota, Quota)
        if quota.fine is not None:
            raise refusal("Quota.fine", quota.fine, f"None {_HERE}")
        fields = {name: getattr(quota, name) for name in ("share", "window_steps", "by_stock")}
        return {**fields, "unit": float(game.law_parameters["quotas"]["window_yield"][0])}
    return None
