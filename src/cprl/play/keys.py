"""The keys of a person, and the actions they stand for."""

from typing import Final

from cprl.commons.game import Game

LETTERS: Final = {
    "w": "forward",
    "s": "backward",
    "a": "left",
    "d": "right",
    "q": "turn_left",
    "e": "turn_right",
    "f": "beam",
    ".": "stay",
}

ACTION_NAMES: Final = {
    "forward": "step forward",
    "backward": "step back",
    "left": "step left",
    "right": "step right",
    "turn_left": "turn left",
    "turn_right": "turn right",
    "beam": "fire the beam",
    "stay": "stay",
}


def keys_of(game: Game) -> dict[str, str]:
    """The letters that a game knows, and their actions."""
    return {letter: action for letter, action in LETTERS.items() if action in game.actions}


def help_of(game: Game) -> str:
    """All letters in a line: "w step forward, s step back, ..."."""
    return ", ".join(f"{letter} {ACTION_NAMES[action]}" for letter, action in keys_of(game).items())
