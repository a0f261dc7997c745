"""Ask a language model by the chat interface of OpenAI, and keep every call.

A call is kept by the hash of its request, as a line of JSON, and what is kept is not asked again. So a run
resumes, and replays without a network, bit for bit. A request has a seed of its own, so that equal prompts of
two agents are two calls. Bad answers are kept like good ones. Nothing here prints, and no key is kept.
"""

import json
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from os.path import isabs
from pathlib import Path
from threading import Lock
from typing import Annotated, Any, Final, NamedTuple, TypeVar
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from cprl.values import Natural, Positive, Range, Value, Where, short_repr

T = TypeVar("T")
Price = Annotated[float, Range(0, 1e6)]
Text = Annotated[str, Where(lambda text: "\0" not in text, "a text without NUL")]

CALLS: Final = "calls.jsonl"
"""The file of a run with its calls."""
OVER_LIMIT: Final = "more than max_calls"
"""What is kept of a call that was not made."""
_FIELDS: Final = (
    *("hash", "call", "request", "answer", "failure", "tries", "seconds"),
    *("prompt_tokens", "answer_tokens", "dollars"),
)
"""What is kept of a call."""
_MOST_BYTES: Final = 2**20
"""The longest answer that is read."""
_BUSY: Final = (408, 429)
"""The statuses below 500 after which a call is tried again."""


@dataclass(frozen=True, kw_only=True)
class Model(Value, stored=False):
    """A language model at a server with `/chat/completions`, and how it may be asked."""

    model: Text
    """The model's name at the server, e.g. "qwen3:4b"."""
    base_url: Annotated[
        str, Where(lambda url: url.startswith(("http://", "https://")), "an address, http:// or https://")
    ] = "http://localhost:11434/v1"
    """The address before `/chat/completions`; by default that of Ollama on this machine."""
    key_variable: Text | None = None
    """The environment variable that holds the server's key, e.g. "OPENAI_API_KEY"; None for no key. The key
    itself is never stored."""
    temperature: Annotated[float, Range(0, 2)] = 0.0
    """The temperature at which the model samples."""
    max_tokens: Positive = 200
    """The most tokens of an answer."""
    max_calls: Positive = 10_000
    """The most calls of a run, of all its agents; later ones are not made."""
    timeout_s: Annotated[float, Range(0.01, 3600)] = 60.0
    """The most seconds that a try takes."""
    prices: tuple[Price, Price] | None = None
    """What a million tokens of prompts, and of answers, cost, in US dollars; None if they are not counted."""
    retries: Annotated[int, Range(0, 20)] = 2
    """How often a call is tried again, after silence or where the server is busy or fails."""
    backoff_s: Annotated[float, Range(0, 600)] = 1.0
    """The seconds before the first retry, doubled before each further one."""
    concurrency: Annotated[int, Range(1, 256)] = 4
    """The most calls at the same time."""
    stored: (
        Annotated[Text, Where(lambda path: not isabs(path), "a path from the working directory")] | None
    ) = None
    """The directory of a run whose calls answer instead of the server; a request that it does not keep is
    refused by name. None to ask the server."""


class Question(NamedTuple):
    """What is asked in a call."""

    call: str
    """The name of the call, e.g. "seed 0, replica 0, agent 2, world 0, call 3"."""
    seed: Natural
    system: str
    prompt: str

    def new_call(self, model: Model) -> dict[str, Any]:
        """Return what is kept of a call before it is made: the hash of its request, its name, its request."""
        request = {
            "model": model.model,
            "messages": [
                {"role": "system", "content": self.system},
                {"role": "user", "content": self.prompt},
            ],
            "temperature": model.temperature,
            "max_tokens": model.max_tokens,
            "seed": self.seed,
            "response_format": {"type": "json_object"},
        }
        return {"hash": _hash(request), "call": self.call, "request": request}


