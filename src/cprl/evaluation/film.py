"""Films an episode of stored agents: as a recording for the viewer, or as a GIF or MP4 of several runs."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np

from cprl.envs.unwrap import commons_of
from cprl.evaluation.fresh import (
    FreshEpisode,
    Recorded,
    fresh_episodes,
    print_descriptions,
    record,
)
from cprl.evaluation.populations import commons_game
from cprl.evaluation.video_files import check_can_write_mp4, write_gif, write_mp4
from cprl.measuring.playing import turns
from cprl.measuring.series import Observer
from cprl.measuring.tracker import Episode, tracker_of
from cprl.pictures.episode_picture import (
    DEFAULT_WIDTH,
    LARGEST_WIDTH,
    SMALLEST_WIDTH,
    EpisodePicture,
    note,
)
from cprl.pictures.readable import capitalised, growth_of, in_lower_case, legend_of
from cprl.runs.files import refuse_to_write_over
from cprl.system.defaults import FILM_SUFFIXES
from cprl.system.output import legible
from cprl.system.working import working
from cprl.training.stored import LoadedRun
from cprl.values import Positive, Range, Value, Where, checked, refusal
from cprl.values.array_types import UInt8
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.replay_views import Decisions, ViolationMarks, events


@working("making a film")
def record_episode(
    run: str | Path,
    out: str | Path | None = None,
    *,
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
) -> tuple[Path, Episode]:
    """Record an episode of a run's agents in a fresh world, with the exploration of evaluations.

    Print which episode it is.

    Args:
        run: the run's directory.
        out: the recording, a .rrd file; by default `film-<replica>-<episode>.rrd` in the run's directory. It
            is written completely or not at all.
        replica: the number of the replica; by default a typical one, see `cprl.evaluation.fresh`.
        episode: the number of the episode; by default a typical one.
        seed: the seed of the worlds and of all random choices. In `evaluate_run` with the same seed the
            episode's world has the number replica * episodes + episode, but the agents' choices differ.

    Returns:
        The path of the recording, and the episode.

    Raises:
        FileExistsError: if the recording exists.
        ValueError: for another kind of file, or a replica, episode or seed that `fresh_episodes` refuses.
    """
    if out is not None:
        if Path(out).suffix != ".rrd":
            raise refusal("out", str(out), "a .rrd; film_episode makes a .gif or an .mp4")
        refuse_to_write_over(Path(out))
    (fresh_episode,) = fresh_episodes([run], replica=replica, episode=episode, seed=seed)
    default_path = Path(run) / f"film-{fresh_episode.replica}-{fresh_episode.episode}.rrd"
    target = Path(out or default_path)
    refuse_to_write_over(target)
    print_descriptions([fresh_episode])
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        return target, _record_to_file(fresh_episode, target)
    except BaseException:  # the next attempt would refuse to overwrite the recording of half an episode
        target.unlink(missing_ok=True)
        raise


@working("playing an episode")
def _record_to_file(fresh_episode: FreshEpisode, target: Path) -> Episode:
    """Play an episode and record all its turns."""
    run = fresh_episode.run
    env = fresh_episode.env
    commons = commons_of(env)
    with ViewerCallback(
        target.parent,
        env,
        title=f"{legible(run.path.name)}, replica {fresh_episode.replica}, episode {fresh_episode.episode}",
        episodes=1,
        recipe=run.recipe,
        replay=target.name,
    ) as viewer:
        logger = viewer.logger
        scene = logger.scene
        views: list[Any] = [viewer]
        if scene is not None:
            views.append(Decisions(logger, scene, fresh_episode.policies, actions=run.game.actions))
            if commons is not None and scene.has_institutions:
                views.append(ViolationMarks(logger, commons))
        observer = Observer(views, env)
        tracker = tracker_of(env)
        for step, batch in enumerate(turns(env, fresh_episode.policies), start=1):
            observer.on_step(batch)
            for event in events(batch):
                _log(viewer, step, event)
            for episode in tracker.add(batch):
                observer.on_episode(episode, {})
                _log(viewer, step, f"the end; {episode.outcome}")
    return episode


def _log(viewer: ViewerCallback, step: int, event: str) -> None:
    """Log an event of the episode."""
    viewer.logger.set_time(step=step, episode=0)
    viewer.logger.log_text(f"step {step:,}: {event}")


DEFAULT_FPS: Final = 15.0
MOST_FPS: Final = 50.0
"""The largest number of pictures per second: browsers slow down GIFs that are faster."""
_GIF_FRAMES: Final = 300
"""The largest number of pictures in a GIF before that of the last turn and the end card, unless `Style.every`
is given."""
_PALETTE_SAMPLES: Final = 24
"""The number of pictures from which a GIF's palette is taken."""
Fps = Annotated[float, Where(lambda fps: 0 < fps <= MOST_FPS, f"a number above 0, at most {MOST_FPS:g}")]


