"""ViewerCallback: records a training for the Rerun viewer, and shows it live."""

import time
from collections.abc import Callable, Mapping, Sequence
from math import gcd
from pathlib import Path
from statistics import fmean
from threading import Event, Thread
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl.envs.unwrap import agent_names, commons_of
from cprl.measuring.episodes import Episode
from cprl.measuring.metrics import reported_by
from cprl.measuring.series import OF_AGENTS, Recent, Series, Values, mean_of, numbers_of
from cprl.measuring.statistics import social_metrics
from cprl.system.compile_clock import CLOCK
from cprl.viewer.exhibition import Exhibited, Exhibition
from cprl.viewer.frames import Filming, scene_of
from cprl.viewer.institutions import has_institutions
from cprl.viewer.logger import FILE_NAME, RerunLogger, free_name, recording_id
from cprl.viewer.scenery import RANDOM_PLAY, Curves, curves_of, missing_in
from cprl.viewer.story import Story, has_died
from cprl.viewer.views import SAMPLED_EVERY, Turns, in_words, log_institutions, views_of

_PERIOD_S: Final = 1.0


class CompilingNotice:
    """Calls a function once a second while code is compiled, in a thread of its own, until it is stopped.

    Args:
        show: called with "compiling, 12 s so far", and with "begins" once nothing is compiled any more; from
            another thread.
    """

    def __init__(self, show: Callable[[str], object]) -> None:
        self._show, self._over = show, Event()
        self._before_s = CLOCK.total_s
        Thread(target=self._watch, daemon=True, name="cprl compiling").start()

    def stop(self) -> None:
        """Ends the thread; a second call does nothing."""
        self._over.set()

    def _watch(self) -> None:
        was_running = False
        while not self._over.wait(_PERIOD_S):
            if CLOCK.is_running:
                self._show(f"compiling, {CLOCK.total_s - self._before_s:.0f} s so far")
            elif was_running:
                self._show("begins")
            was_running = CLOCK.is_running


WINDOW: Final = 0.02
"""The share of the run's episodes whose mean is the bold line."""
SHORTEST: Final = 10
"""Its episodes at least."""
_WITH_MEAN: Final = tuple(f"/{name}" for name in ("return", *OF_AGENTS))


def _of_institutions(episode: Episode) -> dict[str, float]:
    return {f"institutions/{name}": value for name, value in episode.institutions.items()}


