"""A training is watched without being harmed: by no viewer, one that dies or stands still, a full disk."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import PIPE
from types import SimpleNamespace
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import ProxyHandler, build_opener

import numpy as np
import psutil
import pytest
import rerun as rr
import torch
from dqn_parts import dqn_learner
from live_viewers import connected, fake, listens, received, wait
from recordings import GAME, SCENE, column, frames, observing, static
from rerun.chunk import RrdReader
from watched import EXPERIMENT

import cprl
from cprl import CommonsEnv
from cprl.commands import main as cli
from cprl.commands.recipe_command import parse_command
from cprl.learners.settings import DQNSettings
from cprl.training import Schedule, train
from cprl.viewer import live as streams, page
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.live import LiveStream
from cprl.viewer.logger import RerunLogger
from cprl.viewer.page import LOCALHOST, WebViewer, check_watch, to_watch

SETTINGS = DQNSettings(buffer_size=200, learning_rate=1e-3, hidden_cells=(8,), epsilon_hold_steps=5)


class Doing:
    """Does something at a turn."""

    def __init__(self, at, what):
        self.left, self.what = at, what

    def on_step(self, batch):
        self.left -= 1
        if self.left == 0:
            self.what()


def course(run=None, *, live=None, episodes=8, others=()):
    """Weights, torch's generator and returns after a training of two replicas, watched if a run is given."""
    torch.manual_seed(1)
    agents = dqn_learner(GAME.spaces, agents=(0, 1), replicas=2, settings=SETTINGS, seed=1, engine="eager")
    env, returns = CommonsEnv(GAME, 2, seed=1), []

    class Keeping:
        def on_episode(self, episode, learning):
            returns.append((episode.world, episode.return_.tolist(), learning["agent_0/loss"]))

    callbacks = [Keeping(), *others]
    if run is None:
        train(env, {(0, 1): agents}, Schedule(episodes=episodes), callbacks=callbacks)
    else:
        with ViewerCallback(run, env, title="run", episodes=episodes, live=live) as viewer:
            train(env, {(0, 1): agents}, Schedule(episodes=episodes), callbacks=[*callbacks, viewer])
    weights = [value.tolist() for net in agents.networks().values() for value in net.state_dict().values()]
    return repr((weights, torch.get_rng_state().tolist(), returns))


@pytest.fixture(scope="module")
def unwatched():
    return course()


@pytest.mark.integration
@pytest.mark.parametrize("live", [None, "serve"])
def test_watching_changes_nothing_that_is_learned(live, tmp_path, unwatched):
    assert course(tmp_path, live=live) == unwatched
    assert column(tmp_path / "run.rrd", "social/equality", "Scalars:scalars", "episode")[0] == list(range(8))


@pytest.mark.integration
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_viewer_that_is_killed_or_stopped_half_way_changes_nothing(how, tmp_path, unwatched, capsys):
    viewers = []

    def opens():
        address = re.search(r"--connect (\S+)", capsys.readouterr().out)[1]
        viewers.append(connected(address, tmp_path))

    ends = Doing(60, lambda: viewers[0].send_signal(how))
    try:
        assert course(tmp_path, live="serve", others=[Doing(5, opens), ends]) == unwatched
    finally:
        viewers[0].kill()
        viewers[0].wait()
    episodes, _ = column(tmp_path / "run.rrd", "social/equality", "Scalars:scalars", "episode")
    assert episodes == list(range(8)), "the file has it all"


