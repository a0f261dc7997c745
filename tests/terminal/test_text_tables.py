"""A table of texts and estimates is written as text, Markdown, LaTeX and CSV, with the same numbers."""

import csv

import pyarrow.parquet as pq
import pytest
from stored_runs import command

import cprl
from cprl.measuring.registry import title
from cprl.measuring.statistics import Estimate
from cprl.terminal.text_tables import WRITERS, Change, TextTable, escape_cell, markdown, write_tables

EQUALITY = Estimate(value=0.5, low=0.25, high=0.75, replicas=3, episodes=30, undefined=2)
LESS = Estimate(value=-12.5, low=-20.0, high=-5.0, replicas=2, p_value=0.01, differs=True)
SAME = Estimate(value=0.0, low=-1.0, high=1.0, replicas=3, p_value=0.9)
TABLE = TextTable(
    "Means & differences,\nin $",
    ["condition", "equality", "harvest"],
    [["vote_1|<a>*", EQUALITY, Change(LESS, "(of 2)")], ["none", "-", Change(SAME)]],
    "Bold: not 0 for 100 %.",
)


def lines(tmp_path, suffix, tables=(TABLE,), notes=()):
    return write_tables(tables, tmp_path / f"new/table{suffix}", notes=notes).read_text().splitlines()


def test_in_a_text_a_star_marks_what_differs(tmp_path):
    text = "\n".join(lines(tmp_path, ".txt", notes=["3 runs"]))
    assert "0.50 [0.25, 0.75], undefined in 2 of 30 episodes" in text
    assert "-12.5 [-20.0, -5.0] * (of 2)" in text
    assert "* not 0 for 100 %." in text
    assert "vote_1|<a>*" in text
    assert text.endswith("3 runs")


def test_in_markdown_it_is_bold_and_names_are_texts(tmp_path):
    found = lines(tmp_path, ".md", notes=["3 runs"])
    assert found[3:7] == [
        "| condition | equality | harvest |",
        "|---|---:|---:|",
        r"| vote_1\|\<a>\* | 0.50 [0.25, 0.75], undefined in 2 of 30 episodes "
        r"| **-12.5 [-20.0, -5.0]** (of 2) |",
        "| none | - | +0.00 [-1.00, +1.00] |",
    ]
    assert found[-3:] == ["Bold: not 0 for 100 %.", "", "3 runs"]


def test_for_latex_signs_are_escaped_and_a_minus_is_a_minus(tmp_path):
    found = lines(tmp_path, ".tex", notes=["3 runs"])
    assert found[0] == r"% \usepackage{booktabs}"
    assert r"\caption{Means \& differences, in \$}" in found
    assert r"\begin{tabular}{lrr}" in found
    assert r"condition & equality & harvest \\" in found
    row = next(line for line in found if line.startswith("vote"))
    assert row.startswith(r"vote\_1\textbar{}\textless{}a\textgreater{}* & 0.50 [0.25, 0.75]")
    assert row.endswith(r" & \textbf{$-$12.5 [$-$20.0, $-$5.0]} (of 2) \\")
    assert r"none & - & +0.00 [$-$1.00, +1.00] \\" in found
    assert found.count(r"\begin{table}") == found.count(r"\end{table}") == 1
    assert found[-1] == "3 runs"


def test_a_csv_has_the_bounds_of_intervals_as_columns(tmp_path):
    rows = list(csv.DictReader(lines(tmp_path, ".csv", [TABLE, TABLE._replace(heading="again")])))
    first, second, third, fourth = rows[:4]
    assert [row["table"] for row in (first, rows[4])] == ["Means & differences, in $", "again"]
    assert (first["row"], first["column"]) == ("vote_1|<a>*", "equality")
    numbers = ("value", "low", "high", "replicas", "episodes", "undefined", "p_value", "differs", "text")
    assert [first[name] for name in numbers] == ["0.5", "0.25", "0.75", "3", "30", "2", "", "", ""]
    assert [second[name] for name in numbers[:3]] == ["-12.5", "-20.0", "-5.0"]
    assert (second["p_value"], second["differs"]) == ("0.01", "True")
    assert (third["row"], third["value"], third["text"]) == ("none", "", "-")
    assert fourth["differs"] == "False"
    assert (second["episodes"], fourth["undefined"]) == ("", ""), "nobody counts those of a difference"


def test_rows_have_as_many_names_as_the_table_says(tmp_path):
    pairs = TextTable("", ["run", "agent", "return"], [["a", "0", SAME]], texts=2)
    (row,) = csv.DictReader(lines(tmp_path, ".csv", [pairs]))
    assert (row["row"], row["column"]) == ("a, 0", "return")
    assert r"\begin{tabular}{llr}" in lines(tmp_path, ".tex", [pairs])


@pytest.mark.parametrize("name", ["table.xlsx", "table", "table.parquet"])
def test_another_suffix_is_refused(name, tmp_path):
    with pytest.raises(ValueError, match="path"):
        write_tables([TABLE], tmp_path / name)


@pytest.mark.parametrize("suffix", WRITERS)
def test_nothing_is_written_over(suffix, tmp_path):
    path = write_tables([TABLE], tmp_path / f"table{suffix}")
    with pytest.raises((ValueError, OSError), match="table"):
        write_tables([TABLE], path)


def test_names_of_users_mean_nothing_in_markdown():
    names = {"a|b": r"a\|b", "pay_$1_$_": r"pay_\$1_\$_", "*a*": r"\*a\*", "<b>": r"\<b>", "a\nb": "a b"}
    assert [escape_cell(name) for name in names] == list(names.values())
    _, _, line, _ = markdown(TextTable("", ["condition", "x"], [["**a**", Change(SAME)]]))
    assert line.startswith(r"| \*\*a\*\* |")


def test_a_command_writes_what_it_prints_as_the_suffix_says(alike, tmp_path, monkeypatch, capsys):
    files = {suffix: tmp_path / f"means{suffix}" for suffix in (*WRITERS, ".parquet")}
    words = [word for path in files.values() for word in ("--out", path)]
    printed = command(monkeypatch, capsys, "evaluate", alike, "--episodes", 1, *words)
    assert all(f"Written: {path}" in printed for path in files.values())
    rows = list(csv.DictReader(files[".csv"].read_text().splitlines()))
    played = pq.read_table(files[".parquet"])
    levels = cprl.estimates(played, "collective_return", by="policy")
    by_column = {row["column"]: row for row in rows if row["row"] == title("collective_return")}
    for column, policy in {"run's agents": "trained", "random": "random"}.items():
        one = levels[policy, "collective_return"]
        assert [float(by_column[column][name]) for name in ("value", "low")] == [one.value, one.low]
        assert all(str(one) in files[suffix].read_text() for suffix in (".txt", ".md"))
    assert files[".tex"].read_text().count(r"\toprule") == 1


def test_a_command_prints_every_row_as_csv_and_then_nothing_else(alike, monkeypatch, capsys):
    text = command(monkeypatch, capsys, "evaluate", alike, "--episodes", 1, "--csv")
    rows = list(csv.DictReader(text.splitlines()))
    assert {row["policy"] for row in rows} == {"trained", "random"}
    assert len(rows) == 2 * 3 * 2, "policies, replicas and agents"
    with pytest.raises(SystemExit, match="--csv prints every row and nothing else; allowed: without --out"):
        command(monkeypatch, capsys, "evaluate", alike, "--csv", "--out", "a.md")
