"""The page of five steps about a field of apples: scripted agents play in it, without a server."""

from dataclasses import replace
from typing import Any, Final

from cprl.commons.game import Game
from cprl.commons.named_games import game as published_game
from cprl.institutions import Quota
from cprl.web.playable import playable
from cprl.web.scenes import compact_json, scene_json
from cprl.web.static_pages import page_of

GROWTHS: Final = (0.25, 0.5, 1, 2, 4)
"""The factors of the probabilities of growth that the page offers."""
SCRIPTS: Final = ("explorable.css", "board.js", "game.js", "lanes.js", "scripted.js", "explorable.js")
RANDOM_PLAY: Final = "255 [251, 259]"
LEARNERS: Final = (
    {"name": "learned, no rule", "income": "262 [184, 340]", "learning": "189 [183, 196]", "turns": 546},
    {"name": "learned, limit 6", "income": "460 [449, 470]", "learning": "469 [467, 471]", "turns": 1000},
)
"""What trained agents get without a rule, and under a quota: docs/results/studies/changes/institutions.md."""


def explorable_page() -> str:
    """Return the page, one file that needs no network."""
    return page_of("explorable.html", *SCRIPTS, **parts())


def parts() -> dict[str, str]:
    """Return what stands in `explorable.html`, by name."""
    game = published_game("commons")
    quota = Quota(share=1.0)
    data = {
        "scene": scene_json(game),
        "game": playable(game),
        "growths": [_growth(game, quota, times) for times in GROWTHS],
        "window_steps": quota.window_steps,
        "learners": LEARNERS,
        "random": RANDOM_PLAY,
    }
    return {"title": "A field of apples", "more": "", "data": compact_json(data)}


def grown(game: Game, times: float) -> Game:
    """Return a game whose apples grow back `times` as fast."""
    probs = tuple(round(min(1.0, prob * times), 6) for prob in game.rules.regrow_prob)
    return replace(game, rules=replace(game.rules, regrow_prob=probs))


def _growth(game: Game, quota: Quota, times: float) -> dict[str, Any]:
    """Return what a game with faster growth changes: thresholds, and the apples of a quota of share 1."""
    changed = playable(replace(grown(game, times), institutions=(quota,)))
    return {
        "times": times,
        "regrow_below": changed["regrow_below"],
        "unit": changed["quota"]["unit"],
    }
