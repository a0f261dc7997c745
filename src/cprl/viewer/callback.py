"""ViewerCallback: shows a training in the Rerun viewer while it goes on, and keeps it."""

import time
import uuid
from collections.abc import Mapping
from itertools import count
from math import ceil
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from rich.console import Console
from tensordict import TensorDictBase

from cprl import keys
from cprl.commons.colours import BEAM
from cprl.commons.seeing import classes_seen
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.runs.directory import FILE_NAME as RECIPE_FILE
from cprl.viewer.events import ANOTHER, EventDetector
from cprl.viewer.frames import Frame, FrameBuffer
from cprl.viewer.logger import FILE_NAME, RerunLogger
from cprl.viewer.scenery import TOO_EARLY, Scene
from cprl.viewer.series import Series, Values, mean_of
from cprl.viewer.stage import frame_bytes

FRAMES_BYTES: Final = 45_000_000
"""The frames of every k-th episode are to take about so much of a file; those after new bests come on top."""
TAGS_EVERY: Final = 50
"""Episodes whose tags make one matrix of who tagged whom."""

_PERIOD_S: Final = 1.0
_FEWEST_FRAMES: Final = 50
"""Frames are sent when an episode ends, or after a second if there are so many: chunks cost something."""


class ViewerCallback:
    """Logs the metrics of every episode, and the frames of the first world in some.

    Frames are kept of every so many episodes, the first and the last among them, and of the one after each
    new best. Of several replicas metrics are told as soon as all have ended an episode: their mean and each
    of them; returns, losses and the like as means. An observer of `cprl.training`, and a context manager.

    Args:
        run: the run's directory, where the recording is written; beside one that is there, as `run-2.rrd`
            and so on, which the viewer shows as one with it.
        env: a world for each replica; the first is shown.
        title: what is going on; the viewer shows it.
        episodes: how many will be played, by which the frames are rationed.
        recipe: what the viewer shows as the recipe of the run.
        live: "serve", "spawn" or "connect ADDRESS", see `cprl.viewer.streams`; None for the file alone.
        file_name: of the recording, instead of `run.rrd`; then nothing of that name may be there.
        is_replay: whether a stored policy plays again, see `cprl.viewer.scenery.Scene`.
        console: where to tell how to watch; by default standard output.
    """

    def __init__(
        self,
        run: Path,
        env: CommonsEnv,
        *,
        title: str,
        episodes: int,
        recipe: Mapping[str, object] | None = None,
        live: str | None = None,
        file_name: str | None = None,
        is_replay: bool = False,
        console: Console | None = None,
    ) -> None:
        game, replicas = env.game, env.batch_size.numel()
        self.env, self._episodes = env, episodes
        _, rows, columns = game.observation_shape
        board = game.map.height, game.map.width
        scene = Scene(
            height=board[0],
            width=board[1],
            walls=game.map.walls,
            sites=game.map.sites,
            agents=game.agent_names,
            window=(rows, columns),
            replicas=replicas,
            is_replay=is_replay,
        )
        self.logger = RerunLogger(
            title,
            run,
            scene=scene,
            live=live,
            file_name=file_name or _free_name(run),
            recording_id=_recording_id(run, title),
            console=console,
        )
        steps = game.rules.episode_steps
        self.every = max(1, ceil(episodes * steps * frame_bytes(scene) / FRAMES_BYTES))
        self._buffer = FrameBuffer(
            min(steps + 1, 5000),
            board=board,
            sites=len(game.map.sites),
            windows=(game.agents, *game.observation_shape),
        )
        self._series, self._events = Series(replicas), EventDetector()
        self._tags = np.zeros((game.agents, game.agents))
        self._tagged_by = np.full(game.agents, -1, np.int32)
        self._step = self._episode = 0
        self._shows_next = False
        self._sent = self._told_at = time.perf_counter()
        self._told_step = 0
        self.logger.log_hparams({"run": str(run), **(recipe or {})})
        self.logger.log_text(f"{title} begins")
        if not is_replay:
            self.logger.log_states("phase/now", {0: TOO_EARLY})

    def on_step(self, batch: TensorDictBase) -> None:
        """Copies the first world as it stands after the turn, if this episode's frames are kept.

        Otherwise it does next to nothing: a look at a tensor each turn would cost a training some percent.
        """
        self._step += 1
        if not self.is_shown:
            return
        if keys.entry(keys.entry(batch, "next"), keys.DONE)[0, 0]:  # the board is the next episode's already
            self._send_frames()
            return
        self._remember_tags(batch)
        self._buffer.add(self._step, self._episode, self._frame())
        waited = time.perf_counter() - self._sent
        if self._buffer.is_full or (waited > _PERIOD_S and self._buffer.size >= _FEWEST_FRAMES):
            self._send_frames()

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Logs the numbers of an episode once all replicas have ended it, and what is new."""
        numbers = {f"social/{name}": value for name, value in episode.metrics.items()}
        numbers["social/stock_left"] = float(episode.stock_left)
        for agent, value in zip(self.env.game.agent_names, episode.return_, strict=True):
            numbers[f"{agent}/return"] = float(value)
        if episode.world == 0:
            self._episode, self._shows_next = episode.episode + 1, False
        if episode.world == 0 and episode.depletion_step > 0:
            self.logger.at(step=self._step, episode=episode.episode)
            self.logger.log_text(
                f"episode {episode.episode}: the last apple went in step {episode.depletion_step}"
            )
        self._tags += episode.tagged_by
        of_all = self._series.add(episode.episode, episode.world, {**numbers, **learning})
        if of_all is not None:
            self.logger.at(step=self._step, episode=episode.episode)
            self._log(episode.episode, of_all)

    def _log(self, episode: int, of_all: Mapping[str, Values]) -> None:
        logger, now = self.logger, time.perf_counter()
        for name, values in of_all.items():
            singles = values.tolist() if name.startswith("social/") and len(values) > 1 else []
            logger.log_lines(name, [*singles, mean_of(values)])
        steps = (self._step - self._told_step) * self._series.replicas
        if steps:
            logger.log_scalar("time/env_steps_per_s", steps / (now - self._told_at))
            self._told_at, self._told_step = now, self._step
        output = self._events.add(
            {name.removeprefix("social/"): mean_of(values) for name, values in of_all.items()}
        )
        for event in output:
            logger.log_text(f"episode {episode}: {event}")
            self._shows_next |= event.startswith("new best")
        if any(event.startswith("phase") for event in output):
            logger.log_states("phase/now", {episode: self._events.phase or ANOTHER})
        if (episode + 1) % TAGS_EVERY == 0 and self.env.game.agents > 1:
            logger.log_matrix("tags", self._tags, ("tagged", "by whom"))
            self._tags[:] = 0

    def log_event(self, event: str) -> None:
        """Logs an event in words, a checkpoint for instance."""
        self.logger.log_text(event)

    @property
    def is_shown(self) -> bool:
        """Whether frames are kept of the episode that goes on."""
        last = self._episodes - 1
        return self._episode <= last and (
            self._episode % self.every == 0 or self._shows_next or self._episode == last
        )

    def _remember_tags(self, batch: TensorDictBase) -> None:
        """Who was tagged in the first world this turn, and by whom; of several shooters the first."""
        tagged_by = batch["next"][keys.TAGGED_BY][0].cpu().numpy()
        tagged = tagged_by.any(1)
        self._tagged_by[tagged] = tagged_by.argmax(1)[tagged]

    def _frame(self) -> Frame:
        shown = self.env.worlds.show(self.env.output)
        return Frame(
            beams=shown.board == BEAM,
            stock=shown.stock,
            windows=shown.observation,
            row=shown.row,
            col=shown.col,
            heading=shown.heading,
            in_play=shown.in_play,
            tagged_by=self._tagged_by,
            harvested=shown.harvested,
        )

    def _send_frames(self) -> None:
        if self._buffer.size:
            frames = self._buffer.take()
            frames["windows"] = classes_seen(self.env.game, frames["windows"])
            self.logger.log_frames(frames)
        self._sent = time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        """What it has seen and still waits for; frames are sent first."""
        self._send_frames()
        self.logger.flush()
        return {
            "step": self._step,
            "episode": self._episode,
            "shows_next": self._shows_next,
            "frames": self.logger.frames,
            "series": self._series.state_dict(),
            "story": self._events.state_dict(),
            "tags": self._tags.tolist(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on where the watch of that state was."""
        self._step = self._told_step = int(state["step"])
        self._episode, self._shows_next = int(state["episode"]), bool(state["shows_next"])
        self.logger.frames = int(state["frames"])
        self._series.load_state_dict(state["series"])
        self._events.load_state_dict(state["story"])
        self._tags = np.array(state["tags"])
        self.logger.at(step=self._step, episode=self._episode)
        self.logger.log_text(f"gone on with from step {self._step:,}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._send_frames()
        found = self._events.phases()
        if found:
            self.logger.log_states("phase/found", {round(one.first): one.label or ANOTHER for one in found})
        self.logger.shutdown()


def _free_name(run: Path) -> str:
    """run.rrd, or run-2.rrd and so on where the run was recorded before."""
    names = (FILE_NAME if nth == 1 else f"run-{nth}.rrd" for nth in count(1))
    return next(name for name in names if not (run / name).exists())


def _recording_id(run: Path, title: str) -> str | None:
    """The same for a run that is gone on with; None where the directory is no run's."""
    recipe = run / RECIPE_FILE
    if not recipe.exists():
        return None
    return str(uuid.uuid5(uuid.NAMESPACE_URL, title + recipe.read_text(encoding="utf-8")))
