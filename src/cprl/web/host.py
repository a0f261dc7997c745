"""Serve a hosted game: the page, the way to a seat, and the sockets of those who have one."""

import asyncio
import sys
from contextlib import suppress
from html import escape
from io import StringIO
from typing import Final

from aiohttp import WSMsgType

from cprl.system.output import say
from cprl.values import build
from cprl.web import messages
from cprl.web.hall import Hall, JoinRefusedError, Outbox, Seat
from cprl.web.serving import address_in_room, body_of, lasts, page_route, serving, web
from cprl.web.static_pages import page_of

_SEND_SECONDS: Final = 10.0
"""How long a message may take to be sent, before its socket is closed."""
_HEARTBEAT_SECONDS: Final = 20.0
_MOST_FRAME_BYTES: Final = 4 * messages.MOST_BYTES
"""A larger message closes its socket; a smaller one that is too large gets an error."""
_PROTOCOL: Final = "cprl"


def routes_of(hall: Hall) -> list[web.RouteDef]:
    """Return the page of a hosted game, the way to a seat, and the sockets."""
    page = page_of("host.html", "host.css", "board.js", "host.js", title=escape(hall.session.title))

    async def join(request: web.Request) -> web.StreamResponse:
        try:
            body = build(messages.Join, messages.read_object(await body_of(request)), "join")
            return web.json_response(hall.join(body.token, body.seat_token))
        except ValueError as error:
            return _refused(400, str(error))
        except JoinRefusedError as error:
            return _refused(error.status, str(error))

    async def socket(request: web.Request) -> web.StreamResponse:
        protocols = [part.strip() for part in request.headers.get("Sec-WebSocket-Protocol", "").split(",")]
        seat = hall.seat_of(protocols[1]) if len(protocols) == 2 and protocols[0] == _PROTOCOL else None
        if seat is None:
            return _refused(403, "this seat is not of this session")
        return await _talk(request, hall, seat)

    return [page_route(page), web.post("/join", join), web.get("/socket", socket)]


def _refused(status: int, why: str) -> web.Response:
    return web.Response(status=status, text=messages.write("error", why=why), content_type="application/json")


async def _talk(request: web.Request, hall: Hall, seat: Seat) -> web.WebSocketResponse:
    """Pass messages between a socket and the hall until either closes."""
    ws = web.WebSocketResponse(
        max_msg_size=_MOST_FRAME_BYTES,
        compress=False,
        autoping=False,  # answering a flood of pings would be work without a limit
        heartbeat=_HEARTBEAT_SECONDS,
        protocols=(_PROTOCOL,),
    )
    await ws.prepare(request)
    lasts(request)
    outbox = hall.connect(seat)
    sending = asyncio.create_task(_send(ws, outbox))
    try:
        async for message in ws:
            if message.type == WSMsgType.PING and seat.budget.spend():
                await ws.pong(message.data)
            elif message.type in (WSMsgType.TEXT, WSMsgType.BINARY) and seat.outbox is outbox:
                hall.receive(seat, message.data)
    finally:
        hall.leave(seat, outbox)
        sending.cancel()
    return ws


async def _send(ws: web.WebSocketResponse, outbox: Outbox) -> None:
    """Send what waits for a seat; close the socket when it is to be closed, or too slow."""
    with suppress(ConnectionError, TimeoutError):
        while isinstance(news := await outbox.get(), str):
            async with asyncio.timeout(_SEND_SECONDS):
                await ws.send_str(news)
        await ws.close(code=news.code, message=news.why.encode())
        return
    await ws.close()


async def serve_session(hall: Hall, *, port: int, in_room: bool = False) -> None:
    """Serve a session until it is cancelled, and lead through it.

    Args:
        hall: the session.
        port: the port; 0 for any that is free.
        in_room: whether other machines of the local network may join.
    """
    address = address_in_room() if in_room else "127.0.0.1"
    async with serving(routes_of(hall), list({address, "127.0.0.1"}), port) as places:
        _announce(f"http://{address}:{dict(places)[address]}/#{hall.token}", hall, in_room=in_room)
        with suppress(NotImplementedError, ValueError, OSError):  # no terminal, or Windows
            if sys.stdin.isatty():
                asyncio.get_running_loop().add_reader(sys.stdin.fileno(), _read_enter, hall)
        await hall.run()
        say("The session has ended; people may still see how. Ctrl-C ends the server.")
        await asyncio.Event().wait()


def _read_enter(hall: Hall) -> None:
    sys.stdin.readline()
    hall.start_now()


def _announce(link: str, hall: Hall, *, in_room: bool) -> None:
    """Print the link, as a QR code too, and what it opens."""
    import segno

    code = StringIO()
    segno.make(link).terminal(code, compact=True)
    say(f"{code.getvalue()}\n{link}")
    if in_room:
        say(
            "Whoever is in this network and has the link can take a seat. Nothing is encrypted: who listens "
            "in the network can read along and play in another's place, so use one that you trust."
        )
    else:
        say("The link works on this machine alone; --lan opens it to the room.")
    seats = len(hall.seats)
    say(f"{seats} seats. Enter starts with those who are here; Ctrl-C ends the server, to be continued.")
