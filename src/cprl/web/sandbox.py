"""Serve the page of `cprl.web.explorable` with what needs Python beside it: boards and rules of one's choice,
trainings, recipes.

Scripted agents play in the page. What is played and trained is the recipe that the page hands out.
"""

import asyncio
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Annotated, Any, Final, Self

from cprl.commons import maps
from cprl.commons.game import Game
from cprl.commons.named_games import Board, game as published_game
from cprl.evaluation.fresh import averages_of, fresh_episodes
from cprl.institutions import Quota
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.runs.curves import curves_of
from cprl.system.defaults import SANDBOX_EPISODES
from cprl.training.stored import load
from cprl.values import Positive, Range, Value, Where, build, checked
from cprl.web.explorable import SCRIPTS, grown, parts
from cprl.web.messages import read_object
from cprl.web.playable import playable
from cprl.web.scenes import scene_json
from cprl.web.serving import body_of, page_route, serving, web
from cprl.web.show import data_of
from cprl.web.static_pages import page_of, static_text

_MOST_BYTES: Final = 4096
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
    board = {map}
    return replace(base, map=maps.with_agents(board, {agents}), rules=rules, institutions=laws)


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

    board: Board = "commons"
    drawing: Annotated[str, Where(lambda text: len(text) < _MOST_BYTES, "a drawing of a board")] = ""
    """A board of one's own, as `cprl.maps.parse` reads it; "" for the published one."""
    agents: Annotated[int, Range(1, 12)] = 4
    regrowth: Annotated[float, Range(0, 5)] = 1.0
    """The factor of the board's probabilities that apples grow."""
    sight: Annotated[int, Range(3, 15)] = 7
    """The number of cells that agents see ahead, and as many to each side."""
    quota: Annotated[float, Range(0, 1)] = 0.0
    """The share of what the board can bear, of each agent in 50 turns, see `Quota`; 0 for no quota."""
    tax: Annotated[float, Range(0, 1)] = 0.0
    """The share of each harvest that is shared equally; 0 for none."""
    sanctions: Annotated[int, Range(0, 1)] = 0
    """1 where whoever tags others is sanctioned, more with each offence."""

    @classmethod
    def read(cls, text: str) -> Self:
        """Read the body of a request; raise a ValueError that names what is wrong."""
        return build(cls, read_object(text, _MOST_BYTES), "sliders")

    def recipe(self, episodes: int = SANDBOX_EPISODES) -> str:
        """Return the recipe of the game, with agents that learn."""
        base = published_game(self.board)
        laws = {
            f"institutions.Quota(share={self.quota!r}, window_steps=50)": self.quota,
            f'institutions.Tax(rate={self.tax!r}, redistribution="equal")': self.tax,
            'institutions.GraduatedSanctions(on="tags")': self.sanctions,
        }
        # drawn anew from what was read, so that nothing but signs of cells gets into the code
        drawing = maps.parse(self.drawing).drawing() if self.drawing else ""
        rows = drawing.replace("\n", "\n        ")
        return _RECIPE.format(
            board=self.board,
            regrow_prob=grown(base, self.regrowth).rules.regrow_prob,
            sight=self.sight,
            columns=2 * self.sight + 1,
            laws="".join(f"{law}, " for law, strength in laws.items() if strength).rstrip(),
            map=f'maps.parse("""\n        {rows}\n    """)' if drawing else "base.map",
            agents=self.agents,
            episodes=episodes,
        )

    def game(self) -> Game:
        """Return the game of the recipe."""
        namespace: dict[str, Any] = {"__name__": "sandbox"}
        exec(self.recipe(), namespace)
        game: Game = namespace["game"]()
        return game

    def trial(self) -> dict[str, Any]:
        """Return what scripted agents play on the page: they neither fire nor mind what rules cost them."""
        game = self.game()
        quotas = tuple(rule for rule in game.institutions if isinstance(rule, Quota))
        played = replace(game, institutions=quotas)
        return {"scene": scene_json(game), "game": playable(played), "drawing": game.map.drawing()}


