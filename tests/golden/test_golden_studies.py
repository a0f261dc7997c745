"""The summaries of the committed studies come out of their tables line by line."""

import re
import shutil

import pytest
from places import RESULTS

from cprl.studies import StudyTable
from cprl.studies.results import write_summary
from cprl.studies.tables.comparing import condition_table
from cprl.terminal.text_tables import markdown

STUDIES = sorted(path.parent for path in RESULTS.rglob("summary.md"))


def name_of(study):
    return study.name if study.parent.name == "studies" else f"{study.parent.name}/{study.name}"


def last_of(summary):
    """The episodes at the end of the training that a summary compares; 50 of "41 to 50"."""
    headings = (line for line in summary if line.startswith("The last ") and "; means" in line)
    [most] = {line.partition(" episodes")[0].split()[-1] for line in headings}
    return int(most)


@pytest.mark.parametrize("study", STUDIES, ids=name_of)
def test_a_summary_holds_what_its_table_gives(study):
    summary = (study / "summary.md").read_text().splitlines()
    table = StudyTable.read(study / "table.parquet", last=last_of(summary))
    for part in ("training", "evaluation", "random"):
        for kind in ("levels", "differences") if part != "random" else ("levels",):
            lines = markdown(condition_table(table, (), kind, part=part))
            assert len(lines) > 3
            assert set(lines) <= set(summary), (part, kind)


@pytest.mark.parametrize("study", STUDIES, ids=name_of)
def test_a_summary_is_what_its_table_alone_gives(study, tmp_path):
    if (study / "figures").exists():
        shutil.copytree(study / "figures", tmp_path / "figures")
    summary = (study / "summary.md").read_text()
    (again,) = re.findall("This line runs what is lacking: `(.*)`", summary) or [""]
    table = StudyTable.read(study / "table.parquet", last=last_of(summary.splitlines()))
    written = write_summary(table, tmp_path, again=again)
    assert written.read_text() == summary
