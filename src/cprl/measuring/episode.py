"""Episode: the record of an episode that has ended."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cprl.measuring.reported import FIELDS, INSTITUTIONAL, OPTIONAL


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
    wanted_return: NDArray[np.float64] | None = None
    """[N], the sum of the rewards that each agent wanted in a training, see `cprl.preferences`; NaN for
    agents that do not learn. None outside of a training."""
    stock_left: int | None = None
    """Apples on the board at the end."""
    depletion_step: int | None = None
    """The first step that left no apple on the board, or -1."""
    fines: NDArray[np.float64] | None = None
    """[N], what institutions took from each agent, taxes included, in units of reward. This field and all
    below are of games with institutions, see `cprl.measuring.reported.INSTITUTIONAL`."""
    transfers: NDArray[np.float64] | None = None
    """[N], what institutions gave each agent."""
    violations: NDArray[np.int64] | None = None
    """[N], steps in which the agent broke a rule of an institution."""
    counts: Mapping[str, NDArray[np.int64]] | None = None
    """[N] by name, what the game's institutions counted, see `cprl.measuring.institutions.counts_for`."""
    decision: NDArray[np.int64] | None = None
    """[N], what each agent had decided, see `cprl.institutions.choice.ballots`; None in games that ask
    nothing."""
    in_force: NDArray[np.float64] | None = None
    """[V], what was decided for this episode: tax rates, quotas, the agent elected."""
    institutions: Mapping[str, float] = field(default_factory=dict)
    """`cprl.measuring.institutions.summary` of the episode; NaN where undefined, empty without
    institutions."""

    def __repr__(self) -> str:
        returns = [round(value, 2) for value in self.return_.tolist()]
        ended = f"{self.steps} steps, terminated={self.terminated}"
        return f"Episode(world={self.world}, episode={self.episode}, {ended}, returns={returns})"

    @property
    def outcome(self) -> str:
        """The outcome as text: apples if the game reports a harvest, else returns."""
        if self.harvest is None:
            return f"returns: {', '.join(f'{own:.4g}' for own in self.return_)}"
        left = "" if self.stock_left is None else f"; {self.stock_left} left"
        return f"apples: {', '.join(f'{own:.0f}' for own in self.harvest)}{left}"

    @property
    def reported(self) -> tuple[str, ...]:
        """The optional entries that the game reported, see `cprl.measuring.reported`."""
        missing = {entry for name, needs in FIELDS.items() if getattr(self, name) is None for entry in needs}
        more = (entry for name, entry in INSTITUTIONAL.items() if getattr(self, name) is not None)
        return (*(entry for entry in OPTIONAL if entry not in missing), *more)
