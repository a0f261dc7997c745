"""The recordings of docs/results, and the page that plays them in Rerun's web viewer, that of rerun-sdk."""

import gzip
import shutil
import time
from functools import cache
from html import escape
from pathlib import Path
from typing import Final
from urllib.error import URLError
from urllib.parse import quote
from urllib.request import ProxyHandler, build_opener

from cprl.viewer.page import LOCALHOST, WebViewer

RESULTS: Final = Path(__file__).parents[1] / "results"
BOARDS: Final = RESULTS.with_name("boards")
"""Pictures of the boards by their names, which runs have, too."""
SUFFIX: Final = ".rrd.gz"
PAGE: Final = "replays.md"
FOLDER: Final = "recordings"
VIEWER: Final = "viewer"
VIEWER_FILES: Final = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "sw.js", "favicon.ico")
START_S: Final = 30.0

_TEMPLATE: Final = Path(__file__).parent / "replays.md"
"""The page, with {links} where they go."""


@cache
def recordings() -> dict[str, Path]:
    """Return the committed replays by name: the run, and the file where a run has several."""
    files = sorted(RESULTS.rglob(f"replay*{SUFFIX}"))
    runs = [path.parent.relative_to(RESULTS).as_posix() for path in files]
    return {
        run if runs.count(run) == 1 else f"{run}/{path.name.removesuffix(SUFFIX)}": path
        for run, path in zip(runs, files, strict=True)
    }


def stage_replays(folder: Path) -> None:
    """Write the page, and unpack the recordings."""
    for name, path in recordings().items():
        target = folder / FOLDER / f"{name}.rrd"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(gzip.decompress(path.read_bytes()))
    (folder / BOARDS.name).mkdir(exist_ok=True)
    links = ""
    for name in recordings():
        board = BOARDS / f"{name.split('/')[0]}.png"
        picture = ""
        if board.is_file():
            shutil.copyfile(board, folder / BOARDS.name / board.name)
            picture = f'<img src="{BOARDS.name}/{quote(board.name)}" alt="">'
        recording = f"{FOLDER}/{quote(name)}.rrd"
        links += f'<a href="?replay={quote(name)}" data-recording="{recording}">{picture}{escape(name)}</a>\n'
    text = _TEMPLATE.read_text(encoding="utf-8").replace("{links}", links)
    (folder / PAGE).write_text(text, encoding="utf-8")


def copy_viewer(folder: Path) -> None:
    """Write the web viewer of the installed rerun-sdk, 43 MB, beside the pages; Rerun's command has it built
    in, and only hands it out as a server."""
    folder.mkdir(parents=True, exist_ok=True)
    server = WebViewer()
    try:
        for name in VIEWER_FILES:
            (folder / name).write_bytes(_fetched(f"http://{LOCALHOST}:{server.port}/{name}"))
    finally:
        server.close()


def _fetched(address: str) -> bytes:
    """Return what a server answers that may just have been started."""
    opener = build_opener(ProxyHandler({}))
    ends = time.monotonic() + START_S
    while True:
        try:
            with opener.open(address, timeout=START_S) as answer:
                return bytes(answer.read())
        except URLError:
            if time.monotonic() > ends:
                raise
            time.sleep(0.1)
