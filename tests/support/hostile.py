"""Hosted games behind real sockets of 127.0.0.1, and clients that send whatever bytes they like."""

import asyncio
import base64
import hashlib
import json
import os
import socket
import struct
import threading
import time
from contextlib import contextmanager, suppress

from hosted import small_game
from viewers import free_port

from cprl.web import hall as hall_module, host as host_module
from cprl.web.hall import Budget, Hall
from cprl.web.session import HostedSession

PATIENCE_S = 20.0
TEXT = 1
BINARY = 2
CLOSE = 8
PING = 9
PONG = 10
HANDSHAKE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": base64.b64encode(bytes(16)).decode(),
}


def plan(**fields):
    """A session whose turns wait until all have chosen, so that nothing moves by itself."""
    fields = {
        **{"people": 2, "turns_a_second": 0, "choice_seconds": 3600.0, "pause_seconds": 0.0},
        **{"practice_turns": 0, "game": small_game(episode_steps=500), **fields},
    }
    return HostedSession(**fields)


class Hosted:
    """A hosted session in a thread, the secrets of its seats, and all that it has sent.

    Args:
        hall: the session.
        port: the port that it is served at.
    """

    def __init__(self, hall, port):
        self.hall = hall
        self.port = port
        self.name = f"127.0.0.1:{port}"
        self.secrets = []
        self.heard = bytearray()
        self._open = []

    def join(self, **more):
        """Take a seat, and return its secret."""
        secret = self.hall.join(self.hall.token, **more)["seat_token"]
        self.secrets.append(secret)
        return secret

    def open(self, data):
        """Send bytes over a new connection, and return it."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S)
        self._open.append(connection)
        with suppress(ConnectionError):
            connection.sendall(data)
        return connection

    def hang_up(self):
        """Close all connections."""
        for connection in self._open:
            connection.close()
        self._open.clear()

    def answer(self, data, *, ends=False):
        """Send bytes over a new connection, and return the answer until it is closed.

        Args:
            ends: whether to say that no more comes.
        """
        with self.open(data) as connection:
            if ends:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_WR)
            parts = []
            with suppress(ConnectionError):
                while part := connection.recv(65536):
                    parts.append(part)
        self.heard += b"".join(parts)
        return b"".join(parts)

    def request(self, method="GET", path="/", headers=None, body=b"", hosts=None):
        """The bytes of a request; headers is a table or pairs."""
        pairs = [("Host", one) for one in (hosts if hosts is not None else [self.name])]
        pairs += [*dict(headers).items()] if isinstance(headers, dict) else [*(headers or ())]
        if body and not any(name.lower() in ("content-length", "transfer-encoding") for name, _ in pairs):
            pairs.append(("Content-Length", str(len(body))))
        lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in pairs), "", ""]
        return "\r\n".join(lines).encode("utf-8", "surrogateescape") + body

    def status(self, *args, **fields):
        """The status of the answer to a request, 0 if the connection is just closed."""
        return status_of(self.answer(self.request(*args, **fields)))

    def socket(self, secret, **fields):
        """The WebSocket of a seat."""
        return Wire(self, secret, **fields)

    def in_loop(self, call):
        """What a call returns in the thread of the server, after all that waits there."""

        async def called():
            for _ in range(5):
                await asyncio.sleep(0)
            return call()

        return asyncio.run_coroutine_threadsafe(called(), self.loop).result(PATIENCE_S)

    def forget(self, seat):
        """Wait until nobody is connected to a seat."""
        deadline = time.monotonic() + PATIENCE_S
        while self.hall.seats[seat].outbox is not None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"seat {seat} is still connected")
            time.sleep(0.002)

    def refill(self):
        """Give all their budget back, so that one test does not spend that of the next."""
        self.hall._join_budget = Budget(10.0, 200.0)
        for seat in self.hall.seats:
            seat.budget = Budget(20.0, 40.0)

    def state(self):
        """All that must not change: the stage, the worlds, the seats, and every byte of the files."""
        return self.in_loop(self._state)

    def _state(self):
        hall = self.hall
        this = hall._round
        worlds = {}
        if this is not None:
            worlds = {"cells": this._cells().tolist(), "views": this.views()}
        kept = ("code", "secret", "consented", "completion", "is_ready", "action", "number", "vote", "view")
        seats = [{name: getattr(seat, name) for name in kept} for seat in hall.seats]
        return {"stage": hall.stage, "worlds": worlds, "seats": seats, "files": files_in(hall.folder)}

    def leaks(self):
        """The secrets that were sent, or that stand in a file but that of the link."""
        stored = b"".join(
            path.read_bytes()
            for path in self.hall.folder.rglob("*")
            if path.is_file() and path.name != hall_module.LINK_FILE
        )
        secrets = [self.hall.token, *self.secrets, *(seat.secret for seat in self.hall.seats if seat.secret)]
        sent = [one for one in secrets if one.encode() in self.heard]
        return sent + [one for one in secrets[: 1 + len(self.secrets)] if one.encode() in stored]

    @contextmanager
    def unchanged(self):
        """Assert that a block changes nothing, and that nothing it was sent or that is stored is a secret."""
        self.heard.clear()
        before = self.state()
        yield
        assert self.state() == before
        assert self.leaks() == []


def files_in(folder):
    """The digest of each file of a folder."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def status_of(answer):
    """The status of an answer's bytes; 0 without one."""
    head = answer.removeprefix(b"HTTP/1.1 100 Continue\r\n\r\n")
    return int(head.split(b" ", 2)[1]) if head.startswith(b"HTTP/") else 0


