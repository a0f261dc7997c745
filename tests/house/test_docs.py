"""What the docs say is so: names are compared, code is run."""

import functools
import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from places import ROOT
from recordings import watched_training
from rerun.chunk import RrdReader

from cprl import presets
from cprl.commands import main as cli
from cprl.commons.yields import sustainable_yield
from cprl.institutions import Quota
from cprl.measuring.registry import AGENT_TOTALS, INCOME, INCOME_EQUALITY, METRICS, SOCIAL_METRICS
from cprl.measuring.table import complete
from cprl.runs.episodes import INSTITUTION_COLUMNS, read_episodes

INTERVAL = r"-?[\d.,]+ \[[^\]]*\d[^\]]*\]"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_every_logged_name_has_its_line_in_the_docs_and_the_other_way_round(tmp_path):
    watched_training(tmp_path)
    logged = set()
    for chunk in RrdReader(tmp_path / "run.rrd").stream():
        if {"step", "TextDocument:text"} & {*chunk.to_record_batch().schema.names}:
            logged.add(re.sub(r"agent_\d", "agent_<i>", chunk.entity_path.strip("/")))
    text = (ROOT / "docs" / "metrics.md").read_text()
    told = {
        name
        for line in text.splitlines()
        if line.startswith("| `")
        for name in re.findall(r"`([^`]+)`", line.split("|")[1])
    }
    elsewhere = {
        "evaluation/greedy_return",
        *("random_play/<metric>", "evaluation/<metric>", "evaluation/return"),
        *("agent_<i>/harvested", "turn/stock", "turn/rule", "windows/frames", "world/marks"),
        *("wall/boards", "wall/labels", "income", "joint_actions", "random_play/income"),
        *("decisions", "decisions/labels"),
        *(name for name in told if name.startswith(("institutions/", "governor/"))),
        *(f"agent_<i>/{name}" for name in (*AGENT_TOTALS, "paid", "given")),
        *("world/regions", "world/violators", "social/income_equality"),
    }
    because = "by BestWeights, of many episodes or agents, of replays, static, of games with institutions"
    assert logged == told - elsewhere, because


def rows_under(heading):
    """The rows of the first table under a heading of docs/metrics.md, as cells."""
    text = (ROOT / "docs" / "metrics.md").read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[1:]]


@pytest.mark.parametrize(
    ("heading", "prefix", "metrics", "others"),
    [
        (
            "Social metrics",
            "social/",
            [*(name for name in SOCIAL_METRICS if name != INCOME), INCOME_EQUALITY],
            [],
        ),
        (
            "Institutions",
            "",
            [name for name in METRICS if name.startswith(("institutions/", "governor/"))],
            ["institutions/in_force_<v>", *(f"agent_<i>/{name}" for name in AGENT_TOTALS)],
        ),
    ],
)
def test_the_docs_have_each_metric_with_its_unit(heading, prefix, metrics, others):
    rows = rows_under(f"{heading}, one value per episode")
    units = {name: row[1] for row in rows for name in re.findall(r"`([^`]+)`", row[0])}
    words = {f"{prefix}{name}": METRICS[name].unit for name in metrics}
    assert set(units) == {*words, *others}
    assert all(words[name] == units[name].replace("0..1", "0 to 1") for name in words)


def test_the_docs_have_each_column_of_games_with_institutions():
    columns = [row[0] for row in rows_under("The table of a run")]
    assert columns == [*INSTITUTION_COLUMNS, "institutions/in_force_<v>"]


def test_a_page_that_compares_the_quota_over_the_full_schedule_names_its_cap():
    game = presets.game("commons", variant="as_run")
    quota = Quota(share=0.25, window_steps=50)
    of_an_agent = int(
        quota.share * sustainable_yield(game.map, game.rules) * quota.window_steps / game.agents
    )
    windows = game.rules.episode_steps // quota.window_steps
    cap = of_an_agent * windows * game.agents
    assert cap == 480
    for name in (
        "README.md",
        "docs/governs.md",
        "docs/governs_more.md",
        "docs/studies.md",
        "docs/institutions.md",
    ):
        text = (ROOT / name).read_text()
        assert f"{cap}" in text, name


def plain(text):
    """A text without links, bold type and code."""
    return re.sub(r"\[([^][]*)\]\([^)]*\)", r"\1", text).replace("**", "").replace("`", "")