class Sandbox:
    """Answers the page, and trains one population at a time.

    Args:
        folder: where runs are written; by default a temporary one.
        episodes: of a training.
    """

    def __init__(self, folder: Path | None = None, *, episodes: int = SANDBOX_EPISODES) -> None:
        self._temporary = TemporaryDirectory()
        self.folder = folder or Path(self._temporary.name)
        self.episodes = checked("episodes", episodes, Positive)
        self._changing = Lock()
        """Guards the training."""
        self._training: tuple[Path, subprocess.Popen[bytes], Sliders] | None = None
        """Its directory, its process, and its settings."""

    def close(self) -> None:
        """End a training that runs."""
        with self._changing:
            if self._training is not None:
                _, process, _ = self._training
                process.terminate()
                process.wait()
        self._temporary.cleanup()

    def routes(self) -> list[web.RouteDef]:
        """Return the page, and what it asks for."""

        def answering(answer: Callable[[str], Any]) -> Any:
            """Return a handler that answers in JSON, and a ValueError in words."""

            async def handler(request: web.Request) -> web.StreamResponse:
                body = await body_of(request)
                try:
                    return web.json_response(await asyncio.to_thread(answer, body))
                except ValueError as error:
                    return web.Response(status=400, text=str(error))

            return handler

        return [
            page_route(sandbox_page()),
            web.post("/game", answering(lambda body: Sliders.read(body).trial())),
            web.post("/recipe", answering(lambda body: Sliders.read(body).recipe(self.episodes))),
            web.post("/train", answering(lambda body: self.train(Sliders.read(body)))),
            web.post("/state", answering(lambda _: self.state())),
            web.post("/trained", answering(lambda _: self.trained())),
        ]

    def train(self, sliders: Sliders) -> dict[str, Any]:
        """Begin to train, and return the state; raise a ValueError while a training runs."""
        with self._changing:
            if self.state()["state"] == "training":
                raise ValueError("a training runs; wait until it has ended")
            sliders.game()  # refuses what cannot be played before anything is written
            self.folder.mkdir(parents=True, exist_ok=True)
            names = (self.folder / f"sandbox-{number}" for number in count(1))
            run = next(name for name in names if not name.with_suffix(".py").exists())
            recipe = run.with_suffix(".py")
            recipe.write_text(sliders.recipe(self.episodes), encoding="utf-8")
            with run.with_suffix(".log").open("wb") as log:
                command = [sys.executable, str(recipe), "--watch", "off", "--out", str(run)]
                process = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)
            self._training = run, process, sliders
            return self.state()

    def state(self) -> dict[str, Any]:
        """Return the state of the training, "none", "training", "trained" or "failed", its settings, the last
        line that it printed, and its course: the apples of each episode so far."""
        if self._training is None:
            return {"state": "none"}
        run, process, sliders = self._training
        code = process.poll()
        lines = run.with_suffix(".log").read_text(encoding="utf-8", errors="replace").split("\n")
        line = next((text.strip() for text in reversed(lines) if text.strip()), "it begins")
        names = {None: "training", 0: "trained"}
        return {
            "state": names.get(code, "failed"),
            "sliders": vars(sliders),
            "line": line,
            "course": _course(run),
        }

    def trained(self) -> dict[str, Any]:
        """Return an episode of the trained agents, turn by turn, and their averages over fresh episodes.

        Raises:
            ValueError: if no agents are trained.
        """
        if self._training is None or self.state()["state"] != "trained":
            raise ValueError("no agents are trained; press Train these first")
        run = load(self._training[0])
        with self._changing:
            fresh = fresh_episodes([run], replica=0, episode=0)
            data, _ = data_of(fresh)
        turns, apples = averages_of(run)[0]
        return {**data["populations"][0], "turns": turns, "apples": apples}


def _course(run: Path) -> list[float]:
    """Return the apples of each episode of a training so far."""
    try:
        curves = curves_of(run)
    except (OSError, ValueError):  # it has not begun
        return []
    return list(curves[COLLECTIVE_RETURN][0]) if curves else []


def sandbox_page() -> str:
    """Return the page, with a sixth step for boards and rules of one's own."""
    step = static_text("sandbox.html")
    return page_of("explorable.html", *SCRIPTS, "sandbox.js", **{**parts(), "more": step})


async def serve_sandbox(sandbox: Sandbox, port: int, announce: Callable[[str], None]) -> None:
    """Serve the page on 127.0.0.1 until cancelled.

    Args:
        sandbox: what answers.
        port: of the page; 0 for any that is free.
        announce: called with its address.
    """
    async with serving(sandbox.routes(), ["127.0.0.1"], port) as [place]:
        announce(f"http://{place[0]}:{place[1]}/")
        await asyncio.Event().wait()
