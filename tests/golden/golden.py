"""Today's numbers, held: a JSON file for each subject, and how new numbers are compared with it.

The files were made before the house was rebuilt, and are compared with what the code gives now: texts and
checksums must be equal, numbers to 1e-12 relative.
`GOLDEN=write python -m pytest tests/golden -m ""` writes them anew; say in the commit why a number moved.
"""

import hashlib
import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent
sys.path.insert(0, str(FOLDER.parents[1] / "examples" / "own_algorithm"))
OWN_ALGORITHMS = "c51:C51", "cql:CQL", "iql:IQL"
"""Those of the examples, which trainings and stored runs name."""
RESULTS = FOLDER.parents[1] / "docs" / "results"
_EXPERIMENT_3 = RESULTS / "studies" / "experiment_3"
WITH_THE_FAULT = {_EXPERIMENT_3 / "study.json", _EXPERIMENT_3 / "runs" / "both" / "recipe.json"}
"""A study and a run of a rule that no game has any more, kept as they were written; see
docs/results/details.md."""
TOLERANCE = 1e-12
LIKE_EVERY_MACHINE = {
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_CBWR": "COMPATIBLE",
    "ONEDNN_MAX_CPU_ISA": "SSE41",
    "MKL_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
}
IS_X86 = platform.machine() in ("x86_64", "AMD64")


def assert_held(subject, values, *, may_gain=False, tolerance=TOLERANCE):
    """Compare the cases of a subject with its file: `values` maps each case to numbers, texts, lists, tables.

    Weights are compared to 1e-4: processors of Intel and AMD round their last bits apart.

    Cases that stand in the file and are not given are not looked at, so tests may hold a part each. With
    `may_gain` tables may have more fields than in the file, as experiments have when a field is new.
    """
    path = FOLDER / f"{subject}.json"
    held = json.loads(path.read_text()) if path.exists() else {}
    values = json.loads(json.dumps(values))
    if os.environ.get("GOLDEN") == "write":
        lines = [f"{json.dumps(case)}: {json.dumps(cell)}" for case, cell in sorted((held | values).items())]
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n")
        return
    assert list(values)
    found = [
        line
        for case in values
        for line in differences(held.get(case), values[case], case, may_gain, tolerance)
    ]
    assert not found, f"{len(found)} of {subject} differ, the first ones:\n" + "\n".join(found[:20])


def differences(held, now, place, may_gain=False, tolerance=TOLERANCE):
    """How two JSON values differ, a line for each place; nothing where they agree."""
    if isinstance(held, Mapping) and isinstance(now, Mapping):
        keys = held if may_gain else dict.fromkeys([*held, *now])
        return [
            line
            for key in keys
            for line in differences(held.get(key), now.get(key), f"{place} > {key}", may_gain, tolerance)
        ]
    if isinstance(held, Sequence) and isinstance(now, Sequence) and not isinstance(held, str):
        if len(held) != len(now):
            return [f"{place}: {len(held)} entries, now {len(now)}"]
        return [
            line
            for index, pair in enumerate(zip(held, now, strict=True))
            for line in differences(*pair, f"{place}[{index}]", may_gain, tolerance)
        ]
    if is_number(held) and is_number(now):
        if math.isclose(held, now, rel_tol=tolerance) or (math.isnan(held) and math.isnan(now)):
            return []
    elif held == now and type(held) is type(now):
        return []
    return [f"{place}: {held!r}, now {now!r}"]


def in_a_process(script, *words, folder):
    """What a script of this folder writes to `found.json` in a folder, run as on every machine.

    torch and MKL take the same instructions on every x86-64 machine then, in one thread.
    """
    subprocess.run(
        [sys.executable, "-W", "ignore", FOLDER / script, *words, folder],
        env={**os.environ, **LIKE_EVERY_MACHINE},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return json.loads((folder / "found.json").read_text())


def is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)


def checksum(*arrays):
    """The first 16 digits of the SHA-256 of arrays, their types and shapes included."""
    digest = hashlib.sha256()
    for array in map(np.asarray, arrays):
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def columns(table):
    """For each column of a table of numbers: its sum, and the sum in which row k counts k times, from 1.

    Missing and undefined values are counted, and taken for 0; a column of texts is its checksum.
    """
    sums = {}
    for name in table.column_names:
        values = table.column(name).to_pylist()
        if any(isinstance(value, str) for value in values):
            sums[name] = hashlib.sha256(repr(values).encode()).hexdigest()[:16]
            continue
        numbers = np.array([math.nan if value is None else value for value in values], dtype=np.float64)
        undefined = np.isnan(numbers)
        numbers = np.where(undefined, 0.0, numbers)
        rows = np.arange(1, len(numbers) + 1)
        sums[name] = [float(numbers.sum()), float((rows * numbers).sum()), int(undefined.sum())]
    return sums
