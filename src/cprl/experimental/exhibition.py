"""Exhibition: live viewers of a training watch its current policy play a separate world.

The training does not notice: the world has its own seed, and the policy its own random numbers. The
exhibition may use 1 % of the training's time.
"""

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from threading import Event
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv

from cprl import keys
from cprl.commons.game import Game
from cprl.envs.env_state import load_transforms_state, transforms_state
from cprl.envs.unwrap import commons_of
from cprl.experiment import Experiment
from cprl.experimental.current_policy import CurrentPolicy
from cprl.measuring.playing import Policy, turns
from cprl.measuring.tracker import Episode
from cprl.training.agents import Population
from cprl.training.evaluating import make_worlds
from cprl.viewer.board import RIM_CELLS, Frames, board_columns, board_format, board_styles
from cprl.viewer.frames import FrameRecorder
from cprl.viewer.logger import RerunLogger
from cprl.viewer.scene import Scene
from cprl.viewer.view import View

BATCH_S: Final = 2.1
"""Seconds of play that are computed at once. Steps in a row take a quarter of the time of single steps
between steps of the training. They are still sent one by one."""
BATCH_STEPS: Final = 21
"""The number of steps that are computed at once: 10 for each second."""
MOST_SHARE: Final = 0.01
"""The largest share of the training's wall time that the exhibition may use. If a step takes longer than
0.95 ms, fewer steps are played."""
REST_S: Final = 10.0
"""Seconds for which viewers see the last board of an episode of the trained policy."""
LONGEST_S: Final = 10.0
"""The largest number of seconds between two plays, if a step took exceptionally long."""
EXHIBITED_WORLD: Final = 2**31
"""The number of the exhibited world, which is above the numbers of all worlds of a training."""


