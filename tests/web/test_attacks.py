"""Attacks on a hosted game: each gets its answer, changes nothing, and learns no secret."""

import gzip
import json
import socket
import struct
import threading
import time

import pyarrow.parquet as pq
import pytest
from hosted import small_game
from hostile import BINARY, CLOSE, HANDSHAKE, PING, PONG, TEXT, hosting, plan, status_of

from cprl import institutions
from cprl.runs.files import RunLockedError
from cprl.runs.journal import batches_in
from cprl.web import hall as hall_module, serving
from cprl.web.hall import Budget, Hall, digest

CONSENT = "You may leave at any time."


@pytest.fixture(scope="module")
def patch():
    with pytest.MonkeyPatch.context() as patched:
        yield patched


@pytest.fixture(scope="module")
def playing(tmp_path_factory, patch):
    """Two groups of two in the second turn of a round with a chat: all seats are taken."""
    with hosting(tmp_path_factory.mktemp("playing") / "out", plan(groups=2, chat=True), patch) as hosted:
        sockets = [hosted.socket(hosted.join()) for _ in range(4)]
        for turn in (1, 2):
            for one in sockets:
                while hosted.hall.stage != "playing":
                    one.until("stage")
                one.say(type="action", action="forward", number=turn)
            while sockets[0].until("turn")["turn"] < turn:
                pass
        yield hosted


@pytest.fixture(scope="module")
def lobby(tmp_path_factory, patch):
    """A lobby of four seats with a text of consent: one person has consented, one has not."""
    session = plan(people=4, consent=CONSENT)
    with hosting(tmp_path_factory.mktemp("lobby") / "out", session, patch) as hosted:
        first = hosted.socket(hosted.join()).say(type="consent")
        while first.until("stage")["stage"] != "lobby":
            pass
        hosted.join()
        yield hosted


@pytest.fixture(scope="module")
def voting(tmp_path_factory, patch):
    """Two people before a round with a vote."""
    vote = institutions.Vote(on=institutions.Tax(), choices=(0.0, 0.5, 1.0))
    session = plan(rounds=(("vote", (vote,)),), pause_seconds=3000.0)
    with hosting(tmp_path_factory.mktemp("voting") / "out", session, patch) as hosted:
        sockets = [hosted.socket(hosted.join()) for _ in range(2)]
        for one in sockets:
            one.until("round")
        yield hosted


@pytest.fixture(scope="module")
def ended(tmp_path_factory, patch):
    """A session of one person that is over."""
    session = plan(people=1, game=small_game(episode_steps=1), chat=True)
    with hosting(tmp_path_factory.mktemp("ended") / "out", session, patch) as hosted:
        with hosted.socket(hosted.join()) as only:
            while hosted.hall.stage != "playing":
                only.until("stage")
            only.say(type="action", action="stay", number=1)
            only.until("end")
        yield hosted


@pytest.fixture(autouse=True)
def refilled(request):
    yield
    for name in ("playing", "lobby", "voting", "ended"):
        if name in request.fixturenames:
            request.getfixturevalue(name).refill()


# Whose page asks

FOREIGN_HOSTS = {
    "another site": ["evil.example"],
    "another site at our port": ["evil.example:{port}"],
    "ours without its port": ["127.0.0.1"],
    "ours at another port": ["127.0.0.1:1"],
    "ours as a beginning": ["127.0.0.1:{port}.evil.example"],
    "ours as a user": ["127.0.0.1:{port}@evil.example"],
    "localhost without a port": ["localhost"],
    "localhost of a domain": ["localhost.evil.example:{port}"],
    "a final dot": ["localhost.:{port}"],
    "another name of this machine": ["127.1:{port}"],
    "a number": ["2130706433:{port}"],
    "all addresses": ["0.0.0.0:{port}"],
    "IPv6": ["[::1]:{port}"],
    "a port with a zero": ["127.0.0.1:0{port}"],
    "two, ours first": ["127.0.0.1:{port}", "evil.example"],
    "two, ours last": ["evil.example", "127.0.0.1:{port}"],
    "ours twice": ["127.0.0.1:{port}", "127.0.0.1:{port}"],
    "a list": ["127.0.0.1:{port}, evil.example"],
    "an empty one": [""],
    "none": [],
}
FOREIGN_ORIGINS = {
    "another site": ["http://evil.example"],
    "null": ["null"],
    "an empty one": [""],
    "ours encrypted": ["https://127.0.0.1:{port}"],
    "ours at another port": ["http://127.0.0.1:1"],
    "ours without its port": ["http://127.0.0.1"],
    "ours as a beginning": ["http://127.0.0.1:{port}.evil.example"],
    "ours as a user": ["http://127.0.0.1:{port}@evil.example"],
    "ours with a path": ["http://127.0.0.1:{port}/"],
    "a file": ["file://"],
    "an extension": ["chrome-extension://abcdef"],
    "a socket": ["ws://127.0.0.1:{port}"],
    "two, ours first": ["http://127.0.0.1:{port}", "http://evil.example"],
    "two, ours last": ["http://evil.example", "http://127.0.0.1:{port}"],
    "a list": ["http://127.0.0.1:{port} http://evil.example"],
}
ROUTES = ("the page", "a seat", "a socket")


def asked(hosted, route, **fields):
    """The status of a request that would be answered if it came from our page."""
    if route == "a socket":
        with hosted.socket(hosted.secrets[0], **fields) as socket_:
            return socket_.status
    method = "GET" if route == "the page" else "POST"
    body = json.dumps({"token": hosted.hall.token}).encode() if route == "a seat" else b""
    path = "/" if route == "the page" else "/join"
    return hosted.status(method, path, fields.pop("headers", None), body, **fields)


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("names", FOREIGN_HOSTS.values(), ids=FOREIGN_HOSTS)
def test_a_request_to_another_host_is_refused(lobby, route, names):
    with lobby.unchanged():
        hosts = [name.format(port=lobby.port) for name in names]
        assert asked(lobby, route, hosts=hosts) in (400, 403)


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("names", FOREIGN_ORIGINS.values(), ids=FOREIGN_ORIGINS)
def test_a_request_from_a_page_of_another_site_is_refused(lobby, route, names):
    with lobby.unchanged():
        origins = [("Origin", name.format(port=lobby.port)) for name in names]
        if route == "a socket":
            pairs = [*HANDSHAKE.items(), ("Sec-WebSocket-Protocol", f"cprl, {lobby.secrets[0]}"), *origins]
            assert lobby.status("GET", "/socket", pairs) == 403
        else:
            assert asked(lobby, route, headers=origins) == 403


