"""Film an episode of the agents of stored runs: as a recording, or side by side as a GIF or an MP4."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from tensordict import TensorDictBase

from cprl import keys
from cprl.envs.unwrap import commons_of
from cprl.evaluation.film_pictures import (
    DEFAULT_WIDTH,
    LARGEST_WIDTH,
    SMALLEST_WIDTH,
    EpisodePicture,
    check_can_write_mp4,
    note,
    write_gif,
    write_mp4,
)
from cprl.evaluation.fresh import FreshEpisode, Recorded, fresh_episode, fresh_episodes, record, say_which
from cprl.evaluation.lanes import commons_game
from cprl.measuring.episodes import Episode, tracker_of
from cprl.measuring.evaluate import turns
from cprl.measuring.series import Observer
from cprl.pictures.readable import growth_of, in_lower_case, legend_of
from cprl.runs.files import refuse_to_write_over
from cprl.system.defaults import FILM_SUFFIXES as SUFFIXES
from cprl.system.output import legible
from cprl.system.working import working
from cprl.training.stored import LoadedRun
from cprl.values import Positive, Range, Value, Where, checked, refusal
from cprl.values.arrays import Bool, UInt8
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.replay import Decisions, Offences, events


@working("making a film")
def film(
    run: str | Path,
    out: str | Path | None = None,
    *,
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
) -> tuple[Path, Episode]:
    """Record an episode of a run's agents in a fresh world, with the exploration of evaluation; say which.

    Args:
        out: the recording, a .rrd, complete or absent; by default `film-<replica>-<episode>.rrd` in the run's
            directory.
        replica, episode: which fresh episode; by default a typical one, see `cprl.evaluation.fresh`. Equal
            numbers give equal episodes.
        seed: of the worlds and all chance. The world is that of `evaluate_run` with the same seed, of number
            replica x episodes + episode there; what agents draw is their own.

    Returns:
        The recording, and the episode.

    Raises:
        FileExistsError: if the recording exists.
    """
    if out is not None and Path(out).suffix != ".rrd":
        raise refusal("out", str(out), "a .rrd; film_video makes a .gif or an .mp4")
    if out is not None:
        refuse_to_write_over(Path(out))
    fresh = fresh_episode(run, replica=replica, episode=episode, seed=seed)
    which = f"{fresh.replica}-{fresh.episode}"
    target = Path(run) / f"film-{which}.rrd" if out is None else Path(out)
    refuse_to_write_over(target)
    say_which([fresh])
    target.parent.mkdir(parents=True, exist_ok=True)
    title = f"{legible(Path(run).name)}, agents of replica {fresh.replica}, fresh episode {fresh.episode}"
    try:
        return target, _recorded(fresh, target, title)
    except BaseException:  # a recording of half an episode would stand in the way of the next attempt
        target.unlink(missing_ok=True)
        raise


@working("playing an episode")
def _recorded(fresh: FreshEpisode, target: Path, title: str) -> Episode:
    env = fresh.env
    commons = commons_of(env)
    with ViewerCallback(
        target.parent,
        env,
        title=title,
        episodes=1,
        recipe=fresh.run.recipe,
        file_name=target.name,
        is_replay=True,
    ) as viewer:
        logger = viewer.logger
        scene = logger.scene
        views: list[Any] = [viewer]
        if scene is not None:
            views.append(Decisions(logger, scene, fresh.policies, actions=fresh.run.game.actions))
            if commons is not None and scene.has_institutions:
                views.append(Offences(logger, commons))
        observer = Observer(views, env)
        tracker = tracker_of(env)
        for step, batch in enumerate(turns(env, fresh.policies), start=1):
            observer.on_step(batch)
            for event in (*_tags_in(batch), *events(batch)):
                _log(viewer, step, event)
            for episode in tracker.add(batch):
                observer.on_episode(episode, {})
                _log(viewer, step, f"the end; {episode.outcome}")
    return episode


def _tags_in(batch: TensorDictBase) -> list[str]:
    """Return who was tagged out by whom in a turn, a sentence for each."""
    tagged_by = batch.get(("next", *keys.TAGGED_BY), None)
    pairs = [] if tagged_by is None else tagged_by[0].nonzero().tolist()
    return [f"agent {tagged} is tagged out by agent {by}" for tagged, by in pairs]


def _log(viewer: ViewerCallback, step: int, event: str) -> None:
    """Log an event of the episode."""
    viewer.logger.at(step=step, episode=0)
    viewer.logger.log_text(f"step {step:,}: {event}")


DEFAULT_FPS: Final = 15.0
MOST_FPS: Final = 50.0
"""Browsers slow a GIF down that is faster."""
GIF_FRAMES: Final = 300
"""The pictures of a GIF, at most, unless `every` is given."""
_SAMPLES: Final = 24
"""The pictures from which a GIF's palette is taken."""
Fps = Annotated[float, Where(lambda fps: 0 < fps <= MOST_FPS, f"a number above 0, at most {MOST_FPS:g}")]


