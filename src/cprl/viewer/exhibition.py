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
from cprl.envs.state import load_transforms_state, transforms_state
from cprl.envs.unwrap import commons_of
from cprl.viewer.recorder import FrameRecorder
from cprl.viewer.scenery import BACKGROUND, Scene
from cprl.viewer.stage import RIM_CELLS, board_columns, fixed
from cprl.viewer.streams import Live

STEPS_PER_S: Final = 11
"""Steps of the exhibited world in a second of wall time."""

MOST_SHARE: Final = 0.012
"""The share of the training's wall time that its thread may spend on the exhibition: where a step of it takes
longer than 1.1 ms, it plays more slowly."""

EVERY_STEPS: Final = 11
"""Steps after which the caption is sent again, and the state of transforms is taken over."""

_BOARD: Final = "world"
"""Where the entities of the recorded board are."""

_CAPTION_CELLS, _ROOM_CELLS = 0.4, 2.4
"""The distances from the board to the caption and to the line that gives it room, in cells."""
_THIN: Final = 0.01


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
        """A context in which nothing changes torch's generators for the rest of the process."""

    def __call__(self, carried: TensorDictBase) -> TensorDictBase:
        """Writes ("agents", "action"), int64 [1, N]."""


class Exhibition:
    """Plays a step when one is due, and sends viewers the board as static entities: they have no time.

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
    ) -> None:
        commons = commons_of(env)
        if commons is None or tuple(env.batch_size) != (1,):
            raise ValueError(
                f"the exhibition has a {type(env).__name__} of batch size {list(env.batch_size)}; allowed: "
                "one world of a CommonsEnv, with transforms or without"
            )
        self._policy, self._env, self._trained, self._scene = policy, env, trained, scene
        self._live, self._clock = live, clock
        self._recorder = FrameRecorder(commons, episodes=1, scene=scene, capacity=1)
        self._carried: TensorDictBase | None = None
        self._due = clock()
        self._steps, self._caption = 0, ""
        self._there = {"beams": False, "out": False}
        self.is_over = live.stream is None or live.exhibition is None
        """Whether it has ended, because it failed or has no viewers."""
        for entity, parts in fixed(scene).items():
            if live.stream is not None and entity.startswith(f"{_BOARD}/"):
                live.stream.do(_log(_renamed(entity), *parts))
        if live.stream is not None:
            live.stream.do(_log("exhibition/room", _room(scene)))
        if live.exhibition is not None:  # before anything is compiled, which takes half a minute at first
            live.exhibition.do(partial(_send, scene=scene, frames=_before_the_first_step(commons.game)))
            self._send_caption(0)

    def on_step(self, *, episode: int) -> None:
        """Plays a step if one is due; `episode` is that of the training, for the caption."""
        now = self._clock()
        if now < self._due or self.is_over:
            return
        self._play(episode)
        spent = self._clock() - now
        self._due = max(now + max(1 / STEPS_PER_S, spent / MOST_SHARE), self._due + 1 / STEPS_PER_S)

    def play_on(self, stop: Event, *, episode: int) -> None:
        """Plays the trained policy until the event is set; returns at once where it has ended."""
        self._policy.is_trained = True
        while not (self.is_over or stop.is_set()):
            began = self._clock()
            self._play(episode)
            stop.wait(max(0.0, 1 / STEPS_PER_S - (self._clock() - began)))

    def _play(self, episode: int) -> None:
        live = self._live.exhibition
        if live is None or live.is_behind:
            return
        try:
            with self._policy.apart():
                self._step()
        except Exception as error:
            self.is_over = True
            warnings.warn(
                f"the exhibition failed, the run continues without it: {type(error).__name__}: {error}",
                RuntimeWarning,
                stacklevel=4,
            )
            return
        frames = self._recorder.take()
        if frames is not None:
            live.do(partial(_send, scene=self._scene, frames=frames, **self._changing(frames)))
        self._send_caption(episode)

    def _step(self) -> None:
        """One step of the world, of which the recorder then has a frame; the first only begins an episode."""
        if self._steps % EVERY_STEPS == 0 and isinstance(self._env, TransformedEnv):
            load_transforms_state(self._env, transforms_state(self._trained))
        self._steps += 1
        if self._carried is None:
            self._carried = self._env.reset()
            self._recorder.add_board()
            return
        batch, self._carried = self._env.step_and_maybe_reset(self._policy(self._carried))
        self._recorder.add(batch, step=0, episode=0)

    def _changing(self, frames: Mapping[str, NDArray[Any]]) -> dict[str, bool]:
        """Whether beams and agents out of play must be sent: with any, after any, and now and then."""
        there = {"beams": bool(frames["beams"].any()), "out": not frames["in_play"].all()}
        before, self._there = self._there, there
        again = self._steps % EVERY_STEPS == 0
        return {name: again or there[name] or before[name] for name in there}

    def _send_caption(self, episode: int) -> None:
        """Sends the caption where it has changed, and now and then for viewers that came later."""
        caption = caption_of(self._policy, episode)
        if caption == self._caption and self._steps % EVERY_STEPS:
            return
        import rerun as rr

        self._caption = caption
        place = (self._scene.width / 2 + RIM_CELLS, self._scene.height + 2 * RIM_CELLS + _CAPTION_CELLS)
        what = rr.Points2D([place], labels=[caption], show_labels=True, radii=_THIN, colors=[(255, 255, 255)])
        if self._live.exhibition is not None:
            self._live.exhibition.do(_log("exhibition/caption", what))


def caption_of(policy: Exhibited, episode: int) -> str:
    """What is shown: "present policy, episode 1,234, epsilon 0.31", without the last for agents that have no
    epsilon."""
    policy.explore_as_now()
    shown = list(dict.fromkeys(f"{epsilon:.2f}" for epsilon in policy.epsilons))
    chance = f", epsilon {' to '.join(dict.fromkeys((shown[0], shown[-1])))}" if shown else ""
    return f"{'trained' if policy.is_trained else 'present'} policy, episode {episode:,}{chance}"


def _room(scene: Scene) -> Any:
    """A line below the board in the colour of the background: the view makes room for what it shows."""
    import rerun as rr

    low = scene.height + 2 * RIM_CELLS + _ROOM_CELLS
    ends = [(0.0, low), (scene.width + 2 * RIM_CELLS, low)]
    return rr.LineStrips2D([ends], radii=_THIN, colors=[BACKGROUND])


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


def _renamed(entity: str) -> str:
    """The name in the exhibition of an entity of the recorded board."""
    return "exhibition" + entity.removeprefix(_BOARD)


def _log(entity: str, *what: Any) -> Callable[[Any], object]:
    return lambda recording: recording.log(entity, *what, static=True)


def _send(
    recording: Any, *, scene: Scene, frames: Mapping[str, NDArray[Any]], beams: bool = True, out: bool = True
) -> None:
    """Sends a frame without a time, so that viewers keep no other."""
    for entity, (_, what) in board_columns(scene, frames, beams=beams, out=out).items():
        recording.send_columns(_renamed(entity), [], what)
