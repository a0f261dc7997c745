"""The pages of the site: those of docs/, and whatever they link to elsewhere in the repository.

The Markdown pages are read in the repository too, where `../recipes/commons.py` is a file. On the site a file
of text is a page of its own, a folder a list of what it holds; recordings are played by the page of replays.
"""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Final
from urllib.parse import quote

from website.replays import PAGE as REPLAYS, SUFFIX, recordings

ROOT: Final = Path(__file__).parents[2]
DOCS: Final = ROOT / "docs"

COPIED: Final = {".png", ".gif", ".svg", ".html"}
"""Files that stay as they are."""
LANGUAGES: Final = {
    ".py": "python",
    ".toml": "toml",
    ".json": "json",
    ".sh": "sh",
    ".csv": "text",
    ".txt": "text",
    ".cff": "yaml",
}
"""The files that become pages, and how they are highlighted."""

_LINK: Final = re.compile(r"(?<=\]\()([^)#\s]+)(#[^)\s]*)?(?=\))")
_FENCE: Final = re.compile(r"^(```.*?^```[^\n]*$)", re.MULTILINE | re.DOTALL)
_LIST_AFTER_TEXT: Final = re.compile(r"^((?![-*#>|\s]|\d+\. ).+\n)(?=(?:[-*]|\d+\.) )", re.MULTILINE)
"""Python-Markdown, unlike the repository's reader, wants an empty line between a paragraph and a list."""


def stage_pages(folder: Path) -> None:
    """Write docs/*.md, and all that they lead to, into a folder, with links that lead to each other there.

    Raises:
        ValueError: if a page links to something that is not there.
    """
    waiting = sorted(DOCS.glob("*.md"))
    seen = set(waiting)
    while waiting:
        path = waiting.pop()
        for found in _stage(path, folder):
            if found not in seen:
                seen.add(found)
                waiting.append(found)


def place(path: Path) -> str:
    """Return where a file or folder of the repository stands among the staged pages."""
    inside = path.is_relative_to(DOCS)
    name = path.relative_to(DOCS).as_posix() if inside else f"repository/{path.relative_to(ROOT).as_posix()}"
    if path.is_dir():
        return f"{name}/index.md"
    if path.name == "README.md":  # MkDocs takes it for its folder's page, which is a list
        return f"{name.removesuffix(path.name)}about.md"
    if path.suffix == ".md" or path.suffix in COPIED:
        return name
    if path.name.endswith(SUFFIX):
        names = {own: replay for replay, own in recordings().items()}
        return f"{REPLAYS}?replay={quote(names[path])}"
    return f"{name}.md" if path.suffix in LANGUAGES else place(path.parent)


def _stage(path: Path, folder: Path) -> list[Path]:
    """Write one of them, and return what it links to."""
    target = folder / place(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix in COPIED:
        shutil.copyfile(path, target)
        return []
    found: list[Path] = []
    if path.is_dir():
        target.write_text(_folder_page(path, found.append), encoding="utf-8")
    elif path.suffix == ".md":
        target.write_text(_markdown(path, found.append), encoding="utf-8")
    else:
        target.write_text(_source_page(path), encoding="utf-8")
    return found


def _markdown(path: Path, found: Callable[[Path], None]) -> str:
    """Return a page with its links rewritten."""

    def rewritten(match: re.Match[str]) -> str:
        target = match[1]
        heading = match[2] or ""
        if re.match(r"[a-z]+:", target):
            return match[0]
        led = Path(os.path.normpath(path.parent / target))
        if not led.exists():
            raise ValueError(f"{path.relative_to(ROOT)} links to {target}, which is not there")
        return _link(path, led, found) + heading

    parts = _FENCE.split(path.read_text(encoding="utf-8"))
    parts[::2] = [_LIST_AFTER_TEXT.sub(r"\1\n", _LINK.sub(rewritten, part)) for part in parts[::2]]
    return "".join(parts)


def _link(origin: Path, target: Path, found: Callable[[Path], None]) -> str:
    """Return the link from the page of one to the page of the other, which is noted."""
    there = place(target)
    if there.partition("?")[0] != REPLAYS:
        found(target if place(target) != place(target.parent) else target.parent)
    return Path(os.path.relpath(there, Path(place(origin)).parent)).as_posix()


def _source_page(path: Path) -> str:
    """Return a file of text as a page, which the search leaves out."""
    text = path.read_text(encoding="utf-8").rstrip("\n")
    fence = "`" * max(3, *(len(run) + 1 for run in re.findall("`{3,}", text)), 3)
    name = path.relative_to(ROOT).as_posix()
    return f"{_UNSEARCHED}# {name}\n\n{fence}{LANGUAGES[path.suffix]}\n{text}\n{fence}\n"


def _folder_page(path: Path, found: Callable[[Path], None]) -> str:
    """Return a folder as a list of what it holds."""
    lines = [f"{_UNSEARCHED}# {path.relative_to(ROOT).as_posix()}\n"]
    for own in sorted(path.iterdir(), key=lambda one: (one.is_file(), one.name)):
        if own.name.startswith((".", "__pycache__")):
            continue
        name = f"`{own.name}{'/' * own.is_dir()}`"
        is_page = own.is_dir() or own.suffix in {".md", *LANGUAGES} or own.name.endswith(SUFFIX)
        lines.append(f"- [{name}]({_link(path / 'index.md', own, found)})" if is_page else f"- {name}")
    return "\n".join(lines) + "\n"


_UNSEARCHED: Final = "---\nsearch:\n  exclude: true\n---\n\n"
