"""Watch: shows a training in the Rerun viewer while it goes on, and keeps it."""

import time
from collections.abc import Mapping
from math import ceil
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from tensordict import TensorDictBase

from cprl.envs.torchrl_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.recording.frames import Frame, FrameBuffer, classes_seen
from cprl.recording.rerun import FILE_NAME, RerunLogger
from cprl.recording.scenery import Scene

FRAME_BYTES: Final = 300
RECORDING_BYTES: Final = 60_000_000
"""A frame takes about so much of a file, and the frames of a whole run are to take about so much."""

_PERIOD_S: Final = 1.0
_FEWEST_FRAMES: Final = 50
"""Frames are sent when an episode ends, or after a second if there are so many: chunks cost something."""


class Watch:
    """Logs each episode's metrics, and the frames of the first world in every so many episodes.

    An observer of `cprl.train`, and a context manager.

    Args:
        run: the run's directory, where the recording is written.
        env: whose first world is shown.
        title: what is going on; the viewer shows it.
        episodes: how many will be played, by which the frames are rationed.
        recipe: what the viewer shows as the recipe of the run.
        serve: whether to serve the recording live on 127.0.0.1; the addresses are printed at once.
        file_name: of the recording.
        console: where to; by default standard output.
    """

    def __init__(
        self,
        run: Path,
        env: CommonsEnv,
        *,
        title: str,
        episodes: int,
        recipe: Mapping[str, object] | None = None,
        serve: bool = False,
        file_name: str = FILE_NAME,
        console: Console | None = None,
    ) -> None:
        game = env.game
        self.env = env
        _, rows, columns = game.observation_shape
        board = game.map.height, game.map.width
        scene = Scene(height=board[0], width=board[1], agents=game.agent_names, window=(rows, columns))
        self.logger = RerunLogger(title, run, scene=scene, serve=serve, file_name=file_name)
        steps = game.rules.episode_steps
        self.every = max(1, ceil(episodes * steps * FRAME_BYTES / RECORDING_BYTES))
        self._buffer = FrameBuffer(
            min(steps + 1, 5000), board=board, windows=(game.agents, *game.observation_shape)
        )
        self._step = self._episode = 0
        self._sent = self._episode_began = time.perf_counter()
        if serve:
            _tell(self.logger, console or Console())
        self.logger.log_hparams({"run": str(run), **(recipe or {})})
        self.logger.log_text(f"{title} begins")

    def see_turn(self, batch: TensorDictBase) -> None:
        """Copies the first world as it stands after the turn, if this episode's frames are kept."""
        self._step += 1
        if bool(batch.get(("next", "done")).reshape(-1)[0]):
            self._send_frames()
            self._episode += 1
        if self._episode % self.every:
            return
        self._buffer.add(self._step, self._episode, self._frame())
        waited = time.perf_counter() - self._sent
        if self._buffer.is_full or (waited > _PERIOD_S and self._buffer.size >= _FEWEST_FRAMES):
            self._send_frames()

    def see_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Logs the metrics of an episode of the first replica, each agent's return, and how learning went."""
        if episode.world:
            return
        logger, now = self.logger, time.perf_counter()
        logger.at(step=self._step, episode=episode.episode)
        for name, value in episode.metrics.items():
            logger.log_scalar(f"social/{name}", value)
        for agent, value in zip(self.env.game.agent_names, episode.return_, strict=True):
            logger.log_scalar(f"{agent}/return", value)
        for name, value in learning.items():
            logger.log_scalar(name, value)
        logger.log_scalar("time/env_steps_per_s", episode.steps / (now - self._episode_began))
        self._episode_began = now
        if episode.depletion_step > 0:
            logger.log_text(
                f"episode {episode.episode}: the last apple went in step {episode.depletion_step}"
            )

    def _frame(self) -> Frame:
        shown = self.env.worlds.show(self.env.told)
        return Frame(
            board=shown.board,
            windows=shown.observation,
            row=shown.row,
            col=shown.col,
            heading=shown.heading,
            in_play=shown.in_play,
        )

    def _send_frames(self) -> None:
        if self._buffer.size:
            frames = self._buffer.take()
            frames["windows"] = classes_seen(self.env.game, frames["windows"])
            self.logger.log_frames(frames)
        self._sent = time.perf_counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._send_frames()
        self.logger.shutdown()


def _tell(logger: RerunLogger, console: Console) -> None:
    for where, address in logger.addresses.items():
        console.print(f"Watch live ({where}): {address}", soft_wrap=True, highlight=False)
