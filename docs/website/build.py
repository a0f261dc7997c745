"""Builds the site; `make docs` calls it.

python -m website.build, in docs/
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import yaml

from cprl.web.explorable import explorable_page
from website.navigation import sections
from website.pages import ROOT, stage_pages
from website.reference import stage_reference
from website.replays import PAGE as REPLAYS, VIEWER, copy_viewer, stage_replays

HERE: Final = Path(__file__).parent
SITE: Final = ROOT / "build" / "site"
STAGED: Final = ROOT / "build" / "docs"
EXPLORABLE: Final = "explorable.html"
"""The page that the home carries."""


def main() -> None:
    """Stage the pages and build the site, with warnings as errors."""
    pages = STAGED / "pages"
    shutil.rmtree(STAGED, ignore_errors=True)
    pages.mkdir(parents=True)
    stage_pages(pages)
    stage_replays(pages)
    (pages / EXPLORABLE).write_text(explorable_page(), encoding="utf-8")
    shutil.copytree(HERE / "assets", pages / "assets")
    navigation = _navigation(stage_reference(pages))
    config = STAGED / "mkdocs.yml"
    config.write_text(_config(pages, navigation), encoding="utf-8")
    _build(config)
    copy_viewer(SITE / VIEWER)
    files = [path.stat().st_size for path in SITE.rglob("*") if path.is_file()]
    print(f"{SITE.relative_to(ROOT)} has {len(files)} files, {sum(files) / 1e6:.1f} MB")
    print("make docs-serve serves it, with its replays; or open its index.html from the disk")


def _navigation(reference: dict[str, str]) -> list[Any]:
    """Return the pages by section, as MkDocs wants them."""
    found: list[Any] = [{"Home": "index.md"}]
    for section, pages in sections().items():
        if section == "Study":
            pages = {**pages, "Replays": REPLAYS}
        elif section == "Reference":
            pages = {**reference, **pages}
        found.append(_section(section, pages))
    return found


def _section(title: str, pages: Mapping[str, str]) -> dict[str, list[dict[str, str]]]:
    return {title: [{own: path} for own, path in pages.items()]}


def _config(pages: Path, navigation: list[Any]) -> str:
    """Return mkdocs.yml with what depends on this checkout; JSON is YAML."""
    text = (HERE / "mkdocs.yml").read_text(encoding="utf-8")
    text = text.replace("        python:\n", f"        python:\n          paths: ['{ROOT / 'src'}']\n")
    more = {"docs_dir": str(pages), "site_dir": str(SITE), "nav": navigation}
    return text + "\n" + yaml.safe_dump(more, sort_keys=False, allow_unicode=True)


def _build(config: Path) -> None:
    """Run MkDocs, and end with its exit code where it fails.

    Material's banner about its own end, of which `website` says more, is left out.
    """
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--clean", "--config-file", str(config)]
    done = subprocess.run(command, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, check=False)
    if done.returncode:
        raise SystemExit(done.returncode)


if __name__ == "__main__":
    main()
