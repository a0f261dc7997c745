"""Play in a window, by pygame."""

import os
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cprl.commons.colours import GROUND, PALETTE, agent_colour
from cprl.commons.world import Bytes
from cprl.evaluation.episode_picture import EpisodePicture
from cprl.play.keys import ACTION_NAMES, ARROWS, keys_of
from cprl.play.session import Session
from cprl.play.wording import ending, happened, results

WIDTHS: Final = (960, 800, 720, 640, 480, 320, 240)
"""Of the window, in pixels; the first at which it is at most HIGHEST is taken."""
HIGHEST: Final = 860

_OUT_TURN_MS: Final = 120
"""While the person's agent is out of play, a turn is played each so many milliseconds."""
_IDLE_MS: Final = 100
_REPEAT_MS: Final = 300, 120
"""How long a key is held until it repeats, and from then on."""
_INVISIBLE: Final = ("offscreen", "dummy", "evdev")
"""Video drivers of SDL that show nothing; it takes one by itself where there is no display."""
_FONT_PIXELS, _LINE_PIXELS = 14, 20
_COLUMN_PIXELS: Final = 130
_LINES: Final = 10
"""Below the plots: the person's, and those of the keys, which become those of the metrics."""
_TEXT: Final = (228, 231, 236)


class NoWindowError(Exception):
    """No window can be opened; the message says why."""


def play_in_window(session: Session, title: str) -> None:
    """Plays the episode in a window, a turn for each key; Escape, Ctrl-C or closing the window ends it.

    Args:
        session: the episode.
        title: of the window.

    Raises:
        NoWindowError: if pygame is not installed, or there is no display; nothing was played.
    """
    pygame = _pygame()
    picture = WindowPicture(session, title)
    try:
        screen = pygame.display.set_mode(picture.size)
        pygame.display.set_caption(title)
        pygame.key.set_repeat(*_REPEAT_MS)
        _play(pygame, screen, session, picture)
    except KeyboardInterrupt:  # in the terminal that the window was opened from
        return
    finally:
        pygame.display.quit()


def _pygame() -> Any:
    """pygame with a display that can be seen, or the driver that SDL_VIDEODRIVER asks for."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise NoWindowError('pygame is not installed (pip install "cprl[play]")') from error
    try:
        pygame.display.init()
    except pygame.error as error:
        raise NoWindowError(f"there is no display: {error}") from error
    if "SDL_VIDEODRIVER" not in os.environ and pygame.display.get_driver() in _INVISIBLE:
        pygame.display.quit()
        raise NoWindowError("there is no display")
    return pygame


def _play(pygame: Any, screen: Any, session: Session, picture: "WindowPicture") -> None:
    """Shows the episode and plays a turn for each key, until the person leaves."""
    actions = keys_of(session.game)
    actions |= {name: actions[letter] for name, letter in ARROWS.items() if letter in actions}
    while True:
        shown = picture.draw()
        screen.blit(pygame.image.frombuffer(shown.tobytes(), picture.size, "RGB"), (0, 0))
        pygame.display.flip()
        waits = not session.is_in_play and not session.has_ended
        event = pygame.event.wait(_OUT_TURN_MS if waits else _IDLE_MS)
        if event.type == pygame.QUIT:
            return
        key = pygame.key.name(event.key) if event.type == pygame.KEYDOWN else ""
        if key == "escape":
            return
        if session.has_ended:
            continue
        action = actions.get(event.unicode.lower(), actions.get(key)) if key else None
        if waits and event.type == pygame.NOEVENT:
            action = "stay"
        if action is not None:
            picture.events = list(happened(session, session.act(action)))


class WindowPicture:
    """The board and the plots of a session, the keys, and what the last turn brought.

    Args:
        session: the episode.
        title: what is played.
    """

    def __init__(self, session: Session, title: str) -> None:
        self.session, self.title = session, title
        self.events: list[str] = []
        """What the last turn brought."""
        self._font = ImageFont.load_default(_FONT_PIXELS)
        self._episode = self._fitting()
        wide, high = self._episode.size
        self.size: tuple[int, int] = wide, high + _LINES * _LINE_PIXELS
        """Width and height in pixels."""

    def _fitting(self) -> EpisodePicture:
        """As large as the window may be."""
        game = self.session.game
        for width in WIDTHS:
            picture = EpisodePicture(game.map, steps=game.rules.episode_steps, width=width)
            if picture.size[1] + _LINES * _LINE_PIXELS <= HIGHEST:
                break
        return picture

    def draw(self) -> Bytes:
        """The picture of the present turn: uint8 [height, width, 3], RGB."""
        session = self.session
        end = ending(session) if session.has_ended else ""
        episode = self._episode.draw(session.moments, self.title, end=end, own=session.agent)
        image = Image.new("RGB", self.size, PALETTE[GROUND])
        image.paste(Image.fromarray(episode), (0, 0))
        draw = ImageDraw.Draw(image)
        edge, top = _FONT_PIXELS, self._episode.size[1]
        draw.text((edge, top), self._first_line(), agent_colour(session.agent), self._font)
        rows = results(session) if session.has_ended else self._keys()
        for number, row in enumerate(rows):
            below = top + (number + 1) * _LINE_PIXELS
            for column, text in enumerate(row):
                draw.text((edge + column * _COLUMN_PIXELS, below), text, _TEXT, self._font)
        return np.asarray(image)

    def _first_line(self) -> str:
        session = self.session
        you = f"You are agent {session.agent}, with {session.harvested[session.agent]} apples"
        if session.has_ended:
            return f"{you}. The end: {ending(session)}; escape closes the window."
        if not session.is_in_play:
            return f"{you}; out of play."
        return f"{you}; {', '.join(self.events) or 'your turn'}."

    def _keys(self) -> list[tuple[str, str]]:
        """Each key and its action."""
        others = {letter: f" or {name}" for name, letter in ARROWS.items()}
        letters = keys_of(self.session.game).items()
        keys = [(f"{letter}{others.get(letter, '')}", ACTION_NAMES[action]) for letter, action in letters]
        return [*keys, ("escape", "end")]
