"""The server of a hosted game: who may ask, who gets a seat, and what a socket takes."""

import asyncio
import json
import subprocess
import sys
import threading
from contextlib import asynccontextmanager

import aiohttp
import pyarrow.parquet as pq
import pytest
from aiohttp import web
from hosted import hosted, session
from places import ROOT

from cprl.runs.episodes import read_episodes
from cprl.runs.journal import batches_in
from cprl.web import serving
from cprl.web.host import routes_of

PAGE = ("GET", "/")


@asynccontextmanager
async def served(hall):
    """Yield the address of a running server, and a client of it."""
    async with (
        serving.serving(routes_of(hall), ["127.0.0.1"], 0) as places,
        aiohttp.ClientSession(f"http://127.0.0.1:{places[0][1]}") as client,
    ):
        yield client


def ask(tmp_path, monkeypatch, question, plan=None):
    """Run a question, an async function of hall and client, against a server."""

    async def run(hall):
        async with served(hall) as client:
            await question(hall, client)

    with hosted(tmp_path / "out", plan or session(), monkeypatch) as hall:
        asyncio.run(run(hall))


async def joined(hall, client):
    """Take a seat and return its secret."""
    async with client.post("/join", json={"token": hall.token}) as answer:
        assert answer.status == 200
        return (await answer.json())["seat_token"]


def protocols(secret):
    return {"protocols": ("cprl", secret)}


async def until(socket, kind):
    """Return the next message of a kind."""
    while True:
        message = await asyncio.wait_for(socket.receive_json(), 10)
        if message["type"] == kind:
            return message


def test_the_page_and_every_other_answer_say_what_a_browser_may_do_with_them(tmp_path, monkeypatch):
    async def question(hall, client):
        for path in ("/", "/nothing", "/socket", "/../../etc/passwd", "/session.json"):
            async with client.get(path) as answer:
                assert answer.status == (200 if path == "/" else 403 if path == "/socket" else 404), path
                assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
                assert answer.headers["X-Content-Type-Options"] == "nosniff"
                assert answer.headers["Referrer-Policy"] == "no-referrer"
                text = await answer.text()
                assert hall.token not in text
                assert "script-src 'sha256-" in text or path != "/"

    ask(tmp_path, monkeypatch, question)


def test_requests_of_other_hosts_and_other_pages_are_refused(tmp_path, monkeypatch):
    async def question(hall, client):
        here = f"127.0.0.1:{client._base_url.port}"
        other_hosts = ("evil.example", f"{here}.evil.example", f"evil@{here}", "127.0.0.1", "")
        for headers in [{"Host": name} for name in other_hosts]:
            async with client.get("/", headers=headers) as answer:
                assert answer.status == 403, headers
        for origin in ("http://evil.example", "null", f"https://{here}", f"http://{here}.evil.example"):
            for method, path in (PAGE, ("POST", "/join"), ("GET", "/socket")):
                async with client.request(method, path, headers={"Origin": origin}) as answer:
                    assert answer.status == 403, origin
        async with client.get("/", headers={"Origin": f"http://{here}"}) as answer:
            assert answer.status == 200

    ask(tmp_path, monkeypatch, question)


def test_whoever_has_the_link_gets_a_seat_and_others_are_refused_in_words(tmp_path, monkeypatch):
    async def question(hall, client):
        for body, status in (
            ({"token": "guessed"}, 403),
            ({"token": 3}, 400),
            ({"token": hall.token, "as": "person"}, 400),
            (["token"], 400),
            ({"token": "x" * 2000}, 400),
        ):
            async with client.post("/join", json=body) as answer:
                assert answer.status == status
                assert (await answer.json())["type"] == "error"
        async with client.post("/join", data=b"\xff\xfe") as answer:
            assert answer.status == 400
        async with client.post("/join", data=b"x" * 5000) as answer:
            assert answer.status == 413
        await joined(hall, client)
        await joined(hall, client)
        async with client.post("/join", json={"token": hall.token}) as answer:
            assert answer.status == 409
            assert (await answer.json()) == {"type": "error", "why": "all 2 seats are taken"}

    ask(tmp_path, monkeypatch, question)


