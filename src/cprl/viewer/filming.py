"""Filming: which episodes of a training are recorded frame by frame, and their frames."""

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase

from cprl import keys
from cprl.envs.commons_env import CommonsEnv
from cprl.viewer.logger import RerunLogger
from cprl.viewer.recorder import FrameRecorder
from cprl.viewer.scenery import Scene


class Filming:
    """Logs the frames of the first world in every k-th episode, including the first and the last, and in the
    episode after each new best.

    Args:
        env: the environment without its transforms; None for no frames.
        logger: where frames are logged.
        scene: the contents of the board; None for no frames.
        episodes: the number of episodes of the run; determines how often frames are recorded.
    """

    def __init__(
        self, env: CommonsEnv | None, logger: RerunLogger, scene: Scene | None, *, episodes: int
    ) -> None:
        self._logger, self._last = logger, episodes - 1
        self._recorder: FrameRecorder | None = None
        if env is not None and scene is not None:
            self._recorder = FrameRecorder(env, episodes=episodes, scene=scene)
        self.every = 0 if self._recorder is None else self._recorder.every
        """Episodes from one with frames to the next; 0 for no frames."""
        self.shows_next = False
        """Whether the running episode is recorded in any case."""
        self.is_on = False
        """Whether frames are recorded now; `choose` decides it."""

    def is_shown(self, episode: int) -> bool:
        """Whether the frames of an episode that runs now are recorded."""
        is_chosen = self.every > 0 and (episode % self.every == 0 or self.shows_next or episode == self._last)
        return is_chosen and episode <= self._last

    def choose(self, episode: int) -> None:
        """Records from now on if the frames of this episode are recorded."""
        self.is_on = self.is_shown(episode)

    def add(self, batch: TensorDictBase, *, step: int, episode: int) -> int | None:
        """Copies a frame if this episode's are recorded; returns its number, None if there is none."""
        if self._recorder is None or not self.is_on:
            return None
        # Where an episode ends, the board is already that of the next one.
        if keys.entry(keys.entry(batch, "next"), keys.DONE)[0, 0]:
            self.send()
            return None
        self._recorder.add(batch, step=step, episode=episode)
        frame = self._logger.frames + self._recorder.pending - 1
        if self._recorder.is_due:
            self.send()
        return frame

    def send(self) -> None:
        """Sends the frames that wait."""
        frames = None if self._recorder is None else self._recorder.take()
        if frames is not None:
            self._logger.log_frames(frames)

    def state_dict(self) -> dict[str, Any]:
        """What is to be recorded, and the number of frames so far; those that wait are sent first."""
        self.send()
        return {"shows_next": self.shows_next, "frames": self._logger.frames}

    def load_state_dict(self, state: Mapping[str, Any], *, episode: int) -> None:
        """Continues from these entries, in the episode that runs."""
        self.shows_next, self._logger.frames = bool(state["shows_next"]), int(state["frames"])
        self.choose(episode)
