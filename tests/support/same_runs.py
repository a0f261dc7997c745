"""Whether two runs are the same, bit for bit, and whether processes have ended."""

import json
import re
import time
from pathlib import Path

import psutil
import pyarrow.parquet as pq
import torch

from cprl.runs.episodes import read_episodes
from cprl.runs.weights import load_weights
from cprl.studies import study_table
from cprl.studies.status import Status
from cprl.studies.study import STATUS
from cprl.studies.trials import trials_of

CHECKPOINT = re.compile(r"(?:training|ending)-(\d{12})-[0-9a-f]{32}\.pt")
LEARNED = ("steps", "played", "env", "learners", "others", "tracker", "torch")
"""What two states of a training share; the rest holds times."""


def differences(run, twin):
    """What is not the same in two finished runs, bit for bit, and what is left that should not be there."""
    there, wanted = files(run), files(twin)
    lines = [f"{name} is missing" for name in sorted(wanted.keys() - there.keys())]
    lines += [f"{name} is left" for name in sorted(there.keys() - wanted.keys())]
    for name in sorted(wanted.keys() & there.keys()):
        read = reader(name)
        if read is not None and not is_same(read(there[name]), read(wanted[name])):
            lines.append(f"{name} differs")
    return lines


def assert_same_training(run, other, names=("final",)):
    """Episodes and weights are the same bit for bit."""
    tables = [read_episodes(one) for one in (run, other)]
    assert tables[0].schema.equals(tables[1].schema)
    assert is_same(*(table.to_pydict() for table in tables))  # a metric may be NaN, which Arrow calls unequal
    for name in names:
        mine, theirs = (load_weights(one / "checkpoints" / f"{name}.pt") for one in (run, other))
        assert repr(mine) == repr(theirs), name


def assert_same_study(study, runs, undisturbed):
    """The runs of a study equal those that nobody disturbed, and so does its table."""
    names = [trial.name for trial in trials_of(study)]
    assert {name: differences(runs / name, undisturbed / name) for name in names} == {
        name: [] for name in names
    }
    # Marks say under which commit a run was made, which others may change meanwhile.
    tables = [study_table(study, folder).rows.drop_columns(["marks"]) for folder in (runs, undisturbed)]
    assert repr(tables[0].to_pylist()) == repr(tables[1].to_pylist())


def log_of(out, trial):
    """What a trial of the study in a directory printed."""
    return Status(out / STATUS, trial.name).log.read_text()


def attempts_of(out, trial):
    """How often a process was started for a trial."""
    return log_of(out, trial).count("$ ")


def files(run):
    """All files but recordings, of which each process writes one; names without checksums."""
    paths = [path for path in run.rglob("*") if path.is_file() and path.suffix != ".rrd"]
    return {re.sub(r"-[0-9a-f]{32}", "", path.relative_to(run).as_posix()): path for path in paths}


def written_at(folder):
    """When all files of a folder were written."""
    return {path: path.stat().st_mtime_ns for path in Path(folder).rglob("*")}


def reader(name):
    """What of a file is compared; None where times are in it."""
    if name.endswith(".parquet"):
        return rows
    if name.endswith(".pt"):
        return state
    if name == "report.json":
        return lambda path: json.loads(path.read_text())["steps"]
    return (lambda path: path.read_bytes()) if name.endswith(".png") else None


def rows(path):
    """As bytes, because NaN is unequal to itself."""
    table = pq.read_table(path).combine_chunks()
    return {name: (str(table.schema), table[name].to_numpy().tobytes()) for name in table.column_names}


def state(path):
    """Weights, or the part of a checkpoint that holds no times."""
    stored = torch.load(path, weights_only=True)
    return {name: stored[name] for name in LEARNED} if CHECKPOINT.fullmatch(path.name) else stored


def is_same(one, other):
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and one.numpy().tobytes() == other.numpy().tobytes()
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(is_same(one[name], other[name]) for name in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(is_same, one, other))
    return bool(one == other) or (one != one and other != other)


def still_alive(processes, within_s):
    """Those that have not ended after so many seconds; a zombie has ended."""
    last, left = time.monotonic() + within_s, processes
    while True:
        left = [process for process in left if is_alive(process)]
        if not left or time.monotonic() >= last:
            return left
        time.sleep(0.01)


def is_alive(process):
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def live(function):
    """The same, as a script has it."""
    function.__module__ = "__main__"
    return function