class Wire:
    """A WebSocket, frame by frame.

    Args:
        hosted: the session.
        secret: that of a seat.
        protocols: the header of subprotocols, by default that of the seat; "" for none.
        headers: other headers of the handshake; None leaves one out.
    """

    def __init__(self, hosted, secret="", *, protocols=None, headers=None, hosts=None, path="/socket"):
        self.hosted = hosted
        named = f"cprl, {secret}" if protocols is None else protocols
        table = {**HANDSHAKE, **({"Sec-WebSocket-Protocol": named} if named else {}), **(headers or {})}
        pairs = [(name, value) for name, value in table.items() if value is not None]
        self.connection = hosted.open(hosted.request("GET", path, pairs, hosts=hosts))
        self._buffer = b""
        while b"\r\n\r\n" not in self._buffer and self._receive():
            pass
        self.head, _, self._buffer = self._buffer.partition(b"\r\n\r\n")
        self.status = status_of(self.head)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.connection.close()

    def _receive(self):
        try:
            part = self.connection.recv(65536)
        except ConnectionError:
            part = b""
        self.hosted.heard += part
        self._buffer += part
        return part

    def _take(self, count):
        while len(self._buffer) < count:
            if not self._receive():
                return None
        taken, self._buffer = self._buffer[:count], self._buffer[count:]
        return taken

    def frame(self, payload=b"", opcode=TEXT, *, mask=True, fin=True, rsv=0, length=None):
        """Send a frame, whole or with another length than it has."""
        said = len(payload) if length is None else length
        first = bytes([fin << 7 | rsv << 4 | opcode])
        if said < 126:
            second = bytes([mask << 7 | said])
        elif said < 1 << 16:
            second = bytes([mask << 7 | 126]) + struct.pack("!H", said)
        else:
            second = bytes([mask << 7 | 127]) + struct.pack("!Q", said)
        key = os.urandom(4) if mask else b""
        masked = bytes(byte ^ key[at % 4] for at, byte in enumerate(payload)) if mask else payload
        with suppress(ConnectionError):
            self.connection.sendall(first + second + key + masked)
        return self

    def say(self, **message):
        """Send a message."""
        return self.frame(json.dumps(message).encode())

    def read(self):
        """The next message as a table, or ("closed", code); code None without a close frame."""
        while True:
            head = self._take(2)
            if head is None:
                return "closed", None
            size = head[1] & 127
            if size == 126:
                size = struct.unpack("!H", self._take(2))[0]
            elif size == 127:
                size = struct.unpack("!Q", self._take(8))[0]
            payload = self._take(size)
            opcode = head[0] & 15
            if opcode == CLOSE:
                return "closed", struct.unpack("!H", payload[:2])[0] if payload else None
            if opcode == TEXT:
                return json.loads(payload)

    def until(self, kind):
        """The next message of a kind."""
        while True:
            message = self.read()
            if isinstance(message, tuple):
                raise AssertionError(f"closed with {message[1]} before {kind!r}")
            if message["type"] == kind:
                return message

    def closing(self):
        """The code with which the server closes the socket, whatever comes before."""
        while not isinstance(message := self.read(), tuple):
            pass
        return message[1]


@contextmanager
def hosting(folder, session, monkeypatch):
    """Host a session in a thread, for real clients."""
    for name in ("_LAST_BOARD_SECONDS", "_LEAST_TURN_SECONDS"):
        monkeypatch.setattr(hall_module, name, 0.0)
    monkeypatch.setattr(host_module, "_HEARTBEAT_SECONDS", None)  # sockets that wait here answer no ping
    hall = Hall(session, folder)
    hosted = Hosted(hall, free_port())
    hosted.loop = asyncio.new_event_loop()

    async def lead():
        hosted.task = asyncio.current_task()
        await host_module.serve_session(hall, port=hosted.port)

    def run():
        with suppress(asyncio.CancelledError):
            hosted.loop.run_until_complete(lead())
        hosted.loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        _wait_for(hosted.port)
        yield hosted
    finally:
        hosted.hang_up()
        hosted.loop.call_soon_threadsafe(hosted.task.cancel)
        thread.join()
        hall.close()


def _wait_for(port):
    for _ in range(400):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            return
        except ConnectionError:
            threading.Event().wait(0.02)
    raise TimeoutError("the server did not start")