def test_a_socket_opens_with_the_secret_of_a_seat_alone(tmp_path, monkeypatch):
    async def question(hall, client):
        secret = await joined(hall, client)
        for words in (("cprl",), ("cprl", "guessed"), ("other", secret), (secret, "cprl"), (), ("cprl", "")):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await client.ws_connect("/socket", protocols=words)
            assert refused.value.status == 403
        async with client.ws_connect("/socket", **protocols(secret)) as socket:
            assert socket.protocol == "cprl"
            welcome = await until(socket, "welcome")
            assert (welcome["group"], welcome["agent"]) == (0, 0)
            async with client.ws_connect("/socket", **protocols(secret)) as newer:
                await until(newer, "welcome")
                while (message := await socket.receive()).type == aiohttp.WSMsgType.TEXT:
                    pass
                assert message.data == 4001

    ask(tmp_path, monkeypatch, question)


def test_bad_messages_are_answered_and_a_huge_one_closes_the_socket(tmp_path, monkeypatch):
    async def question(hall, client):
        secret = await joined(hall, client)
        async with client.ws_connect("/socket", **protocols(secret)) as socket:
            await socket.send_str("{")
            assert "no JSON" in (await until(socket, "error"))["why"]
            await socket.send_bytes(b"{}")
            assert "bytes" in (await until(socket, "error"))["why"]
            await socket.send_str("x" * 2000)
            assert "too large" in (await until(socket, "error"))["why"]
            await socket.send_str("x" * 100_000)
            while (message := await socket.receive()).type == aiohttp.WSMsgType.TEXT:
                pass
            assert message.data == 1009

    ask(tmp_path, monkeypatch, question)


