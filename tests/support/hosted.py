"""Hosted games without a network: people who choose by rules of their own, and small boards for them."""

import asyncio
import json
from contextlib import contextmanager

from cprl import Game, Rules, maps
from cprl.web import hall as hall_module
from cprl.web.hall import Close, Hall
from cprl.web.session import HostedSession

BOARD = "A..AA\n.>.<.\nAA..A"


def small_game(**rules):
    """A game of two on a board of three rows, on which apples grow fast."""
    rules = {
        "regrow_prob": (0.0, 0.3, 0.4, 0.5),
        "episode_steps": 12,
        "window_rows": 3,
        "window_columns": 5,
        **rules,
    }
    return Game(map=maps.parse(BOARD), rules=Rules(**rules))


def session(game=None, **fields):
    """A session of two people whose turns wait until all have chosen."""
    fields = {
        "people": 2,
        "turns_a_second": 0,
        "choice_seconds": 60.0,
        "pause_seconds": 0.0,
        "practice_turns": 0,
        **fields,
    }
    return HostedSession(game=game or small_game(), **fields)


class Player:
    """A person at a page: keeps what came, and answers each turn with the next of its actions."""

    def __init__(self, hall, secret=None, actions=("forward", "turn_left", "right")):
        self.hall = hall
        self.secret = secret or hall.join(hall.token)["seat_token"]
        self.actions = actions
        self.seat = hall.seat_of(self.secret)
        self.news = []
        self.outbox = None
        self.closed = None
        self.plays = False

    def connect(self):
        self.outbox = self.hall.connect(self.seat)
        return self

    def leave(self):
        self.hall.leave(self.seat, self.outbox)

    def say(self, **message):
        if self.seat.outbox is self.outbox:
            self.hall.receive(self.seat, json.dumps(message))
        return self

    def read(self):
        """Everything that waits."""
        while (news := self.outbox.take()) is not None:
            self._note(news)
        return self.news

    def _note(self, news):
        if isinstance(news, Close):
            self.closed = news.code
            return
        message = json.loads(news)
        self.news.append(message)
        begins = message.get("stage") in ("practice", "playing")
        if (
            self.plays
            and (begins or message["type"] == "turn")
            and self.hall.stage in ("practice", "playing")
        ):
            self.act(message.get("turn", 0))

    def of(self, kind):
        return [message for message in self.read() if message["type"] == kind]

    async def play(self):
        """Answer turns until the end."""
        self.plays = True
        while not self.of("end"):
            self._note(await self.outbox.get())

    def act(self, number):
        self.say(type="action", action=self.actions[number % len(self.actions)], number=number)


@contextmanager
def hosted(folder, session, monkeypatch):
    """A hall whose boards are not shown any longer than they must."""
    for name in ("_LAST_BOARD_SECONDS", "_LEAST_TURN_SECONDS"):
        monkeypatch.setattr(hall_module, name, 0.0)
    hall = Hall(session, folder)
    try:
        yield hall
    finally:
        hall.close()


async def play_all(hall, *players, until=None):
    """Play a session with some players, to its end or until something is so."""
    leading = asyncio.create_task(hall.run())
    playing = [asyncio.create_task(player.play()) for player in players]
    tasks = [leading, *playing]
    try:
        if until is None:
            await asyncio.wait_for(asyncio.gather(*tasks), 60)
        while until is not None and not until():
            done = [task for task in tasks if task.done()]
            assert not done, done
            await asyncio.sleep(0)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
