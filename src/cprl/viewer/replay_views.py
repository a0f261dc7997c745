"""The parts of a replay's recording beside the board: action values, violations and payments in each turn."""

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import nn

from cprl import keys
from cprl.envs.commons_env import CommonsEnv
from cprl.keys import recurrent_state
from cprl.measuring.registry import FINES_TOTAL, TRANSFERS_TOTAL
from cprl.measuring.tracker import Episode
from cprl.pictures.colours import agent_colour
from cprl.policies.actors import LaneActor
from cprl.policies.joint_policy import JointPolicy, agent_indices
from cprl.values.array_types import Float32, Float64
from cprl.viewer.board import centres_of, image_format
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import BOARD_BACKGROUND, GIVEN, PAID
from cprl.viewer.scene import BAR_GAP, BAR_HIGH, BAR_WIDE, Scene, decision_panels

_DECISIONS: Final = "decisions"
"""The entity of the bars of action values."""
_ACTION_SIGNS: Final = {  # the viewer cannot show signs that its font lacks
    "forward": "↑",
    "backward": "↓",
    "left": "←",
    "right": "→",
    "turn_left": "L",
    "turn_right": "R",
    "beam": "B",
    "stay": "S",
}
_WHITE: Final = (255, 255, 255)
_BAR_BRIGHTNESS: Final = 0.75
"""The brightness of an agent's hue in the bars of actions that it does not take."""
_MOST_LABELLED: Final = 4
"""The largest number of agents whose bars have names. Bars of more agents are narrow, and show the name of
their action when the mouse is on them."""


class Decisions:
    """Logs a bar for each action of each agent; the bar of the chosen action is white.

    It is a callback of `cprl.training`. A row has the number of the frame that shows what the agents see:
    the viewer shows the bars together with the agents' windows.

    The scale of action values ends at the best action of the turn and begins as far below the median as the
    best is above it, so that one poor action does not make all others look alike. Probabilities have the
    scale from 0 to 1. Agents without either, scripted or random ones, have a text that says so.
    """

    def __init__(
        self, logger: RerunLogger, scene: Scene, policies: JointPolicy, *, actions: Sequence[str]
    ) -> None:
        self._logger = logger
        self._names = scene.agents
        self._actions = tuple(actions)
        self._actors = list(zip(map(agent_indices, policies.indices), policies.actors, strict=True))
        self._panels = decision_panels(len(scene.agents), len(actions), scene.window)
        self._images: list[NDArray[np.uint16]] = []
        self._texts: list[str] = []
        """The texts of all agents, one frame after the other."""
        self._step = 0
        self._log_static_parts()

    def on_step(self, batch: TensorDictBase) -> None:
        """Draw the values of the agents' last observations, and the actions that the agents took."""
        self._step += 1
        if self._step == 1:
            return  # frames begin after the first turn, so no frame shows the first observations
        actions = batch[keys.ACTION][0].tolist()
        image = np.zeros(self._panels.shape, np.uint16)
        texts = list(self._names)
        for agents, actor in self._actors:
            for agent, (heights, text) in zip(agents, _bars(actor, batch, list(agents)), strict=True):
                texts[agent] += f": {text}"
                top, left = self._panels.corners[agent]
                for action, height in enumerate(heights):
                    bar_left = left + BAR_GAP + action * (BAR_WIDE + BAR_GAP)
                    bar_bottom = top + BAR_HIGH
                    bar = image[bar_bottom - height : bar_bottom, bar_left : bar_left + BAR_WIDE]
                    bar[:] = self._bar_class(agent, action) + (action == actions[agent])
        self._images.append(image)
        self._texts += texts

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        count = len(self._images)
        if not count:
            return
        frames = np.arange(count)
        times = frames + 1, np.zeros(count, np.int64), frames
        pixels = np.stack(self._images).reshape(count, -1).view(np.uint8)
        self._logger.log_columns(_DECISIONS, times, rr.SegmentationImage.columns(buffer=pixels))
        labels = rr.Points2D.columns(labels=self._texts).partition([len(self._names)] * count)
        self._logger.log_columns(f"{_DECISIONS}/labels", times, labels)

    def _bar_class(self, agent: int, action: int) -> int:
        """Return the class of a bar in the image; the class after it is that of the bar of a taken action."""
        return 1 + 2 * (agent * len(self._actions) + action)

    def _log_static_parts(self) -> None:
        """Log the format of the image, the classes of its bars, and the names of actions."""
        classes = [rr.AnnotationInfo(id=0, label="", color=BOARD_BACKGROUND)]
        for agent, name in enumerate(self._names):
            hue = tuple(round(_BAR_BRIGHTNESS * channel) for channel in agent_colour(agent))
            for action, action_name in enumerate(self._actions):
                bar_class = self._bar_class(agent, action)
                label = f"{name}: {action_name}"
                taken_label = f"{name} takes: {action_name}"
                classes.append(rr.AnnotationInfo(id=bar_class, label=label, color=hue))
                classes.append(rr.AnnotationInfo(id=bar_class + 1, label=taken_label, color=_WHITE))
        image = rr.SegmentationImage.from_fields(
            format=image_format(self._panels.shape, rr.ChannelDatatype.U16), opacity=1.0
        )
        self._logger.log_static(_DECISIONS, rr.AnnotationContext(classes), image)
        self._logger.log_static(f"{_DECISIONS}/labels", self._panels.labels())
        if len(self._names) <= _MOST_LABELLED:
            bar_middles = BAR_GAP + BAR_WIDE / 2 + (BAR_GAP + BAR_WIDE) * np.arange(len(self._actions))
            corners = self._panels.corners.tolist()
            positions = [(left + middle, top + BAR_HIGH) for top, left in corners for middle in bar_middles]
            signs = [_ACTION_SIGNS.get(action, action) for action in self._actions] * len(self._names)
            labels = rr.Points2D(positions, labels=signs, radii=0.0, colors=(170, 170, 170), show_labels=True)
            self._logger.log_static(f"{_DECISIONS}/actions", labels)


