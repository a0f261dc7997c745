"""What do the learned governors of governor.py do? The number that they set, against the stock and over time.

    python recipes/study/governs/governor_picture.py --out docs/results/governs/governor.png

To be run where the study has run: plays four fresh worlds of each replica with frozen weights, and draws the
mean number in force in tenths of the stock, and of the episode; thin: each replica, bold: their mean where
all have one. Tenths in which a replica has less than fifty turns are left out.
"""

from pathlib import Path
from typing import Final

import governor
import numpy as np
import tyro
from asking import trained

from cprl import keys, load
from cprl.measuring.playing import turns
from cprl.terminal import style
from cprl.values.array_types import Float64

LEARNED: Final = ("tax learned", "tax learned later", "quota learned", "quota learned later")
WORLDS: Final = 4
SEED: Final = 7
TENTHS: Final = np.arange(10) / 10 + 0.05
FEWEST: Final = 50


def courses(condition: str) -> tuple[Float64, Float64]:
    """Return the mean number in force by tenths of the stock and of the episode, [R, 10] each."""
    run = load(trained(governor.STUDY, condition)[0].run)
    by_stock, by_time = [], []
    for replica in run.replicas:
        env = run.env(WORLDS, seed=SEED, first_world=replica * WORLDS)
        rows = []
        for turn in turns(env, run.policy(replica, worlds=WORLDS, seed=SEED)):
            running = ~turn[keys.DONE][:, 0]
            seen = turn[keys.SEEN][running].numpy()
            number = turn["next", keys.IN_FORCE][running, -1].numpy()
            rows.append(np.stack([seen[:, 0], seen[:, -1], number]))
        stock, time, number = np.concatenate(rows, 1)
        by_stock.append(means(stock, number))
        by_time.append(means(time, number))
    return np.array(by_stock), np.array(by_time)


def means(shares: Float64, numbers: Float64) -> Float64:
    """Return the mean of the numbers in each tenth of the shares, [10]; NaN for a tenth with few."""
    tenth = np.minimum((shares * 10).astype(int), 9)
    count = np.bincount(tenth, minlength=10)
    total = np.bincount(tenth, numbers, minlength=10)
    return np.where(count >= FEWEST, total / np.maximum(count, 1), np.nan)


def main(*, out: Path) -> None:
    """Play the governors, and draw what they set."""
    with style.drawing(out) as sheet:
        panels = sheet.panels(2 * len(LEARNED), columns=2, row_height_em=11, sharey=True)
        for row, condition in enumerate(LEARNED):
            for axes, of_replicas, what in zip(
                panels[2 * row : 2 * row + 2], courses(condition), ("stock", "episode"), strict=True
            ):
                axes.plot(TENTHS, of_replicas.T, color=style.REPLICA_COLOUR, linewidth=0.9, alpha=0.75)
                everywhere = ~np.isnan(of_replicas).any(0)
                axes.plot(
                    TENTHS[everywhere],
                    of_replicas[:, everywhere].mean(0),
                    color=style.MEAN_COLOUR,
                    linewidth=2.4,
                )
                axes.set_title(f"{condition}, by the {what}")
                axes.set_xlabel(f"share of the {what}")
                axes.set_ylim(-0.05, 1.05)


if __name__ == "__main__":
    tyro.cli(main)
