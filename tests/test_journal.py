"""A journal and the files of a manifest: half a batch is left out, damage is refused by name."""

import os

import pyarrow as pa
import pytest
from test_results import an_episode

from cprl.runs.episodes import EpisodeTable, read_episodes, read_table
from cprl.runs.files import remove_listed, rename_listed, verify, write_listed
from cprl.runs.journal import Journal, read_journal

ROWS = [
    pa.record_batch({"replica": [number] * 3, "equality": [0.5, -1.25, number / 4]}) for number in range(4)
]


@pytest.fixture
def journal(tmp_path):
    path = tmp_path / "episodes.arrows"
    written = Journal(path)
    for batch in ROWS:
        written.append(batch)
    written.close()
    return path


def test_a_journal_goes_on_behind_as_many_rows_as_a_checkpoint_has(journal):
    whole = journal.read_bytes()
    for rows, message in ((5, "holds 6 rows up to there; the checkpoint has 5"), (15, "holds 12 rows")):
        with pytest.raises(ValueError, match=message):
            Journal(journal, rows=rows)
    assert journal.read_bytes() == whole, "what cannot be gone on with is left as it is"
    resumed = Journal(journal, rows=6)
    for batch in ROWS[2:]:
        resumed.append(batch)
    resumed.close()
    assert journal.read_bytes() == whole
    Journal(journal).close()
    assert journal.read_bytes() == b""


@pytest.mark.integration
def test_damage_hides_a_batch_with_those_behind_it_or_changes_values_but_nothing_else(journal):
    data, whole = journal.read_bytes(), read_journal(journal)
    for place in range(0, len(data), 3):
        flipped = bytearray(data)
        flipped[place] ^= 64
        journal.write_bytes(flipped)
        table = read_journal(journal)
        assert table is None or table.num_rows <= whole.num_rows


def test_a_stream_that_pyarrow_writes_is_a_journal(tmp_path):
    path = tmp_path / "episodes.arrows"
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, ROWS[0].schema) as stream:
        stream.write_batch(ROWS[0], custom_metadata={"crc32": "0"})
    assert read_journal(path).to_batches() == ROWS[:1]


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


def test_a_listed_file_is_checked_by_its_path_wherever_it_is_moved_to(tmp_path):
    write_listed(tmp_path, "evaluation/random.bin", lambda file: file.write(b"one"))
    rename_listed(tmp_path, "evaluation", "evaluation-5")
    path = tmp_path / "evaluation-5" / "random.bin"
    verify(path)
    path.write_bytes(b"two")
    with pytest.raises(ValueError, match=r"random\.bin is damaged or was changed: its checksum is"):
        verify(path)
    remove_listed(tmp_path, "evaluation-5/random.bin")
    path.write_bytes(b"two")
    verify(path)  # what no manifest lists is not checked
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
