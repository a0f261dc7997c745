"""The site that `make docs` builds: what it is made of, without its tools; and built, in Chromium."""

import gzip
import json
import re
import subprocess
import sys
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from io import BytesIO
from threading import Thread

import numpy as np
import pytest
from PIL import Image
from places import ROOT
from rerun.chunk import RrdReader
from viewers import browser, wait_until
from website import navigation, pages, reference, replays
from website.build import SITE

from cprl.commands.main import COMMANDS
from cprl.commons.cells import APPLE, FIRST_AGENT

DOCS = ROOT / "docs"


def test_the_index_lists_every_page_once_says_for_whom_it_is_and_begins_with_the_first_hour():
    sections = list(navigation.sections().values())
    listed = [path for section in sections for path in section.values()]
    assert sorted(path for path in listed if "/" not in path) == sorted(
        path.name for path in DOCS.glob("*.md") if path.name != "index.md"
    )
    assert len(listed) == len(set(listed))
    assert listed[0] == "tutorial.md"
    rows = re.findall(r"^\| \[.*$", navigation.INDEX.read_text(), re.MULTILINE)
    assert all(all(cell.strip() for cell in row.strip("|").split("|")) for row in rows)


def test_every_package_is_on_a_page_of_the_reference_or_named_as_internal():
    shown = set(reference.REFERENCE) - {"cprl"}
    assert not shown & reference.INTERNAL
    assert shown | reference.INTERNAL == reference.packages_there()
    for package, names in reference._MODULES.items():
        assert all(find_spec(f"cprl.{package}.{name}") for name in names), package


def test_the_page_of_commands_has_the_help_of_each():
    text = reference.help_of("evaluate")
    assert "usage: cprl evaluate" in text
    assert "--episodes" in text
    assert "\x1b" not in text
    assert set(COMMANDS) >= {"run", "sweep"}


