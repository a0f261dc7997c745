"""Hall: the people of a session, the stages that it goes through, and the clock. It knows nothing of the
network.

A server hands in what people do, `join`, `connect`, `receive`, `leave`, and sends what it finds in the queue
of each seat. `run` leads through the session: the lobby, a practice round, all rounds, the end.
"""

import asyncio
import gc
import hashlib
import hmac
import json
import secrets
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from cprl.runs.files import LOCK_FILE, RunLock, read_json, refuse_newer, time_now, write_json
from cprl.runs.recipe import versions
from cprl.system.output import say
from cprl.web import messages
from cprl.web.hosted_round import NONE, HostedRound
from cprl.web.hosting import STAY
from cprl.web.session import HostedSession, with_turns

SESSION_FILE: Final = "session.json"
SESSION_FORMAT: Final = 1
LINK_FILE: Final = "join.txt"
"""The token of the link; only its owner may read the file."""
_SIGNS: Final = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"
"""The signs of codes, of which none looks like another."""
_KEPT: Final = ("group", "agent", "code", "secret", "consented", "completion")
"""The fields of a seat in the session's file."""
_MOST_WAITING: Final = 64
"""The messages that wait for a slow reader at most; earlier ones are lost."""
_FREE_AFTER_SECONDS: Final = 60.0
"""After how long in the lobby a seat is free again whose person has left."""
_ABSENT_AFTER_SECONDS: Final = 5.0
"""After how long without a connection a person has left, and does not just reload the page."""
_BACK_WITHIN_SECONDS: Final = 15.0
"""How long a restarted server waits for people to come back."""
_LAST_BOARD_SECONDS: Final = 1.0
"""How long people see the board before the first turn, and after the last one."""
_LEAST_TURN_SECONDS: Final = 0.1
"""How long a turn lasts at least, where one is played when all have chosen."""


class Close(NamedTuple):
    """The wish, in a seat's queue, that its socket is closed."""

    code: int
    why: str


class Outbox:
    """What waits to be sent over a socket.

    A slow reader never holds up the clock: it gets the newest turn, and the last of the other messages."""

    def __init__(self) -> None:
        self._waiting: deque[str | Close] = deque(maxlen=_MOST_WAITING)
        self._turn: str | None = None
        self._wake = asyncio.Event()

    def put(self, news: str | Close) -> None:
        """Add a message, or the wish that the socket is closed."""
        self._waiting.append(news)
        self._wake.set()

    def show(self, turn: str) -> None:
        """Replace the turn that waits."""
        self._turn = turn
        self._wake.set()

    def take(self) -> str | Close | None:
        """Return what is to be sent next; None if nothing waits."""
        if self._waiting:
            return self._waiting.popleft()
        turn = self._turn
        self._turn = None
        return turn

    async def get(self) -> str | Close:
        """Wait for what is to be sent next."""
        while (news := self.take()) is None:
            self._wake.clear()
            await self._wake.wait()
        return news


class JoinRefusedError(Exception):
    """A request to join is refused; `status` is that of the answer."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


class Budget:
    """A limit of messages: so many a second, and so many at once."""

    def __init__(self, rate: float, most: float) -> None:
        self.rate = rate
        self._most = most
        self._left = most
        self._at = time.monotonic()

    def spend(self) -> bool:
        """Count a message, and return whether it is within the limit."""
        now = time.monotonic()
        self._left = min(self._most, self._left + self.rate * (now - self._at))
        self._at = now
        is_within = self._left >= 1
        self._left -= is_within
        return is_within


@dataclass
class Seat:
    """A person's place in a group: what is known of the person, and what the person has chosen."""

    group: int
    agent: int
    budget: Budget
    code: str = ""
    secret: str = ""
    """The digest of its secret; "" for a seat that is free."""
    consented: str = ""
    """The time of the consent, or of joining without a text."""
    completion: str = ""
    """What the person can show afterwards to prove that the session was played to its end."""
    outbox: Outbox | None = None
    left_at: float = field(default_factory=time.monotonic)
    is_ready: bool = False
    action: int = NONE
    number: int = 0
    vote: int = NONE
    view: str = ""

    def kept(self) -> dict[str, Any]:
        """Return what the session's file says of the person."""
        return {name: getattr(self, name) for name in _KEPT}

    @property
    def is_here(self) -> bool:
        """Return whether the person is connected and has consented."""
        return self.outbox is not None and bool(self.consented)

    def has_left_for(self, seconds: float) -> bool:
        """Return whether the person has not been connected for some time."""
        return self.outbox is None and time.monotonic() - self.left_at > seconds

    def send(self, name: str, **fields: Any) -> None:
        """Send the person a message, if connected."""
        if self.outbox is not None:
            self.outbox.put(messages.write(name, **fields))

    def disconnect(self, code: int, why: str) -> None:
        """Close the person's socket, if connected."""
        if self.outbox is not None:
            self.outbox.put(Close(code, why))