@contextmanager
def disk_of(size, folder):
    """A disk of its own, of so many kilobytes."""
    folder.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", folder]
    if subprocess.run(mounted, check=False).returncode:
        pytest.skip("no disk could be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


only_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount a disk that fills up")


@pytest.mark.integration
@only_root
@pytest.mark.parametrize(
    ("size", "message"),
    [(3000, "the Rerun file failed, the run continues"), (96, "bytes are free there, 2,000,000 are needed")],
)
def test_a_disk_that_fills_up_or_is_full_is_told_once_and_changes_nothing(size, message, tmp_path, unwatched):
    with disk_of(size, tmp_path / "disk") as disk:

        def fill():
            with suppress(OSError), (disk / "others").open("wb", buffering=0) as file:
                while file.write(bytes(1000)):
                    pass

        with pytest.warns(RuntimeWarning, match=message) as caught:
            assert course(disk, live="serve", others=[Doing(30, fill)]) == unwatched
        assert len(caught) == 1
        assert os.statvfs(disk).f_bfree == 0, "the disk really was full"
        begun = [path.stat().st_size > 50_000 for path in disk.glob("run.rrd")]
        assert begun == [True] * (size == 3000)


def test_the_name_of_a_recording_is_no_flag_of_the_viewer():
    assert to_watch(Path("-x/run.rrd"), Path("a/run.rrd"))[1:] == ["./-x/run.rrd", "a/run.rrd"]


def test_a_way_to_watch_that_is_none_is_refused_before_anything_begins(tmp_path):
    with pytest.raises(ValueError, match="live"):
        course(tmp_path, live="telepathy")


@pytest.mark.integration
def test_without_a_display_no_viewer_is_spawned_and_the_addresses_stay(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.warns(RuntimeWarning, match="viewer cannot open: there is no display"):
        course(tmp_path, live="spawn", episodes=1)
    assert "Watch live (browser): http://127.0.0.1:" in capsys.readouterr().out


@pytest.mark.integration
def test_a_society_that_rises_falls_and_recovers_is_told_as_a_story(tmp_path):
    corners, apples = [0, 400, 800, 1200, 1600], [100, 500, 150, 400, 400]
    with ViewerCallback(tmp_path, CommonsEnv(GAME, 2), title="run", episodes=1600) as viewer:
        observer = observing(viewer)
        for number in range(1600):
            for world in (0, 1):
                returned = float(np.interp(number, corners, apples))
                observer.on_episode(fake(number, world, returned=returned, tagged=world), {})
    path = tmp_path / "run.rrd"
    at, events = column(path, "log", "TextLog:text", "episode")
    told = dict(zip([text[0] for text in events], at, strict=True))
    assert told["episode 5: last apple taken in step 7"] == 5
    assert told["episode 399: new best: 474.5 apples per episode, mean of the last 50"] == 399
    episodes, states = column(path, "now", "StateChange:state", "episode")
    labels = [state[0] for state in states]
    assert labels == ["begins", "steady", "rising", "steady", "falling", "recovering"]
    assert episodes[:2] == [0, 9]
    assert 400 < episodes[4] < 800 < episodes[5] < 1200
    for episode, label in zip(episodes[1:], labels[1:], strict=True):
        assert told[f"episode {episode:,}: now {label}"] == episode
    episodes, tags = column(path, "tags/counts", "Points2D:labels", "episode")
    assert episodes == list(range(9, 1600, 10))
    tagged = ["0", "0", "0.5", "0"]
    assert tags[0][:4] == tags[-1][:4] == tagged, "agent 1 by agent 0, once an episode in one of two replicas"


@pytest.mark.integration
def test_the_file_of_a_run_that_goes_on_holds_all_up_to_its_last_flush(tmp_path):
    """As it is left by a process that is killed."""
    left = tmp_path / "left.rrd"
    course(tmp_path, others=[Doing(150, lambda: shutil.copy(tmp_path / "run.rrd", left))])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rr.error_utils.RerunWarning)  # such a file has no footer
        steps, _ = column(left, "world/board", "SegmentationImage:buffer")
    assert len(steps) >= 19, "the frames of the first episode were sent when it ended"
    assert steps == sorted(steps)
    assert left.stat().st_size < (tmp_path / "run.rrd").stat().st_size


@pytest.fixture
def short(monkeypatch):
    """Deadlines of a third of a second."""
    for name in ("STALL_S", "CLOSE_S"):
        monkeypatch.setattr(streams, name, 0.3)


class Recording:
    """Takes nothing, or each call at once."""

    def __init__(self, *, answers=True):
        self.calls, self.answers = [], answers

    def disconnect(self):
        self.calls.append("disconnect")

    def take(self, number):
        if not self.answers:
            threading.Event().wait()
        self.calls.append(number)


def test_calls_are_made_in_their_order_and_all_before_the_end():
    stream, count = LiveStream("live view", Recording(), period_s=1), 3 * streams.QUEUED_CALLS
    for number in range(count):
        stream.call(lambda recording, number=number: recording.take(number))
    stream.close()
    assert stream.recording.calls == [*range(count), "disconnect"]


@pytest.mark.parametrize(
    ("calls", "why"), [(streams.QUEUED_CALLS + 5, "the queue is full"), (1, "has not taken the last data")]
)
def test_a_viewer_that_takes_no_data_is_given_up_with_one_warning(calls, why, short):
    started, stream = time.monotonic(), LiveStream("live view", Recording(answers=False), period_s=1)

    with warnings.catch_warnings(record=True, action="always") as caught:
        for number in range(calls):
            stream.call(lambda recording, number=number: recording.take(number))
        stream.close()
    (warning,) = caught
    assert re.search(f"live view failed, the run continues.*{why}", str(warning.message))
    assert not stream.is_open
    assert time.monotonic() - started < 2


SERVES = """
import sys, time
from pathlib import Path
import numpy as np
import rerun as rr
from cprl.viewer.logger import RerunLogger
logger = RerunLogger("run", Path(sys.argv[1]), live="serve")
print(logger.addresses["native"].split()[-1], flush=True)
sys.stdin.readline()
slowest, random = 0.0, np.random.default_rng(0)
for step in range(700):  # 700 MB: more than the server and its connections hold
    logger.set_time(step=step, episode=step)
    started = time.monotonic()
    logger.log_row("m", rr.Tensor(random.random((500, 500), np.float32)))
    slowest = max(slowest, time.monotonic() - started)
started = time.monotonic()
if sys.argv[2] == "closes": logger.close()
print(slowest, time.monotonic() - started, flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("end", ["closes", "leaves"])
def test_a_served_recording_does_not_wait_for_a_viewer_that_stands_still(end, tmp_path):
    """Rerun's own receiver connects as a viewer does, and is stopped."""
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", SERVES, tmp_path, end], stdin=pipe, stdout=pipe, stderr=pipe, text=True
    ) as process:
        lines = iter(process.stdout.readline, "")
        address = next(line for line in lines if line.startswith("rerun+http")).strip()
        viewer = connected(address, tmp_path)
        try:
            time.sleep(1)
            os.kill(viewer.pid, signal.SIGSTOP)
            process.stdin.write("\n")
            process.stdin.flush()
            slowest, closing = map(float, next(lines).split())
            started = time.monotonic()
            _, errors = process.communicate(timeout=60)
            assert slowest < streams.STALL_S + 1
            assert closing < streams.CLOSE_S + 1
            assert time.monotonic() - started < streams.CLOSE_S + streams.STALL_S + 1
            assert process.returncode == 0
            if end == "closes":
                assert errors.count("live view failed, the run continues without it") == 1
        finally:
            process.kill()
            viewer.kill()
            viewer.wait()


