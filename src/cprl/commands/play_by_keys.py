"""Play in the terminal: the keys of a person, and what is printed of an episode turn by turn."""

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import isnan
from textwrap import wrap
from typing import Final

import numpy as np
from rich.text import Text

from cprl.commons import maps
from cprl.commons.cells import APPLE, BEAM, CLEANING, WALL, WASTE, WATER
from cprl.commons.game import Game
from cprl.commons.maps import SIGN_OF_HEADING
from cprl.commons.world import StepOutput
from cprl.evaluation.play import Session
from cprl.measuring.registry import title
from cprl.pictures.colours import picture_colour
from cprl.system.output import OUT, console, say

KEYS: Final = {
    "w": ("forward", "step forward"),
    "s": ("backward", "step back"),
    "a": ("left", "step left"),
    "d": ("right", "step right"),
    "q": ("turn_left", "turn left"),
    "e": ("turn_right", "turn right"),
    "f": ("beam", "fire the beam"),
    "h": ("harvest", "harvest"),
    "c": ("clean", "clean the river"),
    ".": ("stay", "stay"),
}
"""The action of each key, and its description."""
QUIT: Final = "quit"
HELP: Final = "?"
_ARROWS: Final = {"A": "w", "B": "s", "C": "e", "D": "q"}
"""The key for each arrow, by the last letter that a terminal sends: up, down, right, left."""
_ENDING_KEYS: Final = "\x1b\x04"
"""Esc and Ctrl-D, which end the episode."""
_SIGNS: Final = {
    APPLE: "A",
    WATER: maps.SIGN_OF["water"],
    WASTE: maps.SIGN_OF["waste"],
    BEAM: "*",
    CLEANING: "*",
}
_PROMPT: Final = "keys> "
_LINE_HELP: Final = f"Enter plays a line of them and alone stays, {HELP} prints them, {QUIT} ends"
"""The end of the help if keys are typed in lines."""
_SINGLE_KEY_HELP: Final = f"arrows step and turn, Enter stays, {HELP} prints them, Esc ends"
"""The end of the help if each key plays at once."""


def help_of(game: Game) -> str:
    """Return the keys of a game with their descriptions: "w step forward, s step back, ..."."""
    return ", ".join(f"{key} {name}" for key, (action, name) in KEYS.items() if action in game.actions)


def state(session: Session) -> str:
    """Return a line with the turn, the apples on the board, and the score of each agent."""
    scores = []
    for agent, apples in enumerate(session.harvested):
        name = "you" if agent == session.agent else f"agent {agent}"
        out = "" if session.boards[-1].in_play[agent] else " (out of play)"
        scores.append(f"{apples} by {name}{out}")
    turn = f"turn {session.turn:,} of {session.game.rules.episode_steps:,}"
    return f"{turn}; {session.stock} apples on the board; harvested: {', '.join(scores)}"


def happened(session: Session, turn: StepOutput) -> Iterator[str]:
    """Yield sentences for the events of a turn: the person's harvest and shot, and who tagged whom."""
    person = session.agent
    tagged_by = turn.tagged_by[0]
    if turn.harvest[0, person]:
        yield "you harvest an apple"
    if turn.fired[0, person] and not tagged_by[:, person].any():
        yield "your beam tags nobody out"
    for tagged, shooter in zip(*tagged_by.nonzero(), strict=True):
        target = "you out" if tagged == person else f"agent {tagged} out"
        yield f"you tag {target}" if shooter == person else f"agent {shooter} tags {target}"


def play_in_terminal(session: Session, read_keys: Callable[[], str] | None = None) -> None:
    """Let a person play the episode.

    In a terminal each key plays at once. Through a pipe the keys of each line are played one after the other.

    Args:
        read_keys: returns a line of keys with its newline, or "" at the end; by default the typed keys.
    """
    if read_keys is not None:
        _play(session, read_keys, _LINE_HELP)
    elif sys.stdin.isatty():
        with _single_keys() as read_single_key:
            _play(session, read_single_key, _SINGLE_KEY_HELP)
    else:
        _play(session, sys.stdin.readline, _LINE_HELP)


