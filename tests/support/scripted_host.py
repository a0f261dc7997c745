"""A host of a game that says what a test makes it say, and keeps what the page of a person answers."""

import asyncio
import json
from base64 import b64encode
from contextlib import contextmanager
from threading import Event, Thread

import numpy as np
from aiohttp import web

from cprl.commons.batch import Batch
from cprl.pictures.decoding import classes_seen
from cprl.web.scenes import moment_json, scene_json, window_colours
from cprl.web.static_pages import page_of

WELCOME = {"type": "welcome", "group": 0, "agent": 1, "code": "K7QX", "title": "A commons", "consent": None}


def stage(name, **fields):
    """A stage of two people."""
    told = {"here": 2, "ready": 0, "seats": 2, "round": 1, "rounds": 2, "seconds": None}
    return {"type": "stage", "stage": name, **told, **fields}


def round_and_turn(game, *, view="board", **fields):
    """The messages "round", and "turn" before the first, of a new world of a game."""
    batch = Batch(game, 1, seed=3)
    world = batch.show(batch.begin())
    names = ["person 0", "you", *(f"agent {agent} (greedy)" for agent in range(2, game.agents))]
    told = {
        **{"type": "round", "round": 1, "rounds": 2, "rule": "none", "instructions": ["Pick <b>apples</b>."]},
        **{"view": view, "turns_a_second": 8, "episode_steps": 240, "names": names, "options": None},
        **{"actions": game.actions, "chat": False, "observation_shape": game.observation_shape},
        **{"window_colours": window_colours(game), **scene_json(game)},
    }
    turn = {"type": "turn", "turn": 0, "harvest": [0] * game.agents, "income": None, "ack": 0}
    turn |= {"stock": int(world.stock.sum()), "rule_in_force": None}
    if view == "board":
        turn["board"] = moment_json(game.map, world, np.zeros(game.agents, bool))
    else:
        classes = classes_seen(game, world.observation[None])[0, 1]
        turn |= {"window": b64encode(classes.tobytes()).decode(), "in_play": True}
    return {**told, **fields}, turn


class ScriptedHost:
    """Serves the page at `address`.

    `greeting`: what each socket is sent first; `refusal`: the status with which joining is refused, or None.
    """

    def __init__(self):
        self.greeting = []
        self.refusal = None
        self.joined = []
        self.received = []
        self._socket = None
        self._loop = asyncio.new_event_loop()

    async def start(self):
        routes = [web.get("/", self._page), web.post("/join", self._join), web.get("/socket", self._serve)]
        app = web.Application()
        app.add_routes(routes)
        self._runner = web.AppRunner(app, shutdown_timeout=0.1)
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", 0).start()
        self.address = f"http://127.0.0.1:{self._runner.addresses[0][1]}/"

    async def _page(self, request):
        page = page_of("host.html", "host.css", "board.js", "host.js", title="A commons")
        return web.Response(text=page, content_type="text/html")

    async def _join(self, request):
        self.joined.append(await request.json())
        if self.refusal:
            return web.json_response({"type": "error", "why": "all 2 seats are taken"}, status=self.refusal)
        secret = self.joined[-1].get("seat_token", f"secret{len(self.joined)}")
        return web.json_response({"seat_token": secret, "code": "K7QX"})

    async def _serve(self, request):
        self._socket = web.WebSocketResponse(protocols=("cprl",))
        await self._socket.prepare(request)
        for message in self.greeting:
            await self._socket.send_json(message)
        async for message in self._socket:
            self.received.append(json.loads(message.data))
        return self._socket

    def say(self, *messages):
        """Send messages to the page."""

        async def send():
            for message in messages:
                await self._socket.send_json(message)

        self._call(send())

    def close(self, code=1001):
        """Close the socket of the page."""
        self._call(self._socket.close(code=code))

    def _call(self, coroutine):
        asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(20)

    def run(self, started):
        self._loop.run_until_complete(self.start())
        started.set()
        self._loop.run_forever()
        self._loop.close()

    def stop(self):
        self._call(self._runner.cleanup())
        self._loop.call_soon_threadsafe(self._loop.stop)


@contextmanager
def scripted_host():
    """A host that serves until the block ends."""
    host = ScriptedHost()
    started = Event()
    thread = Thread(target=host.run, args=(started,))
    thread.start()
    started.wait(20)
    try:
        yield host
    finally:
        host.stop()
        thread.join()
