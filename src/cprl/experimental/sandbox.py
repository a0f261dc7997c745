"""Sandbox: a page with sliders for people who do not program. Scripted agents play at once; agents can be
trained.

A page on 127.0.0.1 that asks for an episode whenever a slider has moved, and nothing while nobody moves one.
What is played and trained is the recipe that the page hands out.
"""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from html import escape
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Annotated, Any, Final, Literal, Self, get_args
from urllib.parse import parse_qsl, urlsplit

from cprl.commons.game import Game
from cprl.commons.published import game as published_game
from cprl.evaluation.fresh import fresh_episodes
from cprl.evaluation.show import data_of, page
from cprl.experiment import Experiment
from cprl.population import AgentSpec, Scripted
from cprl.system.defaults import SANDBOX_EPISODES as EPISODES
from cprl.training.stored import LoadedRun, load
from cprl.values import Positive, Range, Value, checked, hints_of

FOR_TRAINED: Final = "changes nothing for scripted agents"
_Board = Literal["commons", "two_complex", "single_complex", "single_basic"]
_RECIPE: Final = '''\
"""A commons from the sandbox of cprl."""

from dataclasses import replace

import cprl
from cprl import institutions, maps, presets
from cprl.algorithms import DQN
from cprl.population import Learning


def game() -> cprl.Game:
    base = presets.game("{board}")
    rules = replace(base.rules, regrow_prob={regrow_prob}, window_rows={sight}, window_columns={columns})
    laws = ({laws})
    return replace(base, map=maps.with_agents(base.map, {agents}), rules=rules, institutions=laws)


def experiment() -> cprl.Experiment:
    """{agents} DQN agents that learn from 16 worlds at once, on a short schedule."""
    settings = replace(
        presets.dqn_settings("commons"),
        learning_rate=1e-3,
        epsilon_decay_steps=100_000,
        gamma=0.97,
        steps_per_update=16,
        batch_size=64,
    )
    agents = (Learning(DQN(settings=settings)),) * {agents}
    return cprl.Experiment(
        name="sandbox", game=game(), agents=agents, episodes={episodes}, replicas=1, worlds=16
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
'''


@dataclass(frozen=True, kw_only=True)
class Sliders(Value, stored=False):
    """The settings that people choose on the page."""

    board: _Board = "commons"
    agents: Annotated[int, Range(1, 12)] = 4
    regrowth: Annotated[float, Range(0, 5)] = 1.0
    """The factor of the board's probabilities that apples grow."""
    greedy: Annotated[int, Range(0, 12)] = 4
    """The number of agents that take every apple; the others leave some near each that they take."""
    sight: Annotated[int, Range(3, 15)] = 7
    """The number of cells that agents see ahead, and as many to each side."""
    quota: Annotated[float, Range(0, 1)] = 0.0
    """The share of what the board can bear, of each agent in 50 turns, see `Quota`; 0 for no quota."""
    tax: Annotated[float, Range(0, 1)] = 0.0
    """The share of each harvest that is shared equally; 0 for none."""
    sanctions: Annotated[int, Range(0, 1)] = 0
    """1 where whoever tags others is sanctioned, more with each offence."""

    @classmethod
    def of(cls, query: Mapping[str, str]) -> Self:
        """Read the sliders of a query; raise a ValueError that names what is wrong."""
        kinds = {name: type(value) for name, value in vars(cls()).items()}
        if unknown := sorted(set(query) - set(kinds)):
            raise ValueError(f"{', '.join(unknown)}: no slider; allowed: {', '.join(kinds)}")
        return cls(**{name: kinds[name](text) for name, text in query.items()})

    def recipe(self, episodes: int = EPISODES) -> str:
        """Return the recipe of the game, with agents that learn."""
        base = published_game(self.board)
        laws = {
            f"institutions.Quota(share={self.quota!r}, window_steps=50)": self.quota,
            f'institutions.Tax(rate={self.tax!r}, redistribution="equal")': self.tax,
            'institutions.GraduatedSanctions(on="tags")': self.sanctions,
        }
        probs = tuple(round(min(1.0, prob * self.regrowth), 6) for prob in base.rules.regrow_prob)
        return _RECIPE.format(
            board=self.board,
            regrow_prob=probs,
            sight=self.sight,
            columns=2 * self.sight + 1,
            laws="".join(f"{law}, " for law, strength in laws.items() if strength).rstrip(),
            agents=self.agents,
            episodes=episodes,
        )

    @property
    def rules(self) -> str:
        """Return a line that describes the rules, for a title."""
        laws = {
            f"quota {self.quota:g}": self.quota,
            f"tax {self.tax:g}": self.tax,
            "sanctions": self.sanctions,
        }
        names = " and ".join(name for name, strength in laws.items() if strength)
        growth = f", growth {self.regrowth:g}" if self.regrowth != 1 else ""
        return f"{self.agents} agents, {names or 'no rule'}{growth}, sight {self.sight}"

    def game(self) -> Game:
        """Return the game of the recipe."""
        namespace: dict[str, Any] = {"__name__": "sandbox"}
        exec(self.recipe(), namespace)
        game: Game = namespace["game"]()
        return game


