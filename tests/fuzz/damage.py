"""What can become of a file: flipped bits, lost ends, other content, another kind of file in its place."""

import io
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from hypothesis import strategies as st

from . import hostile, runs


def _position() -> st.SearchStrategy[float]:
    return st.one_of(
        st.floats(0, 1, exclude_max=True, allow_subnormal=False),
        st.sampled_from((0.0, 0.001, 0.5, 0.99, 0.9999)),
    )


def of_bytes() -> st.SearchStrategy[tuple[Any, ...]]:
    """What can become of the bytes of any file, and of its place."""
    return st.one_of(
        st.tuples(
            st.just("flip"), st.lists(st.tuples(_position(), st.integers(0, 7)), min_size=1, max_size=3)
        ),
        st.tuples(st.just("truncate"), _position()),
        st.tuples(st.just("insert"), _position(), st.binary(min_size=1, max_size=40)),
        st.tuples(st.just("zeros"), _position(), st.integers(1, 600)),
        st.tuples(st.just("twice")),
        st.tuples(st.just("empty")),
        st.tuples(st.just("bytes"), st.binary(max_size=200)),
        st.tuples(st.just("other"), st.integers(0, 60)),
        st.tuples(
            st.sampled_from(("fifo", "directory", "loop", "dangling", "missing", "zero device", "null"))
        ),
        st.tuples(st.just("none")),
    )


def of_json() -> st.SearchStrategy[tuple[Any, ...]]:
    """Other values at some places of a JSON file, and texts that are JSON and no recipe."""
    leaf = st.one_of(
        st.none(),
        st.booleans(),
        st.sampled_from(hostile.LIMITS),
        st.floats(allow_subnormal=False),
        st.sampled_from([own for own in hostile.TEXTS if "\ud800" not in own and "\udfff" not in own]),
        st.text(max_size=10),
        st.just([]),
        st.just({}),
        st.just({"kind": "Custom", "target": "os:getcwd", "arguments": {}}),
        st.just({"kind": "Custom", "target": "os.path:join"}),
        st.recursive(st.integers(), lambda inner: st.lists(inner, max_size=2), max_leaves=5),
    )
    return st.one_of(
        st.tuples(st.just("json"), st.lists(st.tuples(st.integers(0, 400), leaf), min_size=1, max_size=3)),
        st.tuples(st.just("json drop"), st.integers(0, 400)),
        st.tuples(
            st.just("bytes"),
            st.sampled_from(
                (
                    b"[" * 100_000,
                    b'{"a":' * 100_000,
                    b'{"format": 2, "experiment": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
                    b'{"format": 2, "experiment": {}}',
                    b'{"arguments": {}}',
                    b'{"arguments": [], "recipe": 3}',
                    b'{"format": 1e400, "experiment": {"episodes": NaN}}',
                    b"null",
                    b"\xef\xbb\xbf{}",
                    b"1" * 5000,
                    b'{"format": 2, "experiment": {"episodes": ' + b"9" * 5000 + b"}}",
                )
            ),
        ),
    )


def of_weights() -> st.SearchStrategy[tuple[Any, ...]]:
    """Well-formed files of torch with other content."""
    return st.tuples(st.just("torch"), st.sampled_from(sorted(_TORCH)))


def _state(path: Path) -> Any:
    return torch.load(path, weights_only=True)


def _each_tensor(value: Any, change: Callable[[torch.Tensor], Any]) -> Any:
    if isinstance(value, torch.Tensor):
        return change(value)
    if isinstance(value, dict):
        return {name: _each_tensor(own, change) for name, own in value.items()}
    return [_each_tensor(own, change) for own in value] if isinstance(value, list) else value


def _nan(tensor: torch.Tensor) -> torch.Tensor:
    return torch.full_like(tensor, float("nan")) if tensor.is_floating_point() else tensor


_TORCH: Final[dict[str, Callable[[Any], Any]]] = {
    "same": lambda state: state,
    "nothing": lambda state: None,
    "number": lambda state: 3,
    "list": lambda state: [1, 2],
    "empty": lambda state: {},
    "tensor": lambda state: torch.zeros(3),
    "not a number": lambda state: _each_tensor(state, _nan),
    "other numbers": lambda state: _each_tensor(
        state, lambda own: own + 1 if own.dtype != torch.bool else own
    ),
    "doubles": lambda state: _each_tensor(state, lambda own: own.double()),
    "complex": lambda state: _each_tensor(state, lambda own: own.to(torch.complex64)),
    "empty tensors": lambda state: _each_tensor(state, lambda own: own[:0] if own.ndim else own),
    "no shape": lambda state: _each_tensor(state, lambda own: own.flatten()),
    "scalars": lambda state: _each_tensor(state, lambda own: 1.0),
    "meta": lambda state: _each_tensor(state, lambda own: own.to("meta")),
    "texts for keys": lambda state: dict.fromkeys(map(str, range(3)), "x"),
    "numbers for keys": lambda state: dict.fromkeys(range(3), state),
    "one less": lambda state: dict(list(state.items())[1:]) if isinstance(state, dict) else state,
    "one more": lambda state: {**state, "replica_9/agent_0": {}} if isinstance(state, dict) else state,
    "foreign lane": lambda state: {"replica_0/agent_99": {}},
    "negative lane": lambda state: {"replica_0/agent_-1": {}},
    "no lane": lambda state: {"replica_x/agent_y": {}},
    "inside out": lambda state: {"networks": state},
    "code": lambda state: Path("a"),
    "nested": lambda state: hostile.nested(200, list),
}