class Exhibition(View):
    """Plays a world with the current policy, and sends the board to live viewers.

    The board is sent as static entities, which have no time. So a viewer shows the newest board on every
    timeline, and stores no older one. Nothing is written to the recording's file. If the exhibition fails, it
    warns once, and the training continues without it.

    Args:
        policy: the current policy of the training.
        env: the exhibited world, with the transforms of the training.
        trained: the environment of the training, whose transforms' state is copied.
        logger: the live recording of the training.
        clock: returns seconds of wall time.
        wait: waits for some seconds between two frames, in the thread that sends them, and returns whether to
            drop the remaining frames. The default sleeps, and drops them after `close`.
    """

    def __init__(
        self,
        policy: CurrentPolicy,
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
        self._is_resting = False
        """True if an episode of the trained policy has just ended."""
        self.steps = 0
        """The number of steps played so far."""
        self.is_over = False
        """True after a failure."""
        live.stream.call(partial(_send_fixed, scene=scene))
        # Compiling may take half a minute, and of a run that is resumed no policy is loaded yet.
        self._send(_before_the_first_step(commons.game), _beginning(commons.game))

    def on_step(self, batch: TensorDictBase) -> None:
        """Play some steps if they are due."""
        now = self._clock()
        if now >= self._due and not self.is_over:
            self._due = now + BATCH_S
            self._play(self._logger.episode)

    def watch_random_play(self, env: EnvBase, policy: Policy) -> Policy:
        """Return the policy of random play, recording its first world for viewers."""
        commons = commons_of(env)
        assert commons is not None
        recorder = self._at_random = FrameRecorder(commons, self._scene, has_windows=False)

        def acted(moment: TensorDictBase) -> TensorDictBase:
            recorder.add()
            return policy(moment)

        return acted

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Send the random episode of the first world, which viewers watch while the training is compiled.

        The remaining frames are dropped when the training begins.
        """
        frames = None if self._at_random is None else self._at_random.take()
        if frames is not None:
            first = {name: array[: episodes[0].steps] for name, array in frames.items()}
            self._send(first, "random play, before the training", wait=self._until_it_begins)

    def _until_it_begins(self, seconds: float) -> bool:
        return self._wait(seconds) or self.steps > 0

    def play_on(self, stop: Event) -> None:
        """Play the trained policy until the event is set; pause after each episode. Return at once after a
        failure."""
        self._policy.is_trained = True
        while not (self.is_over or stop.is_set()):
            self._play(0)
            pause_s = REST_S if self._is_resting else BATCH_S
            stop.wait(pause_s)

    def close(self) -> None:
        """Drop the frames that have not been sent."""
        self._closing.set()

    def _slept(self, seconds: float) -> bool:
        """Sleep, and return whether `close` has been called. `Event.wait` would wake up late and hold up the
        training."""
        time.sleep(seconds)
        return self._closing.is_set()

    def _play(self, episode: int) -> None:
        """Play some steps and send them; if they took long, play fewer the next time."""
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
        self._is_resting = end is not None and self._policy.is_trained
        frames = self._recorder.take()
        if frames is not None:
            caption = caption_of(self._policy, episode)
            self._send(frames, caption)
            if self._is_resting:
                self._stream.call(partial(_send_caption, caption=f"{caption}: {end}"))

    def _step(self) -> str | None:
        """Play and record a step. If the episode has ended, return how, e.g. "no apple is left, turn 40"."""
        self.steps += 1
        return next(self._moves)

    def _played(self) -> Iterator[str | None]:
        """Yield for each recorded frame of one episode after another; at the end of an episode, how it ended.

        The first frame of an episode is the board before its first step.
        """
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
        self._stream.call(partial(send, wait=wait or self._wait))


def exhibition(
    experiment: Experiment, population: Population, trained: EnvBase, logger: RerunLogger
) -> Exhibition:
    """Return the exhibition of a training for the live viewers of its recording."""
    policy, env = policy_and_world(experiment, population)
    return Exhibition(policy, env, trained=trained, logger=logger)


def policy_and_world(experiment: Experiment, population: Population) -> tuple[CurrentPolicy, EnvBase]:
    """Return the current policy of a training, and a world that neither training nor evaluation plays.

    Torch's generator is left unchanged.
    """
    with torch.random.fork_rng(devices=[]):
        env = make_worlds(experiment, 1, first=EXHIBITED_WORLD, device=experiment.device)
        return CurrentPolicy(population), env


def caption_of(policy: CurrentPolicy, episode: int) -> str:
    """Return the caption below the board, e.g. "current policy, episode 1,234, epsilon 0.31".

    It has no epsilon if no agent has one, and no episode after the training.
    """
    policy.explore_as_now()
    epsilons = [f"{epsilon:.2f}" for epsilon in policy.epsilons]
    exploration = ""
    if epsilons:
        exploration = f", epsilon {' to '.join(dict.fromkeys((epsilons[0], epsilons[-1])))}"
    if policy.is_trained:
        return f"trained policy{exploration}"
    return f"current policy, episode {episode:,}{exploration}"


_CAPTION_CELLS = 2.3
"""The distance from the board to the caption, in cells."""
_THIN: Final = 0.01


def _send_fixed(recording: Any, *, scene: Scene) -> None:
    """Send the parts that never change.

    The format of the image changes neither, but is sent with each frame: a viewer that gets the format after
    a frame shows no board until the next frame.
    """
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
    """Send frames one by one, at the pace of `BATCH_S`, until `wait` returns True."""
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
    """One row of a component's column, with the interface that `send_columns` needs."""

    kind: Any
    values: Any

    def component_descriptor(self) -> Any:
        return self.kind

    def as_arrow_array(self) -> Any:
        return self.values


def _rows(scene: Scene, frames: Frames) -> list[list[tuple[str, list[Any]]]]:
    """Return for each frame the entities that it changes, with their columns of one row.

    The columns of all frames are computed at once and cut into rows, which takes a tenth of the time of
    computing them for each frame.
    """
    rows: list[list[tuple[str, list[Any]]]] = [[] for _ in frames["step"]]
    for entity, (numbers, columns) in board_columns(scene, frames).items():
        if entity == "board":
            forms = rr.SegmentationImage.columns(format=[board_format(scene)] * len(numbers))
            columns = [*columns, *forms]
        arrays = [(column.component_descriptor(), column.as_arrow_array()) for column in columns]
        for place, number in enumerate(numbers.tolist()):
            rows[number].append((entity, [_Row(kind, array.slice(place, 1)) for kind, array in arrays]))
    return rows


def _beginning(game: Game) -> str:
    """Return the caption of the frame before the first step.

    It shows the map as it is drawn, with all apples. Episodes begin like that, unless rules draw the start.
    """
    rules = game.rules
    starts_vary = rules.first_stock_share < 1 or rules.shuffle_starts or rules.random_headings
    if starts_vary or game.map.spawns or game.map.river:
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