TRUSTED_NOWHERE = {
    "X-Forwarded-Host": "127.0.0.1:{port}",
    "X-Forwarded-For": "127.0.0.1",
    "X-Real-IP": "127.0.0.1",
    "Forwarded": "host=127.0.0.1:{port}",
    "X-Host": "127.0.0.1:{port}",
    "X-Original-URL": "/join.txt",
    "X-Rewrite-URL": "/session.json",
    "X-HTTP-Method-Override": "DELETE",
    "Range": "bytes=0-10",
    "Cookie": "seat_token=guessed",
    "Authorization": "Basic Y3BybDpjcHJs",
    "Expect": "100-continue",
    "If-None-Match": "*",
    "Accept-Encoding": "gzip",
    "TE": "trailers",
}


@pytest.mark.parametrize("name", TRUSTED_NOWHERE)
def test_other_headers_open_no_way(playing, name):
    header = {name: TRUSTED_NOWHERE[name].format(port=playing.port)}
    with playing.unchanged():
        assert playing.status(headers=header, hosts=["evil.example"]) == 403
        plain = playing.answer(playing.request())
        answer = playing.answer(playing.request(headers=header))
        assert answer.rpartition(b"\r\n\r\n")[2] == plain.rpartition(b"\r\n\r\n")[2]
        assert playing.status("POST", "/join", header, b'{"token": "guessed"}') in (403, 417)


# Ways to files

PATHS = (
    *("/session.json", "/join.txt", "/../join.txt", "/../../join.txt", "/%2e%2e/join.txt", "/..%2fjoin.txt"),
    *(
        "/%2e%2e%2fjoin.txt",
        "/..%5cjoin.txt",
        "/..\\join.txt",
        "//join.txt",
        "/./join.txt",
        "/join/../join.txt",
    ),
    *("/socket/../join.txt", "/%252e%252e/join.txt", "/..%c0%af..%c0%afjoin.txt", "/join.txt%00.html"),
    *("/round-1/turns.arrows", "/round-1/turns.csv", "/round-1/recipe.json", "/out/session.json"),
    *("/static/host.js", "/static/../hall.py", "/host.py", "/.git/config", "/.env", "/etc/passwd"),
    *(
        "/file:///etc/passwd",
        "/favicon.ico",
        "/robots.txt",
        "/admin",
        "/start",
        "/join/",
        "/socket/",
        "/JOIN",
    ),
    *("/?file=../join.txt&x=join.txt", "/join?token=x", "/{0.__class__}", "/%s%n", "/" + "a" * 7000),
)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path[:40])
def test_no_path_leads_to_a_file(playing, path):
    with playing.unchanged():
        answer = playing.answer(playing.request("GET", path))
        if path.startswith("/?"):
            assert b"<title>" in answer
        else:
            assert status_of(answer) in (400, 404, 405)
            assert b"session" not in answer.partition(b"\r\n\r\n")[2]


METHODS = [
    *(
        (method, "/")
        for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "PROPFIND", "get", "EVIL")
    ),
    *((method, "/join") for method in ("GET", "PUT", "DELETE", "OPTIONS", "HEAD")),
    *((method, "/socket") for method in ("POST", "PUT", "DELETE", "OPTIONS")),
    *(("CONNECT", "evil.example:80"), ("GET", "http://evil.example/"), ("GET", "*"), ("OPTIONS", "*")),
]


@pytest.mark.parametrize(("method", "path"), METHODS)
def test_no_other_method_is_answered(playing, method, path):
    with playing.unchanged():
        body = json.dumps({"token": playing.hall.token}).encode()
        answer = playing.answer(
            playing.request(method, path, body=body if method in ("POST", "PUT") else b"")
        )
        assert status_of(answer) in (0, 400, 403, 404, 405)


# Requests that are none

