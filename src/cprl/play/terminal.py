"""Play in the terminal: a line of keys at a time, also through a pipe."""

import sys
from collections.abc import Callable
from typing import Final

import numpy as np
from rich.text import Text

from cprl.commons.colours import APPLE, BEAM, PALETTE, WALL, Colour, agent_colour
from cprl.commons.maps.board import SIGN_OF_HEADING
from cprl.output import OUT, console, say
from cprl.play.keys import help_of, keys_of
from cprl.play.session import Session
from cprl.play.wording import ending, happened, results_text, state

QUIT: Final = "quit"
_PROMPT: Final = "keys> "


def play_in_terminal(session: Session, read_line: Callable[[], str] | None = None) -> None:
    """Plays the episode: each line of keys is played key by key; `quit` or the end of the input ends it.

    Args:
        session: the episode.
        read_line: returns a line with its newline, or "" at the end; by default that of standard input.
    """
    read_line = read_line or sys.stdin.readline
    shown = console(width=None if OUT.isatty() else 4 * session.game.map.width + 120)
    say(f"You are agent {session.agent}. Keys: {help_of(session.game)}; several in a line, then Enter.")
    say(f"Enter alone stays; {QUIT} ends.")
    while True:
        shown.print(board_text(session), soft_wrap=True)
        say(state(session))
        if session.has_ended or not _ask_and_play(session, read_line):
            break
    say(f"The end: {ending(session)}.")
    say(results_text(session))


def _ask_and_play(session: Session, read_line: Callable[[], str]) -> bool:
    """Plays the next line whose keys are known; False where the person leaves."""
    while True:
        line = _ask(read_line)
        if line is None or line.strip() == QUIT:
            return False
        if _play_line(session, line.strip() or "."):
            return True


def _ask(read_line: Callable[[], str]) -> str | None:
    """The next line of the input, which is shown where no terminal does; None at its end."""
    OUT.write(_PROMPT)
    OUT.flush()
    line = read_line()
    if not sys.stdin.isatty() or not line:
        say(line.rstrip("\n"))
    return line or None


def _play_line(session: Session, line: str) -> bool:
    """Plays a line of keys, or none of it where one is unknown; whether it was played."""
    actions = keys_of(session.game)
    unknown = next((key for key in line if key not in actions), None)
    if unknown is not None:
        say(f"key is {unknown!r}; allowed: {help_of(session.game)}, or {QUIT}; nothing was played")
        return False
    for key in line:
        for event in happened(session, session.act(actions[key])):
            say(f"turn {session.turn:,}: {event}")
        if session.has_ended:
            break
    return True


def board_text(session: Session) -> Text:
    """The board by rows: `A` an apple, `#` a wall, `*` a beam, and each agent's number with its heading."""
    board, now = session.game.map, session.moments[-1]
    wide = len(str(session.game.agents - 1)) + 1
    cells: dict[tuple[int, int], tuple[str, Colour]] = {
        **{cell: ("A", PALETTE[APPLE]) for cell, apple in zip(board.sites, now.stock, strict=True) if apple},
        **{(int(row), int(col)): ("*", PALETTE[BEAM]) for row, col in np.argwhere(now.board == BEAM)},
        **dict.fromkeys(board.walls, ("#" * wide, PALETTE[WALL])),
    }
    for agent, (row, col, heading) in enumerate(zip(now.row, now.col, now.heading, strict=True)):
        if now.in_play[agent]:
            cells[int(row), int(col)] = f"{agent}{SIGN_OF_HEADING[int(heading)]}", agent_colour(agent)
    text = Text()
    for row in range(board.height):
        for col in range(board.width):
            sign, (red, green, blue) = cells.get((row, col), (".", PALETTE[WALL]))
            is_last = col == board.width - 1
            text.append(sign if is_last else sign.ljust(wide), f"rgb({red},{green},{blue})")
        text.append("\n" if row < board.height - 1 else "")
    return text
