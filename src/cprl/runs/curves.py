"""The episodes of a run as curves: a number for each replica and episode, smoothed as in the study."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cprl.measuring import social
from cprl.measuring.published import SMOOTHED_EPISODES
from cprl.runs.episodes import read_episodes

Values = NDArray[np.float64]


def curves_of(run: Path) -> dict[str, Values]:
    """Every metric that a run's game reports, and each agent's return as `return_0` and so on.

    Args:
        run: the run's directory.

    Returns:
        float64 [R, E] by name, for R replicas and the E episodes that all of them have ended; NaN where a
        metric is undefined.
    """
    return as_curves(read_episodes(run))


def as_curves(table: pa.Table) -> dict[str, Values]:
    """Like `curves_of`, from a table of `read_episodes`."""
    replica, episode, agent = (table[name].to_numpy() for name in ("replica", "episode", "agent"))
    replicas, row = np.unique(replica, return_inverse=True)
    episodes = min(int(episode[row == nth].max()) for nth in range(len(replicas))) + 1
    everywhere = episode < episodes
    names = [name for name in table.column_names if name in social.METRICS or name == "yield_share"]
    curves: dict[str, Values] = {}

    def fill(name: str, column: str, which: NDArray[Any]) -> None:
        curves[name] = np.full((len(replicas), episodes), np.nan)
        curves[name][row[which], episode[which]] = table[column].to_numpy()[which]

    for name in names:
        fill(name, name, everywhere & (agent == 0))
    for number in np.unique(agent):
        fill(f"return_{number}", "return", everywhere & (agent == number))
    return curves


def running_mean(values: Values, window: int = SMOOTHED_EPISODES) -> Values:
    """Means over `window` consecutive values, each at the position of the first, [..., len - window + 1].

    With fewer values, the mean of all. Undefined values are skipped; NaN where no value is defined.
    """
    window = min(window, values.shape[-1])
    defined = ~np.isnan(values)
    sums = np.cumsum(_after_a_zero(np.where(defined, values, 0.0)), -1)
    counts = np.cumsum(_after_a_zero(defined.astype(np.float64)), -1)
    with np.errstate(invalid="ignore"):
        means: Values = (sums[..., window:] - sums[..., :-window]) / (
            counts[..., window:] - counts[..., :-window]
        )
    return means


def _after_a_zero(values: Values) -> Values:
    return np.concatenate([np.zeros((*values.shape[:-1], 1)), values], -1)