@dataclass(frozen=True, kw_only=True)
class Style(Value, stored=False):
    """The look of a film: its titles, speed and size."""

    titles: tuple[str, ...] = ()
    """The title of each run; by default the institutions of the runs, or the names of their experiments."""
    every: Positive | None = None
    """The number of turns from one picture to the next; by default 1 for an .mp4, and for a .gif as many as
    give at most `_GIF_FRAMES` pictures, beside the last turn and the end card."""
    fps: Fps = DEFAULT_FPS
    """The pictures per second. In a .gif a picture lasts a whole number of hundredths of a second."""
    width: Positive | None = None
    """The width of the film in pixels, at most `LARGEST_WIDTH` and at least `SMALLEST_WIDTH` for each run; by
    default `DEFAULT_WIDTH` for each run, if that fits. The height follows from the boards, which are at most
    twice as high as wide."""

    def width_of_each(self, runs: int) -> int:
        """Return the width of the panel of each run, in pixels; refuse a width that does not fit them."""
        width = min(LARGEST_WIDTH, DEFAULT_WIDTH * runs) if self.width is None else self.width
        allowed = Annotated[int, Range(SMALLEST_WIDTH * runs, LARGEST_WIDTH)]
        return int(checked("width", width, allowed)) // runs


@working("making a film")
def film_episode(
    run: str | Path,
    out: str | Path,
    *,
    beside: Sequence[str | Path] = (),
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
    style: Style = Style(),
) -> tuple[Path, tuple[Episode, ...]]:
    """Film an episode of a run's agents as a GIF or MP4, beside the agents of other runs if any are given.

    A film shows the board, its apples, and the harvest of each agent so far, turn by turn. A line above the
    board says from the first picture on how the episode ends, and a card at the end says it again for two
    seconds; a note below explains the signs. Agents that broke a rule since the last picture have a white
    diamond around them. All panels show the same turn; a panel whose episode is over waits for the others.

    The episode is the one that `record_episode` records with the same numbers. The first and the last board
    are always in the film.

    Args:
        run: the run's directory.
        out: the film, a .gif or, with imageio-ffmpeg, an .mp4. It is written completely or not at all.
        beside: further runs, which are shown to the right of the first. Runs of the same game play in the
            same fresh world.
        replica: the number of the replica; by default a typical one, see `cprl.evaluation.fresh`.
        episode: the number of the episode; by default a typical one.
        seed: the seed of the worlds and of all random choices.
        style: the titles, the speed and the size of the film.

    Returns:
        The path of the film, and the episode of each run.

    Raises:
        FileExistsError: if the film exists.
        ModuleNotFoundError: for an .mp4 without imageio-ffmpeg.
        ValueError: for another kind of file, too many runs, titles that do not fit them, or a replica,
            episode or seed that `fresh_episodes` refuses.
    """
    path = Path(out)
    is_mp4 = path.suffix == ".mp4"
    runs = (run, *beside)
    _check_path(path)
    check_beside(runs, style.titles, most=LARGEST_WIDTH // SMALLEST_WIDTH)
    width = style.width_of_each(len(runs))
    episodes = fresh_episodes(runs, replica=replica, episode=episode, seed=seed)
    print_descriptions(episodes)
    panels = _panels(episodes, style.titles or titles_of(episodes), width)
    last = max(panel.played.last_turn for panel in panels)
    every = style.every or (1 if is_mp4 else ceil((last + 1) / _GIF_FRAMES))
    filmed_turns = sorted({*range(0, last, every), last})
    games = [commons_game(episode.run) for episode in episodes]
    film_width = sum(panel.picture.size[0] for panel in panels)
    legend = note(f"{growth_of(games[0])} {legend_of(games)}", film_width)
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures = _pictures(panels, filmed_turns, legend)
    if is_mp4:
        write_mp4(path, pictures, fps=style.fps)
    else:
        sampled_turns = filmed_turns[:: ceil(len(filmed_turns) / _PALETTE_SAMPLES)]
        write_gif(path, pictures, list(_pictures(panels, sampled_turns, legend)), fps=style.fps)
    return path, tuple(panel.played.episode for panel in panels)


def _check_path(path: Path) -> None:
    """Refuse a film that exists, or is neither a GIF nor an MP4, or cannot be written here."""
    if path.suffix not in FILM_SUFFIXES:
        raise refusal("out", str(path), f"a file whose name ends in {' or '.join(FILM_SUFFIXES)}")
    refuse_to_write_over(path)
    if path.suffix == ".mp4":
        check_can_write_mp4(path)


def _pictures(panels: Sequence["_Panel"], filmed_turns: Sequence[int], legend: UInt8) -> Iterator[UInt8]:
    """Yield the pictures after these turns, and the end card: the panels side by side, the legend below."""
    for previous, turn in pairwise((-1, *filmed_turns)):
        yield np.vstack([np.hstack([panel.draw(turn, since=previous + 1) for panel in panels]), legend])
    after_end = max(len(panel.played.boards) for panel in panels)
    end_cards = [panel.draw(after_end, since=after_end, is_end_card=True) for panel in panels]
    yield np.vstack([np.hstack(end_cards), legend])


def check_beside(runs: Sequence[str | Path], titles: Sequence[str], *, most: int) -> None:
    """Refuse more than `most` runs, and titles, if there are any, unless each run has a printable line."""
    if len(runs) > most:
        raise refusal("beside", f"{len(runs) - 1} runs", f"at most {most - 1}")
    if titles and (len(titles) != len(runs) or not all(map(str.isprintable, titles))):
        raise refusal("titles", titles, f"a line of text for each of {len(runs)} runs")


def titles_of(episodes: Sequence[FreshEpisode]) -> Sequence[str]:
    """Return titles that distinguish the runs.

    They are the runs' institutions and transforms; if some of these are equal, the names of the experiments;
    and if some of these are equal too, the names of the directories.
    """
    runs = [episode.run for episode in episodes]
    rules = [in_lower_case(" and ".join(_rules_in(run))) for run in runs]
    names = [run.experiment.name.replace("_", " ") for run in runs]
    titles = [rule or "no rule" for rule in rules] if any(rules) else names
    for candidates in (titles, names):
        if len(set(candidates)) == len(runs):
            return list(map(capitalised, candidates))
    return [legible(run.path.resolve().name) for run in runs]


def _rules_in(run: LoadedRun) -> list[str]:
    """Return the names of the classes of a run's institutions and transforms."""
    institutions = [type(kind).__name__ for kind in commons_game(run).institutions]
    transforms = [re.split("[:.]", transform.target)[-1] for transform in run.experiment.transforms]
    return institutions + transforms


class _Panel(NamedTuple):
    """The part of a film that shows the agents of one run."""

    title: str
    picture: EpisodePicture
    played: Recorded
    is_typical: bool
    """Whether the episode was chosen as a typical one."""

    def draw(self, turn: int, *, since: int, is_end_card: bool = False) -> UInt8:
        """Return the picture after a turn, or after the last turn if the episode is over.

        Args:
            turn: the turn; 0 is the start.
            since: the first turn whose violations are marked.
            is_end_card: whether to draw the card that says how the episode ended.
        """
        played = self.played
        apples, outcome = self._outcome_texts()
        subject = "A typical episode" if self.is_typical else "This episode"
        has_died = played.is_dead and turn >= played.last_turn
        return self.picture.draw(
            played.boards[: turn + 1],
            self.title,
            headline=f"{subject}: {apples}, {outcome}",
            end=outcome if has_died else "",
            card=f"{apples} · {outcome}" if is_end_card else "",
            violators=np.flatnonzero(played.violated[since : turn + 1].any(0)).tolist(),
        )

    def _outcome_texts(self) -> tuple[str, str]:
        """Return how many apples were picked, and what became of the board."""
        played = self.played
        count = int(played.boards[-1].harvested.sum())
        apples = f"{count:,} apple{'s' * (count != 1)} picked"
        if played.is_dead:
            return apples, f"gone for good at turn {played.last_turn:,} of {self.picture.steps:,}"
        return apples, f"{played.apples_left:,} of {len(self.picture.board.sites):,} still on the board"


def _panels(episodes: Sequence[FreshEpisode], titles: Sequence[str], width: int) -> list[_Panel]:
    """Play the episodes and return their panels, all of the same size and with the same axis of harvests."""
    games = [commons_game(episode.run) for episode in episodes]
    recorded = [record(episode) for episode in episodes]
    most_harvested = max(int(played.boards[-1].harvested.max()) for played in recorded)
    height = max(EpisodePicture(game.map, steps=1, width=width).size[1] for game in games)
    sizes = {"width": width, "height": height, "most_harvested": most_harvested}
    panels = []
    for title, episode, game, played in zip(titles, episodes, games, recorded, strict=True):
        picture = EpisodePicture(game.map, steps=game.rules.episode_steps, **sizes)
        panels.append(_Panel(title, picture, played, episode.is_typical))
    return panels