def test_sentences_that_a_referee_refuted_stand_on_no_page():
    verdicts = (ROOT / "docs" / "results" / "changed_verdicts.md").read_text()
    section = verdicts.split("\n## By a referee")[1].split("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 60
    for page, before, after, finding, rests_on in rows:
        text = plain((ROOT / page).read_text())
        assert before not in text, page
        assert after, before
        assert finding, before
        assert rests_on, before


def codes(page):
    """The blocks of Python of a page."""
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


def blocks():
    """Each block of Python, with the modules that its page has shown before: blocks that begin with the name
    of their file, `# own.py`."""
    for page in PAGES:
        modules = {}
        for number, code in enumerate(codes(page)):
            yield pytest.param(code, dict(modules), id=f"{page.name}-{number}")
            if name := re.match(r"# (\w+)\.py\n", code):
                modules[name[1]] = code


@pytest.mark.integration
@pytest.mark.parametrize(("code", "modules"), list(blocks()))
def test_python_in_the_docs_runs(code, modules, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    for name, text in modules.items():
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.delitem(sys.modules, name, raising=False)
    importlib.invalidate_caches()
    exec(compile(code, "docs", "exec"), {"__name__": "docs"})
    for name in modules:
        sys.modules.pop(name, None)


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_other_libraries_read_the_table_of_a_run_as_the_docs_say(library, tmp_path, monkeypatch, capsys):
    pytest.importorskip(library)
    (code,) = re.findall(
        rf"```py\n(import {library}\n.*?)```", (ROOT / "docs/metrics.md").read_text(), re.DOTALL
    )
    run = tmp_path / "runs" / "commons"
    run.mkdir(parents=True)
    # A run has the columns of metrics, which committed tables leave to their totals.
    pq.write_table(complete(read_episodes(ROOT / "docs/results/commons")), run / "episodes.parquet")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "docs", "exec"), {"__name__": "docs"})
    assert "0.878" in capsys.readouterr().out, "the equality of replica 0"


OF_RECIPES = ("run", "sweep", "search", "--version")
"""Commands whose options a recipe adds."""


def command_lines():
    """What a shell would run of the subcommands of `cprl`, but for those whose options a recipe adds."""
    for page in PAGES:
        for block in re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(re.split(r" [>|] ", line)[0], comments=True)
                if words and Path(words[0]).name == "cprl" and words[1] not in OF_RECIPES:
                    yield pytest.param(words[1:], id=f"{page.name}: {' '.join(words[1:])}"[:80])


@pytest.mark.parametrize("words", list(command_lines()))
def test_every_command_in_the_docs_has_these_options(words, monkeypatch, capsys):
    called = []

    def instead(command):
        return functools.wraps(command)(lambda *given, **options: called.append((given, options)))

    function_of = cli._function
    monkeypatch.setattr(cli, "_function", lambda command: instead(function_of(command)))
    monkeypatch.setattr(sys, "argv", ["cprl", *words])
    cli.main()
    assert len(called) == 1, capsys.readouterr().err


def test_links_between_pages_lead_somewhere():
    for page in [*PAGES, *map(ROOT.joinpath, ("CHANGELOG.md", "CONTRIBUTING.md", "examples/README.md"))]:
        for target, heading in re.findall(r"\]\(([^)#:]+)#?([^):]*)\)", page.read_text()):
            path = page.parent / target
            assert path.exists(), f"{page.name} links to {target}"
            if heading:
                headings = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
                assert heading in [text.lower().replace(" ", "-") for text in headings], (page.name, heading)


def test_every_interval_of_the_reproduction_stands_in_a_report_or_is_printed_by_the_page_itself(capsys):
    verdicts = (ROOT / "docs" / "results" / "changed_verdicts.md").read_text()
    counted = verdicts.split("\n## By what is counted")[1].split("\n## ")[0]
    page = "".join((ROOT / "docs" / own).read_text() for own in ("results.md", "results/details.md"))
    reports = "experiment_3", "dip", "combat"
    written = (
        "tables.md",
        "studies/perolat.md",
        "studies/perolat_lows.md",
        "studies/no_beam/summary.md",
        *(f"studies/{name}/report/tables.md" for name in reports),
    )
    tables = "".join((ROOT / "docs/results" / own).read_text() for own in written)
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(code, "docs/results.md", "exec"), {"__name__": "docs"})
    tables += capsys.readouterr().out
    told = re.findall(INTERVAL, page)
    assert len(told) > 90
    assert [one for one in (*told, *re.findall(INTERVAL, counted)) if one not in tables] == []


@pytest.mark.integration
def test_what_governs_is_made_of_the_committed_tables_and_its_pages_have_their_numbers(tmp_path):
    results = ROOT / "docs" / "results"
    command = [sys.executable, ROOT / "recipes" / "study" / "contrasts.py", "--out", tmp_path]
    subprocess.run(command, check=True, cwd=ROOT)
    for name in ("contrasts.md", "elsewhere.md"):
        assert (tmp_path / name).read_text() == (results / "governs" / name).read_text()
    anew = (
        *("changes", "tax_rate", "quota_size", "oversight", "best_response", "in_motion", "order"),
        *("shocks", "governor", "governor_kept", "governor_gamed"),
    )
    studies = (*anew, "elsewhere", "many_worlds")
    folders = [results / "governs", *(results / "studies" / study for study in studies)]
    tables = "".join(path.read_text() for folder in folders for path in sorted(folder.rglob("*.md")))
    names = ("index.md", "governs.md", "governs_more.md")
    pages = "".join((ROOT / "docs" / name).read_text() for name in names)
    intervals = re.findall(r"\[[-+\d., ]+\]", pages)
    assert len(intervals) > 40
    assert [one for one in intervals if one not in tables] == []