SEAT = json.dumps({"token": "guessed"}).encode()
BROKEN_REQUESTS = {
    "nothing but lines": b"\r\n\r\n\r\n\r\n",
    "noise": bytes(range(256)) * 4 + b"\r\n\r\n",
    "TLS": bytes.fromhex("160301020001000001fc0303") + bytes(500),
    "no version": b"GET /\r\n\r\n",
    "version 0.9": b"GET / HTTP/0.9\r\nHost: {host}\r\n\r\n",
    "version 2": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    "version 9": b"GET / HTTP/9.9\r\nHost: {host}\r\n\r\n",
    "a header of 200 kB": b"GET / HTTP/1.1\r\nHost: {host}\r\nX: " + b"x" * 200_000 + b"\r\n\r\n",
    "a line of 200 kB": b"GET /" + b"x" * 200_000 + b" HTTP/1.1\r\nHost: {host}\r\n\r\n",
    "a name of a header of 100 kB": b"GET / HTTP/1.1\r\n" + b"x" * 100_000 + b": 1\r\nHost: {host}\r\n\r\n",
    "a space before a colon": b"GET / HTTP/1.1\r\nHost : {host}\r\n\r\n",
    "a header without a name": b"GET / HTTP/1.1\r\nHost: {host}\r\n: x\r\n\r\n",
    "a zero byte in a header": b"GET / HTTP/1.1\r\nHost: {host}\r\nX: a\0b\r\n\r\n",
    "a zero byte in the path": b"GET /\0 HTTP/1.1\r\nHost: {host}\r\n\r\n",
    "a newline in a host": b"GET / HTTP/1.1\r\nHost: {host}\n.evil.example\r\n\r\n",
    "two lengths": b"POST /join HTTP/1.1\r\nHost: {host}\r\nContent-Length: 20\r\nContent-Length: 3\r\n\r\n"
    + SEAT,
    "a length and chunks": b"POST /join HTTP/1.1\r\nHost: {host}\r\nContent-Length: 4\r\n"
    b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\nGET / HTTP/1.1\r\nHost: {host}\r\n\r\n",
    "a negative length": b"POST /join HTTP/1.1\r\nHost: {host}\r\nContent-Length: -1\r\n\r\n" + SEAT,
    "a length that is no number": b"POST /join HTTP/1.1\r\nHost: {host}\r\nContent-Length: 0x14\r\n\r\n"
    + SEAT,
    "a length with a sign": b"POST /join HTTP/1.1\r\nHost: {host}\r\nContent-Length: +20\r\n\r\n" + SEAT,
    "chunks that are none": b"POST /join HTTP/1.1\r\nHost: {host}\r\nTransfer-Encoding: chunked\r\n\r\n"
    b"zz\r\n\r\n",
    "a chunk too large": b"POST /join HTTP/1.1\r\nHost: {host}\r\nTransfer-Encoding: chunked\r\n\r\n"
    + b"F" * 17
    + b"\r\n",
    "chunks by another name": b"POST /join HTTP/1.1\r\nHost: {host}\r\nTransfer-Encoding: xchunked\r\n\r\n"
    b"0\r\n\r\n",
    "a folded header": b"GET / HTTP/1.1\r\nHost: evil.example\r\n {host}\r\n\r\n",
    "a body of 5,000 bytes": b"POST /join HTTP/1.1\r\nHost: {host}\r\nContent-Length: 5000\r\n\r\n"
    + b" " * 5000,
    "a body of a gigabyte": b"POST /join HTTP/1.1\r\nHost: {host}\r\nContent-Length: 1073741824\r\n\r\n"
    + b" " * 9000,
    "another body behind it": b"POST /join HTTP/1.1\r\nHost: {host}\r\nContent-Length: 2\r\n\r\n{}"
    b"POST /join HTTP/1.1\r\nHost: {host}\r\nContent-Length: 2\r\n\r\n{}",
}


@pytest.mark.parametrize("data", BROKEN_REQUESTS.values(), ids=BROKEN_REQUESTS)
def test_broken_requests_are_refused_and_their_connection_is_closed(playing, data):
    with playing.unchanged():
        answer = playing.answer(data.replace(b"{host}", playing.name.encode()), ends=True)
        assert status_of(answer) in (0, 400, 403, 404, 408, 413, 417, 501, 505)
        assert answer.count(b"HTTP/1.1 ") <= 1
        assert b"Traceback" not in answer
        assert playing.status() == 200


def test_a_connection_answers_one_request_though_others_are_behind_it(playing):
    with playing.unchanged():
        answer = playing.answer(playing.request() * 20)
        assert answer.count(b"HTTP/1.1 200") == 1


@pytest.mark.integration
def test_half_requests_are_closed(playing, patch):
    with pytest.MonkeyPatch.context() as quick:
        quick.setattr(serving, "REQUEST_SECONDS", 0.3)
        with playing.unchanged():
            halves = [
                *(b"", b"G", b"GET / HTTP/1.1\r\n", b"GET / HTTP/1.1\r\nHost: "),
                playing.request()[:-2],
                playing.request("POST", "/join", {"Content-Length": "100"}) + b"{",
                playing.request("POST", "/join", {"Transfer-Encoding": "chunked"}) + b"1\r\n",
            ]
            connections = [playing.open(half) for half in halves * 3]
            for connection in connections:
                with connection:
                    received = connection.recv(65536)
                    assert status_of(received) in (0, 408)
                    assert not received or not connection.recv(65536)


def test_headers_forbid_other_sites_to_frame_store_or_sniff_an_answer(playing):
    for data in (
        playing.request(),
        playing.request("GET", "/nowhere"),
        playing.request("POST", "/join", body=b"{}"),
    ):
        head = playing.answer(data).partition(b"\r\n\r\n")[0].lower()
        assert b"x-content-type-options: nosniff" in head
        assert b"referrer-policy: no-referrer" in head
        assert b"cache-control: no-store" in head
        assert b"frame-ancestors 'none'" in head
        assert b"access-control-allow" not in head


# The way to a seat

WRONG_VALUES = {
    "null": "null",
    "true": "true",
    "a number": "7",
    "a negative number": "-1",
    "a broken number": "1.5",
    "a huge number": "1" + "0" * 300,
    "infinity": "1e999",
    "NaN": "NaN",
    "an empty text": '""',
    "a long text": '"' + "x" * 900 + '"',
    "a zero byte": '"\\u0000"',
    "half a character": '"\\ud800"',
    "a list": "[]",
    "a list of lists": "[[[[]]]]",
    "a table": "{}",
    "a target": '{"_target_": "os.system", "command": "true"}',
}
BROKEN_BODIES = {
    "nothing": b"",
    "no JSON": b"{",
    "a list": b"[]",
    "a text": b'"token"',
    "null": b"null",
    "a number": b"1",
    "NaN": b"NaN",
    "no UTF-8": b'{"token": "\xff\xfe"}',
    "UTF-16": '{"token": "x"}'.encode("utf-16"),
    "a mark of bytes": b'\xef\xbb\xbf{"token": "x"}',
    "1,000 lists": b"[" * 1000,
    "4,000 lists": b"[" * 4000,
    "no token": b"{}",
    "another field": b'{"token": "x", "group": 1}',
    "a seat": b'{"token": "x", "seat": 0}',
    "a prototype": b'{"token": "x", "__proto__": {"token": "y"}}',
    "a class": b'{"token": "x", "__class__": "Join"}',
    "a target": b'{"token": "x", "_target_": "os.system"}',
    "a form": b"token=x&seat_token=y",
    "two objects": b'{"token": "x"}{"token": "y"}',
    "1,100 bytes": b'{"token": "' + b"x" * 1100 + b'"}',
}


