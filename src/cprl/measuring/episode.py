"""Episode: the record of an episode that has ended."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cprl.measuring.reported import FIELDS, OPTIONAL


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """One episode of one world, from its first step to its end. Steps are counted from 1."""

    world: int
    """The index of the world in its batch."""
    episode: int
    """The index of the episode in its world, counted from 0."""
    steps: int
    """Steps played, at least 1."""
    terminated: bool
    """True if the game itself ended, e.g. no apple was left and none could grow; else the episode was
    truncated at its time limit."""
    return_: NDArray[np.float64]
    """[N], the undiscounted sum of rewards of each agent."""
    metrics: dict[str, float]
    """`social.summary` of the episode; NaN where undefined. Metrics that need entries that the game does not
    report are missing."""
    harvest: NDArray[np.float64] | None = None
    """[N], apples harvested. This field and all below are None if the game does not report the entries that
    they need, see `cprl.measuring.reported.FIELDS`."""
    in_play_steps: NDArray[np.int64] | None = None
    """[N], steps in which the agent was in play."""
    shots: NDArray[np.int64] | None = None
    """[N], beams fired."""
    hits: NDArray[np.int64] | None = None
    """[N], the number of agents hit by each agent's beams, summed over steps."""
    tagged: NDArray[np.int64] | None = None
    """[N], how often each agent was tagged out; by two agents in one step counts once."""
    tagged_by: NDArray[np.int64] | None = None
    """[N, N], how often the agent of the row was tagged by the agent of the column."""
    decision: NDArray[np.int64] | None = None
    """[N], what each agent had decided, see `cprl.institutions.choice.ballots`; None in games that ask
    nothing."""
    wanted_return: NDArray[np.float64] | None = None
    """[N], the sum of the rewards that each agent wanted in a training, see `cprl.preferences`; NaN for
    agents that do not learn. None outside of a training."""
    stock_left: int | None = None
    """Apples on the board at the end."""
    depletion_step: int | None = None
    """The first step that left no apple on the board, or -1."""

    @property
    def outcome(self) -> str:
        """The outcome as text: apples if the game reports a harvest, else returns."""
        if self.harvest is None:
            return f"returns: {', '.join(f'{own:.4g}' for own in self.return_)}"
        left = "" if self.stock_left is None else f"; {self.stock_left} left"
        return f"apples: {', '.join(f'{own:.0f}' for own in self.harvest)}{left}"

    @property
    def reported(self) -> tuple[str, ...]:
        """The entries of `cprl.measuring.reported.OPTIONAL` that the game reported."""
        missing = {entry for name, needs in FIELDS.items() if getattr(self, name) is None for entry in needs}
        return tuple(entry for entry in OPTIONAL if entry not in missing)
