"""film_video: an episode of the agents of a stored run as a GIF or an MP4."""

from collections.abc import Iterator, Sequence
from math import ceil
from pathlib import Path
from typing import Final

from torchrl.envs import EnvBase

from cprl import arguments, keys
from cprl.commons.world import Bytes, Shown
from cprl.envs.commons_env import CommonsEnv
from cprl.envs.unwrap import commons_of
from cprl.evaluation.episode_picture import (
    DEFAULT_WIDTH,
    LARGEST_WIDTH,
    SMALLEST_WIDTH,
    EpisodePicture,
)
from cprl.evaluation.film import SEED, fresh_episode
from cprl.evaluation.turns import Turns
from cprl.evaluation.video_files import check_can_write_mp4, write_gif, write_mp4
from cprl.measuring.episodes import Episode
from cprl.measuring.tracking import tracker_of
from cprl.memory import check_memory
from cprl.policies.assignment import AgentPolicies
from cprl.runs.labelled import refuse_to_write_over

SUFFIXES: Final = (".gif", ".mp4")
DEFAULT_FPS: Final = 15.0
MOST_FPS: Final = 50.0
"""Browsers slow a GIF down that is faster."""
GIF_FRAMES: Final = 300
"""The pictures of a GIF, at most, unless `every` is given."""
_SAMPLES: Final = 24
"""The pictures from which a GIF's palette is taken."""


def film_video(
    run: str | Path,
    out: str | Path,
    *,
    replica: int = 0,
    episode: int = 0,
    seed: int = SEED,
    every: int | None = None,
    fps: float = DEFAULT_FPS,
    width: int = DEFAULT_WIDTH,
    allow: Sequence[str] = (),
) -> tuple[Path, Episode]:
    """Films an episode of a run's agents: the board, the apples on it and each agent's harvest so far; under
    institutions, agents that broke a rule since the last picture have a white diamond around them.

    It is the episode that `cprl.evaluation.film.film` records with the same numbers; the first and the last
    board are always in the film.

    Args:
        run: its directory, or its exported results.
        out: the film, a .gif or, with imageio-ffmpeg, an .mp4; complete or absent.
        replica: the index of the agents' replica.
        episode: the index of the fresh episode; equal indices give equal episodes.
        seed: of the worlds and all chance. The world is that of `evaluate_run` with the same seed, of number
            replica x episodes + episode there; what agents draw is their own.
        every: turns from one picture to the next; by default 1 for an .mp4, and for a .gif as many as
            it takes for 300 pictures.
        fps: pictures per second, above 0, at most 50; in a .gif rounded to hundredths of a second a picture.
        width: of the pictures in pixels, 240 to 1920; the height follows from the board, which is
            at most twice as high.
        allow: see `cprl.load`.

    Returns:
        The film, and the episode.

    Raises:
        ValueError: if the run cannot be loaded, see `cprl.load`, plays a game without a board, or an argument
            is out of range.
        FileExistsError: if the film exists.
        ModuleNotFoundError: for an .mp4 without imageio-ffmpeg.
        MemoryError: if the pictures of a .gif do not fit into memory.
    """
    path = arguments.path("out", out)
    if path.suffix not in SUFFIXES:
        raise arguments.refusal("out", str(path), f"a file whose name ends in {' or '.join(SUFFIXES)}")
    every = None if every is None else arguments.integer("every", every, 1)
    allowed = f"a number above 0, at most {MOST_FPS:g}"
    fps = arguments.number("fps", fps, low=0.0, high=MOST_FPS, above=True, allowed=allowed)
    arguments.integer("width", width, SMALLEST_WIDTH, LARGEST_WIDTH)
    refuse_to_write_over(path)
    if path.suffix == ".mp4":
        check_can_write_mp4(path)
    fresh = fresh_episode(run, replica=replica, episode=episode, seed=seed, allow=allow)
    commons = commons_of(fresh.env)
    if commons is None:
        raise ValueError(f"{run} plays a game without a board of cprl; allowed: a run of a cprl.Game")
    moments, violators, played = _play(fresh.env, commons, fresh.policies)
    board, steps = commons.game.map, commons.game.rules.episode_steps
    most = int(moments[-1].harvested.max())
    picture = EpisodePicture(board, steps=steps, width=width, most_harvested=most)
    if every is None:
        every = 1 if path.suffix == ".mp4" else ceil(len(moments) / GIF_FRAMES)
    chosen = sorted({*range(0, len(moments), every), len(moments) - 1})
    end = "no apple is left" if played.terminated else ""

    def draw(turns: Sequence[int]) -> Iterator[Bytes]:
        for turn in turns:
            note = end if turn == len(moments) - 1 else ""
            first = max((other for other in chosen if other < turn), default=-1) + 1
            broke = sorted(set().union(*violators[first : turn + 1]))
            yield picture.draw(moments[: turn + 1], fresh.title, note=note, violators=broke)

    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4":
        write_mp4(path, draw(chosen), picture.size, fps=fps)
    else:
        needed = 3 * len(chosen) * picture.size[0] * picture.size[1]
        check_memory(f"every is {every}: {len(chosen):,} pictures", needed, "fewer or smaller pictures")
        samples = chosen[:: ceil(len(chosen) / _SAMPLES)] + chosen[-1:]
        write_gif(path, draw(chosen), list(draw(samples)), fps=fps)
    return path, played


def _play(
    env: EnvBase, commons: CommonsEnv, policies: AgentPolicies
) -> tuple[list[Shown], list[set[int]], Episode]:
    """All boards of the episode, that at its start first, without what agents observe; the agents that broke
    a rule in the turn that led to each; and the episode."""

    def now() -> Shown:
        shown = commons.worlds.show(commons.output)
        return shown._replace(observation=shown.observation[:0])

    longest = commons.game.rules.episode_steps
    tracker = tracker_of(env, longest)
    turns = Turns(env, policies)
    moments, violators = [now()], [set[int]()]
    while True:
        batch = turns.play()
        ended = tracker.add(batch)
        moments.append(now())
        violated = batch.get(("next", *keys.VIOLATED), None)
        violators.append(set() if violated is None else set(violated[0].nonzero()[:, 0].tolist()))
        if ended:
            return moments, violators, ended[0]