class SupersededError(Exception):
    """A request that a later one has replaced."""


class Sandbox:
    """Serves the page on 127.0.0.1 until `close`; trains one population at a time.

    Args:
        folder: where runs are written; by default a temporary one.
        port: of the page; 0 for any that is free.
        episodes: of a training.
    """

    def __init__(self, folder: Path | None = None, *, port: int = 0, episodes: int = EPISODES) -> None:
        self._temporary = TemporaryDirectory()
        self.folder = Path(self._temporary.name) if folder is None else folder
        self.episodes = checked("episodes", episodes, Positive)
        self._playing = Lock()
        self._changing = Lock()
        """Guards the counter of requests, and the training."""
        self._asked = 0
        """The number of requests for an episode so far."""
        self._training: tuple[Path, subprocess.Popen[bytes]] | None = None
        self._trained: Path | None = None
        """The last training that finished."""
        self._learned_under: dict[Path, str] = {}
        """A description of the rules of each training."""
        self.server = ThreadingHTTPServer(("127.0.0.1", port), partial(_Handler, self))
        self.address = f"http://127.0.0.1:{self.server.server_port}/"

    def close(self) -> None:
        """End a training that runs, and stop serving."""
        with self._changing:
            if self._training is not None:
                _, process = self._training
                process.terminate()
                process.wait()
        self.server.server_close()
        self._temporary.cleanup()

    def play(self, sliders: Sliders, *, trained: bool) -> dict[str, Any]:
        """Return the data of `show.html` about an episode of scripted agents, and beside it of trained ones.

        Raises a SupersededError, and plays nothing, where another question has come while it waited.
        """
        with self._changing:
            self._asked += 1
            number = self._asked
        with self._playing:
            if number != self._asked:
                raise SupersededError("a later question is answered instead")
            game = sliders.game()
            greedy = min(sliders.greedy, sliders.agents)
            others = game.agents - greedy
            agents = (Scripted("greedy"),) * greedy + (Scripted("sustainable"),) * others
            runs: dict[str, LoadedRun] = {f"{greedy} greedy, {others} restrained": _unstored(game, agents)}
            if trained and self._trained is not None:
                runs[f"Trained with {self._learned_under[self._trained]}"] = load(self._trained)
            data, _ = data_of(fresh_episodes(list(runs.values()), replica=0, episode=0), list(runs))
        data["populations"][0]["which"] = ""  # scripted agents have no replicas to choose from
        return data

    def train(self, sliders: Sliders) -> None:
        """Begin to train; raise a ValueError while a training runs."""
        with self._changing:
            if self.state()["state"] == "training":
                raise ValueError("a training runs; wait until it has ended")
            self.folder.mkdir(parents=True, exist_ok=True)
            names = (self.folder / f"sandbox-{number}" for number in count(1))
            run = next(name for name in names if not name.with_suffix(".py").exists())
            recipe = run.with_suffix(".py")
            recipe.write_text(sliders.recipe(self.episodes), encoding="utf-8")
            with run.with_suffix(".log").open("wb") as log:
                command = [sys.executable, str(recipe), "--watch", "off", "--out", str(run)]
                process = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)
            self._learned_under[run] = sliders.rules
            self._training = run, process

    def state(self) -> dict[str, str]:
        """Return the state of the training, "none", "training", "trained" or "failed", and its last line."""
        if self._training is None:
            return {"state": "none", "line": ""}
        run, process = self._training
        lines = run.with_suffix(".log").read_text(encoding="utf-8", errors="replace").split("\n")
        line = next((text.strip() for text in reversed(lines) if text.strip()), "it begins")
        code = process.poll()
        if code is None:
            return {"state": "training", "line": line}
        if code == 0:
            self._trained = run
        return {"state": "failed" if code else "trained", "line": line}


