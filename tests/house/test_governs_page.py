"""The page of what governs the commons, row by row: numbers of the tables, shown in Chromium."""

import json
import re

import governs_page
import pytest
from places import RESULTS, ROOT
from viewers import browser

PAGE = RESULTS / "governs" / governs_page.PAGE
JUDGED = RESULTS / "studies" / "changes" / "judged.md"


def figures_on_the_page():
    text = PAGE.read_text(encoding="utf-8")
    [found] = re.findall(r'<script type="application/json" id="figures">(.*?)</script>', text, re.DOTALL)
    return json.loads(found)


def rows_of(title):
    """The cells of a table of judged.md by its columns, for each first cell."""
    lines = JUDGED.read_text(encoding="utf-8").split(f"\n## {title}\n")[1].split("\n## ")[0].splitlines()
    head, _, *rows = (line.strip("| ").split(" | ") for line in lines if line.startswith("|"))
    return {row[0]: dict(zip(head, row, strict=True)) for row in rows}


def test_each_row_of_the_page_has_the_numbers_of_the_judged_tables():
    figures = figures_on_the_page()
    conditions = rows_of("All conditions")
    verdicts = {}
    for title in ("Cannot be told", "As expected"):
        verdicts |= {name: (title.lower(), row) for name, row in rows_of(title).items()}
    shown = [dict(zip(figures["columns"], row, strict=False)) for row in figures["rows"]]
    assert {row["name"] for row in shown} == set(conditions)
    assert {row["name"] for row in shown if "verdict" in row} == set(verdicts)
    assert figures["expectations"] == len(verdicts)
    for row in shown:
        measured = conditions[row["name"]]
        assert row["income"] == measured["income frozen at 0.05"]
        assert row["learning"] == measured["income while learning"]
        assert row["survival"] == measured["survival, turns"]
        assert row["equality"] == measured["equality of income"]
        assert [row["ofMost"], row["ofBest"]] == [
            measured["harvest, of the most possible"],
            measured["of the best known"],
        ]
        assert row["replicas"] == int(measured["replicas"])
        if "verdict" in row:
            verdict, judged = verdicts[row["name"]]
            assert (row["verdict"], row["expected"]) == (verdict, judged["expected"])
            assert row["difference"] == judged["frozen at 0.05"].strip("*")


def test_the_page_is_one_small_file_that_asks_nobody_for_anything():
    text = PAGE.read_text(encoding="utf-8")
    assert len(text.encode()) < 20_000
    assert not re.search(r"https?:|<link|src=|import |fetch|innerHTML", text)


@pytest.mark.integration
def test_the_page_is_made_of_the_committed_tables(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert governs_page.page() == PAGE.read_text(encoding="utf-8")


@pytest.mark.docs
@pytest.mark.parametrize("width", [1280, 400])
def test_chromium_shows_every_row_with_its_dot_orders_them_and_says_a_row(width):
    figures = figures_on_the_page()
    with browser(PAGE.as_uri(), size=(width, 800)) as show:
        show.resize(width, 800)
        assert show.run("return document.documentElement.scrollWidth <= innerWidth")
        dots = "return [...document.querySelectorAll('li .dot')].filter((dot) => dot.offsetParent).length"
        shown = 3 if width > 700 else 1
        assert show.run(dots) == shown * len(figures["rows"])
        show.run("document.querySelector('button[value=survival]').click()")
        first = show.run("return document.querySelector('li .name').textContent")
        survival = {row[0]: row[figures["columns"].index("survival")] for row in figures["rows"]}
        assert survival[first].startswith("1,000")
        show.run("document.querySelector('li').click(); scrollTo(0, 600)")
        assert show.run("return document.getElementById('words').textContent").startswith(f"{first}: income")
        assert show.run("return document.getElementById('axis').getBoundingClientRect().top") < 200
