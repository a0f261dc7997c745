"""A page that plays the committed replays, in the web viewer of the installed rerun-sdk, on 127.0.0.1.

python docs/replay_page.py
"""

import sys
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from typing import Any, Final
from urllib.parse import parse_qs, quote, urlsplit

import tyro

from cprl.viewer.page import web_viewer

RESULTS: Final = Path(__file__).parent / "results"
LOCALHOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8765

VIEWER_FILES: Final = {
    "index.html": "text/html",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "favicon.ico": "image/x-icon",
}
"""The files of the web viewer, and their types."""

PAGE_MAY: Final = "default-src 'none'; frame-src 'self'; style-src 'unsafe-inline'"
VIEWER_MAY: Final = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' "
    "'unsafe-inline'; img-src 'self' data: blob:; worker-src 'self' blob:"
)
"""What the browser lets the page and the viewer load: nothing from another server, such as Google's fonts."""

PAGE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{name} - replays of cprl</title>
<style>
body {{ margin: 0; height: 100vh; display: flex; flex-direction: column; background: #101216; color: #e4e7ec;
  font: 15px sans-serif; }}
header {{ padding: 8px 14px; }}
a {{ color: #a9c7e8; margin-right: 14px; }}
a.shown {{ color: #e4e7ec; font-weight: bold; text-decoration: none; }}
iframe {{ flex: 1; border: 0; }}
</style>
</head>
<body>
<header>An episode of trained agents, played by the web viewer of the installed rerun-sdk:
{links}</header>
<iframe src="{viewer}" title="Replay of {name}"></iframe>
</body>
</html>
"""


def replays() -> dict[str, Path]:
    """The committed replays by name: the run, and the file where a run has several."""
    files = sorted(RESULTS.rglob("replay*.rrd"))
    runs = [path.parent.relative_to(RESULTS).as_posix() for path in files]
    return {
        run if runs.count(run) == 1 else f"{run}/{path.stem}": path
        for run, path in zip(runs, files, strict=True)
    }


_ONE_AT_A_TIME: Final = Lock()


class Handler(BaseHTTPRequestHandler):
    """Answers with the page, a file of the viewer, or a replay."""

    def do_GET(self) -> None:
        """By the path: `/?replay=NAME`, `/viewer/FILE`, `/replays/NAME.rrd`."""
        parts = urlsplit(self.path)
        folder, _, name = parts.path.lstrip("/").partition("/")
        known = replays()
        if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in (LOCALHOST, "localhost"):
            self.send_error(403, f"allowed hosts: {LOCALHOST}, localhost")
        elif (folder, name) == ("", ""):
            chosen = parse_qs(parts.query).get("replay", [next(iter(known))])[0]
            if chosen in known:
                self._send("text/html; charset=utf-8", self._page(chosen).encode(), PAGE_MAY)
            else:
                self.send_error(404, f"allowed replays: {', '.join(known)}")
        elif folder == "viewer" and (name or "index.html") in VIEWER_FILES:
            name = name or "index.html"
            with _ONE_AT_A_TIME:
                content = web_viewer()[name]
            self._send(VIEWER_FILES[name], content, VIEWER_MAY)
        elif folder == "replays" and name.removesuffix(".rrd") in known:
            self._send("application/octet-stream", known[name.removesuffix(".rrd")].read_bytes(), PAGE_MAY)
        else:
            self.send_error(404)

    def _page(self, chosen: str) -> str:
        here = f"http://{self.headers['Host']}"
        replay = quote(f"{here}/replays/{quote(chosen)}.rrd", safe="")
        links = "\n".join(
            f'<a href="/?replay={quote(name)}"{" class=shown" if name == chosen else ""}>{escape(name)}</a>'
            for name in replays()
        )
        how = "renderer=webgl&persist=0&hide_welcome_screen=1&theme=dark"
        return PAGE.format(
            name=escape(chosen), links=links, viewer=escape(f"/viewer/?url={replay}&{how}", quote=True)
        )

    def _send(self, kind: str, content: bytes, may: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("rerun-final-length", str(len(content)))  # of which the viewer shows its share
        self.send_header("Content-Security-Policy", may)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the terminal has the address alone."""


class Server(ThreadingHTTPServer):
    """Listens on 127.0.0.1 alone."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error; others are printed."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def main(*, port: int | None = None) -> None:
    """Serves the page until Ctrl-C.

    Args:
        port: of 127.0.0.1; by default 8765, or any that is free where that one is taken.
    """
    if not replays():
        raise SystemExit(f"{RESULTS} has no replays (*/replay*.rrd)")
    try:
        server = Server((LOCALHOST, DEFAULT_PORT if port is None else port), Handler)
    except OSError as error:
        if port is not None:
            raise SystemExit(f"port {port} of {LOCALHOST}: {error.strerror}; --port takes another") from None
        server = Server((LOCALHOST, 0), Handler)
    with server:
        print(f"http://{LOCALHOST}:{server.server_address[1]}/  (Ctrl-C ends it)", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("\nEnded.")


if __name__ == "__main__":
    tyro.cli(main)
