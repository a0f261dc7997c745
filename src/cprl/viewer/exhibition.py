"""Exhibition: a world of its own that the present policy of a training plays, for viewers alone."""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from threading import Event
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv

from cprl.commons.game import Game
from cprl.envs.recurrent_states import begin_states
from cprl.envs.state import load_transforms_state, transforms_state
from cprl.envs.unwrap import commons_of
from cprl.viewer.live_board import LiveBoard, send_fixed
from cprl.viewer.recorder import FrameRecorder
from cprl.viewer.scenery import Scene
from cprl.viewer.streams import Live

BATCH_S: Final = 2.0
"""Seconds whose steps are played at once, because many steps in a row take a quarter of the time of as many
between steps of the training; they are sent one by one."""

BATCH_STEPS: Final = 21
"""Steps of the exhibited world in this time: 10.5 in a second of wall time."""

MOST_SHARE: Final = 0.01
"""The share of the training's wall time that its thread may spend on the exhibition: where a step of it takes
longer than 0.95 ms, it plays fewer."""

LONGEST_S: Final = 10.0
"""The longest time that a viewer sees the same board, if a step took exceptionally long."""


class Exhibited(Protocol):
    """All agents of one world; `cprl.policies.present.PresentPolicy` is one."""

    is_trained: bool
    """Whether the training is over."""

    @property
    def epsilons(self) -> Sequence[float]:
        """The probabilities with which agents act at random, ascending; empty for agents without any."""

    def explore_as_now(self) -> None:
        """Sets each agent's exploration to what it is now."""

    def apart(self) -> AbstractContextManager[Any]:
        """A context to play steps in: agents explore as they do when it begins, and nothing changes torch's
        generators for the rest of the process."""

    def __call__(self, carried: TensorDictBase) -> TensorDictBase:
        """Writes ("agents", "action"), int64 [1, N]; called within `apart`."""