def _unstored(game: Game, agents: Sequence[AgentSpec]) -> LoadedRun:
    """Return a run of scripted agents that exists only in memory, and is played like a stored run."""
    experiment = Experiment(name="scripted", game=game, agents=tuple(agents), episodes=1, replicas=1)
    nowhere = Path(experiment.name)
    return LoadedRun(
        path=nowhere,
        experiment=experiment,
        recipe={},
        networks={},
        weights_from=nowhere,
        transforms_state={},
    )


class _Handler(BaseHTTPRequestHandler):
    """Answers the requests of our own page, and refuses those of other pages."""

    def __init__(self, sandbox: Sandbox, *arguments: Any) -> None:
        self._sandbox = sandbox
        super().__init__(*arguments)

    def do_GET(self) -> None:
        self._answer("/", "/data", "/recipe", "/state")

    def do_POST(self) -> None:
        self._answer("/train")

    def _answer(self, *paths: str) -> None:
        """Answer a request of our own page for one of the paths; refuse all others."""
        port = self._sandbox.server.server_port
        ours = {f"127.0.0.1:{port}", f"localhost:{port}"}
        origin = self.headers.get("Origin")
        is_ours = self.headers.get("Host") in ours and origin in (None, *(f"http://{host}" for host in ours))
        address = urlsplit(self.path)
        if not is_ours or address.path not in paths:
            status = HTTPStatus.NOT_FOUND if is_ours else HTTPStatus.FORBIDDEN
            self._send("not here", "text/plain", status)
            return
        query = dict(parse_qsl(address.query))
        trained = query.pop("trained", "") == "yes"
        try:
            text, kind = self._content(address.path, Sliders.of(query), trained=trained)
            self._send(text, kind, HTTPStatus.OK)
        except ValueError as error:
            self._send(str(error), "text/plain", HTTPStatus.BAD_REQUEST)
        except SupersededError as error:
            self._send(str(error), "text/plain", HTTPStatus.CONFLICT)

    def _content(self, path: str, sliders: Sliders, *, trained: bool) -> tuple[str, str]:
        """Return the answer to a request, and its content type."""
        if path == "/":
            return sandbox_page(), "text/html"
        if path == "/data":
            return json.dumps(self._sandbox.play(sliders, trained=trained)), "application/json"
        if path == "/recipe":
            return sliders.recipe(self._sandbox.episodes), "text/plain"
        if path == "/train":
            self._sandbox.train(sliders)
        return json.dumps(self._sandbox.state()), "application/json"

    def _send(self, text: str, kind: str, status: HTTPStatus) -> None:
        content = text.encode()
        with suppress(ConnectionError):  # of a browser that has left
            self.send_response(status)
            self.send_header("Content-Type", f"{kind}; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

    def log_message(self, *arguments: Any) -> None:
        """Do not log requests."""


def sandbox_page() -> str:
    """Return the page, without an episode yet."""
    boards = "".join(f"<option>{board}</option>" for board in get_args(_Board))
    sliders = "".join(
        _slider(name, label, step)
        for name, (label, step) in {
            "agents": ("agents", 1),
            "greedy": ("of them greedy; the others restrained", 1),
            "regrowth": ("apples grow, times as fast", 0.25),
            "sight": ("cells that agents see ahead", 1),
            "quota": ("quota, share of a sustainable harvest", 0.05),
            "tax": (f"tax, shared equally; {FOR_TRAINED}", 0.05),
            "sanctions": (f"sanctions for tagging; {FOR_TRAINED}", 1),
        }.items()
    )
    before = (
        "<p>Move a slider: an episode is played by your rules. The first quota, tax or sanction is compiled, "
        "for 10 to 20 seconds, once. Scripted agents do not mind what rules cost them; agents that are "
        "trained do.</p>"
        f'<div class="controls"><label>board <select name="board">{boards}</select></label>{sliders}</div>'
        '<button id="train">Train these</button> <button id="recipe">Copy as recipe</button> '
        '<span id="said" class="faint" role="status"></span><p id="results" role="status"></p>'
    )
    script = files("cprl.experimental").joinpath("sandbox.js").read_text(encoding="utf-8")
    return page("A commons to play with", before, live=script)


def _slider(name: str, label: str, step: float) -> str:
    """Return a slider over the range of a field of `Sliders`."""
    (bounds,) = hints_of(Sliders)[name].__metadata__
    return (
        f'<label>{escape(label)} <span></span><input type="range" name="{name}" min="{bounds.low}" '
        f'max="{bounds.high}" step="{step}" value="{getattr(Sliders(), name)}"></label>'
    )
