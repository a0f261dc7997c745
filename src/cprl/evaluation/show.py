"""One HTML page that shows episodes of stored agents side by side: it opens from the disk, without a network.

`show.html`, beside this module, draws what is handed to it here.
"""

import json
import re
import zlib
from base64 import b64encode
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl import keys
from cprl.commons.cells import APPLE, BEAM, CLEANING, WALL, WASTE, WATER
from cprl.commons.game import Game
from cprl.commons.maps import Map
from cprl.envs.unwrap import commons_of
from cprl.evaluation.film import check_titles, titles_of
from cprl.evaluation.fresh import FreshEpisode, Recorded, fresh_episodes, record, say_which
from cprl.evaluation.lanes import commons_game
from cprl.measuring.episodes import Episode
from cprl.measuring.social import equality
from cprl.pictures.colours import GREY, PALETTE, agent_colour, agent_mark, line_colour
from cprl.pictures.image import EMPTY_SITE_COLOUR
from cprl.pictures.readable import NO_RULES, growth_of, legend_of, meaning_of, rules_of
from cprl.population import learned
from cprl.runs.files import refuse_to_write_over, write_atomically
from cprl.system.working import working
from cprl.training.stored import LoadedRun
from cprl.values import refusal
from cprl.viewer.pictures import regions_of

MOST_RUNS: Final = 6
_COLOURS: Final = {
    **{name: PALETTE[kind] for name, kind in (("wall", WALL), ("apple", APPLE), ("beam", BEAM))},
    **{name: PALETTE[kind] for name, kind in (("water", WATER), ("waste", WASTE), ("cleaning", CLEANING))},
    "empty": EMPTY_SITE_COLOUR,
}
_IN_PLAY: Final = 4
_VIOLATED: Final = 8
"""Bits of a pose, beside the heading of 0 to 3."""


@working("making a page")
def show(
    run: str | Path,
    out: str | Path | None = None,
    *,
    beside: Sequence[str | Path] = (),
    titles: Sequence[str] = (),
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
) -> tuple["Page", tuple[Episode, ...]]:
    """Show an episode of a run's agents, beside the agents of other runs if there are any, as one HTML page.

    It is the episode that `cprl.evaluation.film.film` records with the same numbers, by default a typical
    one, see `cprl.evaluation.fresh`; which one it is stands on the page.

    Args:
        out: the page, an .html, complete or absent; by default `show-<replica>-<episode>.html` in the
            directory of the first run.
        beside: at most five more runs. Games may differ; where they do not, all play the same fresh world.
        titles: one for each run; by default what `cprl.evaluation.film.Style` says.

    Returns:
        The page, which a notebook shows, and the episode of each run.

    Raises:
        FileExistsError: if the page exists.
    """
    runs = (run, *beside)
    if len(runs) > MOST_RUNS:
        raise refusal("beside", f"{len(runs) - 1} runs", f"at most {MOST_RUNS - 1}")
    check_titles(tuple(titles), len(runs))
    if out is not None:
        Page(out).refuse()
    fresh = fresh_episodes(runs, replica=replica, episode=episode, seed=seed)
    by_default = Path(run) / f"show-{fresh[0].replica}-{fresh[0].episode}.html"
    path = Page(by_default if out is None else out)
    path.refuse()
    say_which(fresh)
    data, episodes = data_of(fresh, titles)
    path.write(page(_heading(fresh, data), begins(commons_game(fresh[0].run)), data))
    return path, tuple(episodes)


def begins(game: Game) -> str:
    """Return what a page says above its episodes, as HTML."""
    return f"<p>{escape(growth_of(game))}</p>"


def _heading(fresh: Sequence[FreshEpisode], data: dict[str, Any]) -> str:
    """Return the title of the population, or what differs between several."""
    if len(fresh) == 1:
        return str(data["populations"][0]["title"])
    runs = [population.run for population in fresh]
    agents = {learned(run.specs) for run in runs}
    rules = {(run.game.rules, run.game.institutions, run.experiment.own_rules) for run in runs}
    alike = "Same" if len(agents) == 1 else "Different"
    who = "learners" if all(run.networks for run in runs) else "agents"
    return f"{alike} {who}, {'the same rules' if len(rules) == 1 else 'different rules'}"


class Page(type(Path())):  # type: ignore[misc]
    """The path of a page, which draws itself in a notebook."""

    HEIGHT = 900
    """Pixels in a notebook."""

    def refuse(self) -> None:
        """Refuse names of other files than pages, and to write over one."""
        if self.suffix != ".html":
            raise refusal("out", str(self), "a file whose name ends in .html")
        refuse_to_write_over(self)

    def write(self, text: str) -> None:
        """Write the page, complete or not at all."""
        self.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self, lambda file: file.write(text.encode("utf-8", "replace")))

    def _repr_html_(self) -> str:
        text = escape(self.read_text(encoding="utf-8"))
        return f'<iframe srcdoc="{text}" style="width:100%;height:{self.HEIGHT}px;border:0"></iframe>'


def page(
    title: str, before: str, data: dict[str, Any] | None = None, after: str = "", *, live: str = ""
) -> str:
    """Return the text of a page.

    Args:
        before, after: HTML above and below the episode.
        data: of `data_of`; None to show no episode.
        live: JavaScript that runs after the page's own.
    """
    template = files("cprl.evaluation").joinpath("show.html").read_text(encoding="utf-8")
    encoded = json.dumps(data or {"populations": []}, separators=(",", ":")).replace("<", "\\u003c")
    parts = {"title": escape(title), "before": before, "after": after, "data": encoded, "live": live}
    return re.sub(r"\$(title|before|after|data|live)\b", lambda name: parts[name[1]], template)


