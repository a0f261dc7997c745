"""Shows episodes of stored agents side by side on one HTML page, which opens from the disk without a network.

This module collects the data; `show.html`, beside it, is the page that draws them.
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
from cprl.evaluation.fresh import FreshEpisode, Recorded, fresh_episodes, print_descriptions, record
from cprl.evaluation.populations import commons_game
from cprl.measuring.social import equality
from cprl.measuring.tracker import Episode
from cprl.pictures.colours import GREY, PALETTE, agent_colour, agent_mark, line_colour
from cprl.pictures.image import EMPTY_SITE_COLOUR
from cprl.pictures.readable import NO_RULES, growth_of, legend_of, meaning_of, rules_of
from cprl.population import learned
from cprl.runs.files import refuse_to_write_over, write_text
from cprl.system.working import working
from cprl.training.stored import LoadedRun
from cprl.values import refusal
from cprl.viewer.pictures import regions_of

_MOST_RUNS: Final = 6
"""The largest number of runs on a page."""
_COLOURS: Final = {
    "wall": PALETTE[WALL],
    "apple": PALETTE[APPLE],
    "beam": PALETTE[BEAM],
    "water": PALETTE[WATER],
    "waste": PALETTE[WASTE],
    "cleaning": PALETTE[CLEANING],
    "empty": EMPTY_SITE_COLOUR,
}
_IN_PLAY: Final = 4
"""The bit of an agent's pose that says that it is in play. The two lowest bits are its heading, 0 to 3."""
_VIOLATED: Final = 8
"""The bit of an agent's pose that says that it broke a rule in the turn."""


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
    """Show an episode of a run's agents as an HTML page, beside the agents of other runs if any are given.

    The episode is the one that `cprl.evaluation.film.film` records with the same numbers, by default a
    typical one, see `cprl.evaluation.fresh`. The page says which one it is.

    Args:
        run: the run's directory.
        out: the page, an .html file; by default `show-<replica>-<episode>.html` in the directory of the first
            run. It is written completely or not at all.
        beside: at most five further runs. Runs of the same game play in the same fresh world.
        titles: a title for each run; for the default see `cprl.evaluation.film.Style`.
        replica: the number of the replica.
        episode: the number of the episode.
        seed: the seed of the worlds and of all random choices.

    Returns:
        The page, which a notebook displays, and the episode of each run.

    Raises:
        FileExistsError: if the page exists.
    """
    runs = (run, *beside)
    if len(runs) > _MOST_RUNS:
        raise refusal("beside", f"{len(runs) - 1} runs", f"at most {_MOST_RUNS - 1}")
    check_titles(tuple(titles), len(runs))
    if out is not None:
        Page(out).refuse()
    fresh = fresh_episodes(runs, replica=replica, episode=episode, seed=seed)
    default_path = Path(run) / f"show-{fresh[0].replica}-{fresh[0].episode}.html"
    path = Page(out or default_path)
    path.refuse()
    print_descriptions(fresh)
    data, episodes = data_of(fresh, titles)
    path.write(page(_heading(fresh, data), begins(commons_game(fresh[0].run)), data))
    return path, episodes


def begins(game: Game) -> str:
    """Return the paragraph above the episodes, which says how apples grow, as HTML."""
    return f"<p>{escape(growth_of(game))}</p>"


def _heading(fresh: Sequence[FreshEpisode], data: dict[str, Any]) -> str:
    """Return the title of a page: that of its single run, or how the agents and rules of its runs differ."""
    if len(fresh) == 1:
        return str(data["populations"][0]["title"])
    runs = [population.run for population in fresh]
    agents = {learned(run.specs) for run in runs}
    rules = {(run.game.rules, run.game.institutions, run.experiment.custom_rules) for run in runs}
    adjective = "Same" if len(agents) == 1 else "Different"
    agents_text = "learners" if all(run.networks for run in runs) else "agents"
    rules_text = "the same rules" if len(rules) == 1 else "different rules"
    return f"{adjective} {agents_text}, {rules_text}"


class Page(type(Path())):  # type: ignore[misc]
    """The path of a page. A notebook displays the page itself."""

    HEIGHT = 900
    """The height of the page in a notebook, in pixels."""

    def refuse(self) -> None:
        """Refuse a path that does not end in .html, or that exists."""
        if self.suffix != ".html":
            raise refusal("out", str(self), "a file whose name ends in .html")
        refuse_to_write_over(self)

    def write(self, text: str) -> None:
        """Write the page, complete or not at all."""
        self.parent.mkdir(parents=True, exist_ok=True)
        write_text(self, text)

    def _repr_html_(self) -> str:
        text = escape(self.read_text(encoding="utf-8"))
        return f'<iframe srcdoc="{text}" style="width:100%;height:{self.HEIGHT}px;border:0"></iframe>'