@pytest.mark.parametrize("body", BROKEN_BODIES.values(), ids=BROKEN_BODIES)
def test_a_body_that_is_no_wish_to_join_is_refused(lobby, body):
    with lobby.unchanged():
        answer = lobby.answer(lobby.request("POST", "/join", {"Content-Length": str(len(body))}, body))
        assert status_of(answer) == 400


@pytest.mark.parametrize("field", ["token", "seat_token"])
@pytest.mark.parametrize("value", WRONG_VALUES.values(), ids=WRONG_VALUES)
def test_a_wrong_value_gets_no_seat(playing, field, value):
    fields = {"token": json.dumps(playing.hall.token), field: value}
    body = ("{" + ", ".join(f'"{name}": {text}' for name, text in fields.items()) + "}").encode()
    with playing.unchanged():
        assert playing.status("POST", "/join", body=body) in (400, 403, 409)


def test_a_token_that_is_nearly_right_or_its_digest_gets_no_seat(lobby):
    token = lobby.hall.token
    seat = lobby.hall.seats[0].secret
    near = (
        token[:-1],
        token + "A",
        token.swapcase(),
        f" {token}",
        f"{token}\n",
        f"{token}\0",
        digest(token),
        seat,
    )
    with lobby.unchanged():
        for wrong in (*near, lobby.secrets[0], "*", "%", "' OR '1'='1", "{0.token}", "../join.txt"):
            assert lobby.status("POST", "/join", body=json.dumps({"token": wrong}).encode()) == 403, wrong


def test_the_digest_of_a_secret_which_is_in_the_file_is_no_secret(playing):
    with playing.unchanged():
        for seat in playing.hall.seats:
            body = json.dumps({"token": playing.hall.token, "seat_token": seat.secret}).encode()
            assert playing.status("POST", "/join", body=body) == 409
            with playing.socket(seat.secret) as taken:
                assert taken.status == 403


def test_a_full_session_says_so_to_whoever_has_the_link_and_to_nobody_else(playing):
    with playing.unchanged():
        answers = {}
        for token in (playing.hall.token, "guessed"):
            body = json.dumps({"token": token}).encode()
            answers[token] = playing.answer(playing.request("POST", "/join", body=body))
        full = json.loads(answers[playing.hall.token].partition(b"\r\n\r\n")[2])
        assert status_of(answers[playing.hall.token]) == 409
        assert full == {"type": "error", "why": "all 4 seats are taken"}
        assert status_of(answers["guessed"]) == 403
        assert b"seats" not in answers["guessed"]


@pytest.mark.parametrize(
    ("headers", "body"),
    [
        ({"Content-Encoding": "gzip"}, gzip.compress(b'{"token": "' + b"x" * 10_000_000 + b'"}')[:4000]),
        ({"Content-Encoding": "gzip"}, gzip.compress(b" " * 3_000_000)),
        ({"Content-Encoding": "deflate"}, b"noise"),
        ({"Content-Encoding": "br"}, b"noise"),
        ({"Content-Type": "text/plain; charset=utf-7"}, b'{"token": "x"}'),
        ({"Content-Type": "text/plain; charset=nowhere"}, b'{"token": "x"}'),
        ({"Content-Type": "text/plain; charset=idna"}, b'{"token": "x"}'),
        ({"Content-Type": "text/plain; charset=rot13"}, b'{"token": "x"}'),
        ({"Content-Type": "multipart/form-data; boundary=x"}, b"--x--"),
        ({"Content-Type": "text/plain; charset=" + "x" * 500}, b'{"token": "x"}'),
    ],
    ids=lambda one: str(one)[:60] if isinstance(one, dict) else "",
)
def test_a_body_in_another_coding_takes_no_memory_and_no_seat(lobby, headers, body):
    with lobby.unchanged():
        assert lobby.status("POST", "/join", headers, body) in (400, 403, 413, 415)


def test_many_who_have_the_link_are_told_to_wait_and_who_guess_hold_up_nobody(playing):
    with playing.unchanged():
        playing.hall._join_budget = Budget(rate=0.0, most=2.0)
        statuses = [playing.status("POST", "/join", body=b'{"token": "guessed"}') for _ in range(30)]
        assert statuses == [403] * 30
        body = json.dumps({"token": playing.hall.token}).encode()
        assert [playing.status("POST", "/join", body=body) for _ in range(4)] == [409, 409, 429, 429]


# The way to a socket

WRONG_PROTOCOLS = {
    "none": "",
    "the name alone": "cprl",
    "no secret": "cprl, ",
    "a guess": "cprl, guessed",
    "a guess of its length": "cprl, AAAAAAAAAAAAAAAAAAAAAA",
    "a beginning": "cprl, {secret_but_its_end}",
    "a longer one": "cprl, {secret}A",
    "another name": "json, {secret}",
    "the other order": "{secret}, cprl",
    "the secret alone": "{secret}",
    "three": "cprl, {secret}, x",
    "two secrets": "cprl, {secret}, {secret}",
    "a semicolon": "cprl; {secret}",
    "capitals": "CPRL, {secret}",
    "quotes": 'cprl, "{secret}"',
    "the token of the link": "cprl, {token}",
    "its digest": "cprl, {digest}",
    "a code": "cprl, {code}",
    "a pattern": "cprl, *",
    "7,000 letters": "cprl, " + "x" * 7000,
    "letters of another script": "cprl, \u0430\u0431\u0432",
}


@pytest.mark.parametrize("protocols", WRONG_PROTOCOLS.values(), ids=WRONG_PROTOCOLS)
def test_no_socket_opens_without_the_secret_of_a_seat(playing, protocols):
    secret = playing.secrets[0]
    named = protocols.format(
        secret=secret,
        secret_but_its_end=secret[:-1],
        token=playing.hall.token,
        digest=digest(secret),
        code=playing.hall.seats[0].code,
    )
    with playing.unchanged(), playing.socket("", protocols=named) as opened:
        assert opened.status in (400, 403)
        assert b"101" not in opened.head.partition(b"\r\n")[0]