SCRIPT = """
import sys
import cprl
from watched import EXPERIMENT
cprl.run(EXPERIMENT, sys.argv[1], watch="serve", linger=True)
print("it ends", flush=True)
"""


@pytest.fixture
def lingering(tmp_path):
    """A run that is finished and stays served, its process and the port of its page."""
    run = tmp_path / "run"
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", SCRIPT, run], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        heard = []
        for line in process.stdout:
            heard.append(line)
            if line.startswith("The recording stays served at "):
                break
        assert heard, process.stderr.read()
        yield run, process, heard
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_finished_run_stays_served_until_it_is_asked_to_end(lingering, number):
    run, process, heard = lingering
    assert heard[-1].endswith(" until Ctrl-C\n")
    assert json.loads((run / "report.json").read_text())["episodes"] == 3, "it is finished already"
    assert not (run / "run.lock").exists()
    RrdReader(run / "run.rrd").store()  # the file is whole
    native = next(line for line in heard if "(native)" in line)
    for port in (re.search(r"http://127.0.0.1:(\d+)/", heard[-1])[1], re.search(r":(\d+)/proxy", native)[1]):
        socket.create_connection(("127.0.0.1", int(port)), timeout=5).close()
    process.send_signal(number)
    process.send_signal(number)  # as by a hand in a hurry, or a shell that passes it on
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out == "it ends\n", "cprl.run returns"
    assert "Traceback" not in errors


def test_lingering_is_refused_where_nothing_is_served_or_no_signals_come_before_anything_is_written(tmp_path):
    for watch in ("off", "file"):
        with pytest.raises(ValueError, match="linger is True"):
            cprl.run(EXPERIMENT, tmp_path / "run", watch=watch, linger=True)
    with pytest.raises(ValueError, match="linger is True in another thread"), ThreadPoolExecutor() as others:
        others.submit(check_watch, "serve", linger=True).result()
    check_watch("serve", linger=True)
    assert not (tmp_path / "run").exists()