class Hall:
    """A session in its folder: begun, or continued where an earlier process left it.

    Args:
        session: the session.
        folder: its folder: new, empty, or of the same session.

    Raises:
        ValueError: for a session that cannot be played, or a folder of another session.
        RunLockedError: if another process hosts the session.
    """

    def __init__(self, session: HostedSession, folder: Path) -> None:
        self.session = session
        self.folder = folder
        games = session.games()
        runs = session.trained_runs()
        self.rounds = [
            HostedRound(session, number, name, game, runs=runs, folder=folder / f"round-{number + 1}")
            for number, (name, game) in enumerate(games)
        ]
        self._practice: list[HostedRound] = []
        if session.practice_turns:
            name, game = games[0]
            game = with_turns(game, session.practice_turns)
            self._practice.append(HostedRound(session, 0, name, game, runs=runs, folder=None))
        self.stage = "lobby"
        self._until: float | None = None
        self._round: HostedRound | None = None
        self._starts_now = False
        self._changed = asyncio.Event()
        self._join_budget = Budget(rate=10.0, most=200.0)
        self._rate = max(20.0, 2 * session.turns_a_second)
        """The messages a second that a person, or a program, may send."""
        with ExitStack() as opening:
            folder.mkdir(parents=True, exist_ok=True)
            opening.enter_context(RunLock(folder))
            self._open()
            self._save()
            self._closing = opening.pop_all()

    def close(self) -> None:
        """Close the files of the session, and release its folder."""
        for hosted_round in self.rounds:
            hosted_round.close()
        self._closing.close()

    # the folder

    def _open(self) -> None:
        """Read the session in the folder, or begin it in a new one."""
        path = self.folder / SESSION_FILE
        link = self.folder / LINK_FILE
        consent = self.session.consent
        config = {**self.session.to_config(), "consent": consent and digest(consent)}
        if path.exists():
            self._table = read_json(path)
            refuse_newer(path, self._table, SESSION_FORMAT)
            if self._table.get("session") != json.loads(json.dumps(config)):
                raise ValueError(
                    f"{path} is of another session; allowed: what it was begun with, or another folder"
                )
            self.token = link.read_text(encoding="ascii")
            self.seats = [self._make_seat(**seat) for seat in self._table["seats"]]
            return
        if {file.name for file in self.folder.iterdir()} - {LOCK_FILE, LINK_FILE}:
            raise FileExistsError(f"{self.folder} is not empty; allowed: a new folder, or that of a session")
        self.token = secrets.token_urlsafe(16)
        link.unlink(missing_ok=True)
        link.touch(mode=0o600)
        link.write_text(self.token, encoding="ascii")
        self._table = {
            "format": SESSION_FORMAT,
            "id": secrets.token_hex(8),
            "begun": time_now(),
            "session": config,
            "versions": versions(),
            "rounds": {f"round-{part.number + 1}": part.name for part in self.rounds},
        }
        places = np.ndindex(self.session.groups, self.session.people)
        self.seats = [self._make_seat(group=group, agent=agent) for group, agent in places]

    def _make_seat(self, **fields: Any) -> Seat:
        return Seat(**fields, budget=Budget(self._rate, 2 * self._rate))

    def _save(self) -> None:
        """Write the session's file: of people their codes, and the digests of their secrets."""
        table = {**self._table, "seats": [seat.kept() for seat in self.seats]}
        write_json(self.folder / SESSION_FILE, table)

    # people

    def join(self, token: str, seat_token: str | None = None) -> dict[str, str]:
        """Give a person a seat.

        Args:
            token: that of the link.
            seat_token: the secret of a seat that the person may have already.

        Returns:
            The secret of the seat, which is stored nowhere, and the person's code.

        Raises:
            JoinRefusedError: for another token, too many requests, or if all seats are taken.
        """
        if not hmac.compare_digest(digest(token), digest(self.token)):
            raise JoinRefusedError(403, "this link is not of this session")
        if not self._join_budget.spend():
            raise JoinRefusedError(429, "too many people ask at once; try again in some seconds")
        seat = self.seat_of(seat_token or "")
        if seat is not None and seat_token is not None:
            return {"seat_token": seat_token, "code": seat.code}
        free = next((seat for seat in self.seats if self._is_free(seat)), None)
        if free is None:
            raise JoinRefusedError(409, f"all {len(self.seats)} seats are taken")
        secret = secrets.token_urlsafe(16)
        taken = {seat.code for seat in self.seats}
        self.seats[self.seats.index(free)] = seat = self._make_seat(
            group=free.group,
            agent=free.agent,
            code=next(code for code in iter(_code, "") if code not in taken),
            secret=digest(secret),
            consented="" if self.session.consent else time_now(),
            completion=_code(8),
        )
        self._save()
        return {"seat_token": secret, "code": seat.code}

    def _is_free(self, seat: Seat) -> bool:
        """Return whether a new person may take a seat: in the lobby also that of somebody who has left."""
        return not seat.secret or (self.stage == "lobby" and seat.has_left_for(_FREE_AFTER_SECONDS))

    def seat_of(self, secret: str) -> Seat | None:
        """Return the seat with a secret; None without one."""
        wanted = digest(secret)
        seats = [seat for seat in self.seats if hmac.compare_digest(seat.secret, wanted)]
        return seats[0] if seats else None

    def connect(self, seat: Seat) -> Outbox:
        """Connect the person of a seat, whose older socket is closed."""
        seat.disconnect(4001, "the seat is open in another window")
        seat.outbox = Outbox()
        consent = None if seat.consented else self.session.consent
        place = {"group": seat.group, "agent": seat.agent, "code": seat.code}
        seat.send("welcome", **place, title=self.session.title, consent=consent)
        self._catch_up(seat)
        return seat.outbox

    def leave(self, seat: Seat, outbox: Outbox) -> None:
        """Note that a socket is closed; nothing changes if a newer one has replaced it."""
        if seat.outbox is outbox:
            seat.outbox = None
            seat.left_at = time.monotonic()
            seat.action = NONE
            self._say_stage()

    def receive(self, seat: Seat, text: object) -> None:
        """Do what a message asks for; one that is not allowed gets an error, and changes nothing."""
        if not seat.budget.spend():
            why = f"too many messages; allowed: {seat.budget.rate:.0f} a second"
            seat.send("error", why=why)
            seat.disconnect(4008, why)
            return
        try:
            self._obey(seat, messages.read(text))
        except ValueError as error:
            seat.send("error", why=str(error))

    def _obey(self, seat: Seat, message: messages.Message) -> None:
        """Do what a message asks for.

        Raises:
            ValueError: if it is not allowed, or not now.
        """
        if not seat.consented and not isinstance(message, messages.Consent):
            raise ValueError("it is too early: the text of consent is not answered")
        match message:
            case messages.Consent() if not seat.consented:
                seat.consented = time_now()
                self._save()
                self._catch_up(seat)
            case messages.Ready():
                seat.is_ready = True
                self._say_stage()
            case messages.Seeing(view=view):
                seat.view = view
            case messages.Action(action=action, number=number):
                hosted_round = self._round_now("action", self.stage in ("practice", "playing"))
                if action not in hosted_round.game.actions:
                    raise ValueError(f"action is unknown; allowed: {', '.join(hosted_round.game.actions)}")
                seat.action = hosted_round.game.actions.index(action)
                seat.number = number
                self._changed.set()
            case messages.Choice(option=option):
                hosted_round = self._round_now("vote")
                if not hosted_round.game.decisions or hosted_round.turn:
                    raise ValueError("there is no vote now")
                if option >= hosted_round.game.decisions:
                    raise ValueError(f"option is {option}; allowed: 0 to {hosted_round.game.decisions - 1}")
                seat.vote = option
            case messages.Chat(text=text):
                hosted_round = self._round_now("chat")
                if not hosted_round.has_chat:
                    raise ValueError("there is no chat in this session")
                hosted_round.keep_chat(seat.group, seat.agent, text, _ms())
                line = {"from": self.session.names()[seat.agent], "text": text}
                for other in self.seats:
                    if other.group == seat.group and other.consented:
                        other.send("chat", **line)

    def _round_now(self, what: str, is_now: bool = True) -> HostedRound:
        """Return the round that is on; raise a ValueError if it is too early or too late."""
        if self._round is None or not is_now:
            raise ValueError(f"there is no {what} now")
        return self._round

    # what people are told

    def _say_stage(self) -> None:
        """Tell all which stage it is, who is here, and who is ready."""
        self._changed.set()
        fields = {
            "here": sum(seat.is_here for seat in self.seats),
            "ready": sum(seat.is_here and seat.is_ready for seat in self.seats),
            "seats": len(self.seats),
            "round": self._number,
            "rounds": len(self.rounds),
            "seconds": self._until and round(max(0.0, self._until - time.monotonic()), 1),
        }
        for seat in self.seats:
            seat.send("stage", stage=self.stage if seat.consented else "consent", **fields)

    @property
    def _number(self) -> int:
        """Return the number of the round, from 1; 0 before the first, and in practice."""
        return 0 if self._round is None or self._round.folder is None else self._round.number + 1

    def _catch_up(self, seat: Seat) -> None:
        """Send a person what is on: the stage, and the round with its board, or the end."""
        self._say_stage()
        if seat.consented and self._round is not None:
            self._send_round(seat, self._round)
            self._send_turn(seat, self._round, self._round.views()[seat.group])
        if seat.consented and self.stage == "end":
            self._send_end(seat)

    def _names(self, seat: Seat) -> list[str]:
        """Return what the agents of a person's group are called on the person's page."""
        names = self.session.names()
        names[seat.agent] = "you"
        return names

    def _send_round(self, seat: Seat, hosted_round: HostedRound) -> None:
        if seat.consented:
            names = self._names(seat)
            seat.send(
                "round", round=self._number, rounds=len(self.rounds), names=names, **hosted_round.fixed()
            )

    def _send_turn(self, seat: Seat, hosted_round: HostedRound, view: dict[str, Any]) -> None:
        """Send a turn in the form that the seat asks for."""
        if seat.outbox is None or not seat.consented:
            return
        form = seat.view or self.session.view
        if form != "board":
            view = hosted_round.narrowed(view, seat.group, seat.agent, form)
        in_play = bool(hosted_round.in_play()[seat.group, seat.agent])
        seat.outbox.show(messages.write("turn", **view, in_play=in_play, ack=seat.number))

    def _send_end(self, seat: Seat) -> None:
        rounds = [
            {"rule": hosted_round.name, "trained": hosted_round.trained(), **hosted_round.result(seat.group)}
            for hosted_round in self.rounds
        ]
        seat.send("end", completion_code=seat.completion, names=self._names(seat), rounds=rounds)

    # stages

    def start_now(self) -> None:
        """Leave the lobby without those who are missing, or end the pause before a round."""
        self._starts_now = any(seat.is_here for seat in self.seats)
        self._changed.set()

    async def run(self) -> None:
        """Lead through the session, from where it is to its end."""
        is_new = not (self.folder / "round-1").exists()
        if is_new:
            await self._stay("lobby", lambda: all(seat.is_here for seat in self.seats))
        for hosted_round in [*(self._practice if is_new else ()), *self.rounds]:
            if not hosted_round.is_finished:
                await self._lead_through(hosted_round)
        self.stage = "end"
        for seat in self.seats:
            self._catch_up(seat)

    async def _stay(
        self, stage: str, until: Callable[[], bool] | None = None, seconds: float | None = None
    ) -> None:
        """Go to a stage, and stay there until something is so, the host starts now, or time is over."""
        self.stage = stage
        self._until = None if seconds is None else time.monotonic() + seconds
        self._say_stage()
        if until is not None:
            await self._wait(until, seconds)

    async def _wait(self, until: Callable[[], bool], seconds: float | None = None) -> None:
        self._starts_now = False
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while not (until() or self._starts_now):
                    self._changed.clear()
                    await self._changed.wait()

    async def _lead_through(self, hosted_round: HostedRound) -> None:
        """Let people read the rules of a round, and play it."""
        await asyncio.to_thread(hosted_round.begin, self._table["id"])
        self._round = hosted_round
        for seat in self.seats:
            seat.action = NONE
            seat.vote = NONE
            seat.is_ready = False
            self._send_round(seat, hosted_round)
        if hosted_round.turn:
            await self._stay("paused", self._are_back, _BACK_WITHIN_SECONDS)
        else:
            is_first = hosted_round is (self._practice or self.rounds)[0]
            stage = "instructions" if is_first else "between"
            await self._stay(stage, self._are_ready, self.session.pause_seconds)
        await self._stay("practice" if hosted_round.folder is None else "playing")
        self._send_turns(hosted_round)
        gc.collect()
        gc.freeze()  # a full collection would stop the clock for a quarter of a second
        await asyncio.sleep(_LAST_BOARD_SECONDS)
        await self._run_clock(hosted_round)
        self._round = None
        await asyncio.to_thread(hosted_round.finish)
        if hosted_round.folder is not None:
            say(f"{hosted_round.folder}: round {hosted_round.number + 1}, {hosted_round.name}")
        await asyncio.sleep(_LAST_BOARD_SECONDS)

    def _are_back(self) -> bool:
        """Return whether all are here who had a seat."""
        return all(seat.is_here for seat in self.seats if seat.secret)

    def _are_ready(self) -> bool:
        """Return whether all who are here are ready, and somebody is."""
        ready = [seat.is_ready for seat in self.seats if seat.is_here]
        return bool(ready) and all(ready)

    async def _run_clock(self, hosted_round: HostedRound) -> None:
        """Play turns at the pace of the session until all groups have ended."""
        stage = self.stage
        due = time.monotonic()
        while not hosted_round.is_over:
            if self.session.turns_a_second:
                due = max(due + 1 / self.session.turns_a_second, time.monotonic())
                await asyncio.sleep(due - time.monotonic())
            else:
                await asyncio.sleep(_LEAST_TURN_SECONDS)
                await self._wait(lambda: self._have_chosen(hosted_round), self.session.choice_seconds)
            if not any(seat.is_here for seat in self.seats):
                await self._stay("paused", lambda: any(seat.is_here for seat in self.seats))
                await self._stay(stage)
            self._play_turn(hosted_round)

    def _have_chosen(self, hosted_round: HostedRound) -> bool:
        """Return whether all have chosen who are here and can."""
        in_play = hosted_round.in_play()
        here = [seat for seat in self.seats if seat.is_here]
        return bool(here) and all(seat.action != NONE or not in_play[seat.group, seat.agent] for seat in here)

    def _play_turn(self, hosted_round: HostedRound) -> None:
        """Play a turn of all groups, keep it, and send it."""
        action = hosted_round.nothing()
        votes = hosted_round.nothing()
        person = np.zeros(action.shape, np.bool_)
        given = np.zeros(action.shape, np.bool_)
        stay = hosted_round.game.actions.index(STAY)
        for seat in self.seats:
            agent = seat.group, seat.agent
            person[agent] = bool(seat.consented) and not seat.has_left_for(_ABSENT_AFTER_SECONDS)
            given[agent] = seat.action != NONE
            stays = person[agent] or self.session.absent == STAY
            action[agent] = stay if stays and not given[agent] else seat.action
            votes[agent] = seat.vote
            seat.action = NONE
        playing = [group for group in range(self.session.groups) if group not in hosted_round.episodes]
        hosted_round.play(action, votes)
        hosted_round.keep(playing, person, given, _ms())
        self._send_turns(hosted_round)
        for seat in self.seats:
            if hosted_round.turn == 1 and hosted_round.game.ballots:
                seat.send("vote", result=hosted_round.in_force(seat.group))
            if seat.group in playing and seat.group in hosted_round.episodes:
                seat.send("round_end", round=self._number, **hosted_round.result(seat.group))

    def _send_turns(self, hosted_round: HostedRound) -> None:
        views = hosted_round.views()
        for seat in self.seats:
            self._send_turn(seat, hosted_round, views[seat.group])


def digest(secret: str) -> str:
    """Return the SHA-256 of a secret, the only form in which the session keeps it."""
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()


def _ms() -> int:
    return time.time_ns() // 1_000_000


def _code(length: int = 4) -> str:
    return "".join(secrets.choice(_SIGNS) for _ in range(length))