class Plots:
    """Logs the lines of each episode: social metrics, those of institutions and what agents get and pay
    with a running mean, all else as it is.
    """

    def __init__(self, logger: RerunLogger, curves: Curves, *, episodes: int) -> None:
        self._logger, self._curves = logger, curves
        self.window = max(SHORTEST, round(WINDOW * episodes))
        """Episodes of a running mean."""
        self._recent: dict[str, Recent] = {}
        self._random: dict[str, float] = {}

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Sets the lines of random play: the mean of each metric in these episodes, where it is defined."""
        metrics = [{**social_metrics(episode), **_of_institutions(episode)} for episode in episodes]
        of_institutions = (f"institutions/{metric}" for metric in self._curves.institutions)
        for name in (*self._curves.metrics, *of_institutions):
            values = [numbers[name] for numbers in metrics if name in numbers]
            defined = [value for value in values if value == value]
            if defined:
                self._random[name] = fmean(defined)

    def on_episode(self, of_all: Mapping[str, Values]) -> None:
        """Logs an episode at the logger's time: the numbers [R] of each name."""
        for name, values in of_all.items():
            is_social = name.startswith(("social/", "institutions/"))
            singles = values.tolist() if is_social and len(values) > 1 else []
            line = [*singles, mean := mean_of(values)]
            if is_social or name.endswith(_WITH_MEAN):
                line.append(self._recent.setdefault(name, Recent(self.window)).add(mean))
            self._logger.log_lines(name, line)
        for name, mean in self._random.items():
            self._logger.log_scalar(f"{RANDOM_PLAY}/{name}", mean)

    def state_dict(self) -> dict[str, Any]:
        return {name: recent.state_dict() for name, recent in self._recent.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name, recent in state.items():
            self._recent.setdefault(name, Recent(self.window)).load_state_dict(recent)


EVERY: Final = 10
"""Episodes from one matrix to the next."""
OVER: Final = 5
"""A matrix sums the tags of so many times `EVERY` episodes, the last ones."""


class Tags:
    """Sums the tags of the last episodes, over all replicas."""

    def __init__(self, logger: RerunLogger, agents: int) -> None:
        self._logger = logger
        self._last = [np.zeros((agents, agents))]

    def add(self, tagged_by: NDArray[np.int64]) -> None:
        """Adds the tags of an episode of a replica, [N, N]: row tagged, column by whom."""
        self._last[-1] += tagged_by

    def on_episode(self, episode: int) -> None:
        """Logs the matrix if it is due after an episode, counted from 0, that all replicas have ended."""
        if (episode + 1) % EVERY == 0:
            self._logger.log_matrix("tags", np.sum(self._last, 0), ("tagged", "by whom"))
            self._last = [*self._last[1 - OVER :], np.zeros_like(self._last[0])]

    def state_dict(self) -> list[Any]:
        return [matrix.tolist() for matrix in self._last]

    def load_state_dict(self, state: list[Any]) -> None:
        self._last = list(np.array(state, np.float64))


LONGEST: Final = 50
"""Episodes from one image of visits, stock and Lorenz curve to the next, at most."""
_IMAGES: Final = 20
"""The images of a short run, about."""
_DIED: Final = "died"
"""Among an episode's numbers, whether the board died early."""


class ViewerCallback:
    """Logs the metrics of every episode, and the frames of the first world in some episodes.

    Views that need what the game does not report are left out: a game without a board has no frames; for
    metrics see `cprl.measuring.metrics`. One event of the recording names them. With transforms, windows
    show the observations of the `CommonsEnv` itself.

    Frames are recorded for every k-th episode, including the first and the last, and for the episode after
    each new best. With several replicas metrics are logged once all have ended an episode: the mean and each
    replica; returns, losses and the like as means only. A callback of `cprl.training`, and a context manager.

    Args:
        run: the run's directory, where the recording is written. If there is one already, the new file is
            `run-2.rrd` and so on; the viewer shows them as one recording.
        env: a world for each replica, with transforms or without; the first is shown.
        live: "serve" or "spawn", see `cprl.viewer.streams`; None for the file alone.
        exhibited: what is exhibited live: the present policy and one world for it, see
            `cprl.viewer.exhibition`.
        file_name: the name of the recording instead of `run.rrd`; there must be no such file.
        is_replay: whether a stored policy is replayed, see `cprl.viewer.scenery.Scene`.
    """

    def __init__(
        self,
        run: Path,
        env: EnvBase,
        *,
        title: str,
        episodes: int,
        recipe: Mapping[str, object] | None = None,
        live: str | None = None,
        exhibited: tuple[Exhibited, EnvBase] | None = None,
        file_name: str | None = None,
        is_replay: bool = False,
    ) -> None:
        self.env = env
        self._agents, reported = agent_names(env), reported_by(env)
        curves, commons = curves_of(env, self._agents, reported, episodes=episodes), commons_of(env)
        scene = None if commons is None else scene_of(commons, curves, is_replay=is_replay)
        self.logger = RerunLogger(
            title,
            run,
            scene=scene,
            curves=curves,
            live=live,
            exhibits=exhibited is not None and scene is not None,
            file_name=file_name or free_name(run),
            recording_id=recording_id(run, file_name or FILE_NAME),
        )
        self.filming = Filming(commons, self.logger, scene, episodes=episodes)
        """Which episodes are recorded frame by frame."""
        self.exhibition: Exhibition | None = None
        """What the present policy plays for viewers; None where nothing is exhibited."""
        if exhibited is not None and scene is not None:
            self.exhibition = Exhibition(*exhibited, trained=env, scene=scene, live=self.logger.live)
        self._series = Series(curves.replicas)
        self.plots = Plots(self.logger, curves, episodes=episodes)
        game = None if commons is None else commons.game
        self.story = (
            None
            if is_replay
            else Story(self.logger, curves, episodes=episodes, window=self.plots.window, game=game)
        )
        self._views = views_of(
            commons, self.logger, scene or curves, episodes=episodes, every=self.filming.every
        )
        self._every = max(1, min(LONGEST, episodes // _IMAGES))
        """Episodes from one image of the views to the next."""
        self._ended = self._logged = 0
        if has_institutions(curves):
            log_institutions(self.logger, commons)
        has_tags = curves.has_tags and len(self._agents) > 1
        turns = self._views.get("turns")
        self._sampled = gcd(SAMPLED_EVERY, turns.stride) if isinstance(turns, Turns) else 1
        """Steps from one look at the worlds to the next where no frame is recorded."""
        self._tags = Tags(self.logger, len(self._agents)) if has_tags else None
        self._step = self._episode = 0
        self._has_died = False
        self.filming.choose(0)
        self._rate_at = time.perf_counter()
        self._rate_step = 0
        self.logger.log_hparams({"run": run.name, **(recipe or {})})
        self.logger.log_text(f"{title} begins")
        missing = missing_in(reported, has_board=scene is not None)
        if missing:
            self.logger.log_text(missing)
        if live and scene is None:
            self.logger.log_text("no exhibition: the game has no board")
        self.log_status("begins")
        self._compiling = CompilingNotice(self._show_status) if live else None

    def on_step(self, batch: TensorDictBase) -> None:
        """Copies the state of the first world after the turn, if this episode's frames are recorded.

        Otherwise it only counts: reading a tensor each turn would cost a training some percent.
        """
        self._step += 1
        if not self.filming.is_on and self._step % self._sampled:
            return  # nothing is due; whatever runs here displaces a training's data from the fast caches
        self.filming.choose(self._episode)
        if self.exhibition is not None:
            self.exhibition.on_step(episode=self._episode)
        frame = self.filming.add(batch, step=self._step, episode=self._episode)
        if frame is not None or self._step % self._sampled == 0:
            for view in self._views.values():
                view.on_step(self._step, self._episode, frame)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Logs the numbers of an episode, and its events, once all replicas have ended it."""
        if episode.world == 0:
            self._log_death(episode)
            if episode.episode % self._every == 0 and (words := in_words(episode, self.logger.curves)):
                self.logger.at(step=self._step, episode=episode.episode)
                self.logger.log_text(f"episode {episode.episode:,}: {words}")
            self._episode, self.filming.shows_next = episode.episode + 1, False
        if self._tags is not None and episode.tagged_by is not None:
            self._tags.add(episode.tagged_by)
        for view in self._views.values():
            view.on_episode(episode)
        numbers = numbers_of(episode, learning, self._agents)
        died = has_died(episode)
        of_all = self._series.add(
            episode.episode, episode.world, numbers if died is None else {**numbers, _DIED: float(died)}
        )
        if of_all is not None:
            self._stop_notice()
            self.logger.at(step=self._step, episode=episode.episode)
            self._log(episode.episode, of_all)
        self.filming.choose(self._episode)

    def _show_status(self, status: str) -> None:
        if self.story is not None and self._episode == 0:
            self.logger.show_live("header", self.story.beginning(status))

    def _log_death(self, episode: Episode) -> None:
        """Logs the step of the last apple in the first replica, for the first time and where one sees it."""
        step = episode.depletion_step or -1
        if step > 0 and (self.filming.is_shown(self._episode) or not self._has_died):
            self.logger.at(step=self._step, episode=episode.episode)
            self.logger.log_text(f"episode {episode.episode:,}: last apple taken in step {step}")
            self._has_died = True

    def _log(self, episode: int, of_all: dict[str, Values]) -> None:
        now, died = time.perf_counter(), of_all.pop(_DIED, None)
        self.plots.on_episode(of_all)
        self._ended = episode + 1
        if self._ended % self._every == 0:
            self._log_views()
        steps = (self._step - self._rate_step) * self._series.replicas
        if steps:
            self.logger.log_scalar("time/env_steps_per_s", steps / (now - self._rate_at))
            self._rate_at, self._rate_step = now, self._step
        if self.story is not None:
            events = self.story.on_episode(episode, of_all, None if died is None else float(np.nansum(died)))
            self.filming.shows_next |= any(event.startswith("new best") for event in events)
        if self._tags is not None:
            self._tags.on_episode(episode)

    def _log_views(self) -> None:
        if self._ended > self._logged:
            for view in self._views.values():
                view.log(self._logged + 1, self._ended)
            self._logged = self._ended

    def _close_views(self) -> None:
        self._log_views()
        for view in self._views.values():
            view.close()

    def log_status(self, status: str) -> None:
        """Says in the header what happens before the first episode has ended, e.g. "compiling, 12 s so far";
        viewers get it at once."""
        if self.story is not None:
            self.story.begins(status)

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Compares the training with these episodes of random play: in header, label, plots and an event."""
        self.plots.random_play(episodes)
        if self.story is not None:
            self.story.random_play(episodes)

    @property
    def baseline(self) -> float | None:
        """The mean collective return of random play (or summed return, without a harvest), if it is known."""
        return None if self.story is None else self.story.baseline

    def finished(self, played: Mapping[str, Sequence[Episode]]) -> None:
        """Shows that the run is finished, and closes the file; a live view stays open until the end."""
        self.filming.send()
        self._close_views()
        if self.story is not None:
            self.story.finished(played["trained"], played["random"])
        self.logger.close_file()

    def log_event(self, event: str) -> None:
        self.logger.log_text(event)

    def play_on(self, stop: Event) -> None:
        """Exhibits the trained policy until the event is set; returns at once where nothing is exhibited."""
        if self.exhibition is not None:
            self.exhibition.play_on(stop, episode=self._episode)

    def flush(self) -> None:
        """Sends all that waits, to the file and to viewers."""
        self.filming.send()
        self.logger.flush()

    def state_dict(self) -> dict[str, Any]:
        self.flush()
        return {
            "step": self._step,
            "episode": self._episode,
            **self.filming.state_dict(),
            "series": self._series.state_dict(),
            "plots": self.plots.state_dict(),
            "views": {
                "logged": self._logged,
                "ended": self._ended,
                **{name: view.state_dict() for name, view in self._views.items()},
            },
            "story": None if self.story is None else self.story.state_dict(),
            "tags": None if self._tags is None else self._tags.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._step = self._rate_step = int(state["step"])
        self._episode = int(state["episode"])
        self.filming.load_state_dict(state, episode=self._episode)
        self._series.load_state_dict(state["series"])
        self.plots.load_state_dict(state["plots"])
        self._logged, self._ended = (int(state["views"][name]) for name in ("logged", "ended"))
        for name, view in self._views.items():
            view.load_state_dict(state["views"][name])
        self.logger.at(step=self._step, episode=self._episode)
        if self.story is not None:
            self.story.load_state_dict(state["story"] or {})
        if self._tags is not None:
            self._tags.load_state_dict(state["tags"])
        self.logger.log_text(f"resumed from step {self._step:,}")

    def _stop_notice(self) -> None:
        if self._compiling is not None:
            self._compiling.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stop_notice()
        if self.exhibition is not None:
            self.exhibition.close()
        self.filming.send()
        self._close_views()
        if self.story is not None:
            self.story.close()
        self.logger.shutdown()