@dataclass(frozen=True, kw_only=True)
class Style(Value, stored=False):
    """How a film shows an episode."""

    titles: tuple[str, ...] = ()
    """Of the run and those beside it, one each; by default the institutions of each, or the names of their
    experiments."""
    every: Positive | None = None
    """Turns from one picture to the next; by default 1 for an .mp4, and for a .gif as many as it takes for
    300 pictures."""
    fps: Fps = DEFAULT_FPS
    """Pictures per second; in a .gif rounded to hundredths of a second a picture."""
    width: Positive | None = None
    """Of the pictures in pixels, at most 1920, and at least 240 for each run; by default 640 for each run
    that has room. The height follows from the boards, each at most twice as high as its part is wide."""

    def width_of_each(self, runs: int) -> int:
        """Return the width of the part of each run."""
        width = min(LARGEST_WIDTH, DEFAULT_WIDTH * runs) if self.width is None else self.width
        allowed = Annotated[int, Range(SMALLEST_WIDTH * runs, LARGEST_WIDTH)]
        return int(checked("width", width, allowed)) // runs


@working("making a film")
def film_video(
    run: str | Path,
    out: str | Path,
    *,
    beside: Sequence[str | Path] = (),
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
    style: Style = Style(),
) -> tuple[Path, tuple[Episode, ...]]:
    """Film an episode of a run's agents, beside the agents of other runs if there are any.

    A film shows the board, the apples on it and what each agent picked so far, turn by turn. From the first
    picture a line says what the episode comes to, and a card of two seconds at the end says it again; a note
    below says what the signs mean. Agents that broke a rule since the last picture have a white diamond
    around them. Populations side by side play on one clock; one whose board is dead waits for the others.

    It is the episode that `cprl.evaluation.film.film` records with the same numbers; the first and the last
    board are always in the film.

    Args:
        out: the film, a .gif or, with imageio-ffmpeg, an .mp4; complete or absent.
        beside: more runs, whose agents are shown to the right of the first. Games may differ; where they do
            not, all play the same fresh world.

    Returns:
        The film, and the episode of each run.

    Raises:
        FileExistsError: if the film exists.
        ModuleNotFoundError: for an .mp4 without imageio-ffmpeg.
    """
    path = Path(out)
    if path.suffix not in SUFFIXES:
        raise refusal("out", str(path), f"a file whose name ends in {' or '.join(SUFFIXES)}")
    runs = (run, *beside)
    most_runs = LARGEST_WIDTH // SMALLEST_WIDTH
    if len(runs) > most_runs:
        raise refusal("beside", f"{len(runs) - 1} runs", f"at most {most_runs - 1}")
    check_titles(style.titles, len(runs))
    width = style.width_of_each(len(runs))
    refuse_to_write_over(path)
    if path.suffix == ".mp4":
        check_can_write_mp4(path)
    fresh = fresh_episodes(runs, replica=replica, episode=episode, seed=seed)
    say_which(fresh)
    panels = _panels(fresh, style.titles or titles_of(fresh), width)
    length = max(len(panel.played.boards) for panel in panels)
    every = style.every or (1 if path.suffix == ".mp4" else ceil(length / GIF_FRAMES))
    chosen = sorted({*range(0, length, every), length - 1})

    def draw(turns: Sequence[int]) -> Iterator[UInt8]:
        """Yield the pictures after these turns, and the end card."""
        for before, turn in pairwise((-1, *turns)):
            yield joined([panel.draw(turn, since=before + 1) for panel in panels])
        yield joined([panel.draw(length, since=length, card=True) for panel in panels])

    def joined(pictures: Sequence[UInt8]) -> UInt8:
        return np.concatenate([np.concatenate(pictures, 1), words], 0)

    games = [commons_game(population.run) for population in fresh]
    wide = sum(panel.picture.size[0] for panel in panels)
    words = note(f"{growth_of(games[0])} {legend_of(games)}", wide)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4":
        write_mp4(path, draw(chosen), fps=style.fps)
    else:
        samples = list(draw(chosen[:: ceil(len(chosen) / _SAMPLES)]))
        write_gif(path, draw(chosen), samples, fps=style.fps)
    return path, tuple(panel.played.episode for panel in panels)


