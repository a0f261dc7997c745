"""Exhibition: a world of its own that the current policy of a training plays, for viewers alone."""

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from threading import Event
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv

from cprl import keys
from cprl.commons.game import Game
from cprl.envs.state import load_transforms_state, transforms_state
from cprl.envs.unwrap import commons_of
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import Policy, turns
from cprl.policies.present import PresentPolicy
from cprl.viewer.board import RIM_CELLS, Frames, board_columns, board_form, board_styles
from cprl.viewer.frames import FrameRecorder
from cprl.viewer.logger import RerunLogger
from cprl.viewer.scene import Scene
from cprl.viewer.views import View

BATCH_S: Final = 2.1
"""Seconds whose steps are played at once, because many steps in a row take a quarter of the time of as many
between steps of the training; they are sent one by one."""
BATCH_STEPS: Final = 21
"""Steps of the exhibited world in this time: 10 in a second of wall time."""
MOST_SHARE: Final = 0.01
"""The share of the training's wall time that its thread may spend on the exhibition: where a step of it takes
longer than 0.95 ms, it plays fewer."""
REST_S: Final = 10.0
"""Seconds for which the last board of an episode of the trained policy stays: of a tragedy the empty one."""
LONGEST_S: Final = 10.0
"""The longest time that a viewer sees the same board, if a step took exceptionally long."""


class Exhibition(View):
    """Plays steps when they are due, and sends viewers the board as static entities: they have no time.

    So a viewer shows the newest board wherever its cursor is and on every timeline, and keeps that one alone,
    however long the training takes. Nothing of it is written to the file. If it fails, it warns once, and the
    training continues without it.

    Args:
        env: one world that no training or evaluation plays, with the transforms of the training.
        trained: the environment of the training; what its transforms learn is taken over.
        logger: the recording of the training, which is live. The server of its own stream keeps what never
            changes for viewers that come later; that of the exhibition keeps the newest frame alone.
        clock: seconds of wall time.
        wait: waits so many seconds between two frames, in the thread that sends them; returns whether to
            leave out the rest. By default until `close`.
    """

    def __init__(
        self,
        policy: PresentPolicy,
        env: EnvBase,
        *,
        trained: EnvBase,
        logger: RerunLogger,
        clock: Callable[[], float] = time.perf_counter,
        wait: Callable[[float], bool] | None = None,
    ) -> None:
        commons = commons_of(env)
        scene = logger.scene
        live = logger.live
        assert commons is not None
        assert scene is not None
        assert live is not None
        assert live.exhibition is not None
        self._policy = policy
        self._env = env
        self._trained = trained
        self._scene = scene
        self._logger = logger
        self._stream = live.exhibition
        self._clock = clock
        self._closing = Event()
        self._wait = wait or self._slept
        self._at_random: FrameRecorder | None = None
        self._recorder = FrameRecorder(commons, scene, has_windows=False)
        self._moves = self._played()
        self._due = clock()
        self._count = BATCH_STEPS
        self._rests = False
        """Whether an episode of the trained policy has just ended."""
        self.steps = 0
        """Steps played so far."""
        self.is_over = False
        """Whether it has ended, because it failed."""
        live.stream.do(partial(_send_fixed, scene=scene))
        # Compiling may take half a minute, and of a run that is resumed no policy is loaded yet.
        self._send(_before_the_first_step(commons.game), _beginning(commons.game))

    def on_step(self, batch: TensorDictBase) -> None:
        """Play the steps of a batch if they are due."""
        now = self._clock()
        if now >= self._due and not self.is_over:
            self._due = now + BATCH_S
            self._play(self._logger.episode)

    def seen(self, env: EnvBase, policy: Policy) -> Policy:
        """Return the policy of random play, whose first world viewers see until the training begins."""
        commons = commons_of(env)
        assert commons is not None
        recorder = self._at_random = FrameRecorder(commons, self._scene, has_windows=False)

        def acted(moment: TensorDictBase) -> TensorDictBase:
            recorder.add()
            return policy(moment)

        return acted

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Have the episode of the first world sent, which shows what compares with the training while its
        code is compiled; what is left of it when the exhibition begins is left out."""
        frames = None if self._at_random is None else self._at_random.take()
        if frames is not None:
            first = {name: array[: episodes[0].steps] for name, array in frames.items()}
            self._send(first, "random play, before the training", wait=self._until_it_begins)

    def _until_it_begins(self, seconds: float) -> bool:
        return self._wait(seconds) or self.steps > 0

    def play_on(self, stop: Event) -> None:
        """Play the trained policy until the event is set; return at once where it has ended.

        It rests when an episode ends.
        """
        self._policy.is_trained = True
        while not (self.is_over or stop.is_set()):
            self._play(0)
            stop.wait(REST_S if self._rests else BATCH_S)

    def close(self) -> None:
        """Leave out frames that have not been sent."""
        self._closing.set()

    def _slept(self, seconds: float) -> bool:
        """Return whether `close` was called by the end of so many seconds; an event's own `wait` takes
        longer to end, and keeps the training from going on meanwhile."""
        time.sleep(seconds)
        return self._closing.is_set()

    def _play(self, episode: int) -> None:
        """Play some steps, and have them sent; fewer the next time if they took long."""
        if self._stream.is_behind:
            return
        began = self._clock()
        end = None
        try:
            with self._policy.apart():
                if isinstance(self._env, TransformedEnv):
                    load_transforms_state(self._env, transforms_state(self._trained))
                for _ in range(self._count):
                    end = self._step()
                    if end is not None and self._policy.is_trained:
                        break
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
        self._rests = end is not None and self._policy.is_trained
        frames = self._recorder.take()
        if frames is not None:
            caption = caption_of(self._policy, episode)
            self._send(frames, caption)
            if self._rests:
                self._stream.do(partial(_send_caption, caption=f"{caption}: {end}"))

    def _step(self) -> str | None:
        """Play a step, of which the recorder then has a frame; return in words how an episode has ended."""
        self.steps += 1
        return next(self._moves)

    def _played(self) -> Iterator[str | None]:
        """Play episode after episode; the first step of each only begins it, the last leaves its board."""
        while True:
            batches = turns(self._env, self._policy)
            self._recorder.add()
            yield None
            for turn, batch in enumerate(batches, start=1):
                self._recorder.add(batch)
                if batch["next"][keys.DONE][0, 0]:
                    end = "no apple is left" if batch["next", "terminated"][0, 0] else "the end"
                    yield f"{end}, turn {turn:,}"
                else:
                    yield None

    def _send(self, frames: Frames, caption: str, *, wait: Callable[[float], bool] | None = None) -> None:
        send = partial(_send_frames, scene=self._scene, frames=frames, caption=caption)
        self._stream.do(partial(send, wait=wait or self._wait))


def caption_of(policy: PresentPolicy, episode: int) -> str:
    """Return what is shown: "current policy, episode 1,234, epsilon 0.31", without the last for agents that
    have no epsilon, and without the episode after the training."""
    policy.explore_as_now()
    chances = list(dict.fromkeys(f"{epsilon:.2f}" for epsilon in policy.epsilons))
    chance = f", epsilon {' to '.join(dict.fromkeys((chances[0], chances[-1])))}" if chances else ""
    return f"trained policy{chance}" if policy.is_trained else f"current policy, episode {episode:,}{chance}"


_CAPTION_CELLS = 2.3
"""The distance from the board to the caption, in cells."""
_THIN: Final = 0.01


def _send_fixed(recording: Any, *, scene: Scene) -> None:
    """Send what never changes; formats of images are in each frame instead: a viewer that gets one after a
    frame, for the first time or again, shows no board until the next frame."""
    for entity, parts in board_styles().items():
        recording.log(f"exhibition/{entity}", *parts, static=True)
    low = scene.height + 2 * RIM_CELLS
    wide = scene.width + 2 * RIM_CELLS
    place = wide / 2, low + _CAPTION_CELLS
    caption = rr.Points2D([place], show_labels=True, radii=_THIN, colors=[(255, 255, 255)])
    recording.log("exhibition/caption", caption, static=True)


def _send_frames(
    recording: Any, *, scene: Scene, frames: Frames, caption: str, wait: Callable[[float], bool]
) -> None:
    """Send frames one by one, over the time of a batch, until `wait` says to leave out the rest."""
    _send_caption(recording, caption=caption)
    rows = _rows(scene, frames)
    for sent, row in enumerate(rows, 1):
        for entity, columns in row:
            recording.send_columns(f"exhibition/{entity}", [], columns)
        if sent < len(rows) and wait(BATCH_S / min(len(rows), BATCH_STEPS)):
            return


def _send_caption(recording: Any, *, caption: str) -> None:
    recording.send_columns("exhibition/caption", [], rr.Points2D.columns(labels=[caption]))


class _Row(NamedTuple):
    """A component's column of one row, as `send_columns` reads it."""

    kind: Any
    values: Any

    def component_descriptor(self) -> Any:
        return self.kind

    def as_arrow_array(self) -> Any:
        return self.values


