"""What a replay shows besides the board: what policies say of actions, who breaks a rule, what is paid."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import nn

from cprl import keys
from cprl.commons.colours import agent_colour
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.policies.assignment import AgentPolicies, agent_indices
from cprl.policies.lanes import LaneActor
from cprl.viewer.board import centres_of
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import BACKGROUND, GIVEN, PAID
from cprl.viewer.scene import APART, BAR, HIGH, decision_panels

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
_TAKEN: Final = (255, 255, 255)
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
        self,
        logger: RerunLogger,
        policies: AgentPolicies,
        *,
        actions: Sequence[str],
        names: Sequence[str],
        window: tuple[int, int],
    ) -> None:
        self._logger, self._names, self._actions = logger, tuple(names), tuple(actions)
        self._actors = list(zip(map(agent_indices, policies.indices), policies.actors, strict=True))
        self._panels = decision_panels(len(names), len(actions), window)
        many = 2 * len(names) * len(actions) > np.iinfo(np.uint8).max
        self._dtype = np.uint16 if many else np.uint8
        kinds = {agent: _kind(actor) for agents, actor in self._actors for agent in agents}
        self._kinds = [kinds[agent] for agent in range(len(names))]
        self._rows: list[tuple[NDArray[np.float64], NDArray[np.int64]]] = []
        self._step = 0
        self._log_fixed()

    def on_step(self, batch: TensorDictBase) -> None:
        """Notes what the agents' policies say of what they saw before this turn, and what they did."""
        self._step += 1
        if self._step == 1:
            return  # the first board is shown in no frame
        observation = batch[keys.OBSERVATION]
        values = np.full((len(self._names), len(self._actions)), np.nan)
        for agents, actor in self._actors:
            if isinstance(actor, LaneActor):
                seen = [observation[:, list(agents)]]
                if actor.state_cells:
                    seen.append(batch[keys.RECURRENT_STATE_BEFORE][:, list(agents), : actor.state_cells])
                preferences = actor.preferences(*seen)
                if preferences is not None:
                    values[list(agents)] = preferences[0].double().numpy(force=True)
        self._rows.append((values, batch[keys.ACTION][0].numpy(force=True).copy()))

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        if not self._rows:
            return
        values, taken = (np.stack(part) for part in zip(*self._rows, strict=True))
        count = len(values)
        frames = np.arange(count)
        at = frames + 1, np.zeros(count, np.int64), frames
        images = self._images(values, taken).reshape(count, -1)
        self._logger.log_columns(ENTITY, at, rr.SegmentationImage.columns(buffer=images.view(np.uint8)))
        texts = [text for row in values for text in self._texts(row)]
        labels = rr.Points2D.columns(labels=texts).partition([len(self._names)] * count)
        self._logger.log_columns(f"{ENTITY}/labels", at, labels)

    def _images(
        self, values: NDArray[np.float64], taken: NDArray[np.int64]
    ) -> NDArray[np.unsignedinteger[Any]]:
        """Bars of T frames as classes: values [T, N, A] and actions [T, N] to [T, rows, columns]."""
        count, agents, actions = values.shape
        heights = self._heights(values)
        level = np.arange(HIGH)[::-1, None]
        classes = 1 + 2 * np.arange(agents * actions).reshape(agents, actions)
        classes = classes + (np.arange(actions) == taken[..., None])
        bars = np.where(level < heights[..., None, None], classes[..., None, None], 0)  # [T, N, A, HIGH, 1]
        bars = np.pad(bars.repeat(BAR, -1), ((0, 0),) * 4 + ((APART, 0),))
        panels = bars.transpose(0, 1, 3, 2, 4).reshape(count, agents, HIGH, -1)
        panels = np.pad(panels, ((0, 0),) * 3 + ((0, APART),))
        whole = np.zeros((count, *self._panels.shape), self._dtype)
        for agent, (top, left) in enumerate(self._panels.corners):
            whole[:, top : top + HIGH, left : left + panels.shape[-1]] = panels[:, agent]
        return whole

    def _heights(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """The heights of bars in pixels, at least 1; 0 where there are no values."""
        low, best = _range(np.nan_to_num(values))
        span = (best - low)[..., None]
        share = np.clip((values - low[..., None]) / np.where(span > 0, span, 1.0), 0.0, 1.0)
        is_share = np.array([kind == "probabilities" for kind in self._kinds])
        share = np.where(is_share[:, None], values, share)
        heights = 1 + (share * (HIGH - 2)).round()
        pixels: NDArray[np.int64] = np.nan_to_num(heights).astype(np.int64)
        return pixels

    def _texts(self, values: NDArray[np.float64]) -> list[str]:
        low, best = _range(np.nan_to_num(values))
        return [
            f"{name}: Q {low[agent]:.2f} to {best[agent]:.2f}" if kind == "Q" else f"{name}: {kind}"
            for agent, (name, kind) in enumerate(zip(self._names, self._kinds, strict=True))
        ]

    def _log_fixed(self) -> None:
        """Logs the form of the image, the classes of its bars, and the names of actions."""
        rows, columns = self._panels.shape
        kind = rr.ChannelDatatype.U16 if self._dtype is np.uint16 else rr.ChannelDatatype.U8
        form = rr.components.ImageFormat(width=columns, height=rows, channel_datatype=kind)
        classes = [rr.AnnotationInfo(id=0, label="", color=BACKGROUND)]
        for agent, name in enumerate(self._names):
            hue = tuple(round(_BAR_SHARE * part) for part in agent_colour(agent))
            for action, what in enumerate(self._actions):
                first = 1 + 2 * (agent * len(self._actions) + action)
                classes.append(rr.AnnotationInfo(id=first, label=f"{name}: {what}", color=hue))
                label = f"{name} takes: {what}"
                classes.append(rr.AnnotationInfo(id=first + 1, label=label, color=_TAKEN))
        image = rr.SegmentationImage.from_fields(format=form, opacity=1.0)
        self._logger.log_static(ENTITY, rr.AnnotationContext(classes), image)
        self._logger.log_static(f"{ENTITY}/labels", self._panels.labels())
        if len(self._names) <= _MOST_LABELLED:
            bars = APART + BAR / 2 + (APART + BAR) * np.arange(len(self._actions))
            places = [(left + bar, top + HIGH) for top, left in self._panels.corners.tolist() for bar in bars]
            signs = [SIGNS.get(action, action) for action in self._actions] * len(self._names)
            labels = rr.Points2D(places, labels=signs, radii=0.0, colors=(170, 170, 170), show_labels=True)
            self._logger.log_static(f"{ENTITY}/actions", labels)


def _range(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where bars of action values [..., A] begin and end."""
    best = values.max(-1)
    return np.maximum(2 * np.median(values, -1) - best, values.min(-1)), best


def _kind(actor: nn.Module) -> str:
    if not isinstance(actor, LaneActor):
        return "scripted, has no values"
    if actor.values is None:
        return "acts at random"
    return "probabilities" if actor.stochastic else "Q"


_VIOLATORS: Final = "world/violators"
_WHITE: Final = (255, 255, 255)
_DIAMOND: Final = 0.72 * np.array([(0, -1), (1, 0), (0, 1), (-1, 0), (0, -1)], np.float32)
"""The mark of an agent that breaks a rule, (x, y) in cells from the middle of its own."""
_RADIUS_CELLS: Final = 0.06


class Offences:
    """Logs a white diamond around each agent in the frame of the turn in which it broke a rule, and lines of
    fines and transfers per turn; a callback of `cprl.training`."""

    def __init__(self, logger: RerunLogger, env: CommonsEnv, *, names: Sequence[str]) -> None:
        self._logger, self._env, self._names = logger, env, tuple(names)
        self._paid: list[NDArray[np.float64]] = []
        self._marked: list[NDArray[np.bool_]] = []
        self._centres: list[NDArray[np.float32]] = []
        mark = rr.LineStrips2D.from_fields(colors=[_WHITE], radii=[_RADIUS_CELLS], show_labels=False)
        logger.log_static(_VIOLATORS, mark)
        for agent, name in enumerate(names):
            for kind, words in ((PAID, "pays"), (GIVEN, "gets")):
                line = rr.SeriesLines(names=[f"{name} {words}"], colors=[agent_colour(agent)], widths=[1.5])
                logger.log_static(f"{name}/{kind}", line)

    def on_step(self, batch: TensorDictBase) -> None:
        """Notes the payments of the turn, and where those are who broke a rule in it."""
        agents, count = batch["next", keys.AGENTS], len(self._names)
        fines, transfers, violated = (
            np.zeros(count) if (entry := agents.get(name, None)) is None else entry[0].numpy(force=True)
            for name in ("fines", "transfers", "violated")
        )
        self._paid.append(np.stack([-fines.astype(np.float64), transfers.astype(np.float64)]))
        if bool(batch["next", keys.DONE][0, 0]):
            return  # the board is already that of the next episode
        board = self._env.worlds.show(self._env.output)
        self._marked.append(violated.astype(np.bool_, copy=True))
        self._centres.append(centres_of(board._asdict()))

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        turns, frames = len(self._paid), len(self._marked)
        if not frames:
            return
        steps = np.arange(1, turns + 1)
        nothing = np.zeros(turns, np.int64)
        paid = np.stack(self._paid)  # [T, paid or given, N]
        for agent, name in enumerate(self._names):
            for side, kind in enumerate((PAID, GIVEN)):
                at = steps, nothing, np.minimum(steps - 1, frames - 1)
                self._logger.log_columns(
                    f"{name}/{kind}", at, rr.Scalars.columns(scalars=paid[:, side, agent].copy())
                )
        marked, centres = np.stack(self._marked), np.stack(self._centres)
        strips = centres[marked][:, None] + _DIAMOND
        # The viewer shows them on request.
        labels = [fined(agent, -paid[frame, 0, agent]) for frame, agent in np.argwhere(marked).tolist()]
        marks = rr.LineStrips2D.columns(strips=strips, labels=labels)
        at = steps[:frames], nothing[:frames], np.arange(frames)
        self._logger.log_columns(_VIOLATORS, at, marks.partition(marked.sum(1)))


def fined(agent: int, fine: float) -> str:
    """A violation in words, e.g. "agent 2 breaks a rule, fined 1.5"."""
    return f"agent {agent} breaks a rule" + (f", fined {fine:.4g}" if fine > 0 else "")


def events(batch: TensorDictBase) -> list[str]:
    """The violations of a turn of the first world in words, and the fines of agents who were tagged; taxes
    and costs, which many pay in each turn, are no events."""
    agents: Any = batch["next", keys.AGENTS]
    fines, violated, tagged_by = (agents.get(name, None) for name in ("fines", "violated", "tagged_by"))
    if fines is None and violated is None:
        return []
    count = len(agents["reward"][0])
    paid = [0.0] * count if fines is None else fines[0].tolist()
    broke = [False] * count if violated is None else violated[0].tolist()
    tagged = [False] * count if tagged_by is None else tagged_by[0].any(-1).tolist()
    violations = [fined(agent, paid[agent]) for agent in range(count) if broke[agent]]
    return violations + [
        f"agent {agent} fined {paid[agent]:.4g}"
        for agent in range(count)
        if tagged[agent] and not broke[agent] and paid[agent] > 0
    ]
