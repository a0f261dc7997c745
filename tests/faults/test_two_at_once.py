"""Two processes at one run: one of them writes it, the other is refused by the name of the first."""

import json
import os
import socket
from dataclasses import replace

import pytest

from .driver import alive, differences, lived, tree
from .sentences import assert_refused

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("stage", ["training", "weights", "evaluation", "figures"])
def test_a_second_process_is_refused_while_the_first_lives(stage, shop, twin):
    run = shop.folder / "run"
    with alive(shop.started("run", pause=(stage, 2))) as first:
        assert first.paused()
        before = tree(run)
        second = replace(shop.resumed("run"), output=shop.folder / "second.out")
        assert_refused(lived(second), str(run), f"process {first.pid}", socket.gethostname())
        new = replace(shop.started("run"), output=shop.folder / "second.out")
        assert_refused(lived(new), str(run))
        assert_refused(lived(replace(second, argv=(*second.argv, "--take-over"))), f"process {first.pid}")
        assert tree(run) == before
        first.resume()
        ended = first.end()
    assert ended.code == 0, ended.said
    assert differences(run, twin[0]) == []


def test_of_two_that_resume_at_the_same_time_one_does(shop, halfway, twin):
    lives = [replace(shop.resumed("run"), output=shop.folder / f"{nth}.out") for nth in range(2)]
    with alive(lives[0]) as one, alive(lives[1]) as other:
        ended = sorted((one.end(), other.end()), key=lambda end: end.code or 0)
    assert ended[0].code == 0, ended[0].said
    if ended[1].code == 0:
        assert "is finished" in ended[1].out, "it came too late, when everything was done"
    else:
        assert_refused(ended[1], str(halfway), "process ")
    assert differences(halfway, twin[0]) == []


def test_the_lock_of_another_host_is_refused_unless_taken_over(shop, halfway, twin):
    lock = halfway / "run.lock"
    held = json.loads(lock.read_text())
    assert held["host"] == socket.gethostname()
    assert held["pid"] != os.getpid()
    assert held["started"]
    lock.write_text(json.dumps({**held, "host": "elsewhere", "pid": 4711}))
    before = tree(halfway)
    refused = lived(shop.resumed("run"))
    assert_refused(refused, "elsewhere", "4711", held["started"], "--take-over")
    assert tree(halfway) == before
    taken = lived(shop.resumed("run", "--take-over"))
    assert taken.code == 0, taken.said
    assert differences(halfway, twin[0]) == []


def test_the_lock_of_a_killed_process_is_no_hindrance(shop, halfway, twin):
    assert (halfway / "run.lock").exists()
    assert lived(shop.resumed("run")).code == 0
    assert not (halfway / "run.lock").exists()
    assert differences(halfway, twin[0]) == []
