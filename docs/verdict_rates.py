"""How often intervals of eight replicas hold the truth, and how often the rule of `cprl report` contradicts
curves that are drawn as ours are; the numbers stand in docs/results.md. And how often the interval of a
difference of nothing excludes 0, by the number of replicas: docs/studies.md.

python docs/verdict_rates.py
python docs/verdict_rates.py --differences
"""

from collections.abc import Callable

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy import stats

from cprl.measuring.statistics import difference, estimate
from cprl.reporting import verdicts

Values = NDArray[np.float64]
Draw = Callable[[np.random.Generator, int], Values]

LAWS: dict[str, tuple[Draw, float]] = {
    "normal": (lambda rng, number: rng.normal(size=number), 0.0),
    "skewed (gamma, shape 2)": (lambda rng, number: rng.gamma(2.0, size=number), 2.0),
    "heavy tails (t, 3 degrees of freedom)": (lambda rng, number: rng.standard_t(3, number), 0.0),
}
"""Distributions of replicas, with their means."""
POINTS, WINDOW = 400, 20
PAIRS = 2, 3, 4, 5, 6, 8, 10, 12, 16, 24, 32


def main(*, replicas: int = 8, repetitions: int = 1_000, seed: int = 0, differences: bool = False) -> None:
    """Prints two tables in Markdown, or that of differences."""
    rng = np.random.default_rng(seed)
    if differences:
        _differences(rng, repetitions)
        return
    print("| replicas are | percentile | BCa | t |\n|---|---:|---:|---:|")
    for name, (draw, mean) in LAWS.items():
        held = np.zeros(3)
        for _ in range(repetitions):
            sample = draw(rng, replicas)
            found = [_percentile(sample, rng)]
            found += [
                (one.low, one.high)
                for one in (estimate(sample, interval="bca", resamples=1000), estimate(sample))
            ]
            held += [low <= mean <= high for low, high in found]
        print(f"| {name} | " + " | ".join(f"{share:.1%}" for share in held / repetitions) + " |", flush=True)
    print("\n| curves | one run | mean of two |\n|---|---:|---:|")
    for name, spread, heavy in (
        ("noise alone", 0.0, False),
        ("noise and levels of their own", 1.0, False),
        ("mostly levels of their own", 3.0, False),
        ("the same, with heavy tails", 3.0, True),
    ):
        rates = []
        for runs in (1, 2):
            alarms = 0
            for _ in range(repetitions):
                drawn = _curves(rng, replicas + runs, spread, heavy)
                of_curve = verdicts.of_curve(drawn[replicas:].mean(0), drawn[:replicas], runs=runs)
                alarms += of_curve.verdict == verdicts.CONTRADICTED
            rates.append(f"{alarms / repetitions:.1%}")
        print(f"| {name} | {' | '.join(rates)} |", flush=True)


def _differences(rng: np.random.Generator, repetitions: int) -> None:
    """How often the interval of the difference of two conditions excludes 0 that are the same, by the number
    of replicas, which are normal and paired."""
    print("| replicas | BCa | t |\n|---:|---:|---:|")
    for pairs in PAIRS:
        excluded = np.zeros(2)
        for _ in range(repetitions):
            one, other = rng.normal(size=(2, pairs))
            found = [difference(one, other, paired=True, interval=own) for own in ("bca", "t")]
            excluded += [own.low > 0 or own.high < 0 for own in found]
        print(f"| {pairs} | " + " | ".join(f"{own:.1%}" for own in excluded / repetitions) + " |", flush=True)


def _percentile(sample: Values, rng: np.random.Generator) -> tuple[float, float]:
    means = rng.choice(sample, (1000, len(sample))).mean(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def _curves(rng: np.random.Generator, number: int, spread: float, heavy: bool) -> Values:
    """Running means of noise, each about a level and a drift of its own, [number, POINTS]."""
    noise = np.cumsum(np.pad(rng.normal(size=(number, POINTS + WINDOW - 1)), ((0, 0), (1, 0))), axis=1)
    level = stats.t.rvs(3, size=(number, 1), random_state=rng) if heavy else rng.normal(size=(number, 1))
    drift = np.cumsum(rng.normal(size=(number, POINTS)), axis=1) / np.sqrt(POINTS)
    found: Values = (noise[:, WINDOW:] - noise[:, :-WINDOW]) / np.sqrt(WINDOW) + spread * (level + drift)
    return 100 + 8 * found


if __name__ == "__main__":
    tyro.cli(main)
