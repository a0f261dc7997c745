"""The named backgrounds of scenarios, scripted and stored; scenarios_of a game.

A scenario is called by its focal agents and its background, e.g. "minority_among_greedy". Together with the
board and its variant this names a score that others can hold theirs against.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

from cprl import arguments, presets
from cprl.commons.game import Game
from cprl.evaluation.scenarios.scenario import Focal, Scenario
from cprl.population import Frozen, Scripted

SCRIPTED: Final = ("greedy", "sustainable", "territorial", "aggressive")
"""Backgrounds in which all agents follow one scripted policy."""

STORED: Final = "dqn"
"""The background of the population that DQN trained on the very game, where one is committed."""

_COMMITTED: Final[tuple[tuple[presets.Board, presets.Variant, bool, str], ...]] = (
    ("commons", "as_run", True, "commons"),
    ("commons", "published", True, "commons_published"),
    ("two_complex", "as_run", True, "two_complex"),
    ("two_complex", "as_run", False, "two_complex_no_beam"),
)
"""Board, variant, whether agents may fire, and the folder of `docs/results` with the population."""


def results_folder() -> Path:
    """The folder with the results that come with a checkout of cprl, which is `docs/results`; an installed
    wheel has none."""
    return Path(presets.__file__).parents[2] / "docs" / "results"


def stored_for(game: Game) -> Path | None:
    """The folder of the committed population that was trained on a game, whether it is at hand or not; None
    if there is none."""
    for board, variant, may_fire, name in _COMMITTED:
        published = presets.game(board, variant=variant)
        if game == replace(published, rules=replace(published.rules, may_fire=may_fire)):
            return results_folder() / name
    return None


def left_out_of(game: Game) -> str:
    """Which scenarios of a game are not at hand and why; "" if all are."""
    folder = stored_for(game)
    if folder is None or folder.is_dir():
        return ""
    names = " and ".join(_name(focal, STORED) for focal in _modes(game))
    return f"{names}: the stored population {folder} comes with a checkout of cprl, and is not there"


def scenarios_of(game: Game) -> tuple[Scenario, ...]:
    """All named scenarios of a game: as a majority and as a minority among each of `SCRIPTED`, and among the
    committed population that DQN trained on this very game, if there is one and its folder is at hand.

    In a game of two agents a majority and a minority are the same, so that it has the minorities alone.
    Without a beam "territorial" and "aggressive" have nothing to fire, and are left out.

    Args:
        game: a `cprl.Game` for at least 2 agents, with windows as observations.

    Raises:
        ValueError: for any other game.
    """
    check_game(game)
    everyone = range(game.agents)
    backgrounds: dict[str, tuple[Scripted | Frozen, ...]] = {
        policy: (Scripted(policy),) * game.agents
        for policy in SCRIPTED
        if game.rules.may_fire or policy not in ("territorial", "aggressive")
    }
    folder = stored_for(game)
    if folder is not None and folder.is_dir():
        backgrounds[STORED] = tuple(Frozen(str(folder), agent, replica=None) for agent in everyone)
    return tuple(
        Scenario(name=_name(focal, name), game=game, focal=focal, background=background)
        for name, background in backgrounds.items()
        for focal in _modes(game)
    )


def check_game(game: object) -> None:
    """Checks that a game can have scenarios.

    Raises:
        ValueError: if it is no `cprl.Game`, has a single agent, or shows agents something else than windows.
    """
    arguments.object_of("game", game, Game, "a cprl.Game, because scripted agents read its windows")
    if isinstance(game, Game) and game.agents < 2:
        raise ValueError(f"the game has {game.agents} agent; allowed for scenarios: at least 2")
    if isinstance(game, Game) and game.observation.area != "window":
        raise ValueError(
            f"Observation.area is {game.observation.area!r}; allowed for scenarios: 'window', because "
            "scripted agents rely on the agent's position in it"
        )


def _modes(game: Game) -> tuple[Focal, ...]:
    return ("minority",) if game.agents == 2 else ("majority", "minority")


def _name(focal: Focal, background: str) -> str:
    return f"{focal}_among_{background}"
