"""The outcome of a finished training, judged by the whole of it: sentences, tables of studies, reports.

"The mean of n episodes" of a replica in W worlds is that of the last ceil(n / W) episodes of each world, so
that worlds count alike. Those that ended last, of all worlds, would be the longest ones.
"""

from dataclasses import dataclass
from statistics import fmean
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cprl.measuring.table import gain_metric, where, world_of
from cprl.measuring.windows import episodes_per_world, mean_of_worlds
from cprl.system.defaults import LAST_EPISODES
from cprl.values.array_types import Float64

NO_BETTER: Final = "no better"
HARVESTING: Final = "harvesting"
DECLINE: Final = "decline"
RECOVERY: Final = "recovery"
TRAGEDY: Final = "tragedy"

PEAK_EPISODES: Final = 10
"""Episodes of the mean whose highest value is the peak of a training; with fewer, nothing is judged."""
LEARNED_FACTOR: Final = 1.5
"""The least ratio of the peak to random play if agents have learned something."""
LOST_SHARE_OF_LEAD: Final = 1 / 3
"""The least share of the peak's lead over random play that a fall loses."""
LOST_SHARE_OF_PEAK: Final = 0.15
"""The least share of the peak that a fall loses, however small its lead over random play."""
REGAINED_SHARE: Final = 1 / 4
"""The least share of the loss that a recovery regains."""
BELOW_RANDOM_FACTOR: Final = 0.95
"""The highest ratio of the last episodes to random play in a tragedy."""
LIVED_SHARE: Final = 0.7
"""The longest mean life of boards in a tragedy, as a share of the longest life."""


def is_lost(mean: float, *, peak: float, random: float) -> bool:
    """Return whether a mean has fallen from a peak."""
    loss = peak - mean
    least_loss = max(LOST_SHARE_OF_LEAD * (peak - random), LOST_SHARE_OF_PEAK * abs(peak))
    return loss > 0 and loss >= least_loss


def is_regained(mean: float, *, peak: float, low: float) -> bool:
    """Return whether a mean has recovered from the lowest one of a fall."""
    return mean >= low + REGAINED_SHARE * (peak - low)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The outcome of the training of one replica, or of several, whose means are then means over replicas."""

    first_mean: float
    """The mean of what all agents got in the first 10 episodes."""
    peak: float
    """The highest mean of 10 episodes."""
    peak_episode: int
    """The episode in the middle of those of the peak, counted from 1."""
    lowest_after_peak: float
    """The lowest mean of 30 episodes from the peak on."""
    last_mean: float
    """The mean of the last 30 episodes."""
    life_share: float
    """The mean life of boards in the last 30 episodes, as a share of the longest life in the training."""
    random_mean: float
    """The mean of what agents who act at random get."""
    agents: int

    @property
    def word(self) -> str:
        """Return the word for the outcome.

        - no better: the peak is below 1.5 times random play;
        - recovery: a fall, of a third of the peak's lead over random play and 15 % of the peak, of which a
          quarter is regained at the end;
        - tragedy: at the end several agents get at most 95 % of random play, and their boards last at most
          70 % of the steps that they could;
        - decline: a fall that is not regained, or an end below random play that is no tragedy;
        - harvesting: else.

        A tragedy in the sense of G. Hardin, "The tragedy of the commons" (1968): each of several has learned
        to take what pays, and what they share is ruined, so that all get less than if nobody had learned.
        That it is learned is why the peak is well above random play; that it is the ruin of a board, and no
        mere fall, why boards have to die. The numbers are ours; factors of a negative random play, as of
        incomes without a harvest, are as far above or below it. Whether the difference is more than chance is
        another question, which intervals over replicas answer.
        """
        if self.peak < self.random_mean + (LEARNED_FACTOR - 1) * abs(self.random_mean):
            return NO_BETTER
        has_fallen = is_lost(self.lowest_after_peak, peak=self.peak, random=self.random_mean)
        if has_fallen and is_regained(self.last_mean, peak=self.peak, low=self.lowest_after_peak):
            return RECOVERY
        if self.last_mean <= self.random_mean - (1 - BELOW_RANDOM_FACTOR) * abs(self.random_mean):
            is_ruin = self.agents > 1 and self.life_share <= LIVED_SHARE
            return TRAGEDY if is_ruin else DECLINE
        return DECLINE if is_lost(self.last_mean, peak=self.peak, random=self.random_mean) else HARVESTING


RULE: Final = (
    f"its last {LAST_EPISODES} episodes against its peak and random play ({NO_BETTER}: no mean of "
    f"{PEAK_EPISODES} episodes reached {LEARNED_FACTOR} times random play; {TRAGEDY}: several agents get at "
    f"most {BELOW_RANDOM_FACTOR:.0%} of random play, and boards last at most {LIVED_SHARE:.0%} of the "
    "longest life)"
)
"""The rule of the word, as tables explain it."""


def outcome_of(table: pa.Table, *, random: float) -> Outcome:
    """Return the outcome of a training, of one replica or over several.

    Args:
        table: its episodes, those of each replica in the order in which they ended.
        random: the mean of what agents who act at random get.
    """
    rows = where(table, agent=0)
    replicas = [where(rows, replica=replica) for replica in rows["replica"].unique().to_pylist()]
    world_columns = list(map(world_of, replicas))
    worlds = len(np.unique(world_columns[0]))

    def means(metric: str, episodes: int) -> list[Float64]:
        return [
            mean_of_worlds(rows[metric].to_numpy(), world, episodes)
            for rows, world in zip(replicas, world_columns, strict=True)
        ]

    peak_curves = means(gain_metric(table), PEAK_EPISODES)
    end_curves = means(gain_metric(table), LAST_EPISODES)
    length = min(map(len, peak_curves))
    peak_curve = np.mean([curve[:length] for curve in peak_curves], 0)
    end_curve = np.mean([curve[:length] for curve in end_curves], 0)
    peak_window = episodes_per_world(PEAK_EPISODES, worlds) * worlds
    window_growth = episodes_per_world(LAST_EPISODES, worlds) * worlds - peak_window
    peak_index = int(np.nanargmax(peak_curve))
    lives = fmean(curve[-1] for curve in means("steps", LAST_EPISODES))
    return Outcome(
        first_mean=float(peak_curve[~np.isnan(peak_curve)][0]),
        peak=float(peak_curve[peak_index]),
        peak_episode=_middle_episode(peak_index, peak_window, length),
        lowest_after_peak=float(np.nanmin(end_curve[min(peak_index + window_growth, length - 1) :])),
        last_mean=fmean(curve[-1] for curve in end_curves),
        life_share=lives / pc.max(rows["steps"]).as_py(),
        random_mean=random,
        agents=pc.max(table["agent"]).as_py() + 1,
    )


def _middle_episode(index: int, window: int, length: int) -> int:
    """Return the episode, counted from 1, in the middle of those whose mean has an index in a curve.

    Args:
        window: the episodes of the mean.
        length: the episodes of the curve, which may be fewer.
    """
    return min(index + 1 - min(window, length) + window // 2, length)