@pytest.mark.parametrize(
    "changed",
    [
        *({"Sec-WebSocket-Version": "9"}, {"Sec-WebSocket-Version": None}, {"Sec-WebSocket-Key": None}),
        *({"Sec-WebSocket-Key": "short"}, {"Sec-WebSocket-Key": "!" * 24}, {"Upgrade": None}),
        *({"Upgrade": "h2c"}, {"Connection": "close"}, {"Connection": None}),
    ],
    ids=str,
)
def test_a_broken_handshake_opens_no_socket(playing, changed):
    with playing.unchanged(), playing.socket(playing.secrets[0], headers=changed) as opened:
        assert opened.status in (400, 426)


@pytest.mark.parametrize("where", ["the query", "a cookie", "Authorization", "the path"])
def test_a_secret_in_another_place_opens_no_socket(playing, where):
    secret = playing.secrets[0]
    path = {"the query": f"/socket?seat_token={secret}", "the path": f"/socket/{secret}"}.get(
        where, "/socket"
    )
    headers = {
        "a cookie": {"Cookie": f"cprl={secret}"},
        "Authorization": {"Authorization": f"Bearer {secret}"},
    }
    opening = playing.socket("", protocols="", path=path, headers=headers.get(where))
    with playing.unchanged(), opening as opened:
        assert opened.status in (403, 404)


def test_compression_is_not_negotiated_and_a_secret_does_not_come_back(playing):
    asked_for = {"Sec-WebSocket-Extensions": "permessage-deflate; client_max_window_bits"}
    with playing.unchanged(), playing.socket(playing.secrets[0], headers=asked_for) as opened:
        assert opened.status == 101
        head = opened.head.lower()
        assert b"sec-websocket-extensions" not in head
        assert b"sec-websocket-protocol: cprl\r\n" in head + b"\r\n"


# Messages

FIELDS = {
    "action": {"action": '"forward"', "number": "1"},
    "vote": {"option": "1"},
    "chat": {"text": '"hello"'},
    "view": {"view": '"array"'},
}
ALLOWED = {("number", "a number"), ("option", "a number"), ("text", "a long text")}
OFF = {
    **{("action", "number", text): text for text in ("0.0", "9223372036854775808", '"1"', "1e3", "0x1")},
    **{("action", "action", text): text for text in ('"FORWARD"', '"forward "', '"fly"', "0", '["forward"]')},
    **{("action", "action", text): text for text in ('"__class__"', '"forward\\u0000"', '"{0}"', '"%s"')},
    **{("vote", "option", text): text for text in ("3", "1000000", '"1"', "1.0")},
    **{("view", "view", text): text for text in ('"board"', '"ARRAY"', '"../text"', '"window\\n"')},
    **{("chat", "text", text): text for text in ('" "', '"\\u0007"', '"a\\nb"', '"\\u202etxt"', '"\\u200b"')},
    ("chat", "text", "201 characters"): '"' + "x" * 201 + '"',
    ("chat", "text", "201 wide ones"): '"' + "\u00e9" * 201 + '"',
}
WRONG_FIELDS = [
    *(
        pytest.param(kind, field, text, id=f"{kind}.{field}: {name}")
        for kind, fields in FIELDS.items()
        for field in fields
        for name, text in WRONG_VALUES.items()
        if (field, name) not in {("number", "a number"), ("action", "null")}
    ),
    *(pytest.param(*key[:2], text, id=f"{key[0]}.{key[1]} {key[2][:20]}") for key, text in OFF.items()),
]


def refused(hosted, data, *, seat=0):
    """The error that a seat gets for the bytes of a message, and nothing else."""
    with hosted.socket(hosted.secrets[seat]) as opened:
        opened.until("stage")
        error = opened.frame(data).until("error")
    assert set(error) == {"type", "why"}
    return error["why"]


def message_of(kind, **fields):
    """The text of a message whose fields are texts of JSON."""
    return (
        "{" + ", ".join([f'"type": "{kind}"', *(f'"{name}": {text}' for name, text in fields.items())]) + "}"
    ).encode()


@pytest.mark.integration
@pytest.mark.parametrize(("kind", "field", "text"), WRONG_FIELDS)
def test_a_message_with_a_wrong_value_is_refused(playing, voting, kind, field, text):
    hosted = voting if kind == "vote" else playing
    with hosted.unchanged():
        why = refused(hosted, message_of(kind, **FIELDS[kind] | {field: text}))
        assert len(why) < 600
        assert why.isprintable()


MORE_FIELDS = {
    **{
        name: {name: "1"}
        for name in ("agent", "seat", "group", "code", "secret", "seat_token", "turn", "__proto__")
    },
    **{name: {name: '"person 2"'} for name in ("from", "as", "constructor", "_target_", "__class__", "")},
}


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["action", "chat", "view", "ready", "consent"])
@pytest.mark.parametrize("more", MORE_FIELDS.values(), ids=MORE_FIELDS)
def test_a_message_for_another_seat_or_with_other_fields_is_refused(playing, kind, more):
    with playing.unchanged():
        refused(playing, message_of(kind, **FIELDS.get(kind, {}) | more))


@pytest.mark.parametrize("kind", FIELDS)
def test_a_message_that_lacks_a_field_is_refused(playing, voting, kind):
    hosted = voting if kind == "vote" else playing
    for field in FIELDS[kind]:
        fields = {name: text for name, text in FIELDS[kind].items() if name != field}
        with hosted.unchanged():
            assert field in refused(hosted, message_of(kind, **fields))