async def half_a_request(port, text):
    """Send half a request, and wait until the server closes the connection."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(text)
    try:
        while await asyncio.wait_for(reader.read(1000), 10):
            pass
    except ConnectionError:
        pass
    finally:
        writer.close()


@pytest.mark.integration
def test_half_requests_are_closed_and_whole_ones_are_not_kept_open(tmp_path, monkeypatch):
    monkeypatch.setattr(serving, "REQUEST_SECONDS", 0.2)

    async def question(hall, client):
        port = client._base_url.port
        head = f"Host: 127.0.0.1:{port}\r\n".encode()
        await asyncio.gather(
            half_a_request(port, b""),
            half_a_request(port, b"GET / HTTP/1.1\r\nHost:"),
            half_a_request(port, b"POST /join HTTP/1.1\r\nContent-Length: 50\r\n" + head + b"\r\n{"),
            half_a_request(port, b"GET / HTTP/1.1\r\n" + head + b"\r\n"),
            half_a_request(port, b"GET / HTTP/1.1\r\n" + head + b"\r\nGET / HTTP/1.1\r\nHost:"),
        )

    ask(tmp_path, monkeypatch, question)


@pytest.mark.integration
def test_an_answer_that_takes_too_long_is_closed_and_a_socket_is_not(monkeypatch):
    monkeypatch.setattr(serving, "ANSWER_SECONDS", 0.2)

    async def slow(request):
        await asyncio.sleep(30)
        raise AssertionError("was not closed")

    async def socket(request):
        ws = web.WebSocketResponse()
        await ws.prepare(request)
        serving.lasts(request)
        async for message in ws:
            await ws.send_str(message.data)
        return ws

    async def run():
        routes = [web.get("/slow", slow), web.get("/socket", socket)]
        async with serving.serving(routes, ["127.0.0.1"], 0) as places:
            address = f"http://127.0.0.1:{places[0][1]}"
            async with aiohttp.ClientSession(address) as client, client.ws_connect("/socket") as ws:
                with pytest.raises(aiohttp.ClientError):
                    await client.get("/slow")
                await ws.send_str("still there")
                assert (await ws.receive()).data == "still there"

    asyncio.run(run())


class Host:
    """The command in a process of its own, which prints its link."""

    def __init__(self, out, *words):
        command = [sys.executable, "-m", "cprl", "host", *words, "--out", str(out), "--port", "0"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=out.parent)
        self.printed = []
        for line in self.process.stdout:
            self.printed.append(line)
            if line.startswith("http://"):
                self.link = line.strip()
                break
        self.rest = threading.Thread(target=lambda: self.printed.extend(self.process.stdout), daemon=True)
        self.rest.start()

    def kill(self):
        self.process.kill()
        self.process.wait()
        self.rest.join()
        self.process.stdout.close()


def remote_agent(link):
    command = [sys.executable, str(ROOT / "examples" / "remote_agent.py"), link]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@pytest.mark.integration
def test_programs_take_seats_in_a_session_that_the_command_hosts(tmp_path):
    out = tmp_path / "out"
    words = ("--people", "2", "--agents", "greedy", "--turns", "20", "--turns-a-second", "20")
    host = Host(
        out,
        "commons",
        *words,
        "--practice-turns",
        "5",
        "--rounds",
        "none",
        "quota:share=0.5,fine=1+monitoring",
    )
    try:
        agents = [remote_agent(host.link) for _ in range(2)]
        assert all("apples in the last round" in agent.communicate(timeout=120)[0] for agent in agents)
    finally:
        host.kill()
    assert "█" in "".join(host.printed)
    for number in (1, 2):
        table = pq.read_table(out / f"round-{number}" / "turns.parquet")
        assert table.num_rows == 20 * 3
        assert sum(table["given"].to_pylist()) > 20
        assert read_episodes(out / f"round-{number}").num_rows == 3


@pytest.mark.integration
def test_a_killed_server_loses_no_finished_turn_and_goes_on(tmp_path):
    out = tmp_path / "out"
    words = ("commons", "--people", "2", "--agents", "random", "--turns", "60", "--turns-a-second", "20")
    host = Host(out, *words, "--practice-turns", "0", "--pause-seconds", "2")

    async def play(link, *, seats, turns):
        """Take or retake seats, play until a turn or the end, and return the secrets and the last turn."""
        server, _, token = link.partition("/#")
        async with aiohttp.ClientSession(server) as client:
            for number in range(2):
                if number >= len(seats):
                    async with client.post("/join", json={"token": token}) as answer:
                        seats.append((await answer.json())["seat_token"])
            sockets = [await client.ws_connect("/socket", protocols=("cprl", seat)) for seat in seats]
            while True:
                message = await asyncio.wait_for(sockets[0].receive_json(), 60)
                if message["type"] == "turn":
                    for socket in sockets:
                        await socket.send_json({"type": "action", "action": "forward", "number": 1})
                if message["type"] == "end" or message.get("turn", 0) >= turns:
                    return message

    seats = []
    try:
        seen = asyncio.run(play(host.link, seats=seats, turns=20))["turn"]
    finally:
        host.kill()
    kept = [batch["turn"][0].as_py() for batch, _ in batches_in(out / "round-1" / "turns.arrows")]
    assert kept[: seen + 1][:seen] == list(range(1, seen + 1))
    codes = [seat["code"] for seat in json.loads((out / "session.json").read_text())["seats"]]
    host = Host(out, *words, "--practice-turns", "0", "--pause-seconds", "2")
    try:
        end = asyncio.run(play(host.link, seats=seats, turns=1000))
    finally:
        host.kill()
    assert len(end["rounds"]) == 1
    table = pq.read_table(out / "round-1" / "turns.parquet")
    assert table["turn"].to_pylist() == [turn for turn in range(1, 61) for _ in range(3)]
    assert [seat["code"] for seat in json.loads((out / "session.json").read_text())["seats"]] == codes
