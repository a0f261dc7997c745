"""Odd values and damaged files are accepted and kept as they are, or refused as documented; nothing hangs."""

import json
import os
import shutil
import signal
from contextlib import contextmanager
from dataclasses import fields, replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings, strategies as st
from places import DATA
from valid_values import valid

import cprl
from cprl import Experiment
from cprl.runs.episodes import read_episodes, read_table
from cprl.runs.files import RunLock, read_json
from cprl.values import KINDS, custom_targets, from_config, to_config, trusting

LONGEST_S = 10.0
STORED = DATA / "stored" / "run"


def nested(depth):
    value = []
    for _ in range(depth):
        value = [value]
    return value


def within_itself():
    value = []
    value.append(value)
    return value


class Foreign:
    """Objects that no library knows."""


OBJECTS = (
    *(lambda: nested(100_000), within_itself, Foreign, lambda: Foreign, lambda: len, lambda: Ellipsis),
    *(lambda: {}, lambda: {1: 2}, set, lambda: b"\xff", lambda: range(3), lambda: iter("ab"), lambda: 1j),
    *(lambda: Decimal("NaN"), lambda: Path("a\0b"), lambda: np.float64("nan"), lambda: np.float32(0.1)),
    *(lambda: np.int64(3), lambda: np.bool_(True), lambda: np.str_("random"), lambda: np.array(3)),
    *(lambda: np.zeros((2, 3)), lambda: np.array([None, "a"], dtype=object)),
    *(lambda: torch.tensor(1), lambda: torch.zeros(2, 3), lambda: torch.zeros(3, device="meta")),
    *(lambda: torch.nn.Linear(1, 1), lambda: torch.float32, lambda: int, lambda: np.datetime64("NaT")),
)
NUMBERS = st.one_of(
    st.sampled_from((-1, 0, 1, 2, 256, 2**31 - 1, 2**31, 2**32, 2**63 - 1, 2**63, 2**64, -(10**400))),
    st.sampled_from((float("nan"), float("inf"), -0.0, 5e-324, 0.5, 1.9, 1 - 2**-53, 1.8e308, 2.0**63)),
    st.integers(-(2**70), 2**70),
    st.floats(allow_subnormal=False),
)
TEXTS = st.one_of(
    st.sampled_from(("", "\0", "\ud800", "\n", "..", "None", "1", "cuda:99", "os:getcwd", ":", "a" * 70_000)),
    st.text(st.characters(codec=None), max_size=9),
)
SCALARS = st.one_of(NUMBERS, TEXTS, st.sampled_from((None, True, False)))
VALUES = st.sampled_from(sorted({*KINDS, "Experiment"})).map(valid)
ANY = st.one_of(SCALARS, st.sampled_from(OBJECTS).map(lambda make: make()), VALUES)
ODD = st.one_of(ANY, ANY, st.lists(ANY, max_size=3), st.lists(ANY, max_size=3).map(tuple))


class Hung(BaseException):
    """It took too long."""


@contextmanager
def at_most(seconds):
    def end(*_):
        raise Hung

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def accepted(call, *, refusals=(ValueError,)):
    """What a call returns, in a tuple; an empty one where it refuses in a documented way."""
    try:
        with at_most(LONGEST_S):
            return (call(),)
    except refusals as error:
        if 0 < len(str(error)) < 2000:
            return ()
        raise AssertionError(f"refused in {len(str(error))} characters") from error
    except (Exception, Hung) as error:
        raise AssertionError(f"neither accepted nor refused: {type(error).__name__}: {error}") from error


def many(examples, drawn, holds):
    """Draws so many examples, the same in every run."""
    calm = settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    calm(given(drawn)(holds))()


@st.composite
def changes(draw):
    name = draw(st.sampled_from(sorted({*KINDS, "Experiment"} - {"Person"})))  # which has no field
    field = draw(st.sampled_from([field.name for field in fields(valid(name)) if field.init]))
    return name, field, draw(ODD)


