"""A finished run stays served until it is asked to end, and then ends in peace."""

import json
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from rerun.chunk import RrdReader
from test_outcome import EXPERIMENT

import cprl
from cprl.commands.recipe import parse
from cprl.viewer.watching import check_linger

SCRIPT = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})
import cprl
from test_outcome import EXPERIMENT
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


@pytest.mark.parametrize("watch", ["off", "file"])
def test_lingering_without_anything_served_is_refused_before_anything_is_written(watch, tmp_path):
    with pytest.raises(ValueError, match=f'linger is True, but watch is "{re.escape(watch)}", which serves'):
        cprl.run(EXPERIMENT, tmp_path / "run", watch=watch, linger=True)
    assert not (tmp_path / "run").exists()


def test_lingering_in_a_thread_that_gets_no_signals_is_refused():
    refusals = []

    def ask():
        try:
            check_linger(True, "serve")
        except ValueError as error:
            refusals.append(str(error))

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    assert refusals == ["linger is True in another thread than the main one, which alone gets signals"]
    check_linger(True, "serve")


def test_linger_is_a_flag_of_every_recipe():
    _, options = parse(lambda: EXPERIMENT, ["recipe.py", "--watch", "serve", "--linger"])
    assert options.linger
    _, options = parse(lambda: EXPERIMENT, ["recipe.py"])
    assert not options.linger