NO_MESSAGES = {
    **{
        f"the type {text}": f'{{"type": {text}}}'.encode()
        for text in WRONG_VALUES.values()
        if len(text) < 500
    },
    **{
        f"the type {name}": json.dumps({"type": name}).encode()
        for name in (
            "join",
            "start",
            "end",
            "turn",
            "stage",
            "welcome",
            "error",
            "Action",
            "ready ",
            "_obey",
            "../x",
        )
    },
    "an empty one": b"",
    "a space": b" ",
    "no JSON": b"{type: ready}",
    "a list": b'[{"type": "ready"}]',
    "two": b'{"type": "ready"}{"type": "ready"}',
    "a comment": b'{"type": "ready"} // yes',
    "no type": b'{"action": "forward", "number": 1}',
    "500 lists": b"[" * 500,
    "500 tables": b'{"a":' * 200,
    "1,025 bytes": b" " * 1025,
    "a ready of 1,025 bytes": b'{"type": "ready"' + b" " * 1008 + b"}",
    "4,000 bytes": b"x" * 4000,
    "a pickle": b"\x80\x04\x95".decode("latin-1").encode(),
}


@pytest.mark.parametrize("data", NO_MESSAGES.values(), ids=NO_MESSAGES)
def test_what_is_no_message_is_refused(playing, data):
    with playing.unchanged():
        refused(playing, data)


TOO_EARLY = {
    "a ready before consent": (1, {"type": "ready"}),
    "an action before consent": (1, {"type": "action", "action": "forward", "number": 1}),
    "a vote before consent": (1, {"type": "vote", "option": 1}),
    "a chat before consent": (1, {"type": "chat", "text": "hello"}),
    "a view before consent": (1, {"type": "view", "view": "array"}),
    "an action in the lobby": (0, {"type": "action", "action": "forward", "number": 1}),
    "a vote in the lobby": (0, {"type": "vote", "option": 1}),
    "a chat in the lobby": (0, {"type": "chat", "text": "hello"}),
}


@pytest.mark.parametrize(("seat", "message"), TOO_EARLY.values(), ids=TOO_EARLY)
def test_what_is_too_early_is_refused(lobby, seat, message):
    with lobby.unchanged():
        refused(lobby, json.dumps(message).encode(), seat=seat)


def test_who_has_not_consented_sees_no_game(lobby):
    with lobby.unchanged(), lobby.socket(lobby.secrets[1]) as opened:
        kinds = [opened.read()["type"], opened.read()["type"]]
        assert kinds == ["welcome", "stage"]


def test_a_second_consent_changes_no_time(lobby):
    with lobby.unchanged(), lobby.socket(lobby.secrets[0]) as opened:
        opened.say(type="consent").say(type="vote", option=0)
        opened.until("error")


@pytest.mark.parametrize("kind", ["action", "chat", "vote"])
def test_what_is_too_late_is_refused(ended, kind):
    with ended.unchanged():
        refused(ended, message_of(kind, **FIELDS[kind]))


def test_there_is_no_vote_in_a_round_without_one_and_none_for_no_option(playing, voting):
    with playing.unchanged():
        assert "no vote" in refused(playing, message_of("vote", option="0"))
    with voting.unchanged():
        assert "no action" in refused(voting, message_of("action", **FIELDS["action"]))


# Frames


def closes(opened, *codes):
    return opened.closing() in codes


BROKEN_FRAMES = {
    "a reserved bit": ({"payload": b"{}", "rsv": 4}, (1002,)),
    "another reserved bit": ({"payload": b"{}", "rsv": 1}, (1002,)),
    "a kind that is none": ({"payload": b"{}", "opcode": 3}, (1002,)),
    "a control kind that is none": ({"payload": b"{}", "opcode": 11}, (1002,)),
    "a continuation of nothing": ({"payload": b"{}", "opcode": 0}, (1002,)),
    "a long ping": ({"payload": b"x" * 126, "opcode": PING}, (1002,)),
    "half a ping": ({"payload": b"x", "opcode": PING, "fin": False}, (1002,)),
    "no UTF-8": ({"payload": b"\xff\xfe"}, (1007,)),
    "5,000 bytes": ({"payload": b"x" * 5000}, (1009,)),
    "a length of 16 exabytes": ({"payload": b"x", "length": 2**64 - 1}, (1002, 1009)),
    "a length of a gigabyte": ({"payload": b"x" * 9000, "length": 2**30}, (1009,)),
    "a close without a whole code": ({"payload": b"\x03", "opcode": CLOSE}, (1002,)),
    "a close with a code that is none": ({"payload": struct.pack("!H", 999), "opcode": CLOSE}, (1002,)),
    "a close with no UTF-8": ({"payload": b"\x03\xe8\xff", "opcode": CLOSE}, (1002, 1007)),
}


@pytest.mark.parametrize(("frame", "codes"), BROKEN_FRAMES.values(), ids=BROKEN_FRAMES)
def test_a_broken_frame_closes_the_socket_and_the_seat_stays(playing, frame, codes):
    with playing.unchanged():
        with playing.socket(playing.secrets[0]) as opened:
            opened.until("stage")
            assert opened.frame(**frame).closing() in (*codes, None)
        with playing.socket(playing.secrets[0]) as again:
            assert again.until("welcome")["agent"] == 0


def test_a_frame_without_a_mask_is_held_to_the_same_rules(playing):
    with playing.unchanged(), playing.socket(playing.secrets[0]) as opened:
        opened.until("stage")
        assert (
            "unknown"
            in opened.frame(message_of("action", action='"fly"', number="1"), mask=False).until("error")[
                "why"
            ]
        )


def test_bytes_instead_of_text_are_refused(playing):
    with playing.unchanged(), playing.socket(playing.secrets[0]) as opened:
        opened.until("stage")
        assert "bytes" in opened.frame(b'{"type": "ready"}', BINARY).until("error")["why"]


def test_a_message_in_endless_pieces_is_cut_off(playing):
    with playing.unchanged(), playing.socket(playing.secrets[0]) as opened:
        opened.until("stage")
        opened.frame(b"x" * 100, TEXT, fin=False)
        for _ in range(200):
            opened.frame(b"x" * 100, 0, fin=False)
        assert opened.closing() in (1009, None)


def test_a_text_within_a_text_closes_the_socket(playing):
    with playing.unchanged(), playing.socket(playing.secrets[0]) as opened:
        opened.until("stage")
        assert opened.frame(b"{", fin=False).frame(b'{"type": "ready"}').closing() in (1002, None)


