"""`cprl docs`: the documentation as `make docs` has built it, and its replays, served on 127.0.0.1 alone."""

import shutil
import sys
import webbrowser
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from cprl.system.output import say
from cprl.viewer.page import LOCALHOST, LocalHandler, has_display

SITE: Final = Path(__file__).parents[1] / "docs_site"
"""Where `make docs` builds the site; a wheel carries it in the same place."""

DEFAULT_PORT: Final = 8765

_VIEWER: Final = "viewer"
"""The folder of the site that has Rerun's web viewer, which is read from the installed rerun-sdk."""

_KINDS: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".xml": "application/xml",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".gif": "image/gif",
    ".rrd": "application/octet-stream",
}
"""What is served, by suffix. Not `mimetypes`: on Windows it asks the registry."""

_PAGES_MAY: Final = (
    "default-src 'self'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; worker-src 'self' blob:; object-src 'none'"
)
_VIEWER_MAY: Final = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' "
    "'unsafe-inline'; img-src 'self' data: blob:; worker-src 'self' blob:"
)
"""What the browser lets pages and the viewer load: nothing from another server, such as Google's fonts."""


class Handler(LocalHandler):
    """Answers with a file of the site or of Rerun's web viewer."""

    site: Path = SITE

    def do_GET(self) -> None:  # noqa: N802 - so http.server calls it
        """Answers with the file that the path names, or says why not."""
        if self.is_for_us():
            self._answer(with_content=True)

    def do_HEAD(self) -> None:  # noqa: N802
        """Answers likewise, without the content."""
        if self.is_for_us():
            self._answer(with_content=False)

    def _answer(self, *, with_content: bool) -> None:
        path = unquote(urlsplit(self.path).path).lstrip("/")
        folder, _, name = path.partition("/")
        if folder == _VIEWER:
            self.send_viewer(name or "index.html", may=_VIEWER_MAY, with_content=with_content)
            return
        file = self._file(path)
        if file is None:
            self.send_error(404)
            return
        self.begin(_KINDS[file.suffix], file.stat().st_size, may=_PAGES_MAY)
        if with_content:
            with file.open("rb") as content:
                shutil.copyfileobj(content, self.wfile)

    def _file(self, path: str) -> Path | None:
        """The file of the site at this path, a folder's index.html; None for what is not served."""
        try:
            found = (self.site / path).resolve()
            if found.is_dir():
                found /= "index.html"
            inside = found.is_relative_to(self.site.resolve())
            return found if inside and found.suffix in _KINDS and found.is_file() else None
        except (OSError, ValueError):  # a name that no file can have
            return None


class Server(ThreadingHTTPServer):
    """Listens on 127.0.0.1 alone."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error; others are printed."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def docs(*, port: int | None = None, browser: bool = True) -> None:
    """Serves this documentation on 127.0.0.1, until Ctrl-C, and opens it in the browser.

    Args:
        port: of 127.0.0.1; by default 8765, or any that is free where that one is taken.
        browser: open it; without a display only the address is printed.
    """
    if port is not None and not 0 <= port < 65536:
        raise ValueError(f"--port is {port}; it must be 0 to 65535")
    if not (SITE / "index.html").is_file():
        raise ValueError("the documentation has not been built here; in a checkout, make docs builds it")
    with _listening(port) as server:
        address = f"http://{LOCALHOST}:{server.server_address[1]}/"
        say(f"{address}  (Ctrl-C ends it)")
        if browser and has_display():
            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            say("\nEnded.")


def _listening(port: int | None) -> Server:
    try:
        return Server((LOCALHOST, DEFAULT_PORT if port is None else port), Handler)
    except OSError as error:
        if port is not None:
            raise ValueError(f"port {port} of {LOCALHOST}: {error.strerror}; --port takes another") from None
        return Server((LOCALHOST, 0), Handler)
