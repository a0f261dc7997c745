"""A journal and the files of a manifest: whatever is damaged is refused, never read as something else."""

import os

import numpy as np
import pyarrow as pa
import pytest
from test_results import an_episode

from cprl.runs.episodes import EpisodeTable, read_episodes, read_table
from cprl.runs.files import enlist, unlist, verify, write_listed
from cprl.runs.journal import Journal, read_journal

SCHEMA = pa.schema({"replica": pa.int32(), "ended": pa.bool_(), "equality": pa.float64()})


def batch(number):
    columns = [np.full(3, number), np.array([True, False, True]), np.array([0.5, -1.25, number])]
    arrays = [pa.array(column, field.type) for column, field in zip(columns, SCHEMA, strict=True)]
    return pa.record_batch(arrays, schema=SCHEMA)


@pytest.fixture
def journal(tmp_path):
    path = tmp_path / "episodes.arrows"
    written = Journal(path)
    written.begin(SCHEMA)
    for number in range(4):
        written.append(batch(number))
    written.close()
    return path


@pytest.mark.integration
def test_each_flipped_bit_is_refused_or_changes_nothing(journal):
    data, whole = journal.read_bytes(), read_journal(journal).batches
    assert whole == [batch(number) for number in range(4)]
    last = read_journal(journal).ends[-2]
    refused = 0
    for place in range(len(data)):
        for bit in (0, 6):
            flipped = bytearray(data)
            flipped[place] ^= 1 << bit
            journal.write_bytes(flipped)
            try:
                found = read_journal(journal).batches
            except ValueError:
                refused += 1
            else:
                # The head of the last message cannot be told from one that was half written.
                assert found == whole or (found == whole[:3] and place >= last), (place, bit)
    journal.write_bytes(data[:500] + b"?" + data[501:])
    with pytest.raises(ValueError, match=r"episodes\.arrows is damaged or was changed behind row 0"):
        read_journal(journal)
    assert refused > len(data) / 2


def test_a_stream_without_checksums_is_refused(tmp_path):
    path = tmp_path / "episodes.arrows"
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, SCHEMA) as stream:
        stream.write_batch(batch(0))
    with pytest.raises(ValueError, match=r"episodes\.arrows has no checksum behind row 0"):
        read_journal(path)


def test_a_finished_table_that_is_resumed_goes_on_behind_any_episode(tmp_path):
    path = tmp_path / "episodes.parquet"
    with EpisodeTable(path) as table:
        for number in range(5):
            table.add(an_episode(number))
    rows = read_episodes(tmp_path)
    with EpisodeTable(path, resumable=True) as table:
        table.load_state_dict({"rows": 4})
        for number in range(2, 5):
            table.add(an_episode(number))
    assert str(read_episodes(tmp_path).to_pylist()) == str(rows.to_pylist())
    assert read_episodes(tmp_path).schema.equals(rows.schema, check_metadata=True)
    assert not table.journal.exists()


def test_a_table_syncs_its_journal_before_a_checkpoint_counts_its_rows(tmp_path, monkeypatch):
    table = EpisodeTable(tmp_path / "episodes.parquet")
    table.add(an_episode())
    synced = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_ino))
    assert table.state_dict() == {"rows": 2}
    assert synced == [table.journal.stat().st_ino]
    table.close()


def test_a_journal_that_somebody_deleted_is_missed(tmp_path):
    table = EpisodeTable(tmp_path / "episodes.parquet")
    table.add(an_episode())
    table.journal.unlink()
    with pytest.raises(FileNotFoundError, match=r"was .*episodes\.arrows deleted\?"):
        table.close()
    table._file.close()


def test_a_flipped_bit_in_a_listed_file_is_refused_by_name(tmp_path):
    with EpisodeTable(tmp_path / "episodes.parquet") as table:
        table.add(an_episode())
    data = bytearray(table.path.read_bytes())
    data[len(data) // 2] ^= 1
    table.path.write_bytes(data)
    with pytest.raises(ValueError, match=r"episodes\.parquet is damaged or was changed: its checksum is"):
        read_episodes(tmp_path)
    unlist(tmp_path, "episodes.parquet")
    verify(table.path)  # what no manifest lists is not checked


def test_files_in_folders_of_a_run_are_listed_by_their_path(tmp_path):
    path = write_listed(tmp_path, "evaluation/random.bin", lambda file: file.write(b"one"))
    verify(path)
    path.write_bytes(b"two")
    with pytest.raises(ValueError, match=r"random\.bin is damaged or was changed"):
        verify(path)
    enlist(tmp_path, "evaluation/random.bin")
    verify(path)
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(ValueError, match=r"manifest\.json is not the manifest of a run"):
        verify(path)


def test_what_is_no_table_is_refused_by_name(tmp_path):
    (tmp_path / "a.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(ValueError, match=r"a\.parquet is not a table"):
        read_table(tmp_path / "a.parquet")
    os.mkfifo(tmp_path / "b.parquet")
    with pytest.raises(ValueError, match=r"b\.parquet is not a file"):
        read_table(tmp_path / "b.parquet")