def test_pings_and_pongs_that_nobody_asked_for_do_nothing(playing):
    with playing.unchanged(), playing.socket(playing.secrets[0]) as opened:
        opened.until("stage")
        for _ in range(30):
            opened.frame(b"x" * 125, PING).frame(b"x", PONG)
        assert "no JSON" in opened.frame(b"{").until("error")["why"]


def test_a_socket_that_vanishes_in_the_middle_of_a_frame_changes_nothing(playing):
    with playing.unchanged():
        for cut in (0, 10, 200):
            opened = playing.socket(playing.secrets[0])
            opened.frame(b"x" * cut, length=500)
            opened.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            opened.connection.close()
        assert playing.status() == 200


# Duplicates, replays, floods


def test_an_action_sent_a_hundred_times_is_one_action(playing):
    before = playing.state()
    action = before["seats"][0]["action"]
    with playing.socket(playing.secrets[0]) as opened:
        opened.until("stage")
        for _ in range(35):
            opened.say(type="action", action="left", number=9)
        opened.frame(b"{").until("error")
    after = playing.state()
    assert after["worlds"] == before["worlds"], "the turn waits for the others"
    assert action == hall_module.NONE
    assert after["seats"][1:] == before["seats"][1:]
    assert after["files"] == before["files"]
    playing.forget(0)
    assert playing.state()["seats"][0]["action"] == hall_module.NONE, "who has left has chosen nothing"


def test_who_left_has_chosen_nothing_and_a_replayed_turn_is_not_played(playing):
    with playing.unchanged():
        number = playing.hall.seats[0].number
        for _ in range(4):
            playing.forget(0)
            with playing.socket(playing.secrets[0]) as opened:
                opened.until("stage")
                opened.say(type="view", view="text").say(type="action", action="forward", number=number)
                opened.say(type="view", view="array").frame(b"{").until("error")
        playing.forget(0)
        playing.in_loop(lambda: setattr(playing.hall.seats[0], "view", ""))


def test_a_second_window_of_a_seat_closes_the_first_which_is_not_heard_any_more(playing):
    with playing.unchanged(), playing.socket(playing.secrets[0]) as first:
        first.until("stage")
        with playing.socket(playing.secrets[0]) as second:
            second.until("stage")
            first.say(type="action", action="forward", number=7)
            assert first.closing() == 4001
            for _ in range(5):
                first.say(type="ready")
            second.frame(b"{").until("error")


def test_twenty_windows_of_one_seat_take_one_seat(playing):
    with playing.unchanged():
        sockets = [playing.socket(playing.secrets[0]) for _ in range(20)]
        assert [one.closing() for one in sockets[:-1]] == [4001] * 19
        sockets[-1].frame(b"{").until("error")
        for one in sockets:
            one.connection.close()


def test_a_flood_is_refused_and_then_cut_off_while_others_are_answered(playing):
    with (
        playing.unchanged(),
        playing.socket(playing.secrets[0]) as flooding,
        playing.socket(playing.secrets[1]) as other,
    ):
        flooding.until("stage")
        other.until("stage")
        for _ in range(400):
            flooding.frame(b'{"type": "vote", "option": 1}')
        assert flooding.closing() in (4008, None)
        assert "no JSON" in other.frame(b"{").until("error")["why"]


def test_a_flood_goes_on_in_a_new_window_where_it_was(playing):
    with playing.unchanged():
        playing.hall.seats[0].budget = Budget(rate=0.0, most=40.0)
        with playing.socket(playing.secrets[0]) as opened:
            opened.until("stage")
            for _ in range(30):
                opened.frame(b"{").until("error")
        for left in (11, 1):
            with playing.socket(playing.secrets[0]) as opened:
                opened.until("stage")
                errors = [opened.frame(b"{").until("error") for _ in range(left)]
                assert "too many" in errors[-1]["why"]
                assert opened.closing() == 4008


def test_who_never_reads_holds_up_nobody_and_fills_no_memory(playing):
    with playing.unchanged():
        slow = playing.socket(playing.secrets[0])
        slow.until("stage")  # the server has connected the seat; nothing is read from here on
        outbox = playing.hall.seats[0].outbox

        def fill():
            for number in range(5000):
                outbox.put("x" * 1000)
                outbox.show(f"turn {number}")
            return len(outbox._waiting), outbox._turn

        assert playing.in_loop(fill) == (64, "turn 4999")
        with playing.socket(playing.secrets[1]) as other:
            other.until("stage")
            assert "no JSON" in other.frame(b"{").until("error")["why"]
        slow.connection.close()


def test_whoever_has_the_link_takes_at_most_all_seats(tmp_path, monkeypatch):
    with hosting(tmp_path / "out", plan(people=3), monkeypatch) as hosted:
        body = json.dumps({"token": hosted.hall.token}).encode()
        statuses = [hosted.status("POST", "/join", body=body) for _ in range(8)]
        assert statuses == [200] * 3 + [409] * 5
        assert (
            len({seat.secret for seat in hosted.hall.seats})
            == len({seat.code for seat in hosted.hall.seats})
            == 3
        )


