"""In which phase each replica ends: tragedy, recovery and so on.

Trainings of at least 1,000 episodes have phases as in `cprl.measuring.phases`, of each replica alone; what
counts is the last one. Shorter ones are judged by the collective return (in other games by the return of
all agents). With p the highest mean of 10 consecutive episodes, m the mean of the last 30, r that of random
play in the run's evaluation, and low the lowest mean of 30 consecutive episodes after the peak, it ends in:

- no better: p < 1.5 r; it never was much better off than random play;
- recovery: at low it had lost a third of p's lead over random play and 15 % of p, and m has regained a
  quarter of p - low;
- tragedy: m <= 0.95 r: worse off than random play, after it had been better off; of a single agent, which
  shares nothing, decline;
- decline: m has lost a third of p's lead over random play and 15 % of p, but is above 0.95 r;
- harvesting: else.

The numbers are those of `cprl.measuring.now` and `cprl.terminal.course`.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from cprl.measuring.now import DECLINE, HARVESTING, LEAST_LOSS, LOST, RECOVERY, REGAINED, TRAGEDY
from cprl.measuring.phases import FEWEST_EPISODES
from cprl.runs.curves import Values, as_curves, curves_of, phases_of, running_mean
from cprl.runs.episodes import read_table
from cprl.studies.tables.sources import Source
from cprl.terminal.course import BELOW_RANDOM, LAST_EPISODES, PEAK_EPISODES, PEAK_OVER_RANDOM
from cprl.terminal.figures import COLOURS as PHASE_COLOURS
from cprl.terminal.figures import UNNAMED

NO_BETTER: Final = "no better"
COLOURS: Final = {
    **PHASE_COLOURS,
    HARVESTING: "#c7e9c0",
    RECOVERY: "#c6dbef",
    DECLINE: "#d9c9b6",
    NO_BETTER: "#cfcfcf",
}
"""Of labels, light enough for text before them."""
BY_PHASES: Final = f"the last phase that cprl.measuring.phases finds, from {FEWEST_EPISODES:,} episodes on"
BY_RETURNS: Final = "its last 30 episodes against its peak and random play, see cprl.studies.tables.outcomes"


@dataclass(frozen=True, kw_only=True)
class Endings:
    """In which phase the replicas of each condition end."""

    labels: Mapping[str, Mapping[int, str]]
    """By condition and number of the replica; none for conditions without a finished run."""
    rules: tuple[str, ...]
    """How they were found, one for short trainings and one for long ones."""

    def counts(self, condition: str) -> Counter[str]:
        """How many replicas of a condition have each label, the most frequent one first."""
        return Counter(sorted(self.labels.get(condition, {}).values()))

    def most_frequent(self, condition: str) -> tuple[str, int, int] | None:
        """The most frequent label of a condition, how many replicas have it, and how many there are.

        Of equally frequent ones the first by name; None without a finished run.
        """
        found = self.counts(condition)
        if not found:
            return None
        label, number = found.most_common(1)[0]
        return label, number, found.total()


def endings(sources: list[Source]) -> Endings:
    """The phases in which the replicas of finished runs end.

    Raises:
        ValueError: for a damaged file; runs that a table holds are whole.
    """
    labels: dict[str, dict[int, str]] = {}
    rules: dict[str, None] = {}
    for source in sources:
        found, rule = _labels(source)
        rules[rule] = None
        numbered = {source.first + nth: own for nth, own in enumerate(found)}
        labels[source.condition] = {**labels.get(source.condition, {}), **numbered}
    return Endings(labels=labels, rules=tuple(rules))


def _labels(source: Source) -> tuple[list[str], str]:
    """The label of each replica of a run, and by which rule."""
    curves = curves_of(source.run)
    of_each = [{name: own[nth : nth + 1] for name, own in curves.items()} for nth in range(source.replicas)]
    by_phases = [phases_of(own, resamples=1) for own in of_each]
    if all(own is not None for own in by_phases):
        return [own[1][-1].label or UNNAMED for own in by_phases if own is not None], BY_PHASES
    agents = sum(name.startswith("return_") for name in curves)
    random = float(_harvest(as_curves(read_table(source.run / "evaluation" / "random.parquet"))).mean())
    return [ending(own, random=random, agents=agents) for own in _harvest(curves)], BY_RETURNS


def ending(returns: Values, *, random: float, agents: int) -> str:
    """In which phase a replica of a short training ends; see the module.

    Args:
        returns: of all agents together by episode, [E].
        random: the mean of random play.
        agents: how many there are.
    """
    tens, means = running_mean(returns, PEAK_EPISODES), running_mean(returns, LAST_EPISODES)
    peak, at, last = float(tens.max()), int(tens.argmax()), float(means[-1])
    low = float(means[min(at, len(means) - 1) :].min())

    def is_lost(mean: float) -> bool:
        return bool(peak - mean >= max(LOST * (peak - random), LEAST_LOSS * peak))

    if peak < PEAK_OVER_RANDOM * random:
        return NO_BETTER
    if is_lost(low) and last >= low + REGAINED * (peak - low):
        return RECOVERY
    if last <= BELOW_RANDOM * random:
        return TRAGEDY if agents > 1 else DECLINE
    return DECLINE if is_lost(last) else HARVESTING


def _harvest(curves: Mapping[str, Values]) -> Values:
    """The collective return, [R, E]; of games without a harvest the return of all agents."""
    if "collective_return" in curves:
        return curves["collective_return"]
    return np.asarray(np.sum([own for name, own in curves.items() if name.startswith("return_")], axis=0))
