"""Games of the user's own, as a recipe holds them and back; and which games are cprl's."""

from typing import Any, Final

from cprl.commons.game import Game
from cprl.custom import Custom
from cprl.envs.make_env import PlayableGame
from cprl.envs.matrix import MatrixGame
from cprl.envs.taking import TakingGame
from cprl.theory import PowerWorth

OF_CPRL: Final[tuple[type[Any], ...]] = (Game, MatrixGame, TakingGame)
"""Games that a recipe holds as values, and whose chance follows from the seed alone."""


def stored_game(game: object) -> object:
    """As a recipe holds it: a game of the user's by the name of its class.

    Raises:
        ValueError: for a game that a recipe cannot hold; says what it can.
    """
    if isinstance(game, TakingGame) and not isinstance(game.sharing.worth, PowerWorth):
        raise ValueError(
            f"experiment.game.sharing.worth is a {type(game.sharing.worth).__name__}, which a recipe cannot "
            'hold; allowed: a PowerWorth, or as the game Custom("module:function"), a function of yours that '
            "makes it"
        )
    if type(game) in OF_CPRL or isinstance(game, Game | Custom) or not isinstance(game, PlayableGame):
        return game
    kind = type(game)
    if "<" in kind.__qualname__:
        raise ValueError(
            f"experiment.game is a {kind.__qualname__}, which no recipe can name; allowed: a class at the "
            "top of a module"
        )
    return Custom(f"{kind.__module__}:{kind.__qualname__}", arguments=game.to_config())


def game_of(stored: Custom) -> Custom | PlayableGame:
    """The game whose class and arguments these are; the same where they only make one."""
    kind = stored.resolve()
    if not (isinstance(kind, type) and hasattr(kind, "to_config") and hasattr(kind, "make")):
        return stored
    try:
        game = kind(**{name: _tuples(value) for name, value in stored.arguments.items()})
    except (TypeError, ValueError) as error:
        raise ValueError(f"experiment.game: {stored.target} does not take its arguments: {error}") from error
    return game if isinstance(game, PlayableGame) and stored_game(game) == stored else stored


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def is_playable(value: Any) -> bool:
    """Whether it is a game, of cprl or of the user's own, or the `Custom` that makes one."""
    return isinstance(value, Game | Custom | PlayableGame) and not isinstance(value, type)
