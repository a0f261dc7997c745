"""Tables of episodes as files: whole, small, and never over one that is there."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cprl.runs.episodes import write_table

ROWS = 20_000


@pytest.fixture
def table():
    """A column that is smallest by each way to hold it, a text and a truth value."""
    rng = np.random.default_rng(0)
    return pa.table(
        {
            "policy": ["trained", "random"] * (ROWS // 2),
            "terminated": rng.random(ROWS) < 0.5,
            "return": rng.normal(100, 10, ROWS).astype(np.float32),
            "share": rng.random(100)[rng.integers(0, 100, ROWS)],
            "steps": rng.integers(0, 1000, ROWS, dtype=np.int32),
        }
    ).replace_schema_metadata({"kept": "too"})


def test_a_table_comes_back_value_by_value_from_a_file_smaller_than_by_any_one_way(table, tmp_path):
    path = tmp_path / "new" / "table.parquet"
    write_table(path, table)
    assert pq.read_table(path).equals(table, check_metadata=True)
    numbers = ["return", "share", "steps"]
    for how in (
        {"use_dictionary": True},
        {"use_dictionary": False},
        {"use_dictionary": ["policy", "terminated"], "use_byte_stream_split": numbers},
    ):
        pq.write_table(table, tmp_path / "other.parquet", compression="zstd", compression_level=19, **how)
        assert path.stat().st_size < (tmp_path / "other.parquet").stat().st_size


def test_a_table_without_rows_or_columns_is_written_too(table, tmp_path):
    for empty in (table.slice(0, 0), pa.table({})):
        write_table(tmp_path / "table.parquet", empty, over=True)
        assert pq.read_table(tmp_path / "table.parquet").schema.equals(empty.schema)


def test_a_file_that_is_there_is_written_over_only_where_that_is_asked_for(table, tmp_path):
    path = tmp_path / "table.parquet"
    write_table(path, table)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match=r"table\.parquet exists and is not overwritten"):
        write_table(path, table.slice(1))
    assert path.read_bytes() == before
    write_table(path, table.slice(1), over=True)
    assert len(pq.read_table(path)) == ROWS - 1