def page(
    title: str, before: str, data: dict[str, Any] | None = None, after: str = "", *, live: str = ""
) -> str:
    """Return the text of a page.

    Args:
        title: the title of the page.
        before: HTML above the episode.
        data: the episode, as `data_of` returns it; None for a page without an episode.
        after: HTML below the episode.
        live: JavaScript that runs after that of the page.
    """
    template = files("cprl.evaluation").joinpath("show.html").read_text(encoding="utf-8")
    encoded = json.dumps(data or {"populations": []}, separators=(",", ":")).replace("<", "\\u003c")
    parts = {"title": escape(title), "before": before, "after": after, "data": encoded, "live": live}
    return re.sub(r"\$(title|before|after|data|live)\b", lambda name: parts[name[1]], template)


def data_of(
    fresh: Sequence[FreshEpisode], titles: Sequence[str] = ()
) -> tuple[dict[str, Any], tuple[Episode, ...]]:
    """Play the episodes; return the data that `show.html` draws, and the episodes."""
    games = [commons_game(population.run) for population in fresh]
    recorded = [record(population) for population in fresh]
    populations = zip(titles or titles_of(fresh), fresh, recorded, strict=True)
    return {
        "populations": [_population(*population) for population in populations],
        "palette": _COLOURS,
        "axis": max(played.last for played in recorded),
        "most": max(int(played.boards[-1].harvested.max()) for played in recorded),
        "legend": legend_of(games),
    }, tuple(played.episode for played in recorded)


def _population(title: str, fresh: FreshEpisode, played: Recorded) -> dict[str, Any]:
    """Return the data about one run's agents, in the form that `show.html` reads."""
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
        "which": fresh.description,
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
    """Return sentences about a run's agents and rules for readers who know nothing of learning agents."""
    game = commons_game(run)
    experiment = run.experiment
    agents = learned(run.specs)
    if run.networks:
        sentences = [f"Computer players that learned by practice: {agents}, {experiment.trained_for}."]
    else:
        sentences = [f"Computer players: {agents}."]
    sentences += [meaning_of(kind, game) for kind in game.institutions]
    if game.institutions:
        sentences.append(f"Settings: {rules_of(game)}.")
    elif not experiment.custom_rules:
        sentences.append(f"Rules: {NO_RULES}.")
    return " ".join([*sentences, experiment.custom_code]).strip()


def _cells(board: Map, positions: Sequence[Sequence[int]]) -> list[int]:
    """Return the indices of cells, counted row by row, from positions that begin with (row, col)."""
    return [row * board.width + col for row, col, *_ in positions]


def _turns(board: Map, played: Recorded) -> dict[str, NDArray[Any]]:
    """Return the data that change from turn to turn as arrays [turns, ...]; bits are packed into bytes.

    `beams` has the indices of the cells that a beam lights, of all turns one after the other. Those of turn t
    are `beams[beam_first[t] : beam_first[t + 1]]`. To the index of a cell that is being cleaned the number of
    cells of the board is added.
    """

    def stacked(name: str) -> NDArray[Any]:
        return np.stack([getattr(board_in_turn, name) for board_in_turn in played.boards])

    harvested = stacked("harvested")
    stock = stacked("stock")
    boards = stacked("board").reshape(len(stock), -1)
    is_violated = played.since_the_start("next", *keys.VIOLATED) > 0
    pose = stacked("heading") + _IN_PLAY * stacked("in_play") + _VIOLATED * is_violated
    turns, lit = np.nonzero(np.concatenate([boards == BEAM, boards == CLEANING], 1))
    return {
        "stock": np.packbits(stock, axis=1),
        "waste": np.packbits(boards[:, _cells(board, board.river)] == WASTE, axis=1),
        "stocked": stock.sum(1, dtype=np.uint32),
        "cell": (stacked("row") * board.width + stacked("col")).astype(np.uint32),
        "pose": pose.astype(np.uint8),
        "harvested": harvested.astype(np.uint32),
        "equality": equality(harvested).astype(np.float32),
        "beam_first": np.searchsorted(turns, np.arange(len(stock) + 1)).astype(np.uint32),
        "beams": lit.astype(np.uint32),
    }


def _packed(arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return arrays joined and compressed for JSON, with the name, the type and the length of each.

    The bytes are little-endian, compressed by zlib and encoded in base64.
    """
    raw = b"".join(values.astype(values.dtype.newbyteorder("<")).tobytes() for values in arrays.values())
    lengths = [
        (name, f"{values.dtype.kind}{values.itemsize}", values.size) for name, values in arrays.items()
    ]
    return {"arrays": lengths, "data": b64encode(zlib.compress(raw, 9)).decode("ascii")}
