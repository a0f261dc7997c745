"""A server of a language model for tests: it answers chat completions from a table, well or badly."""

import json
import time
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock, Thread

from cprl.policies.scripted import SCRIPTED_POLICIES

SLOW, HALF, SILENT, ODD, LONG = "slow", "half", "silent", "odd", "long"
"""Bad answers: after a second, cut in the middle, without text, of another form, larger than is read."""


def plan(request):
    """A plan that depends on the seed of a request alone."""
    seed = request["seed"]
    return json.dumps({"policy": SCRIPTED_POLICIES[seed % 6], "spare": 1 + seed % 3, "why": "é <b>"})


class ModelServer:
    """Answers each request by `answer(request)`: a text, a status of failure, or one of the bad answers."""

    def __init__(self, answer=plan):
        self.answer = answer
        self.requests = []
        self.headers = []
        self.at_once = self.most_at_once = 0
        self.lock = Lock()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server.server_port}/v1"

    def reply(self, handler):
        request = json.loads(handler.rfile.read(int(handler.headers["Content-Length"])))
        assert handler.path == "/v1/chat/completions"
        with self.lock:
            self.requests.append(request)
            self.headers.append(dict(handler.headers))
            self.at_once += 1
            self.most_at_once = max(self.most_at_once, self.at_once)
        answer = self.answer(request)
        with self.lock:
            self.at_once -= 1
        if isinstance(answer, int):
            return handler.send_error(answer)
        body = {
            "choices": [{"message": {"role": "assistant", "content": answer}}],
            "usage": {"prompt_tokens": 100, "completion_tokens": 20},
        }
        if answer == SLOW:
            time.sleep(1)
        if answer == SILENT:
            body["choices"][0]["message"]["content"] = None
        if answer == ODD:
            body = {"error": "odd"}
        if answer == LONG:
            body["choices"][0]["message"]["content"] = "x" * 2**21
        content = json.dumps(body).encode()
        handler.send_response(200)
        handler.send_header("Content-Length", str(len(content)))
        handler.end_headers()
        handler.wfile.write(content[: len(content) // 2] if answer == HALF else content)


@contextmanager
def served(answer=plan):
    """A `ModelServer` on a free port of this machine."""
    model = ModelServer(answer)

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            with suppress(BrokenPipeError, ConnectionResetError):  # who asked has stopped waiting
                model.reply(self)

        def log_message(self, *words):
            pass

    model.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    model.server.daemon_threads = True
    Thread(target=model.server.serve_forever, args=(0.01,), daemon=True).start()
    try:
        yield model
    finally:
        model.server.shutdown()
        model.server.server_close()