def _play(session: Session, read_keys: Callable[[], str], help_end: str) -> None:
    """Play the episode and print the board, the score and, at the end, the metrics."""
    width = None if OUT.isatty() else 4 * session.game.map.width + 120
    boards = console(width=width)
    say(f"You are agent {session.agent}. {session.about_others}".rstrip())
    _print_keys(session, help_end)
    while True:
        boards.print(board_text(session), soft_wrap=True)
        say(state(session))
        if session.has_ended or not _ask_and_play(session, read_keys, help_end):
            break
    ending = f"stopped after turn {session.turn:,}"
    if session.has_ended:
        ending = "no apple is left" if session.stock == 0 else "time is over"
    say(f"The end: {ending}.")
    if session.has_ended and session.average_harvest_text:
        apples = session.harvested[session.agent]
        say(f"You got {apples} apple{'' if apples == 1 else 's'}. {session.average_harvest_text}")
    for name, value in session.metrics().items():
        number = "undefined" if isnan(value) else f"{value:.4g}"
        say(f"{name:17s} {number:>9s}  {title(name)}")
    if not session.turn:
        say("No turn was played, so there is nothing to measure.")


def _print_keys(session: Session, help_end: str) -> None:
    """Print the help in lines that break only between keys."""
    keys = f"Keys: {help_of(session.game)}, {help_end}."
    unbreakable = ", ".join(key.replace(" ", "\xa0") for key in keys.split(", "))
    width = console().width if OUT.isatty() else 80
    for line in wrap(unbreakable, width, break_on_hyphens=False):
        say(line.replace("\xa0", " "))


def _ask_and_play(session: Session, read_keys: Callable[[], str], help_end: str) -> bool:
    """Ask for keys and play them; return False if the person ends the episode."""
    while True:
        OUT.write(_PROMPT)
        OUT.flush()
        try:
            keys = read_keys()
        except KeyboardInterrupt:
            keys = ""
        say(keys.rstrip("\n"))
        typed = keys.strip() or "."
        if not keys or typed == QUIT:
            return False
        if typed == HELP:
            _print_keys(session, help_end)
            continue
        unknown = [key for key in typed if KEYS.get(key, ("",))[0] not in session.game.actions]
        if not unknown:
            break
        say(f"key is {unknown[0]!r}; allowed: {help_of(session.game)}; nothing was played")
    for key in typed:
        for event in happened(session, session.act(KEYS[key][0])):
            say(f"turn {session.turn:,}: {event}")
        if session.has_ended:
            break
    return True


@contextmanager
def _single_keys() -> Iterator[Callable[[], str]]:
    """Make the terminal deliver each key when it is pressed, without showing it.

    Yield a function that returns the pressed keys.
    """
    if sys.platform == "win32":
        import msvcrt

        yield lambda: keys_of(msvcrt.getwch())
        return
    import termios
    import tty

    settings = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin, termios.TCSADRAIN)  # the default would discard keys that were typed already
    try:
        yield lambda: keys_of(os.read(sys.stdin.fileno(), 64).decode(errors="replace"))
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, settings)


def keys_of(pressed: str) -> str:
    """Return the keys that a terminal sent, with arrows as the keys that they stand for; "" for Esc."""
    keys = re.sub(r"\x1b[\[O]([ABCD])", lambda arrow: _ARROWS[arrow[1]], pressed)
    return "" if any(key in _ENDING_KEYS for key in keys) else keys


def board_text(session: Session) -> Text:
    """Return the board by rows, in colours.

    `A` is an apple, `#` a wall, `~` the water of a river and `H` its waste, `*` a beam, and `.` any other
    cell. An agent has its number and the sign of its heading.
    """
    board = session.boards[-1]
    cell_width = len(str(session.game.agents - 1)) + 1
    signs = {**_SIGNS, WALL: "#" * cell_width}
    agent_signs = {}
    for agent in np.flatnonzero(board.in_play):
        position = int(board.row[agent]), int(board.col[agent])
        agent_signs[position] = f"{agent}{SIGN_OF_HEADING[int(board.heading[agent])]}"
    text = Text()
    for cell, kind in np.ndenumerate(board.board):
        sign = agent_signs.get(cell, signs.get(int(kind), ".")).ljust(cell_width)
        if cell[1] == board.board.shape[1] - 1:
            sign = f"{sign.rstrip()}\n"
        red, green, blue = picture_colour(int(kind) or WALL)
        text.append(sign, f"rgb({red},{green},{blue})")
    text.right_crop()
    return text