def test_linger_is_a_flag_of_every_recipe():
    for words in (["--watch", "serve", "--linger"], []):
        _, options = parse_command(lambda: EXPERIMENT, ["recipe.py", *words])
        assert options.linger == bool(words)


def ports_of(process):
    """The (address, port) at which a process and its children listen."""
    every = [process, *process.children(recursive=True)]
    connections = [each for one in every for each in one.net_connections()]
    return {tuple(each.laddr) for each in connections if each.status == psutil.CONN_LISTEN}


@pytest.mark.integration
def test_a_page_with_a_short_address_is_on_this_machine_alone_until_it_is_closed(monkeypatch):
    monkeypatch.setattr("urllib.request._opener", None)  # it knows the proxies of before
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    urlopen = build_opener(ProxyHandler({})).open
    before = ports_of(psutil.Process())
    page, source = WebViewer("rerun+http://127.0.0.1:9/proxy"), "rerun%2Bhttp%3A%2F%2F127.0.0.1%3A9%2Fproxy"
    try:
        wait(lambda: len(ports_of(psutil.Process()) - before) == 3)  # the page's, Rerun's own, and its data
        answer = urlopen(page.addresses["browser"])
        assert b"re_viewer_bg.wasm" in answer.read()
        assert f"url={source}&" in answer.url
        assert len(page.addresses["browser"]) <= len("http://127.0.0.1:65535/")
        assert "connect-src 'self' http://127.0.0.1:*" in answer.headers["Content-Security-Policy"]
        with pytest.raises(HTTPError, match="404"):
            urlopen(page.addresses["browser"] + "nothing")
        opened = ports_of(psutil.Process()) - before
        assert {address for address, _ in opened} == {LOCALHOST}
    finally:
        page.close()
    wait(lambda: ports_of(psutil.Process()) == before)
    page.close()


def asked(port, line, host):
    """The first line of the answer to a request; "" for none."""
    with socket.create_connection((LOCALHOST, port), timeout=10) as connection:
        connection.sendall(b"%b\r\nHost: %b\r\n\r\n" % (line, host.encode()))
        return connection.makefile("rb").readline().decode().strip()


@pytest.mark.integration
def test_a_page_answers_this_machine_alone_and_odd_requests_with_an_error(capfd):
    served = WebViewer("rerun+http://127.0.0.1:9/proxy")
    try:
        for host, code in (
            (f"127.0.0.1:{served.port}", 302),
            (f"localhost:{served.port}", 302),
            ("evil.example", 403),
            (f"evil.example:{served.port}", 403),
            ("127.0.0.1", 403),
            ("", 403),
        ):
            assert f" {code} " in asked(served.port, b"GET / HTTP/1.1", host), host
        ours = f"127.0.0.1:{served.port}"
        for path in (b"/a\x01b", b"*", b"[", "/ü".encode(), b"http://evil.example/", b"/\x7f"):
            assert " 400 " in asked(served.port, b"GET %b HTTP/1.1" % path, ours), path
        wait(lambda: " 200 " in asked(served.port, b"GET /re_viewer_bg.wasm HTTP/1.1", ours))
        with socket.create_connection((LOCALHOST, served.port), timeout=10) as leaves:
            leaves.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # a reset
            leaves.sendall(f"GET /re_viewer_bg.wasm HTTP/1.1\r\nHost: {ours}\r\n\r\n".encode())
        wait(lambda: not [thread for thread in threading.enumerate() if "request" in thread.name])
    finally:
        served.close()
    assert capfd.readouterr() == ("", "")


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_who_opens_the_page_late_reads_that_history_loads_until_it_has(tmp_path, monkeypatch):
    monkeypatch.setattr(streams, "LOADING_S", 5.0)
    get = build_opener(ProxyHandler({})).open
    with RerunLogger("run", tmp_path, curves=SCENE, live="serve") as logger:
        logger.log_frames(frames(3)[0])
        logger.log_header("#### Finished")
        logger.flush()
        live = logger.live.stream

        def opens():
            with suppress(HTTPError):  # until Rerun's own server is up
                return bool(get(logger.addresses["browser"]).read())

        wait(opens)
        wait(lambda: not live.is_behind)
        assert not live._loading_browsers, "a recording that has just begun has no history"
        live._has_history_from = 0.0
        assert opens()
        wait(lambda: live._loading_browsers)
        client = connected(logger.addresses["native"].split()[2], tmp_path)
        wait(lambda: not live._loading_browsers)
        logger.log_static("last", rr.TextLog("last"))

        def has_last():
            with suppress(RuntimeError, ValueError):  # it is being written
                return static(tmp_path / "got.rrd", "last", "TextLog:text")

        try:
            wait(has_last)
        finally:
            client.terminate()
            client.wait()
    read = []
    for chunk in RrdReader(tmp_path / "got.rrd").stream():
        batch = chunk.to_record_batch()
        if "SegmentationImage:buffer" in batch.schema.names and chunk.entity_path == "/world/board":
            read.append("board")
        if "TextDocument:text" in batch.schema.names:
            read += batch["TextDocument:text"].to_pylist()[0]
    assert read[-3:] == ["#### History loads · Finished", "board", "#### Finished"]


