"""What a replay shows besides the board: what policies say of actions, who breaks a rule, what is paid."""

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import nn

from cprl import keys, recurrent_state
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.measuring.registry import FINES, TRANSFERS
from cprl.pictures.colours import agent_colour
from cprl.policies.assignment import AgentPolicies, agent_indices
from cprl.policies.lanes import LaneActor
from cprl.values.arrays import Float32, Float64
from cprl.viewer.board import centres_of
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import BACKGROUND, GIVEN, PAID
from cprl.viewer.scene import APART, BAR, HIGH, Scene, decision_panels

ENTITY: Final = "decisions"
SIGNS: Final = {  # the viewer ends at a sign that its font lacks
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
_BAR_SHARE: Final = 0.75
"""Of an agent's hue, in the bars of actions that it does not take."""
_MOST_LABELLED: Final = 4
"""Agents whose bars have names; those of more are too narrow, and name their actions where the pointer is."""


class Decisions:
    """Logs a bar for each action of each agent, the taken one white; a callback of `cprl.training`.

    A row has the number of the frame that shows what the agents see, so the bars stand beside their windows.
    Bars of action values end at the best of the moment and begin as far below the median as that is above, so
    that one poor action does not make all others look alike; bars of probabilities are from 0 to 1. Agents
    that have neither, scripted ones and those at random, say so.
    """

    def __init__(
        self, logger: RerunLogger, scene: Scene, policies: AgentPolicies, *, actions: Sequence[str]
    ) -> None:
        self._logger = logger
        self._names = scene.agents
        self._actions = tuple(actions)
        self._actors = list(zip(map(agent_indices, policies.indices), policies.actors, strict=True))
        self._panels = decision_panels(len(scene.agents), len(actions), scene.window)
        many = 2 * len(scene.agents) * len(actions) > np.iinfo(np.uint8).max
        self._dtype = np.uint16 if many else np.uint8
        self._images: list[NDArray[np.unsignedinteger[Any]]] = []
        self._texts: list[str] = []
        """Of each frame."""
        self._step = 0
        self._log_fixed()

    def on_step(self, batch: TensorDictBase) -> None:
        """Draw what the agents' policies say of what they saw before this turn, and what they did."""
        self._step += 1
        if self._step == 1:
            return  # the first board is shown in no frame
        actions = batch[keys.ACTION][0].tolist()
        image = np.zeros(self._panels.shape, self._dtype)
        words = list(self._names)
        for agents, actor in self._actors:
            for agent, (heights, text) in zip(agents, _bars(actor, batch, list(agents)), strict=True):
                words[agent] += f": {text}"
                top, left = self._panels.corners[agent]
                for action, height in enumerate(heights):
                    left_of_bar = left + APART + action * (BAR + APART)
                    bar = image[top + HIGH - height : top + HIGH, left_of_bar : left_of_bar + BAR]
                    bar[:] = self._class(agent, action) + (action == actions[agent])
        self._images.append(image)
        self._texts += words

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        count = len(self._images)
        if not count:
            return
        frames = np.arange(count)
        at = frames + 1, np.zeros(count, np.int64), frames
        pixels = np.stack(self._images).reshape(count, -1).view(np.uint8)
        self._logger.log_columns(ENTITY, at, rr.SegmentationImage.columns(buffer=pixels))
        labels = rr.Points2D.columns(labels=self._texts).partition([len(self._names)] * count)
        self._logger.log_columns(f"{ENTITY}/labels", at, labels)

    def _class(self, agent: int, action: int) -> int:
        """Return the class of a bar; that of the action that is taken is the next one."""
        return 1 + 2 * (agent * len(self._actions) + action)

    def _log_fixed(self) -> None:
        """Log the form of the image, the classes of its bars, and the names of actions."""
        rows, columns = self._panels.shape
        kind = rr.ChannelDatatype.U16 if self._dtype is np.uint16 else rr.ChannelDatatype.U8
        form = rr.components.ImageFormat(width=columns, height=rows, channel_datatype=kind)
        classes = [rr.AnnotationInfo(id=0, label="", color=BACKGROUND)]
        for agent, name in enumerate(self._names):
            hue = tuple(round(_BAR_SHARE * part) for part in agent_colour(agent))
            for action, what in enumerate(self._actions):
                first = self._class(agent, action)
                classes.append(rr.AnnotationInfo(id=first, label=f"{name}: {what}", color=hue))
                taken = f"{name} takes: {what}"
                classes.append(rr.AnnotationInfo(id=first + 1, label=taken, color=_WHITE))
        image = rr.SegmentationImage.from_fields(format=form, opacity=1.0)
        self._logger.log_static(ENTITY, rr.AnnotationContext(classes), image)
        self._logger.log_static(f"{ENTITY}/labels", self._panels.labels())
        if len(self._names) <= _MOST_LABELLED:
            bars = APART + BAR / 2 + (APART + BAR) * np.arange(len(self._actions))
            places = [(left + bar, top + HIGH) for top, left in self._panels.corners.tolist() for bar in bars]
            signs = [SIGNS.get(action, action) for action in self._actions] * len(self._names)
            labels = rr.Points2D(places, labels=signs, radii=0.0, colors=(170, 170, 170), show_labels=True)
            self._logger.log_static(f"{ENTITY}/actions", labels)


def _bars(actor: nn.Module, batch: TensorDictBase, agents: list[int]) -> list[tuple[list[int], str]]:
    """Return the heights of the bars of some agents in pixels, at least 1, and what they are; no heights
    where there are no values."""
    if not isinstance(actor, LaneActor):
        return [([], "scripted, has no values")] * len(agents)
    seen = [batch[keys.OBSERVATION][:, agents]]
    if actor.state_cells:
        at = slice(None), agents
        seen.append(recurrent_state.read(batch[keys.AGENTS], at, actor.state_cells))
    of_agents = actor.action_values(*seen)
    if of_agents is None:
        return [([], "acts at random")] * len(agents)
    bars = []
    for values in of_agents[0].double().numpy(force=True):
        share = values
        words = "probabilities"
        if not actor.stochastic:
            best = values.max()
            low = max(2 * np.median(values) - best, values.min())
            share = ((values - low) / (best - low or 1.0)).clip(0.0, 1.0)
            words = f"Q {low:.2f} to {best:.2f}"
        bars.append(((1 + (share * (HIGH - 2)).round()).astype(int).tolist(), words))
    return bars


_VIOLATORS: Final = "world/violators"
_DIAMOND: Final = 0.72 * np.array([(0, -1), (1, 0), (0, 1), (-1, 0), (0, -1)], np.float32)
"""The mark of an agent that breaks a rule, (x, y) in cells from the middle of its own."""
_RADIUS_CELLS: Final = 0.06


class Offences:
    """Logs a white diamond around each agent in the frame of the turn in which it broke a rule, and lines of
    fines and transfers per turn; a callback of `cprl.training`."""

    def __init__(self, logger: RerunLogger, env: CommonsEnv) -> None:
        self._logger = logger
        self._env = env
        self._names = logger.curves.agents
        self._amounts: dict[str, list[Float64]] = {PAID: [], GIVEN: []}
        """[N] in each turn."""
        self._strips: list[Float32] = []
        self._labels: list[list[str]] = []
        """Marks, and what they say, of each frame."""
        mark = rr.LineStrips2D.from_fields(colors=[_WHITE], radii=[_RADIUS_CELLS], show_labels=False)
        logger.log_static(_VIOLATORS, mark)
        for agent, name in enumerate(self._names):
            for kind, words in ((PAID, "pays"), (GIVEN, "gets")):
                line = rr.SeriesLines(names=[f"{name} {words}"], colors=[agent_colour(agent)], widths=[1.5])
                logger.log_static(f"{name}/{kind}", line)

    def on_step(self, batch: TensorDictBase) -> None:
        """Note the payments of the turn, and where those are who broke a rule in it."""
        fines, transfers, violated = (_of_agents(batch, name) for name in (FINES, TRANSFERS, "violated"))
        self._amounts[PAID].append(-fines)
        self._amounts[GIVEN].append(transfers)
        if bool(batch["next", keys.DONE][0, 0]):
            return  # the board is already that of the next episode
        violators = np.flatnonzero(violated)
        centres = centres_of(self._env.worlds.show(self._env.output)._asdict())
        self._strips.append(centres[violators][:, None] + _DIAMOND)
        # The viewer shows them on request.
        self._labels.append([fined(agent, fines[agent]) for agent in violators.tolist()])

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        frames = len(self._strips)
        if not frames:
            return
        steps = np.arange(1, len(self._amounts[PAID]) + 1)
        nothing = np.zeros_like(steps)
        at = steps, nothing, np.minimum(steps, frames) - 1
        for kind, turns in self._amounts.items():
            for name, amounts in zip(self._names, np.transpose(turns), strict=True):
                self._logger.log_columns(f"{name}/{kind}", at, rr.Scalars.columns(scalars=amounts.copy()))
        marks = rr.LineStrips2D.columns(
            strips=np.concatenate(self._strips), labels=list(chain(*self._labels))
        )
        at = steps[:frames], nothing[:frames], np.arange(frames)
        self._logger.log_columns(_VIOLATORS, at, marks.partition(list(map(len, self._strips))))


def _of_agents(batch: TensorDictBase, name: str) -> Float64:
    """Return an entry of the agents of the first world in a turn, [N]; zeros where the game lacks it."""
    agents: Any = batch["next", keys.AGENTS]
    entry = agents.get(name, None)
    values = np.zeros(agents["reward"].shape[1]) if entry is None else entry[0].numpy(force=True)
    return values.astype(np.float64)


def fined(agent: int, fine: float) -> str:
    """Return a violation in words, e.g. "agent 2 breaks a rule, fined 1.5"."""
    return f"agent {agent} breaks a rule" + (f", fined {fine:.4g}" if fine > 0 else "")


def events(batch: TensorDictBase) -> list[str]:
    """Return the violations of a turn of the first world in words, and the fines of agents who were tagged;
    taxes and costs, which many pay in each turn, are no events."""
    tagged_by = batch.get(("next", *keys.TAGGED_BY), None)
    fines = _of_agents(batch, FINES)
    violated = _of_agents(batch, "violated")
    tagged = np.zeros(len(fines), bool) if tagged_by is None else tagged_by[0].numpy(force=True).any(-1)
    fined_when_tagged = np.flatnonzero((violated == 0) & (fines > 0) & tagged)
    return [
        *(fined(agent, fines[agent]) for agent in np.flatnonzero(violated).tolist()),
        *(f"agent {agent} fined {fines[agent]:.4g}" for agent in fined_when_tagged.tolist()),
    ]
