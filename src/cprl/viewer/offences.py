"""Offences: in a replay, who breaks a rule, and what institutions take and give in each turn."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cprl import keys
from cprl.commons.colours import agent_colour
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.viewer.institutions import GIVEN, PAID
from cprl.viewer.logger import RerunLogger
from cprl.viewer.stage import RIM_CELLS

ENTITY: Final = "world/violators"
_WHITE: Final = (255, 255, 255)
_DIAMOND: Final = 0.72 * np.array([(0, -1), (1, 0), (0, 1), (-1, 0), (0, -1)], np.float32)
"""The mark of an agent that breaks a rule, (x, y) in cells from the middle of its own."""
_RADIUS_CELLS: Final = 0.06


class Offences:
    """Logs a white diamond around each agent in the frame of the turn in which it broke a rule, and lines of
    fines and transfers per turn; a callback of `cprl.training`.

    Args:
        logger: of the replay, whose frames are all recorded.
        env: its world, without transforms.
        names: the names of the agents.
    """

    def __init__(self, logger: RerunLogger, env: CommonsEnv, *, names: Sequence[str]) -> None:
        import rerun as rr

        self._logger, self._env, self._names = logger, env, tuple(names)
        self._paid: list[NDArray[np.float64]] = []
        self._marked: list[NDArray[np.bool_]] = []
        self._centres: list[NDArray[np.float32]] = []
        mark = rr.LineStrips2D.from_fields(colors=[_WHITE], radii=[_RADIUS_CELLS], show_labels=False)
        logger.log_static(ENTITY, mark)
        for agent, name in enumerate(names):
            for kind, words in ((PAID, "pays"), (GIVEN, "gets")):
                line = rr.SeriesLines(names=[f"{name} {words}"], colors=[agent_colour(agent)], widths=[1.5])
                logger.log_static(f"{name}/{kind}", line)

    def on_step(self, batch: TensorDictBase) -> None:
        """Notes the payments of the turn, and where those are who broke a rule in it."""
        agents, count = batch["next", keys.AGENTS], len(self._names)
        fines, transfers, violated = (
            np.zeros(count) if (own := agents.get(name, None)) is None else own[0].numpy(force=True)
            for name in ("fines", "transfers", "violated")
        )
        self._paid.append(np.stack([-fines.astype(np.float64), transfers.astype(np.float64)]))
        if bool(batch["next", keys.DONE][0, 0]):
            return  # the board is already that of the next episode
        shown = self._env.worlds.show(self._env.output)
        self._marked.append(violated.astype(np.bool_, copy=True))
        centres = np.stack([shown.col, shown.row], -1).astype(np.float32)
        self._centres.append(centres + RIM_CELLS + 0.5)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Sends the rows of the episode."""
        import rerun as rr

        turns, frames = len(self._paid), len(self._marked)
        if not frames:
            return
        steps = np.arange(1, turns + 1)
        nothing = np.zeros(turns, np.int64)
        paid = np.stack(self._paid)  # [T, paid or given, N]
        for agent, name in enumerate(self._names):
            for nth, kind in enumerate((PAID, GIVEN)):
                at = steps, nothing, np.minimum(steps - 1, frames - 1)
                self._logger.log_columns(
                    f"{name}/{kind}", at, rr.Scalars.columns(scalars=paid[:, nth, agent].copy())
                )
        marked, centres = np.stack(self._marked), np.stack(self._centres)
        strips = centres[marked][:, None] + _DIAMOND
        marks = rr.LineStrips2D.columns(strips=strips, labels=self._labels(marked, paid))
        at = steps[:frames], nothing[:frames], np.arange(frames)
        self._logger.log_columns(ENTITY, at, marks.partition(marked.sum(1)))

    def _labels(self, marked: NDArray[np.bool_], paid: NDArray[np.float64]) -> list[str]:
        """What the viewer shows of a mark on request."""
        return [fined(agent, -paid[frame, 0, agent]) for frame, agent in np.argwhere(marked).tolist()]


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
    told = [fined(agent, paid[agent]) for agent in range(count) if broke[agent]]
    return told + [
        f"agent {agent} fined {paid[agent]:.4g}"
        for agent in range(count)
        if tagged[agent] and not broke[agent] and paid[agent] > 0
    ]