def check_titles(titles: Sequence[str], runs: int) -> None:
    """Refuse titles that are not one printable line for each run; none are fine."""
    if titles and (len(titles) != runs or not all(map(str.isprintable, titles))):
        raise refusal("titles", titles, f"a line of text for each of {runs} runs")


def titles_of(fresh: Sequence[FreshEpisode]) -> Sequence[str]:
    """Return what tells runs apart: their institutions and transforms, their names, or the names of their
    directories."""
    rules = [in_lower_case(" and ".join(_rules_in(population.run))) for population in fresh]
    names = [population.run.experiment.name.replace("_", " ") for population in fresh]
    titles = [rule or "no rule" for rule in rules] if any(rules) else names
    for candidates in (titles, names):
        if len(set(candidates)) == len(fresh):
            return [title[0].upper() + title[1:] for title in candidates]
    return [legible(population.run.path.resolve().name) for population in fresh]


def _rules_in(run: LoadedRun) -> list[str]:
    """Return the names of the classes of a run's institutions and transforms."""
    institutions = [type(kind).__name__ for kind in commons_game(run).institutions]
    transforms = [re.split("[:.]", transform.target)[-1] for transform in run.experiment.transforms]
    return institutions + transforms


class _Panel(NamedTuple):
    """What a film shows of one population."""

    title: str
    picture: EpisodePicture
    played: Recorded
    violated: Bool
    """[T + 1, N], which agents broke a rule in the turn that led to each board."""
    is_typical: bool

    def draw(self, turn: int, *, since: int, card: bool = False) -> UInt8:
        """Draw the population after a turn of the film's clock, or at its end if that was before.

        Args:
            card: whether to say how the episode ended.
        """
        played = self.played
        dead = ""
        if played.is_dead:
            dead = f"gone for good at turn {played.last:,} of {self.picture.steps:,}"
        outcome = dead or f"{played.left:,} of {len(self.picture.board.sites):,} still on the board"
        count = int(played.boards[-1].harvested.sum())
        apples = f"{count:,} apple{'s' * (count != 1)} picked"
        which = "A typical episode" if self.is_typical else "This episode"
        return self.picture.draw(
            played.boards[: turn + 1],
            self.title,
            comes_to=f"{which}: {apples}, {outcome}",
            end=dead if turn >= played.last else "",
            card=f"{apples} · {outcome}" if card else "",
            violators=np.flatnonzero(self.violated[since : turn + 1].any(0)).tolist(),
        )


def _panels(fresh: Sequence[FreshEpisode], titles: Sequence[str], width: int) -> list[_Panel]:
    """Play the episodes; return what is shown of each, in panels of one size with one axis of harvests."""
    games = [commons_game(population.run) for population in fresh]
    episodes = [record(population) for population in fresh]
    most = max(int(played.boards[-1].harvested.max()) for played in episodes)
    height = max(EpisodePicture(game.map, steps=1, width=width).size[1] for game in games)
    sizes = {"width": width, "height": height, "most_harvested": most}
    panels = []
    for title, population, game, played in zip(titles, fresh, games, episodes, strict=True):
        picture = EpisodePicture(game.map, steps=game.rules.episode_steps, **sizes)
        violated = played.since_the_start("next", *keys.VIOLATED) > 0
        panels.append(_Panel(title, picture, played, violated, population.is_typical))
    return panels