def is_kept(value):
    """Whether a recipe holds the value and gives it back as it was."""
    is_whole = isinstance(value, Experiment)
    table = value.to_config() if is_whole else to_config(value)
    read = Experiment.from_config if is_whole else from_config
    with trusting(custom_targets(table)):
        return read(table) == value


def holds_of_a_change(change):
    name, field, odd = change
    for value in accepted(lambda: replace(valid(name), **{field: odd}), refusals=(ValueError, MemoryError)):
        assert accepted(lambda: is_kept(value), refusals=()) == (True,), "a recipe loses it"  # noqa: B023


@pytest.mark.parametrize("examples", [150, pytest.param(2000, marks=pytest.mark.integration)])
def test_an_odd_value_in_a_field_is_refused_or_kept_by_a_recipe(examples):
    many(examples, changes(), holds_of_a_change)


def lock(run):
    with RunLock(run):
        return None


READERS = {
    "recipe.json": cprl.load,
    "manifest.json": cprl.load,
    "checkpoints/final.pt": cprl.load,
    "episodes.parquet": read_episodes,
    "evaluation/trained.parquet": lambda run: read_table(run / "evaluation" / "trained.parquet"),
    "report.json": lambda run: read_json(run / "report.json"),
    "run.lock": lock,
}
"""Who reads a file of a run."""
BYTES = {
    "cut": lambda content, at, more: content[:at] + more,
    "longer": lambda content, at, more: content[:at] + b"?" + more + content[at:],
    "flipped": lambda content, at, more: content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :],
    "twice": lambda content, at, more: content + content,
    "deep": lambda content, at, more: b'{"a":' * 100_000,
    "other": lambda content, at, more: more,
}
PLACES = {
    "nothing": lambda path: None,
    "a folder": Path.mkdir,
    "a pipe": os.mkfifo,
    "a loop of links": lambda path: path.symlink_to(path.name),
}


def places_of(value):
    """Every place in a JSON value, as its container and its name in it."""
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value if isinstance(value, list) else ())
    )
    for name, entry in list(entries):
        yield value, name
        yield from places_of(entry)


@st.composite
def damages(draw):
    """A file, what becomes of it, where, and with which bytes or JSON value."""
    name = draw(st.sampled_from(sorted(READERS)))
    leaves = ["leaf"] * 9 if name.endswith((".json", ".lock")) else []
    what, at = draw(st.sampled_from([*BYTES, *PLACES, *leaves])), draw(st.integers(0, 999))
    leaf = draw(st.one_of(st.none(), NUMBERS, st.text(max_size=9), st.sampled_from(([], {}))))
    return name, what, at / 1000, leaf if what == "leaf" else draw(st.binary(max_size=40))


def damaged(run, name, what, at, more):
    """A copy of the stored run in which a file is damaged; whether its content is another one now."""
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree(STORED, run)
    (run / "run.lock").write_text('{"host": "elsewhere", "pid": 1, "started": "2026-11-01T10:00:00+00:00"}')
    path = run / name
    content = changed = path.read_bytes()
    if what in PLACES:
        path.unlink()
        PLACES[what](path)
        return True
    if what == "leaf":
        places = list(places_of(table := json.loads(content)))
        holder, key = places[int(at * len(places))]
        holder[key] = more
        changed = json.dumps(table).encode()
    else:
        changed = BYTES[what](content, int(at * len(content)), more)
    path.write_bytes(changed)
    return changed != content


def holds_of_a_damage(run, damage):
    name, is_changed = damage[0], damaged(run, *damage)
    read = accepted(lambda: READERS[name](run), refusals=(ValueError, OSError))
    has_checksum = name.endswith((".pt", ".parquet"))
    assert not (read and is_changed and has_checksum), "nobody sees the damage"


@pytest.mark.parametrize("examples", [30, pytest.param(400, marks=pytest.mark.integration)])
def test_a_damaged_file_of_a_run_is_refused_or_read_as_it_was(examples, tmp_path):
    many(examples, damages(), lambda damage: holds_of_a_damage(tmp_path / "run", damage))