def _bars(actor: nn.Module, batch: TensorDictBase, agents: list[int]) -> list[tuple[list[int], str]]:
    """Return the heights of some agents' bars in pixels, at least 1, and a text that says what they show.

    An agent without action values or probabilities has no heights.
    """
    if not isinstance(actor, LaneActor):
        return [([], "has no values")] * len(agents)
    inputs = [batch[keys.OBSERVATION][:, agents]]
    if actor.state_cells:
        all_worlds = slice(None)
        inputs.append(
            recurrent_state.read_states(batch[keys.AGENTS], (all_worlds, agents), actor.state_cells)
        )
    action_values = actor.action_values(*inputs)
    if action_values is None:
        return [([], "acts at random")] * len(agents)
    bars = []
    for values in action_values[0].double().numpy(force=True):
        share = values
        text = "probabilities"
        if not actor.stochastic:
            best = values.max()
            lowest = max(2 * np.median(values) - best, values.min())
            share = ((values - lowest) / (best - lowest or 1.0)).clip(0.0, 1.0)
            text = f"Q {lowest:.2f} to {best:.2f}"
        bars.append(((1 + (share * (BAR_HIGH - 2)).round()).astype(int).tolist(), text))
    return bars


_VIOLATORS: Final = "world/violators"
_DIAMOND: Final = 0.72 * np.array([(0, -1), (1, 0), (0, 1), (-1, 0), (0, -1)], np.float32)
"""The corners of the mark around a violator, (x, y), in cells from the middle of the agent's cell."""
_DIAMOND_LINE_RADIUS_CELLS: Final = 0.06
"""Half the width of the diamond's line, in cells."""


