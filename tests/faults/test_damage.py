"""Files that were cut or changed by a bit: refused by name, or the state before them is taken."""

import random
import re
import shutil

import pyarrow.parquet as pq
import pytest

import cprl
from cprl.runs.episodes import read_episodes
from cprl.runs.export import export_results

from .driver import alive, checkpoints, differences, lived, tree
from .sentences import assert_refused

pytestmark = pytest.mark.slow

BITS = 24
"""How many are tried in each file."""


def flipped(path, nth):
    """The file with one bit changed: the first and the last byte, and random ones between."""
    content = bytearray(path.read_bytes())
    place = {0: 0, 1: len(content) - 1}.get(nth, random.Random(nth).randrange(len(content)))
    content[place] ^= 1 << random.Random(-nth).randrange(8)
    return bytes(content)


def read_evaluation(run):
    """As a report reads it."""
    return export_results(run, run.parent / "exported")


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("checkpoints/final.pt", cprl.load),
        ("episodes.parquet", read_episodes),
        ("evaluation/random.parquet", read_evaluation),
        ("evaluation/trained.parquet", read_evaluation),
    ],
)
def test_a_bit_that_flipped_in_a_result_is_refused_by_name(name, read, tmp_path, twin):
    run = tmp_path / "run"
    shutil.copytree(twin[0], run)
    read(run)
    content = (run / name).read_bytes()
    for nth in range(BITS):
        (run / name).write_bytes(flipped(run / name, nth))
        with pytest.raises(ValueError, match=re.escape(str(run / name))):
            read(run)
        (run / name).write_bytes(content)


@pytest.mark.parametrize("nth", range(BITS))
def test_a_bit_that_flipped_in_the_journal_is_refused_or_does_no_harm(nth, shop, halfway, twin):
    journal = halfway / "episodes.arrows"
    journal.write_bytes(flipped(journal, nth))
    before = tree(halfway)
    ended = lived(shop.resumed("run"))
    if ended.code == 0:
        assert differences(halfway, twin[0]) == []
    else:
        assert_refused(ended, str(journal))
        assert tree(halfway) == before


def test_a_bit_that_flipped_in_the_newest_checkpoint_costs_the_time_since_the_one_before(shop, halfway, twin):
    older, newest = (path for _, path in checkpoints(halfway))
    newest.write_bytes(flipped(newest, 7))
    ended = lived(shop.resumed("run"))
    assert ended.code == 0, ended.said
    assert older.name in ended.out.replace("\n", "")
    assert differences(halfway, twin[0]) == []


def test_bits_that_flipped_in_all_checkpoints_are_refused_by_name(shop, halfway):
    kept = [path for _, path in checkpoints(halfway)]
    for path in kept:
        path.write_bytes(flipped(path, 7))
    before = tree(halfway)
    assert_refused(lived(shop.resumed("run")), *(path.name for path in kept))
    assert tree(halfway) == before


def test_a_journal_that_is_shorter_than_the_newest_checkpoint_says_falls_back(shop, twin):
    run, sizes = shop.folder / "run", []
    for begin in (shop.started, shop.resumed):
        with alive(begin("run", every_s=0.2, pause=("training", 1))) as process:
            assert process.paused()
            sizes.append((run / "episodes.arrows").stat().st_size)
    (older, _), (newest, _) = checkpoints(run)
    assert older < newest
    assert sizes[0] < sizes[1]
    with open(run / "episodes.arrows", "r+b") as file:
        file.truncate(sum(sizes) // 2)
    ended = lived(shop.resumed("run"))
    assert ended.code == 0, ended.said
    assert f"Resuming from step {older:,}" in ended.out
    assert differences(run, twin[0]) == []


def test_a_journal_that_is_shorter_than_every_checkpoint_says_is_refused(shop, halfway):
    journal = halfway / "episodes.arrows"
    with open(journal, "r+b") as file:
        file.truncate(10)
    before = tree(halfway)
    ended = lived(shop.resumed("run"))
    assert_refused(ended, "episodes.arrows")
    assert re.search(r"\d+ rows", ended.err)
    assert tree(halfway) == before


def test_a_table_has_no_row_twice(twin):
    table = pq.read_table(twin[0] / "episodes.parquet").select(["replica", "episode", "agent"]).to_pylist()
    assert len({tuple(row.values()) for row in table}) == len(table) == 24 * 2 * 2