def test_links_lead_to_the_same_page_list_or_replay_from_every_depth(tmp_path):
    pages.stage_pages(tmp_path)
    page = (tmp_path / "institutions.md").read_text()
    assert "](repository/recipes/institutions.py.md)" in page
    assert "](results/studies/changes/institutions.md)" in page
    assert "](replays.md?replay=commons)" in (tmp_path / "watching.md").read_text()
    readme = (tmp_path / "repository" / "about.md").read_text()
    assert "](../game.md)" in readme
    recipe = (tmp_path / "repository" / "recipes" / "commons.py.md").read_text()
    assert (ROOT / "recipes" / "commons.py").read_text().rstrip() in recipe
    assert not list(tmp_path.rglob("README.md")), "MkDocs takes it for its folder's page and drops it"
    for path in tmp_path.rglob("*.md"):
        outside = re.sub(r"^```.*?^```", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
        for target in re.findall(r"\]\(([^)#\s:]+)(?:#[^)]*)?\)", outside):
            if not target.partition("?")[0].endswith(replays.PAGE):
                assert (path.parent / target).exists(), (path, target)


def test_staged_pages_have_whole_lists_and_a_link_to_nothing_is_refused_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    monkeypatch.setattr(pages, "DOCS", tmp_path)
    page = tmp_path / "a.md"
    page.write_text("Two:\n- one\n- [two](a.md)\n\n```text\nTwo:\n- [a](nowhere)\n```\n")
    pages.stage_pages(tmp_path / "staged")
    staged = (tmp_path / "staged" / "a.md").read_text()
    assert staged == "Two:\n\n- one\n- [two](a.md)\n\n```text\nTwo:\n- [a](nowhere)\n```\n"
    page.write_text("see [it](b.md)\n")
    with pytest.raises(ValueError, match=r"a\.md links to b\.md, which"):
        pages.stage_pages(tmp_path / "again")


def test_the_page_of_replays_names_every_committed_one(tmp_path):
    replays.stage_replays(tmp_path)
    text = (tmp_path / replays.PAGE).read_text()
    committed = sorted(
        path.parent.relative_to(replays.RESULTS).as_posix() for path in replays.recordings().values()
    )
    assert sorted(re.findall(r'href="\?replay=([^"]+)"', text)) == committed
    for path in re.findall(r'data-recording="([^"]+)"', text):
        assert (tmp_path / path).stat().st_size > 100_000
    thumbnails = re.findall(r'<img src="([^"]+)"', text)
    assert len(thumbnails) == len(committed)
    assert all((tmp_path / path).is_file() for path in thumbnails)


def test_the_page_of_replays_has_all_that_its_script_fills():
    script = (DOCS / "website" / "assets" / "replays.js").read_text()
    filled = set(re.findall(r'getElementById\("([^"]+)"\)', script))
    assert filled == {"replay", "replay-note", "replay-missing", "replay-wanted"}
    assert filled == set(re.findall(r'id="([^"]+)"', (DOCS / "website" / replays.PAGE).read_text()))


@pytest.fixture(scope="module")
def built():
    """The site, built anew with warnings as errors, and where it is served."""
    done = subprocess.run(
        [sys.executable, "-m", "website.build"], cwd=DOCS, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    handler = partial(SimpleHTTPRequestHandler, directory=SITE)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


@pytest.mark.docs
def test_a_page_that_links_to_nothing_fails_the_build(built, tmp_path):
    text = (ROOT / "build" / "docs" / "mkdocs.yml").read_text()
    folder = tmp_path / "pages"
    folder.mkdir()
    (folder / "index.md").write_text("# a\n\n[b](#nowhere)\n")
    text = re.sub(r"^(docs_dir|site_dir): .*$", rf"\1: {tmp_path}/\1", text, flags=re.MULTILINE)
    text = text.replace("/docs_dir", "/pages").split("\nnav:\n")[0]
    (tmp_path / "mkdocs.yml").write_text(f"{text}\nnav: [index.md]\n")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(tmp_path / "mkdocs.yml")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "nowhere" in done.stderr


def searched(show, words):
    """The titles that the site's search finds."""
    show.run("document.querySelector('[for=__search]').click()")
    time.sleep(1)
    script = f"""
        const field = document.querySelector('.md-search__input');
        field.focus(); field.value = {json.dumps(words)};
        field.dispatchEvent(new KeyboardEvent('keyup', {{bubbles: true}}));
        field.dispatchEvent(new InputEvent('input', {{bubbles: true}}));
    """
    show.run(script)
    found = []

    def has_results():
        found[:] = show.run(
            "return [...document.querySelectorAll('.md-search-result__item h1, .md-search-result__item h2')]"
            ".map((own) => own.textContent)"
        )
        return bool(found)

    wait_until(has_results, 60, f"the search found nothing for {words}")
    return found


@pytest.mark.docs
@pytest.mark.parametrize("width", [1280, 390])
def test_chromium_shows_the_pages_and_no_page_is_wider_than_the_window(built, width, tmp_path):
    with browser(f"{built}/index.html", size=(width, 900)) as show:
        show.resize(width, 900)
        assert show.run("return document.title") == "cprl"
        assert show.run("return document.querySelectorAll('.md-tabs__link').length") >= 7
        for page in ("tutorial", "institutions", "results", "reference/cprl.envs", "reference/commands"):
            show.open(f"{built}/{page}.html")
            assert show.run("return document.documentElement.scrollWidth <= innerWidth"), page
            assert show.run("return [...document.images].every((own) => own.naturalWidth > 0)"), page
            (tmp_path / f"{page.replace('/', '_')}.png").write_bytes(show())
        show.open(f"{built}/reference/cprl.envs.html")
        has_entry = "return !!document.getElementById('cprl.envs.CommonsEnv')"
        wait_until(lambda: show.run(has_entry), 20.0, "CommonsEnv is not on its page of the reference")
        assert Image.open(BytesIO(show())).size[0] == width


@pytest.mark.docs
@pytest.mark.parametrize("how", ["served", "from the disk"])
def test_the_search_finds_a_page(built, how):
    home = f"{built}/index.html" if how == "served" else (SITE / "index.html").as_uri()
    with browser(home, size=(1280, 900)) as show:
        titles = searched(show, "graduated sanctions")
    assert any("sanctions" in title.lower() for title in titles), titles


@pytest.mark.docs
def test_pages_ask_no_other_server_for_anything():
    for page in SITE.rglob("*.html"):
        loaded = re.findall(
            r"<(?:script|link|img|iframe)[^>]+(?:src|href)=\"(https?:[^\"]+)", page.read_text()
        )
        assert loaded == [], page


def colours_of(recording):
    """The colours of apples and agents in a recording, by the name of the class."""
    component = "AnnotationContext:context"
    found = {}
    for chunk in RrdReader(recording).stream():
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            for entry in batch.column(component)[0].as_py()[0]:
                info = entry["class_description"]["info"]
                value = info["color"]
                found[info["id"]] = (value >> 24 & 255, value >> 16 & 255, value >> 8 & 255)
    return {name: found[kind] for name, kind in (("apple", APPLE), ("agent_0", FIRST_AGENT))}


@pytest.mark.docs
def test_the_page_of_replays_shows_a_board(built, tmp_path):
    recording = tmp_path / "replay.rrd"
    recording.write_bytes(gzip.decompress(replays.recordings()["commons"].read_bytes()))
    colours = colours_of(recording)
    with browser(f"{built}/replays.html?replay=commons", size=(900, 900)) as show:  # it draws on a CPU
        began, shown = time.monotonic(), {}
        while min(shown.values(), default=0) < 60 and time.monotonic() - began < 400:
            picture = show()
            (tmp_path / "page.png").write_bytes(picture)
            pixels = np.asarray(Image.open(BytesIO(picture)).convert("RGB"), np.int32)
            shown = {
                name: int((np.abs(pixels - colour).max(-1) <= 4).sum()) for name, colour in colours.items()
            }
            time.sleep(1)
        assert min(shown.values()) >= 60, f"{tmp_path / 'page.png'} shows {shown}"


@pytest.mark.docs
@pytest.mark.parametrize(
    ("query", "element", "said"),
    [
        (None, "replay-note", "make docs-serve"),
        ("institutions/nobody", "replay-missing", "The replay institutions/nobody is not here"),
    ],
    ids=["from the disk", "one that is not there"],
)
def test_the_page_of_replays_says_why_it_shows_none(built, query, element, said):
    home = f"{built}/replays.html?replay={query}" if query else (SITE / "replays.html").as_uri()
    with browser(home, size=(900, 600)) as show:
        wait_until(lambda: show.run(f"return !document.getElementById('{element}').hidden"), 60, "no note")
        assert said in show.run(f"return document.getElementById('{element}').textContent")
