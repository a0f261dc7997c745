"""ViewerCallback: records a training for the Rerun viewer, and shows it live."""

import itertools
import json
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Event
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from rich.console import Console
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.arguments import object_of
from cprl.arguments import path as path_of
from cprl.checks import NONE, TEXT, check_nesting, checked, count, either
from cprl.envs.unwrap import agent_names, commons_of
from cprl.measuring import phases
from cprl.measuring.episodes import Episode
from cprl.measuring.reported import FIELDS, METRICS, available, left_out, reported_by
from cprl.measuring.series import Series, Values, mean_of, numbers_of
from cprl.runs.directory import FILE_NAME as RECIPE_FILE
from cprl.runs.files import read_json
from cprl.viewer.events import ANOTHER, EventDetector
from cprl.viewer.exhibition import Exhibited, Exhibition
from cprl.viewer.logger import FILE_NAME, RerunLogger
from cprl.viewer.recorder import FrameRecorder, scene_of
from cprl.viewer.scenery import TOO_EARLY, Curves

TAGS_EVERY: Final = 50
"""Episodes whose tags are summed in one matrix of who tagged whom."""

_SHOWN: Final[Mapping[str, tuple[str, ...]]] = {
    "phases and new bests": tuple(dict.fromkeys(entry for name in phases.METRICS for entry in METRICS[name])),
    "who tagged whom": ("tagged_by",),
    "the board and what agents see": ("board",),
}
"""The views of a recording besides metrics, and the entries that each needs."""


