"""Shows episodes of stored agents side by side on one HTML page, which opens from the disk without a network.

This module collects the data; `static/show.js` is what draws them.
"""

import zlib
from base64 import b64encode
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from cprl import keys
from cprl.commons.game import Game
from cprl.evaluation.film import check_beside, titles_of
from cprl.evaluation.fresh import FreshEpisode, Recorded, fresh_episodes, print_descriptions, record
from cprl.evaluation.populations import commons_game
from cprl.measuring.social import equality
from cprl.measuring.tracker import Episode
from cprl.pictures.colours import line_colour
from cprl.pictures.readable import NO_RULES, growth_of, legend_of, meaning_of, rules_of
from cprl.population import has_people, learned
from cprl.runs.files import refuse_to_write_over, write_text
from cprl.system.working import working
from cprl.training.stored import LoadedRun
from cprl.values import refusal
from cprl.web.scenes import compact_json, moment_json, scene_json
from cprl.web.static_pages import page_of

_MOST_RUNS: Final = 6
"""The largest number of runs on a page."""


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

    The episode is the one that `cprl.evaluation.film.record_episode` records with the same numbers, by
    default a typical one, see `cprl.evaluation.fresh`. The page says which one it is.

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
    check_beside(runs, tuple(titles), most=_MOST_RUNS)
    if out is not None:
        Page(out).refuse()
    episodes = fresh_episodes(runs, replica=replica, episode=episode, seed=seed)
    default_path = Path(run) / f"show-{episodes[0].replica}-{episodes[0].episode}.html"
    path = Page(out or default_path)
    path.refuse()
    print_descriptions(episodes)
    data, played_episodes = data_of(episodes, titles)
    path.write(page(_heading(episodes, data), begins(commons_game(episodes[0].run)), data))
    return path, played_episodes


def begins(game: Game) -> str:
    """Return the paragraph above the episodes, which says how apples grow, as HTML."""
    return f"<p>{escape(growth_of(game))}</p>"


def _heading(episodes: Sequence[FreshEpisode], data: dict[str, Any]) -> str:
    """Return the title of a page: that of its single run, or how the agents and rules of its runs differ."""
    if len(episodes) == 1:
        return str(data["populations"][0]["title"])
    runs = [episode.run for episode in episodes]
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


def page(title: str, before: str, data: dict[str, Any] | None = None, after: str = "") -> str:
    """Return the text of a page.

    Args:
        title: the title of the page.
        before: HTML above the episode.
        data: the episode, as `data_of` returns it; None for a page without an episode.
        after: HTML below the episode.
    """
    encoded = compact_json(data or {"populations": []}).replace("<", "\\u003c")
    parts = {"title": escape(title), "before": before, "after": after, "data": encoded}
    return page_of("show.html", "board.js", "show.js", **parts)


def data_of(
    episodes: Sequence[FreshEpisode], titles: Sequence[str] = ()
) -> tuple[dict[str, Any], tuple[Episode, ...]]:
    """Play the episodes; return the data that `show.js` draws, and the episodes."""
    games = [commons_game(episode.run) for episode in episodes]
    recorded = [record(episode) for episode in episodes]
    populations = zip(titles or titles_of(episodes), episodes, recorded, strict=True)
    return {
        "populations": [_population(*population) for population in populations],
        "axis": max(played.last_turn for played in recorded),
        "most": max(int(played.boards[-1].harvested.max()) for played in recorded),
        "legend": legend_of(games),
    }, tuple(played.episode for played in recorded)


def _population(title: str, episode: FreshEpisode, played: Recorded) -> dict[str, Any]:
    """Return the data about one run's agents, in the form that `show.js` reads.

    `data` is what changes from turn to turn: JSON, compressed by zlib and encoded in base64.
    """
    game = commons_game(episode.run)
    moments = [
        {
            "harvest": world.harvested.tolist(),
            "stock": int(world.stock.sum()),
            "board": moment_json(game.map, world, broken),
        }
        for world, broken in zip(played.boards, played.violated, strict=True)
    ]
    shares = equality(np.stack([world.harvested for world in played.boards]))
    changing = {
        "moments": moments,
        "equality": [None if np.isnan(share) else round(float(share), 3) for share in shares],
    }
    counted = ["apples on the board", "picked by all", "how evenly shared (1: all alike)"]
    fines = played.since_the_start("next", *keys.FINES).sum(1).cumsum()
    if fines.any() or any(institution.can_be_broken for institution in game.institutions):
        changing["fined"] = fines.round(3).tolist()
        counted.append("apples paid as fines")
    outcome = f"apples still grow after {played.last_turn:,} turns"
    if played.is_dead:
        outcome = f"gone for good at turn {played.last_turn:,}: no apple is left"
    return {
        "title": title,
        "which": episode.description,
        "about": about(episode.run),
        "outcome": outcome,
        "isDead": played.is_dead,
        "counted": counted,
        "lines": [line_colour(agent) for agent in range(game.agents)],
        **scene_json(game),
        "data": b64encode(zlib.compress(compact_json(changing).encode(), 9)).decode("ascii"),
    }


def about(run: LoadedRun) -> str:
    """Return sentences about a run's agents and rules for readers who know nothing of learning agents."""
    game = commons_game(run)
    experiment = run.experiment
    agents = learned(run.specs)
    if run.networks:
        sentences = [f"Computer players that learned by practice: {agents}, {experiment.trained_for}."]
    else:
        players = "Players" if has_people(run.specs) else "Computer players"
        sentences = [f"{players}: {agents}."]
    sentences += [meaning_of(kind, game) for kind in game.institutions]
    if game.institutions:
        sentences.append(f"Settings: {rules_of(game)}.")
    elif not experiment.custom_rules:
        sentences.append(f"Rules: {NO_RULES}.")
    return " ".join([*sentences, experiment.custom_code]).strip()