class Calls:
    """The calls of a run, each made once; kept in a file if there is one."""

    def __init__(self) -> None:
        self.kept: dict[str, dict[str, Any]] = {}
        """The calls by the hashes of their requests."""
        self._path: Path | None = None
        self._stored: dict[Path, dict[str, Any]] = {}
        """The calls of other runs, see `Model.stored`, each run read once."""
        self._most = 0
        """The most calls of the model that was asked last."""
        self._lock = Lock()

    def keep_in(self, path: Path) -> None:
        """Read the calls that a file holds, and append further ones."""
        self._path = path
        self.kept |= read_calls(path)

    def ask(self, model: Model, questions: Sequence[Question], read: Callable[[Any], T]) -> list[T | None]:
        """Return what a model answers, several questions at once; what is kept is not asked again.

        Args:
            read: returns what the JSON of an answer says; raises a ValueError if that is not allowed.

        Returns:
            An entry for each question; None where the answer is bad or missing.

        Raises:
            ValueError: if `Model.stored` lacks a call.
            ConnectionError: if the first call of all fails in a way that a retry cannot change.
        """
        calls = [question.new_call(model) for question in questions]
        new = {call["hash"]: call for call in calls if call["hash"] not in self.kept}
        self._most = model.max_calls
        if model.stored is not None:
            for call in new.values():
                self._keep(self._stored_call(model.stored, call))
        else:
            left = model.max_calls - self._made
            most_tries = [1 + model.retries if index < left else 0 for index in range(len(new))]
            with ThreadPoolExecutor(model.concurrency) as pool:
                list(pool.map(partial(self._make, model, read), new.values(), most_tries))
        return [_understood(self.kept[call["hash"]]["answer"], read)[0] for call in calls]

    def _make(self, model: Model, read: Callable[[Any], Any], call: dict[str, Any], most_tries: int) -> None:
        """Make a call, and keep what came of it."""
        began = time.monotonic()
        tries = 0
        outcome = _Outcome(None, OVER_LIMIT)
        while tries < most_tries:
            if tries:
                time.sleep(model.backoff_s * 2 ** (tries - 1))
            tries += 1
            outcome = _post(model, call["request"])
            if not outcome.may_retry:
                break
        # a list, since other threads keep calls meanwhile
        if outcome.is_refused and all(call["answer"] is None for call in list(self.kept.values())):
            raise ConnectionError(f"{model.base_url} with the model {model.model!r}: {outcome.failure}")
        prompt_price, answer_price = model.prices or (0.0, 0.0)
        self._keep(
            {
                **call,
                "answer": outcome.answer,
                "failure": outcome.failure or _understood(outcome.answer, read)[1],
                "tries": tries,
                "seconds": round(time.monotonic() - began, 3),
                "prompt_tokens": outcome.prompt_tokens,
                "answer_tokens": outcome.answer_tokens,
                "dollars": (prompt_price * outcome.prompt_tokens + answer_price * outcome.answer_tokens)
                / 1e6,
            }
        )

    def _stored_call(self, run: str, call: dict[str, Any]) -> dict[str, Any]:
        """Return a call as another run keeps it; refuse one that it does not keep."""
        path = Path(run) / CALLS
        if path not in self._stored:
            self._stored[path] = read_calls(path)
        stored = self._stored[path]
        if call["hash"] not in stored:
            raise ValueError(f"{path} keeps no answer for {call['call']}: {_differs(stored, call)}")
        return stored[call["hash"]]

    def _keep(self, call: dict[str, Any]) -> None:
        with self._lock:
            if self._path is not None:
                with open(self._path, "a", encoding="utf-8") as file:
                    # The last line may have been cut by a kill, so none relies on the end of another.
                    file.write("\n" * (file.tell() > 0) + json.dumps(call))
            self.kept[call["hash"]] = call

    def in_words(self) -> str:
        """Return how many calls were made, their tokens, failures and costs; "" without any."""
        if not self.kept:
            return ""
        tokens = f"{self._total('prompt_tokens'):,} + {self._total('answer_tokens'):,} tokens"
        failed = sum(call["failure"] is not None for call in self.kept.values())
        words = f"{self._made:,} calls, {tokens}, {failed:,} without a usable answer"
        dollars = self._total("dollars")
        if dollars:
            words += f", {dollars:,.4f} US dollars"
        if dollars and self._most:
            words += f" ({self._most:,} such calls: {dollars / self._made * self._most:,.2f})"
        return words

    @property
    def _made(self) -> int:
        """Return how many of the calls were made."""
        return sum(call["tries"] > 0 for call in self.kept.values())

    def _total(self, name: str) -> Any:
        """Return the sum of a number of all calls."""
        return sum(call[name] for call in self.kept.values())