class ViewerCallback:
    """Logs the metrics of every episode, and the frames of the first world in some episodes.

    Views that need what the game does not report are left out: a game without a board has no frames; for
    metrics see `cprl.measuring.reported`. One event of the recording names them. With transforms, windows
    show the observations of the `CommonsEnv` itself.

    Frames are recorded for every k-th episode, including the first and the last, and for the episode after
    each new best. With several replicas metrics are logged once all have ended an episode: the mean and each
    replica; returns, losses and the like as means only. A callback of `cprl.training`, and a context manager.

    Args:
        run: the run's directory, where the recording is written. If there is one already, the new file is
            `run-2.rrd` and so on; the viewer shows them as one recording.
        env: a world for each replica, with transforms or without; the first is shown.
        title: the title in the viewer.
        episodes: the number of episodes of the run; determines how often frames are recorded.
        recipe: the recipe that the viewer shows.
        live: "serve", "spawn" or "connect ADDRESS", see `cprl.viewer.streams`; None for the file alone.
        exhibited: what is exhibited live: the present policy and one world for it, see
            `cprl.viewer.exhibition`.
        file_name: the name of the recording instead of `run.rrd`; there must be no such file.
        is_replay: whether a stored policy is replayed, see `cprl.viewer.scenery.Scene`.
        console: the console for the addresses; by default standard output.
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
        console: Console | None = None,
    ) -> None:
        checked("title", title, TEXT)
        object_of("recipe", recipe, Mapping | None, "a table, or None")
        checked("episodes", episodes, count(1))
        checked("file_name", file_name, either(TEXT, NONE))
        check_nesting(recipe, "recipe")
        run = path_of("run", run)
        self.env, self._episodes = env, episodes
        self._agents, reported = agent_names(env), reported_by(env)
        curves, commons = _curves(env, self._agents, reported), commons_of(env)
        scene = None if commons is None else scene_of(commons, curves, is_replay=is_replay)
        self.logger = RerunLogger(
            title,
            run,
            scene=scene,
            curves=curves,
            live=live,
            exhibits=exhibited is not None and scene is not None,
            file_name=file_name or _free_name(run),
            recording_id=_recording_id(run, file_name or FILE_NAME),
            console=console,
        )
        self._recorder = (
            None
            if commons is None or scene is None
            else FrameRecorder(commons, episodes=episodes, scene=scene)
        )
        self.exhibition: Exhibition | None = None
        """What the present policy plays for viewers; None where nothing is exhibited."""
        if exhibited is not None and scene is not None:
            self.exhibition = Exhibition(*exhibited, trained=env, scene=scene, live=self.logger.live)
        self.every = 0 if self._recorder is None else self._recorder.every
        """Episodes from one with frames to the next; 0 for no frames."""
        self._series = Series(curves.replicas)
        self._events = EventDetector() if curves.has_phases else None
        self._tags = np.zeros((len(self._agents),) * 2) if curves.has_tags else None
        self._step = self._episode = 0
        self._shows_next = False
        self._rate_at = time.perf_counter()
        self._rate_step = 0
        self.logger.log_hparams({"run": run.name, **(recipe or {})})
        self.logger.log_text(f"{title} begins")
        missing = left_out([*reported, *(["board"] if scene else [])], more=_SHOWN)
        if missing:
            self.logger.log_text(missing)
        if live and scene is None:
            self.logger.log_text("no exhibition: the game has no board")
        if curves.has_phases and not is_replay:
            self.logger.log_states("phase/now", {0: TOO_EARLY})

    def on_step(self, batch: TensorDictBase) -> None:
        """Copies the state of the first world after the turn, if this episode's frames are recorded.

        Otherwise it only counts: reading a tensor each turn would cost a training some percent.
        """
        self._step += 1
        if self.exhibition is not None:
            self.exhibition.on_step(episode=self._episode)
        if self._recorder is None or not self.is_shown:
            return
        if keys.entry(keys.entry(batch, "next"), keys.DONE)[
            0, 0
        ]:  # the board is already that of the next episode
            self._send_frames()
            return
        self._recorder.add(batch, step=self._step, episode=self._episode)
        if self._recorder.is_due:
            self._send_frames()

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Logs the numbers of an episode, and its events, once all replicas have ended it."""
        if episode.world == 0:
            self._episode, self._shows_next = episode.episode + 1, False
        if episode.world == 0 and (episode.depletion_step or -1) > 0:
            self.logger.at(step=self._step, episode=episode.episode)
            self.logger.log_text(
                f"episode {episode.episode}: the last apple was taken in step {episode.depletion_step}"
            )
        if self._tags is not None and episode.tagged_by is not None:
            self._tags += episode.tagged_by
        numbers = numbers_of(episode, learning, self._agents)
        of_all = self._series.add(episode.episode, episode.world, numbers)
        if of_all is not None:
            self.logger.at(step=self._step, episode=episode.episode)
            self._log(episode.episode, of_all)

    def _log(self, episode: int, of_all: Mapping[str, Values]) -> None:
        logger, now = self.logger, time.perf_counter()
        for name, values in of_all.items():
            singles = values.tolist() if name.startswith("social/") and len(values) > 1 else []
            logger.log_lines(name, [*singles, mean_of(values)])
        steps = (self._step - self._rate_step) * self._series.replicas
        if steps:
            logger.log_scalar("time/env_steps_per_s", steps / (now - self._rate_at))
            self._rate_at, self._rate_step = now, self._step
        if self._events is not None:
            self._log_events(self._events, episode, of_all)
        if self._tags is not None and (episode + 1) % TAGS_EVERY == 0 and len(self._agents) > 1:
            logger.log_matrix("tags", self._tags, ("tagged", "by whom"))
            self._tags[:] = 0

    def _log_events(self, detector: EventDetector, episode: int, of_all: Mapping[str, Values]) -> None:
        events = detector.add(
            {name.removeprefix("social/"): mean_of(values) for name, values in of_all.items()}
        )
        for event in events:
            self.logger.log_text(f"episode {episode}: {event}")
            self._shows_next |= event.startswith("new best")
        if any(event.startswith("phase") for event in events):
            self.logger.log_states("phase/now", {episode: detector.phase or ANOTHER})

    def log_event(self, event: str) -> None:
        """Logs an event as text, for instance a checkpoint."""
        self.logger.log_text(event)

    def play_on(self, stop: Event) -> None:
        """Exhibits the trained policy until the event is set; returns at once where nothing is exhibited."""
        if self.exhibition is not None:
            self.exhibition.play_on(stop, episode=self._episode)

    @property
    def is_shown(self) -> bool:
        """Whether the frames of the current episode are recorded."""
        last = self._episodes - 1
        return (
            self.every > 0
            and self._episode <= last
            and (self._episode % self.every == 0 or self._shows_next or self._episode == last)
        )

    def _send_frames(self) -> None:
        frames = None if self._recorder is None else self._recorder.take()
        if frames is not None:
            self.logger.log_frames(frames)

    def state_dict(self) -> dict[str, Any]:
        """The counters, events and pending numbers; frames are sent first."""
        self._send_frames()
        self.logger.flush()
        return {
            "step": self._step,
            "episode": self._episode,
            "shows_next": self._shows_next,
            "frames": self.logger.frames,
            "series": self._series.state_dict(),
            "story": None if self._events is None else self._events.state_dict(),
            "tags": None if self._tags is None else self._tags.tolist(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self._step = self._rate_step = int(state["step"])
        self._episode, self._shows_next = int(state["episode"]), bool(state["shows_next"])
        self.logger.frames = int(state["frames"])
        self._series.load_state_dict(state["series"])
        if self._events is not None:
            self._events.load_state_dict(state["story"])
        if self._tags is not None:
            self._tags = np.array(state["tags"])
        self.logger.at(step=self._step, episode=self._episode)
        self.logger.log_text(f"resumed from step {self._step:,}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._send_frames()
        found = [] if self._events is None else self._events.phases()
        if found:
            self.logger.log_states("phase/found", {round(one.first): one.label or ANOTHER for one in found})
        self.logger.shutdown()


def _curves(env: EnvBase, agents: tuple[str, ...], reported: Sequence[str]) -> Curves:
    """The numbers of an environment that are plotted."""
    metrics = available({**METRICS, "stock_left": FIELDS["stock_left"]}, reported)
    return Curves(
        agents=agents,
        replicas=env.batch_size.numel(),
        metrics=metrics,
        has_phases=set(phases.METRICS) <= set(metrics),
        has_tags="tagged_by" in reported,
    )


def _free_name(run: Path) -> str:
    """run.rrd, or run-2.rrd and so on if the run has a recording already."""
    names = (FILE_NAME if nth == 1 else f"run-{nth}.rrd" for nth in itertools.count(1))
    return next(name for name in names if not (run / name).exists())


def _recording_id(run: Path, file_name: str) -> str | None:
    """The recording id, the same when a run is resumed or extended; None where there is no run."""
    if not (run / RECIPE_FILE).exists():
        return None
    recipe = read_json(run / RECIPE_FILE)
    same = {name: own for name, own in recipe.items() if name not in ("experiment", "extended")}
    return str(uuid.uuid5(uuid.NAMESPACE_URL, file_name + json.dumps(same, sort_keys=True)))
