"""Serve pages of our own with aiohttp: who may ask, which headers an answer has, and how long a request may
take.

A page that another site shows must not reach a server on this machine. So each request names this server as
its `Host`, and the page that sends it as its `Origin` if it names one. aiohttp itself waits for the rest of
half a request for ever, hence the watchdog: a connection has one request, `REQUEST_SECONDS` to send it, and
`ANSWER_SECONDS` until it is answered; only a WebSocket lasts longer.
"""

import asyncio
import logging
import socket
import sys
import traceback
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager, closing
from typing import Final

try:
    from aiohttp import web as web
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        'pages are served by aiohttp, which is not installed; run pip install "cprl[web]"', name="aiohttp"
    ) from error

REQUEST_SECONDS: Final = 5.0
ANSWER_SECONDS: Final = 60.0
MOST_CONNECTIONS: Final = 1000
HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of each answer that does not set them itself."""
_SILENT, _BEGUN, _UPGRADED = range(3)
_STATES: Final[dict[asyncio.BaseProtocol, int]] = {}
"""How far the request of each young connection has come."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def page_route(page: str) -> web.RouteDef:
    """Return the route of a page that says itself what it may load."""
    policy = {"Content-Security-Policy": "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"}

    async def show(request: web.Request) -> web.StreamResponse:
        return web.Response(text=page, content_type="text/html", headers=policy)

    return web.get("/", show)


def _names_of(address: str, port: int) -> set[str]:
    """Return what a browser may call a server at an address in the header `Host`."""
    names = {address, "localhost"} if address == "127.0.0.1" else {address, socket.gethostname().lower()}
    return {f"{name}:{port}" for name in names}


def _guarded(routes: Sequence[web.RouteDef], hosts: set[str]) -> web.Application:
    """Return an application that answers requests to these hosts, from their own pages, alone."""

    @web.middleware
    async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
        _note(request, _BEGUN)
        host = request.headers.getall("Host", [])
        origin = request.headers.getall("Origin", [])
        is_ours = len(host) == 1 and host[0].lower() in hosts and request.raw_path.startswith("/")
        is_from_ours = not origin or origin[0].lower() in {f"http://{name}" for name in hosts}
        if request.version.major != 1:
            response: web.StreamResponse = web.Response(status=505)
        elif not is_ours or not is_from_ours or len(origin) > 1:
            response = web.Response(status=403, text="not here")
        else:
            response = await _answer(request, handler)
        if not response.prepared:
            response.force_close()
            for name, value in HEADERS.items():
                response.headers.setdefault(name, value)
        return response

    app = web.Application(middlewares=[guard], client_max_size=4096)
    app.add_routes(routes)
    return app


async def _answer(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Return the answer of a handler; an error of ours is printed, without the address of who asked."""
    try:
        return await handler(request)
    except web.HTTPException as refused:
        return web.Response(status=refused.status, text=refused.reason)
    except (ConnectionError, TimeoutError):
        return web.Response(status=408)
    except Exception:
        traceback.print_exc(file=sys.stderr)
        return web.Response(status=500, text="an error of the server")


async def body_of(request: web.Request) -> str:
    """Return the body of a request as text; refuse one that takes too long to come, or is no UTF-8."""
    try:
        return await asyncio.wait_for(request.text(), REQUEST_SECONDS)
    except (LookupError, UnicodeDecodeError, web.RequestPayloadError):
        raise web.HTTPBadRequest from None


def lasts(request: web.Request) -> None:
    """Exempt the connection of a request from the watchdog, as a WebSocket that was accepted."""
    _note(request, _UPGRADED)


def _note(request: web.Request, state: int) -> None:
    if request.protocol in _STATES:
        _STATES[request.protocol] = state


@asynccontextmanager
async def serving(
    routes: Sequence[web.RouteDef], addresses: Sequence[str], port: int
) -> AsyncIterator[list[tuple[str, int]]]:
    """Serve routes in the block, at the port of each address; yield addresses and ports.

    Nothing is logged: the messages of aiohttp name the addresses of people.

    Args:
        routes: the routes; the body of a request has at most 4,096 bytes.
        addresses: the addresses of this machine at which it is served.
        port: the port; 0 for any that is free.
    """
    logging.getLogger("aiohttp").setLevel(logging.CRITICAL + 1)
    hosts: set[str] = set()
    app = _guarded(routes, hosts)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0, lingering_time=1.0)
    await runner.setup()
    assert runner.server is not None
    make_protocol = runner.server
    loop = asyncio.get_running_loop()

    def watched() -> asyncio.BaseProtocol:
        protocol = make_protocol()
        _STATES[protocol] = _SILENT
        is_full = len(make_protocol.connections) >= MOST_CONNECTIONS
        loop.call_later(0 if is_full else REQUEST_SECONDS, _close_below, protocol, _BEGUN)
        loop.call_later(ANSWER_SECONDS, _close_below, protocol, _UPGRADED)
        loop.call_later(ANSWER_SECONDS, _STATES.pop, protocol)
        return protocol

    try:
        with closing(await loop.create_server(watched, addresses, port)) as server:
            places = [listening.getsockname()[:2] for listening in server.sockets]
            for place in places:
                hosts |= _names_of(*place)
            yield places
    finally:
        await runner.cleanup()


def _close_below(protocol: "web.RequestHandler", state: int) -> None:
    """Close a connection whose request has not come so far."""
    if _STATES[protocol] < state and protocol.transport is not None:
        protocol.transport.abort()


def address_in_room() -> str:
    """Return the address of this machine in its local network; 127.0.0.1 if it is in none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("10.255.255.255", 1))  # sends nothing: it asks which address would send
            return str(probe.getsockname()[0])
        except OSError:
            return "127.0.0.1"