class _Outcome(NamedTuple):
    """What came of a try."""

    answer: str | None
    failure: str | None = None
    prompt_tokens: int = 0
    answer_tokens: int = 0
    may_retry: bool = False
    is_refused: bool = False
    """Whether the server is not there, or refuses the request."""


def read_calls(path: Path) -> dict[str, dict[str, Any]]:
    """Return the calls that a file keeps, by the hashes of their requests, without a line that was cut."""
    calls = {}
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        try:
            call = json.loads(line)
        except ValueError:  # the process was killed while it wrote
            continue
        try:
            calls[_hash(call["request"])] = {name: call[name] for name in _FIELDS}
        except (TypeError, LookupError):
            raise ValueError(f"{path} holds {short_repr(call)}; allowed: calls as cprl keeps them") from None
    return calls


def _hash(request: dict[str, Any]) -> str:
    return sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()


def _post(model: Model, request: dict[str, Any]) -> _Outcome:
    """Post a request once."""
    message = Request(f"{model.base_url.rstrip('/')}/chat/completions", json.dumps(request).encode())
    message.add_header("Content-Type", "application/json")
    key = os.environ.get(model.key_variable or "", "")
    if key:
        message.add_unredirected_header("Authorization", f"Bearer {key}")
    try:
        table = json.loads(_body(message, model.timeout_s))
        answer = table["choices"][0]["message"]["content"]
        usage = table.get("usage") or {}
        prompt_tokens = int(usage.get("prompt_tokens") or 0)
        answer_tokens = int(usage.get("completion_tokens") or 0)
    except HTTPError as error:
        is_busy = error.code in _BUSY or error.code >= 500
        return _Outcome(None, f"status {error.code}", may_retry=is_busy, is_refused=not is_busy)
    except OSError as error:
        reason = getattr(error, "reason", error)
        if isinstance(reason, TimeoutError):
            return _Outcome(None, "no answer in time", may_retry=True)
        return _Outcome(None, f"no connection: {reason}", may_retry=True, is_refused=True)
    except Exception as error:  # half an answer, or one of any other form
        return _Outcome(None, f"a broken answer: {type(error).__name__}", may_retry=True)
    failure = None if isinstance(answer, str) else "an answer without text"
    return _Outcome(None if failure else answer, failure, prompt_tokens, answer_tokens)


def _body(message: Request, timeout_s: float) -> bytes:
    """Return the body of an answer; raise a TimeoutError if it comes too slowly."""
    ends = time.monotonic() + timeout_s
    body = b""
    with urlopen(message, timeout=timeout_s) as response:
        while part := response.read1(2**16):
            body += part
            if time.monotonic() > ends:
                raise TimeoutError
            if len(body) > _MOST_BYTES:
                raise ValueError("too long")
    return body


def _understood(answer: str | None, read: Callable[[Any], T]) -> tuple[T | None, str | None]:
    """Return what an answer says, or why it says nothing."""
    if answer is None:
        return None, None
    try:
        table, _ = json.JSONDecoder().raw_decode(answer, answer.index("{"))
    except (ValueError, RecursionError):
        return None, "no JSON"
    try:
        return read(table), None
    except ValueError as error:
        return None, str(error)


def _differs(stored: dict[str, dict[str, Any]], call: dict[str, Any]) -> str:
    """Return what differs between a call and the stored one of the same name."""
    request = call["request"]
    for earlier in stored.values():
        if earlier["call"] == call["call"]:
            changed = [part for part in request if request[part] != earlier["request"].get(part)]
            return f"it keeps one with another {' and '.join(changed)}"
    return "it keeps none of that name"
