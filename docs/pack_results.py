"""Packs the committed results: the same numbers in two thirds of the bytes.

    python docs/pack_results.py docs/results/commons docs/results/exploitability

A table loses the metrics that `cprl.measuring.table.complete` computes from its totals, and the wanted return
where agents want what they are paid; each other column is written in its smallest encoding. A file of
weights is written with compression, which `torch.load` reads, and JSON without spaces.
The manifest of a run is kept up to date.
"""

import argparse
import io
import json
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from shutil import copyfileobj

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cprl.measuring.registry import METRICS, TOTALS
from cprl.measuring.table import WINDOWS, complete
from cprl.runs.files import MANIFEST_FILE, read_json, write_listed

PACKED = ("*.parquet", "*.pt", "recipe.json", "study.json")
WANTED = "wanted_return"
_COMPRESSIONS = {"brotli": 11, "zstd": 22}
_IN_ONE_PIECE = {
    "row_group_size": 2**30,
    "data_page_size": 2**26,
    "dictionary_pagesize_limit": 2**26,
    "write_statistics": False,
}
_SAME_DATE = (1980, 1, 1, 0, 0, 0)


def without_derived(table: pa.Table) -> pa.Table:
    """Return a table without what follows from its other columns, equal at the stored precision."""
    if WANTED in table.column_names and table[WANTED].equals(table["return"]):
        table = table.drop([WANTED])
    columns = {*table.column_names}
    if WINDOWS in columns or "harvest" not in columns:
        return table
    derived = [
        name
        for name, metric in METRICS.items()
        if name in columns and name not in TOTALS and columns.issuperset(metric.needs)
    ]
    smaller = table.drop(derived)
    again = complete(smaller).select(table.column_names).cast(table.schema)
    for name in derived:
        if not np.array_equal(again[name].to_numpy(), table[name].to_numpy(), equal_nan=True):
            raise ValueError(f"its totals do not give the column {name} of this table again")
    return smaller


def packed(table: pa.Table) -> bytes:
    """Return a table as a parquet file whose columns have the smallest of a few encodings each."""
    dictionaries = []
    encodings = {}
    compressions = {}
    for field in table.schema:
        column = table.select([field.name])
        sizes = {
            (encoding, compression): len(_written(column, [field.name], {field.name: encoding}, compression))
            for encoding in _encodings_for(field.type)
            for compression in _COMPRESSIONS
        }
        encoding, compressions[field.name] = min(sizes, key=sizes.__getitem__)
        if encoding == "DICTIONARY":
            dictionaries.append(field.name)
        else:
            encodings[field.name] = encoding
    return _written(table, dictionaries, encodings, compressions)


def _encodings_for(kind: pa.DataType) -> Iterator[str]:
    yield "DICTIONARY"
    yield "PLAIN"
    if pa.types.is_integer(kind) or pa.types.is_floating(kind):
        yield "BYTE_STREAM_SPLIT"
    if pa.types.is_integer(kind):
        yield "DELTA_BINARY_PACKED"


def _written(
    table: pa.Table, dictionaries: list[str], encodings: dict[str, str], compression: str | dict[str, str]
) -> bytes:
    names = table.column_names
    by_name = dict.fromkeys(names, compression) if isinstance(compression, str) else compression
    others = {name: encoding for name, encoding in encodings.items() if encoding != "DICTIONARY"}
    file = io.BytesIO()
    pq.write_table(
        table,
        file,
        compression=by_name,
        compression_level={name: _COMPRESSIONS[by_name[name]] for name in names},
        use_dictionary=[name for name in dictionaries if name not in others] or False,
        column_encoding=others or None,
        **_IN_ONE_PIECE,
    )
    return file.getvalue()


def compressed_weights(path: Path) -> bytes:
    """Return a file of `torch.save` with its tensors compressed, bit for bit the same."""
    file = io.BytesIO()
    with zipfile.ZipFile(path) as whole, zipfile.ZipFile(file, "w") as smaller:
        for name in whole.namelist():
            entry = zipfile.ZipInfo(name, _SAME_DATE)
            smaller.writestr(entry, whole.read(name), zipfile.ZIP_DEFLATED, compresslevel=9)
    return file.getvalue()


def pack(path: Path) -> bytes:
    """Return the packed content of a table, of a file of weights, or of one of JSON."""
    if path.suffix == ".pt":
        return compressed_weights(path)
    if path.suffix == ".json":
        return (json.dumps(read_json(path), separators=(",", ":")) + "\n").encode()
    return packed(without_derived(pq.read_table(path)))


def main() -> None:
    """Pack tables, weights, recipes and studies below the given folders, where that makes them smaller."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", type=Path, nargs="+")
    for folder in parser.parse_args().folders:
        for path in sorted(path for pattern in PACKED for path in folder.rglob(pattern)):
            before = path.stat().st_size
            content = pack(path)
            if len(content) >= before:
                continue
            run = path.parent if (path.parent / MANIFEST_FILE).exists() else path.parents[1]
            if (run / MANIFEST_FILE).exists():
                name = path.relative_to(run).as_posix()
                write_listed(run, name, partial(copyfileobj, io.BytesIO(content)))
            else:
                path.write_bytes(content)
            print(f"{before:>9,} -> {len(content):>9,} {path}", flush=True)


if __name__ == "__main__":
    main()