def data_of(
    fresh: Sequence[FreshEpisode], titles: Sequence[str] = ()
) -> tuple[dict[str, Any], Sequence[Episode]]:
    """Play the episodes of these populations; return the data of `show.html` about them, and the episodes."""
    games = [commons_game(population.run) for population in fresh]
    recorded = [record(population) for population in fresh]
    each = zip(titles or titles_of(fresh), fresh, recorded, strict=True)
    return {
        "populations": [_population(*one) for one in each],
        "palette": _COLOURS,
        "axis": max(played.last for played in recorded),
        "most": max(int(played.boards[-1].harvested.max()) for played in recorded),
        "legend": legend_of(games),
    }, [played.episode for played in recorded]


def _population(title: str, fresh: FreshEpisode, played: Recorded) -> dict[str, Any]:
    """Return what the page shows of a population."""
    game = commons_game(fresh.run)
    board = game.map
    agents = range(game.agents)
    commons = commons_of(fresh.env)
    assert commons is not None
    arrays = _turns(board, played)
    counted = ["apples on the board", "picked by all", "how evenly shared (1: all alike)"]
    fines = played.since_the_start("next", *keys.FINES).sum(1).cumsum()
    if fines.any() or any(institution.can_be_broken for institution in game.institutions):
        arrays["fined"] = fines.astype(np.float32)
        counted.append("apples paid as fines")
    outcome = f"apples still grow after {played.last:,} turns"
    if played.is_dead:
        outcome = f"gone for good at turn {played.last:,}: no apple is left"
    regions = [
        {
            "colour": agent_colour(owners[0]) if len(owners) == 1 else GREY,
            "cells": np.flatnonzero(inside).tolist(),
        }
        for owners, inside in regions_of(commons)
    ]
    return {
        "title": title,
        "which": fresh.words,
        "about": about(fresh.run),
        "outcome": outcome,
        "isDead": played.is_dead,
        "counted": counted,
        "turns": played.last + 1,
        "agents": game.agents,
        "width": board.width,
        "height": board.height,
        "walls": _cells(board, board.walls),
        "river": _cells(board, board.river),
        "sites": _cells(board, board.sites),
        "regions": regions,
        "colours": [agent_colour(agent) for agent in agents],
        "lines": [line_colour(agent) for agent in agents],
        "marks": [agent_mark(agent) for agent in agents],
        **_packed(arrays),
    }


def about(run: LoadedRun) -> str:
    """Say who plays, under which rules, in sentences."""
    return f"{_players(run)} {_rules(run)}"


def _players(run: LoadedRun) -> str:
    """Say who plays, for readers who do not know what a learner is."""
    who = learned(run.specs)
    if not run.networks:
        return f"Computer players: {who}."
    return f"Computer players that learned by practice: {who}, {run.experiment.trained_for}."


def _rules(run: LoadedRun) -> str:
    game = commons_game(run)
    experiment = run.experiment
    words = [meaning_of(kind, game) for kind in game.institutions]
    if game.institutions:
        words.append(f"Settings: {rules_of(game)}.")
    elif not experiment.own_rules:
        words.append(f"Rules: {NO_RULES}.")
    return " ".join([*words, experiment.own_code]).strip()


def _cells(board: Map, places: Sequence[Sequence[int]]) -> list[int]:
    """Return the indices of cells, row by row."""
    return [row * board.width + col for row, col, *_ in places]


def _turns(board: Map, played: Recorded) -> dict[str, NDArray[Any]]:
    """Return what changes from turn to turn: arrays [turns, ...], bits packed.

    `beams` has the cells of all turns one after the other, those of turn t from `beam_first[t]` on and before
    `beam_first[t + 1]`; the number of cells is added to those of a beam that cleans.
    """

    def of_all(name: str) -> NDArray[Any]:
        return np.stack([getattr(one, name) for one in played.boards])

    harvested = of_all("harvested")
    stock = of_all("stock")
    boards = of_all("board").reshape(len(stock), -1)
    is_violated = played.since_the_start("next", *keys.VIOLATED) > 0
    pose = of_all("heading") + _IN_PLAY * of_all("in_play") + _VIOLATED * is_violated
    turns, lit = np.nonzero(np.concatenate([boards == BEAM, boards == CLEANING], 1))
    return {
        "stock": np.packbits(stock, axis=1),
        "waste": np.packbits(boards[:, _cells(board, board.river)] == WASTE, axis=1),
        "stocked": stock.sum(1, dtype=np.uint32),
        "cell": (of_all("row") * board.width + of_all("col")).astype(np.uint32),
        "pose": pose.astype(np.uint8),
        "harvested": harvested.astype(np.uint32),
        "equality": equality(harvested).astype(np.float32),
        "beam_first": np.searchsorted(turns, np.arange(len(stock) + 1)).astype(np.uint32),
        "beams": lit.astype(np.uint32),
    }


def _packed(arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return arrays one after the other as deflated bytes, and the name, type and length of each."""
    raw = b"".join(values.astype(values.dtype.newbyteorder("<")).tobytes() for values in arrays.values())
    lengths = [
        (name, f"{values.dtype.kind}{values.itemsize}", values.size) for name, values in arrays.items()
    ]
    return {"arrays": lengths, "data": b64encode(zlib.compress(raw, 9)).decode("ascii")}