class ViolationMarks:
    """Logs a white diamond around each agent that breaks a rule, and lines of fines and transfers per turn.

    It is a callback of `cprl.training`.
    """

    def __init__(self, logger: RerunLogger, env: CommonsEnv) -> None:
        self._logger = logger
        self._env = env
        self._names = logger.curves.agents
        self._amounts: dict[str, list[Float64]] = {PAID: [], GIVEN: []}
        """The amounts of all agents in each turn, [N]."""
        self._diamonds: list[Float32] = []
        """The diamonds of each frame, float32 [violators, 5, 2]."""
        self._labels: list[list[str]] = []
        """The labels of the diamonds of each frame."""
        mark = rr.LineStrips2D.from_fields(
            colors=[_WHITE], radii=[_DIAMOND_LINE_RADIUS_CELLS], show_labels=False
        )
        logger.log_static(_VIOLATORS, mark)
        for agent, name in enumerate(self._names):
            for kind, verb in ((PAID, "pays"), (GIVEN, "gets")):
                line = rr.SeriesLines(names=[f"{name} {verb}"], colors=[agent_colour(agent)], widths=[1.5])
                logger.log_static(f"{name}/{kind}", line)

    def on_step(self, batch: TensorDictBase) -> None:
        """Add the payments of the turn, and a diamond around each agent that broke a rule in it."""
        fines = _amounts_in(batch, FINES_TOTAL)
        self._amounts[PAID].append(-fines)
        self._amounts[GIVEN].append(_amounts_in(batch, TRANSFERS_TOTAL))
        if bool(batch["next", keys.DONE][0, 0]):
            return  # the board is already that of the next episode
        violators = np.flatnonzero(_amounts_in(batch, "violated"))
        centres = centres_of(self._env.worlds.show(self._env.output)._asdict())
        self._diamonds.append(centres[violators][:, None] + _DIAMOND)
        # The viewer shows a label when the mouse is on its diamond.
        self._labels.append([describe_violation(agent, fines[agent]) for agent in violators.tolist()])

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        frames = len(self._diamonds)
        if not frames:
            return
        steps = np.arange(1, len(self._amounts[PAID]) + 1)
        episodes = np.zeros_like(steps)
        times = steps, episodes, np.minimum(steps, frames) - 1
        for kind, turns in self._amounts.items():
            for name, amounts in zip(self._names, np.transpose(turns), strict=True):
                columns = rr.Scalars.columns(scalars=amounts.copy())
                self._logger.log_columns(f"{name}/{kind}", times, columns)
        marks = rr.LineStrips2D.columns(
            strips=np.concatenate(self._diamonds), labels=list(chain(*self._labels))
        )
        times = steps[:frames], episodes[:frames], np.arange(frames)
        self._logger.log_columns(_VIOLATORS, times, marks.partition(list(map(len, self._diamonds))))


def _amounts_in(batch: TensorDictBase, name: str) -> Float64:
    """Return an amount of each agent of the first world in a turn, [N]; zeros if the game lacks it."""
    agents: Any = batch["next", keys.AGENTS]
    entry = agents.get(name, None)
    values = np.zeros(agents["reward"].shape[1]) if entry is None else entry[0].numpy(force=True)
    return values.astype(np.float64)


def describe_violation(agent: int, fine: float) -> str:
    """Return a violation in words, e.g. "agent 2 breaks a rule, fined 1.5"."""
    return f"agent {agent} breaks a rule" + (f", fined {fine:.4g}" if fine > 0 else "")


def events(batch: TensorDictBase) -> list[str]:
    """Return the events of a turn of the first world in words: tags, violations, and fines of tagged agents.

    Taxes and costs are left out, because many agents pay them in every turn.
    """
    tagged_by = batch.get(("next", *keys.TAGGED_BY), None)
    fines = _amounts_in(batch, FINES_TOTAL)
    violated = _amounts_in(batch, "violated")
    tags = [] if tagged_by is None else tagged_by[0].nonzero().tolist()
    tagged_agents = {agent for agent, _ in tags}
    fined = np.flatnonzero((violated == 0) & (fines > 0)).tolist()
    return [
        *(f"agent {tagged} is tagged out by agent {shooter}" for tagged, shooter in tags),
        *(describe_violation(agent, fines[agent]) for agent in np.flatnonzero(violated).tolist()),
        *(f"agent {agent} fined {fines[agent]:.4g}" for agent in fined if agent in tagged_agents),
    ]