def test_a_process_that_is_killed_leaves_no_page():
    script = "from cprl.viewer.page import WebViewer; print(WebViewer().port, flush=True); input()"
    process = subprocess.Popen([sys.executable, "-c", script], stdin=PIPE, stdout=PIPE, text=True)
    port = int(process.stdout.readline())
    wait(lambda: listens(port))
    process.kill()
    process.communicate()
    wait(lambda: not listens(port))


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
@pytest.mark.parametrize("serve", [True, False])
def test_without_a_display_or_on_request_a_run_is_served_until_it_is_interrupted(
    serve, tmp_path, monkeypatch, capsys
):
    with RerunLogger("run", tmp_path, curves=SCENE) as logger:
        logger.log_frames(frames(3)[0])
        for episode, text in enumerate(("# Episode 1", "# Finished")):
            logger.set_time(step=episode, episode=episode)
            logger.log_header(text)
    (tmp_path / "film.rrd").write_bytes(b"half a recording")
    monkeypatch.setattr(page, "has_display", lambda: serve)
    got, said = tmp_path / "got", []

    def interrupted(seconds):
        said.append(capsys.readouterr().out)
        got.mkdir()
        address = re.search(r"--connect (\S+)", said[0])[1]
        wait(lambda: listens(urlsplit(address).port))
        client = connected(address, got)
        try:
            wait(lambda: received(got, "world/board", "SegmentationImage:buffer")[0])
        finally:
            client.terminate()
            client.wait()
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "time", SimpleNamespace(sleep=interrupted))
    cli.watch(tmp_path, serve=serve)
    assert said[0].endswith("served on 127.0.0.1 until Ctrl-C\n")
    assert ("There is no display" in said[0]) != serve
    assert static(got / "got.rrd", "header", "TextDocument:text") == ["# Finished"], "before the history"
    assert column(got / "got.rrd", "world/board", "SegmentationImage:buffer")[0] == [1, 2, 3]
    served, whole = (RrdReader(path) for path in (got / "got.rrd", tmp_path / "run.rrd"))
    ids = [[store.recording_id for store in reader.recordings()] for reader in (served, whole)]
    assert ids[0] == ids[1], "header and history are of one recording"
    layouts = [
        {chunk.entity_path for chunk in reader.stream(store=reader.blueprints()[0])}
        for reader in (served, whole)
    ]
    assert layouts[0] == layouts[1], "views have names of their own"


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
@pytest.mark.parametrize("beside", [True, False])
def test_a_recording_that_is_cut_is_served_up_to_there(beside, tmp_path):
    with RerunLogger("run", tmp_path, curves=SCENE) as logger:
        logger.log_frames(frames(3)[0])
    whole, cut = (tmp_path / name for name in ("run.rrd", "run-2.rrd"))
    cut.write_bytes(whole.read_bytes()[:-2000])

    def boards():
        with suppress(RuntimeError, ValueError):  # it is being written
            reader = RrdReader(tmp_path / "got.rrd")
            chunks = [chunk for store in reader.recordings() for chunk in reader.stream(store=store)]
            return [chunk for chunk in chunks if chunk.entity_path == "/world/board" and not chunk.is_static]

    with pytest.raises(RuntimeError, match="exceeds file size"):
        RrdReader(cut).recordings()
    with streams.served([whole, cut] if beside else [cut]) as served:
        client = connected(served.addresses["native"].split()[-1], tmp_path)
        try:
            wait(boards)
        finally:
            client.terminate()
            client.wait()
    with pytest.raises(ValueError, match="no recording can be read"), streams.served([]):
        pass


def test_a_run_without_a_recording_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no recording"):
        cli.watch(tmp_path, serve=True)