def test_many_who_join_at_once_get_different_seats(tmp_path, monkeypatch):
    with hosting(tmp_path / "out", plan(people=6), monkeypatch) as hosted:
        body = json.dumps({"token": hosted.hall.token}).encode()
        answers = []

        def join():
            answers.append(hosted.answer(hosted.request("POST", "/join", body=body)))

        threads = [threading.Thread(target=join) for _ in range(30)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        taken = [json.loads(one.partition(b"\r\n\r\n")[2]) for one in answers if status_of(one) == 200]
        assert sorted(map(status_of, answers)) == [200] * 6 + [409] * 24
        assert len({one["seat_token"] for one in taken}) == len({one["code"] for one in taken}) == 6


# Markup

MARKUP = (
    *(
        "<script>alert(1)</script>",
        "<img src=x onerror=alert(1)>",
        "</script><script>alert(1)</script>",
        "<!--",
    ),
    *(
        "&lt;b&gt;",
        "' onmouseover='x",
        '"><svg onload=alert(1)>',
        "javascript:alert(1)",
        "${alert(1)}",
        "{{7*7}}",
    ),
    *("{0.__class__.__mro__}", "%s%n%x", "=cmd|' /C calc'!A0", "../../etc/passwd", "'; DROP TABLE turns;--"),
    *("\\u003cscript\\u003e", "\N{RED APPLE} \u00fcnd", "$(reboot)", "`reboot`", "x" * 200),
)


@pytest.mark.parametrize("text", MARKUP, ids=lambda text: text[:25])
def test_markup_in_a_chat_stays_the_text_that_it_is_and_in_its_group(playing, text):
    before = playing.state()
    with (
        playing.socket(playing.secrets[0]) as writer,
        playing.socket(playing.secrets[1]) as reader,
        playing.socket(playing.secrets[2]) as stranger,
    ):
        for one in (writer, reader, stranger):
            one.until("turn")
        writer.say(type="chat", text=text)
        assert reader.until("chat") == {"type": "chat", "from": "person 0", "text": text}
        stranger.frame(b"{")
        message = stranger.read()
        while message["type"] != "error":
            assert message["type"] == "stage"
            message = stranger.read()
    after = playing.state()
    changed = {name for name in after["files"] if after["files"][name] != before["files"].get(name)}
    assert changed == {"round-1/chat.arrows"}
    assert {**after, "files": 0} == {**before, "files": 0}
    stored = [batch for batch, _ in batches_in(playing.hall.folder / "round-1" / "chat.arrows")]
    assert [row["text"] for row in stored[-1].to_pylist()] == [text]


def test_the_page_has_no_secret_and_no_word_of_a_person(playing):
    page = playing.answer(playing.request())
    assert status_of(page) == 200
    for secret in (playing.hall.token, *playing.secrets, *(seat.code for seat in playing.hall.seats)):
        assert secret.encode() not in page
    assert b"innerHTML" not in page


def test_markup_in_a_title_or_a_name_of_a_round_is_no_markup_of_the_page(tmp_path, monkeypatch):
    bold = "<b>x</b></script><script>alert(1)</script>"
    session = plan(people=1, title=bold, rounds=((bold, ()),))
    with hosting(tmp_path / "out", session, monkeypatch) as hosted:
        assert bold.encode() not in hosted.answer(hosted.request())
        with hosted.socket(hosted.join()) as opened:
            assert opened.until("welcome")["title"] == bold
            assert opened.until("round")["rule"] == bold
    assert [path.name for path in (tmp_path / "out").iterdir() if path.is_dir()] == ["round-1"]


# The folder


def test_a_second_server_on_a_session_is_refused_and_writes_nothing(playing):
    with playing.unchanged(), pytest.raises(RunLockedError):
        Hall(playing.hall.session, playing.hall.folder)


def test_files_of_a_session_name_nobody_and_keep_the_link_for_their_owner(playing):
    assert (playing.hall.folder / hall_module.LINK_FILE).stat().st_mode & 0o077 == 0
    stored = b"".join(path.read_bytes() for path in playing.hall.folder.rglob("*") if path.is_file())
    assert b"127.0.0.1" not in stored


def test_a_session_file_that_somebody_changed_is_refused(tmp_path):
    Hall(plan(people=1), tmp_path / "out").close()
    path = tmp_path / "out" / hall_module.SESSION_FILE
    written = json.loads(path.read_text())
    for changed in ({"format": 99}, {"session": {**written["session"], "people": 40}}):
        path.write_text(json.dumps(written | changed))
        with pytest.raises(ValueError, match="session"):
            Hall(plan(people=1), tmp_path / "out")
        assert json.loads(path.read_text()) == written | changed


# Heavy ones


@pytest.mark.integration
def test_three_hundred_half_requests_and_a_thousand_connections_shut_nobody_out(playing):
    with playing.unchanged():
        halves = [playing.open(b"GET / HTTP/1.1\r\nHost:") for _ in range(300)]
        began = time.monotonic()
        with playing.socket(playing.secrets[0]) as player:
            assert player.status == 101
        assert time.monotonic() - began < serving.REQUEST_SECONDS, (
            "it was not their end that let the player in"
        )
        for half in halves:
            with half:
                assert half.recv(100) in (b"", b"HTTP/1.1 408")
        strangers = []
        for _ in range(serving.MOST_CONNECTIONS + 200):
            try:
                strangers.append(playing.open(b""))
            except OSError:
                break
        for stranger in strangers:
            stranger.close()
        with playing.socket(playing.secrets[0]) as player:
            assert player.status == 101


@pytest.mark.integration
def test_a_session_that_was_attacked_ends_with_the_data_of_its_players_alone(tmp_path, monkeypatch):
    session = plan(groups=1, game=small_game(episode_steps=20), chat=True)
    with hosting(tmp_path / "out", session, monkeypatch) as hosted:
        players = [hosted.socket(hosted.join()) for _ in range(2)]
        stop = threading.Event()

        def attack():
            while not stop.is_set():
                hosted.status("POST", "/join", body=b'{"token": "guessed"}')
                hosted.answer(hosted.request("GET", "/../join.txt", hosts=["evil.example"]))
                with hosted.socket("guessed") as refused_:
                    assert refused_.status == 403

        attackers = [threading.Thread(target=attack) for _ in range(4)]
        for thread in attackers:
            thread.start()
        sent = []
        for player in players:
            while hosted.hall.stage != "playing":
                player.until("stage")
        for turn in range(1, 21):
            action = ("forward", "turn_left", "right")[turn % 3]
            for player in players:
                player.say(type="action", action=action, number=turn)
                player.frame(b"{")
            sent.append(action)
            while players[0].until("turn" if turn < 20 else "end").get("turn", 20) < turn:
                pass
        stop.set()
        for thread in attackers:
            thread.join()
    actions = small_game().actions
    table = pq.read_table(tmp_path / "out" / "round-1" / "turns.parquet").to_pylist()
    for agent in (0, 1):
        assert [actions[row["action"]] for row in table if row["agent"] == agent] == sent