def _rows(scene: Scene, frames: Frames) -> list[list[tuple[str, list[Any]]]]:
    """Return what each frame changes: entities and their columns of one row, cut out of those of all frames,
    which takes a tenth of the time of columns for each."""
    rows: list[list[tuple[str, list[Any]]]] = [[] for _ in frames["step"]]
    for entity, (numbers, columns) in board_columns(scene, frames).items():
        if entity == "board":
            forms = rr.SegmentationImage.columns(format=[board_form(scene)] * len(numbers))
            columns = [*columns, *forms]
        arrays = [(column.component_descriptor(), column.as_arrow_array()) for column in columns]
        for place, number in enumerate(numbers.tolist()):
            rows[number].append((entity, [_Row(kind, array.slice(place, 1)) for kind, array in arrays]))
    return rows


def _beginning(game: Game) -> str:
    """Return what the frame before the first step is: each episode begins with the map as it is drawn, all
    apples on it and each agent at its start, or otherwise by chance."""
    rules = game.rules
    by_chance = rules.first_stock_share < 1 or rules.shuffle_starts or rules.random_headings
    if by_chance or game.map.spawns or game.map.river:
        return "the map; episodes begin otherwise"
    return "the board as an episode begins"


def _before_the_first_step(game: Game) -> Frames:
    """Return the frame before the first step, drawn from the map."""
    board = game.map
    row, col, heading = np.array(board.starts, np.int32).T
    frame = {
        "step": np.zeros((), np.int64),
        "beams": np.zeros((board.height, board.width), np.bool_),
        "stock": np.ones(len(board.sites), np.uint8),
        "row": row,
        "col": col,
        "heading": heading,
        "in_play": np.ones(game.agents, np.bool_),
        "tagged_by": np.full(game.agents, -1, np.int32),
    }
    return {name: array[None] for name, array in frame.items()}