def of_table() -> st.SearchStrategy[tuple[Any, ...]]:
    """Well-formed tables with other content."""
    return st.tuples(st.just("table"), st.sampled_from(sorted(_TABLES)))


_TABLES: Final[dict[str, Callable[[pa.Table], pa.Table]]] = {
    "no rows": lambda table: table.slice(0, 0),
    "fewer rows": lambda table: table.slice(1),
    "rows twice": lambda table: pa.concat_tables([table, table]),
    "no columns": lambda table: table.select([]),
    "no replica": lambda table: table.drop_columns(["replica"]),
    "no return": lambda table: table.drop_columns(["return"]),
    "more columns": lambda table: table.append_column("more", pa.array(["x"] * len(table))),
    "texts": lambda table: table.set_column(0, "replica", pa.array(["x"] * len(table))),
    "nulls": lambda table: table.set_column(1, "episode", pa.nulls(len(table), pa.int32())),
    "negative": lambda table: table.set_column(1, "episode", pa.array([-5] * len(table), pa.int32())),
    "huge": lambda table: table.set_column(1, "episode", pa.array([2**31 - 1] * len(table), pa.int32())),
    "not a number": lambda table: table.set_column(
        table.column_names.index("return"), "return", pa.array([float("nan")] * len(table), pa.float32())
    ),
    "foreign": lambda table: pa.table({"a": [1, 2]}),
}


def apply(path: Path, damage: tuple[Any, ...]) -> None:
    """Damages a file."""
    how, *rest = damage
    content = path.read_bytes()
    at = int(rest[0] * len(content)) if how in ("truncate", "insert", "zeros") else 0
    if how == "flip":
        changed = bytearray(content)
        for place, bit in rest[0]:
            changed[int(place * len(content))] ^= 1 << bit
        content = bytes(changed)
    elif how in ("truncate", "insert", "zeros"):
        middle = {"truncate": b"", "insert": rest[-1], "zeros": b"\0" * rest[-1] if how == "zeros" else b""}[
            how
        ]
        tail = {"truncate": b"", "insert": content[at:], "zeros": content[at + len(middle) :]}[how]
        content = content[:at] + middle + tail
    elif how == "twice":
        content += content
    elif how == "empty":
        content = b""
    elif how == "bytes":
        content = rest[0]
    elif how == "other":
        others = sorted(own for own in runs.root().rglob("*") if own.is_file())
        content = others[rest[0] % len(others)].read_bytes()
    elif how in _PLACES:
        path.unlink()
        _PLACES[how](path)
        return
    elif how in ("json", "json drop"):
        try:
            content = _other_json(content, how, rest[0])
        except RecursionError:  # a leaf was put into itself
            content = b"[" * 100_000
    elif how == "torch":
        kept = io.BytesIO()
        value = _TORCH[rest[0]](_state(path))
        try:
            torch.save(value, kept)
        except (RecursionError, NotImplementedError):
            kept.write(pickle.dumps(3))
        content = kept.getvalue()
    elif how == "table":
        content = _other_table(path, _TABLES[rest[0]])
    path.write_bytes(content)


_PLACES: Final[dict[str, Callable[[Path], object]]] = {
    "fifo": os.mkfifo,
    "directory": Path.mkdir,
    "loop": lambda path: path.symlink_to(path.name),
    "dangling": lambda path: path.symlink_to("nowhere"),
    "missing": lambda path: None,
    "zero device": lambda path: path.symlink_to("/dev/zero"),
    "null": lambda path: path.symlink_to("/dev/null"),
}


def _other_json(content: bytes, how: str, changes: Any) -> bytes:
    value = json.loads(content)
    if how == "json drop":
        places = list(_places(value))
        holder, name = places[changes % len(places)]
        del holder[name]
    else:
        for number, leaf in changes:
            places = list(_places(value))
            if places:
                holder, name = places[number % len(places)]
                holder[name] = leaf
    return json.dumps(value).encode()


def _places(value: Any) -> Any:
    """Every place in a JSON value, as its container and its name in it."""
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for name, own in list(entries):
        yield value, name
        yield from _places(own)


def _other_table(path: Path, change: Callable[[pa.Table], pa.Table]) -> bytes:
    is_parquet = path.suffix == ".parquet"
    with pa.OSFile(str(path)) as source:
        table = pq.read_table(path) if is_parquet else pa.ipc.open_stream(source).read_all()
    kept = pa.BufferOutputStream()
    changed = change(table)
    if is_parquet:
        pq.write_table(changed, kept)
    else:
        with pa.ipc.new_stream(kept, changed.schema) as stream:
            stream.write_table(changed)
    return bytes(kept.getvalue())