class Exhibition:
    """Plays steps when they are due, and sends viewers the board as static entities: they have no time.

    So a viewer shows the newest board wherever its cursor is and on every timeline, and keeps that one alone,
    however long the training takes. Nothing of it is written to the file. If it fails, it warns once, and the
    training continues without it.

    Args:
        policy: the agents.
        env: one world that no training or evaluation plays, with the transforms of the training.
        trained: the environment of the training; what its transforms learn is taken over.
        scene: the contents of the board.
        live: what viewers are sent.
        clock: seconds of wall time.
        wait: waits so many seconds between two frames, in the thread that sends them; returns whether to
            leave out the rest. By default until `close`.

    Raises:
        ValueError: for another number of worlds than one, or a game without a board.
    """

    def __init__(
        self,
        policy: Exhibited,
        env: EnvBase,
        *,
        trained: EnvBase,
        scene: Scene,
        live: Live,
        clock: Callable[[], float] = time.perf_counter,
        wait: Callable[[float], bool] | None = None,
    ) -> None:
        commons = commons_of(env)
        if commons is None or tuple(env.batch_size) != (1,):
            raise ValueError(
                f"the exhibition has a {type(env).__name__} of batch size {list(env.batch_size)}; allowed: "
                "one world of a CommonsEnv, with transforms or without"
            )
        self._policy, self._env, self._trained, self._board = policy, env, trained, LiveBoard(scene)
        self._live, self._clock, self._closing = live, clock, Event()
        self._wait = wait or self._slept
        self._recorder = FrameRecorder(
            commons, episodes=1, scene=scene, capacity=BATCH_STEPS, has_windows=False
        )
        self._carried: TensorDictBase | None = None
        self._due, self._count = clock(), BATCH_STEPS
        self.steps = 0
        """Steps played so far."""
        self.is_over = live.stream is None or live.exhibition is None
        """Whether it has ended, because it failed or has no viewers."""
        if live.stream is not None:
            live.stream.do(partial(send_fixed, scene=scene))
        # Compiling may take half a minute, and of a run that is resumed no policy is loaded yet.
        self._send(_before_the_first_step(commons.game), "the board as an episode begins")

    def on_step(self, *, episode: int) -> None:
        """Plays the steps of two seconds if they are due; `episode` is the training's, for the caption."""
        now = self._clock()
        if now >= self._due and not self.is_over:
            self._due = now + BATCH_S
            self._play(episode)

    def play_on(self, stop: Event, *, episode: int) -> None:
        """Plays the trained policy until the event is set; returns at once where it has ended."""
        self._policy.is_trained = True
        while not (self.is_over or stop.is_set()):
            self._play(episode)
            stop.wait(BATCH_S)

    def close(self) -> None:
        """Leaves out frames that have not been sent."""
        self._closing.set()

    def _slept(self, seconds: float) -> bool:
        """Whether `close` was called by the end of so many seconds; an event's own `wait` takes
        longer to end, and keeps the training from going on meanwhile."""
        time.sleep(seconds)
        return self._closing.is_set()

    def _play(self, episode: int) -> None:
        """Plays some steps, and has them sent; fewer the next time if they took long."""
        if self._live.exhibition is None or self._live.exhibition.is_behind:
            return
        began = self._clock()
        try:
            with self._policy.apart():
                for _ in range(self._count):
                    self._step()
        except Exception as error:
            self.is_over = True
            warnings.warn(
                f"the exhibition failed, the run continues without it: {type(error).__name__}: {error}",
                RuntimeWarning,
                stacklevel=4,
            )
            return
        spent = self._clock() - began
        is_first = self.steps == self._count  # much of it was compiling
        self._due = max(self._due, began + (0.0 if is_first else min(spent / MOST_SHARE, LONGEST_S)))
        affordable = int(MOST_SHARE * BATCH_S / max(spent / self._count, 1e-9))
        self._count = max(1, min(BATCH_STEPS, affordable))
        frames = self._recorder.take()
        if frames is not None:
            self._send(frames, caption_of(self._policy, episode))

    def _step(self) -> None:
        """One step of the world, of which the recorder then has a frame; the first only begins an episode."""
        self.steps += 1
        if self._carried is None:
            self._carried = self._env.reset()
            self._recorder.add_board()
            return
        batch, self._carried = self._env.step_and_maybe_reset(self._policy(self._carried))
        begin_states(self._carried, self._carried, batch)
        self._recorder.add(batch, step=0, episode=0)
        if isinstance(self._env, TransformedEnv) and self.steps % BATCH_STEPS == 0:
            load_transforms_state(self._env, transforms_state(self._trained))

    def _send(self, frames: Mapping[str, NDArray[Any]], caption: str) -> None:
        if self._live.exhibition is not None:
            shown = partial(self._board.send, frames=frames, caption=caption)
            self._live.exhibition.do(partial(shown, wait=self._wait, lasting_s=BATCH_S))


def caption_of(policy: Exhibited, episode: int) -> str:
    """What is shown: "present policy, episode 1,234, epsilon 0.31", without the last for agents that have no
    epsilon."""
    policy.explore_as_now()
    shown = list(dict.fromkeys(f"{epsilon:.2f}" for epsilon in policy.epsilons))
    chance = f", epsilon {' to '.join(dict.fromkeys((shown[0], shown[-1])))}" if shown else ""
    return f"{'trained' if policy.is_trained else 'present'} policy, episode {episode:,}{chance}"


def _before_the_first_step(game: Game) -> dict[str, NDArray[Any]]:
    """The frame of the board as an episode begins, drawn from the map."""
    board, agents = game.map, game.agents
    row, col, heading = np.array(board.starts, np.int32).T
    one = {
        "step": np.zeros((), np.int64),
        "episode": np.zeros((), np.int64),
        "beams": np.zeros((board.height, board.width), np.bool_),
        "stock": np.ones(len(board.sites), np.uint8),
        "windows": np.zeros((agents, *game.observation_shape[1:]), np.uint8),
        "row": row,
        "col": col,
        "heading": heading,
        "in_play": np.ones(agents, np.bool_),
        "tagged_by": np.full(agents, -1, np.int32),
        "harvested": np.zeros(agents, np.int32),
    }
    return {name: array[None] for name, array in one.items()}
