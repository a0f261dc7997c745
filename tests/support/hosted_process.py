"""A hosted game in a process of its own, and people at real browsers."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from urllib.error import URLError
from urllib.request import urlopen

from viewers import NO_GPU, browser, free_port, wait_until

PATIENCE_S = 120.0
"""For a process or a browser to start on a machine with much other work."""
KEYS = {"ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "ArrowLeft": 37, "f": 70}


class HostedProcess:
    """`cprl host` with some words, which can be killed and started again.

    Args:
        folder: of the session.
        words: of the command, without --out and --port.
    """

    def __init__(self, folder, *words):
        self.folder = folder
        self.port = free_port()
        self._words = [*words, "--out", str(folder), "--port", str(self.port)]
        self._process = None

    def start(self):
        """Start the server, and wait until it answers."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "cprl", "host", *self._words],
            stdout=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL,
        )
        wait_until(self._answers, PATIENCE_S, "cprl host did not answer")

    def _answers(self):
        assert self._process.poll() is None, f"cprl host ended with {self._process.returncode}"
        try:
            return urlopen(f"http://127.0.0.1:{self.port}/", timeout=5).status == 200
        except (URLError, OSError):
            return False

    @property
    def link(self):
        """The link to a seat."""
        return f"http://127.0.0.1:{self.port}/#{(self.folder / 'join.txt').read_text()}"

    def kill(self):
        """End the process as a power failure would."""
        if self._process is not None and self._process.poll() is None:
            os.kill(self._process.pid, signal.SIGKILL)
            self._process.wait()


@contextmanager
def hosted_process(folder, *words):
    """Host a session by the command, and end it."""
    process = HostedProcess(folder, *words)
    try:
        process.start()
        yield process
    finally:
        process.kill()


@contextmanager
def person(link, size):
    """A person at a browser who has opened the link."""
    with browser("about:blank", size=size, graphics=NO_GPU) as window:
        window.resize(*size)
        window.open(link)
        yield Person(window)


class Person:
    """What a person sees and does at a browser's window."""

    def __init__(self, window):
        self.window = window

    def sees(self, stage, limit_s=PATIENCE_S):
        """Wait until the page shows a stage."""
        self.until(f"document.body.dataset.stage === '{stage}'", limit_s)
        return self

    def until(self, condition, limit_s=PATIENCE_S):
        """Wait until something is so in the page."""

        def holds():
            return self.window.run(f"return Boolean({condition})")

        wait_until(holds, limit_s, f"{condition} was not so, but {self.text('body')!r}", every_s=0.05)
        return self

    def text(self, selector):
        """The text of a part of the page."""
        return self.window.run(f"return document.querySelector('{selector}').innerText")

    def value(self, expression):
        """The value of an expression in the page."""
        return self.window.run(f"return {expression}")

    def click(self, selector):
        """Press a button with the mouse, where it is."""
        x, y = self._middle(selector)
        for kind in ("mousePressed", "mouseReleased"):
            self.window.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        return self

    def hold(self, key, seconds):
        """Hold a key."""
        names = {"key": key, "windowsVirtualKeyCode": KEYS[key]}
        self.window.command("Input.dispatchKeyEvent", type="keyDown", **names)
        time.sleep(seconds)
        self.window.command("Input.dispatchKeyEvent", type="keyUp", **names)
        return self

    def touch(self, selector, seconds):
        """Hold a finger on a button."""
        x, y = self._middle(selector)
        self.window.command("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        time.sleep(seconds)
        self.window.command("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        return self

    def _middle(self, selector):
        box = f"document.querySelector('{selector}').getBoundingClientRect()"
        return self.value(f"(({{x, y, width, height}}) => [x + width / 2, y + height / 2])({box})")

    def picture(self, path):
        """Write what the window shows."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.window())
        return self
