"""The rules on README.md, institutions.md and gallery.md are conditions of the study of changes.py."""

import re
from dataclasses import replace

import changes
import pytest
from boards import module_at
from institutions_page import DRAWN, STUDY, lines
from judging import outcomes_of
from places import RECIPES, RESULTS, ROOT

from cprl.studies.study import Condition

RULES = RESULTS / "studies" / STUDY / "institutions.md"
CALLED = {
    "nothing changed": ("none", "none", "No rule"),
    "boundaries (1)": ("1 boundaries", "boundaries", "Boundaries"),
    "quota (2)": ("2 quota", "a quota that cannot be exceeded", "A quota"),
    "vote on a tax (3)": ("3 vote on a tax", "a vote on a tax", "A vote on a tax"),
    "monitored quota (4)": ("4 monitored quota", "a monitored quota", "A monitored quota"),
    "graduated sanctions (5)": ("5 graduated sanctions", "graduated sanctions", "Graduated sanctions"),
    "mediation (6)": ("6 mediation", "mediation", "Mediation"),
    "elected sanctioner (7)": ("7 elected sanctioner", "elected sanctioner", "An elected sanctioner"),
    "nested levies (8)": ("8 nested levies", "nested levies", "Nested levies"),
}
"""What docs/institutions.md, README.md and docs/gallery.md call the conditions of the study."""
CONDITIONS = {word: condition for condition, words in CALLED.items() for word in words}


def rows_in(path, heading=""):
    """The numbers of the first table below a heading, by the first cell and the column."""
    text = path.read_text().split(f"\n## {heading}\n")[1] if heading else path.read_text()
    lines = [line.strip("| ").split(" | ") for line in text.split("\n|", 1)[1].split("\n\n")[0].splitlines()]
    head, _, *rows = lines
    return {row[0].strip("*"): dict(zip(head[-len(row) + 1 :], row[1:], strict=True)) for row in rows}


def means(row):
    """The numbers of a row without their intervals."""
    return [cell.split(" [")[0] for cell in row]


def test_the_tables_of_rules_have_the_numbers_of_the_study():
    measured = rows_in(RULES)
    columns = "income frozen at 0.05", "its equality", "survival, steps", "income frozen at 0.1"
    page = rows_in(ROOT / "docs" / "institutions.md", "What they do to the tragedy")
    assert len(page) == 9
    for name, row in page.items():
        found = measured[CONDITIONS[name]]
        assert list(row.values()) == [*(found[column] for column in columns), found["income while learning"]]
    readme = rows_in(ROOT / "README.md", "Five rules")
    assert len(readme) == 6, "with that of none"
    for name, row in readme.items():
        found = measured[CONDITIONS[name]]
        assert row["income, apples"] == found[columns[0]]
        others = [found[column] for column in (*columns[1:3], "income while learning")]
        assert means([*row.values()][1:]) == means(others)


def test_the_gallery_has_the_numbers_of_the_study():
    measured = rows_in(RULES)
    text = (ROOT / "docs" / "gallery.md").read_text()
    shown = re.findall(r"<br>\*\*([^*]+)\*\*<br>(\S+ \[[^]]+\]) apples[a-z ]*<br>([\d,]+) turns", text)
    assert len(shown) == 9
    for title, income, turns in shown:
        found = measured[CONDITIONS[title]]
        assert (income, turns) == (found["income frozen at 0.05"], found["survival, steps"].split(" [")[0])


def test_every_interval_about_rules_is_in_the_tables_of_the_study():
    page = (ROOT / "docs" / "institutions.md").read_text().split("\n## Use\n")[0]
    intervals = re.findall(r"\[[-+\d., ]+\]", page)
    assert len(intervals) > 50
    made = RULES.read_text()
    assert [one for one in intervals if one not in made] == []


@pytest.mark.integration
def test_the_tables_of_rules_are_made_of_the_committed_study(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert "\n".join(lines(outcomes_of(STUDY))) == RULES.read_text()


def test_the_recipes_that_users_run_are_conditions_of_the_study():
    asked = {condition.name: condition for condition in changes.STUDY.all_conditions}
    institutions = module_at(RECIPES / "institutions.py")
    names = {"none": changes.NOTHING, **{word: name for name, word in DRAWN.items()}}
    assert set(names) == set(institutions.INSTITUTIONS)
    for word, name in names.items():
        made = institutions.experiment(institution=word)
        assert Condition(made).checksum == asked[name].checksum
        assert (made.seed, made.replicas) == (asked[name].experiment.seed, asked[name].experiment.replicas)
    tragedy = module_at(RECIPES / "tragedy.py").experiment()
    whole = institutions.experiment()
    assert replace(tragedy, name=whole.name, steps=whole.steps, replicas=whole.replicas) == whole
