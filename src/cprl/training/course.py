"""The course of a run in sentences: what its agents get while they learn, what in fresh worlds, and why the
two differ.

The terminal, reports and notebooks say it in these words. Verdicts rest on intervals over replicas.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Final, Self

import numpy as np
import pyarrow as pa

from cprl.measuring.series import Values
from cprl.measuring.statistics import Estimate, difference, estimate, form_for
from cprl.measuring.windows import LAST_EPISODES, last_of, mean_of_worlds, rounds_of, running_mean
from cprl.population import AgentSpec, Learning, Team, exploring
from cprl.runs.curves import as_curves, worlds_of
from cprl.runs.episodes import read_episodes, read_rows

PEAK_EPISODES: Final = 10
"""Episodes of the mean whose highest value is the peak of a training."""
PEAK_OVER_RANDOM, BELOW_RANDOM = 1.5, 0.95
"""How many times random play the peak of agents who learned something is at least, and a tragedy's end at
most."""
SHORT: Final = 0.7
"""Of the turns that a board can last, what it lasts in a tragedy at most."""
FEW_REPLICAS: Final = 5
"""So many are told one by one."""
BETTER: Final = "better off"
WORSE: Final = "worse off"
NEEDED: Final = ("collective_return", "survival_steps")
"""The metrics of which a course is made."""


def course_of(run: Path, agents: Sequence[AgentSpec]) -> str:
    """Return what became of a run, in sentences: a line for each fact, and last what they mean.

    A tragedy, here: at the end of the training agents who learn get less than random play, over replicas, and
    at most 95 % of it; their best ten episodes yielded at least 1.5 times as much as it; and boards last at
    most 70 % of the turns that they could.

    Args:
        run: Its directory, with the evaluation.
        agents: Who plays in it.

    Raises:
        ValueError: If the game does not report harvests.
    """
    table = read_episodes(run)
    if lacking := sorted(set(NEEDED) - set(table.column_names)):
        raise ValueError(f"the episodes of {run} lack {', '.join(lacking)}; allowed: games that report them")
    trained = read_rows(run / "evaluation" / "trained.parquet")
    random = Outcome.of(read_rows(run / "evaluation" / "random.parquet"))
    fresh = Outcome.of(trained)
    if not any(isinstance(spec, Learning | Team) for spec in agents):
        parts = [f"In fresh worlds they get {fresh}.", *_replicas(fresh, trained)]
        parts += [f"Random play gets {random}.", _verdict({"in fresh worlds": fresh}, random, "random play")]
        return "\n".join(parts)
    last = Outcome.of(last_of(table, LAST_EPISODES))
    began, peak, around = _rise(table)
    parts = [
        f"The agents began at {began:.0f} apples an episode, all together, and reached {peak:.0f} around "
        f"episode {around}.",
        f"While they learn, in {last_text(table)}, they get {last}.",
        f"In fresh worlds, where {_differs(agents, table)}, they get {fresh}.",
        *_replicas(fresh, trained),
        f"Random play gets {random}.",
    ]
    level = random.apples.mean()
    longest = as_curves(table)["survival_steps"].max()
    is_fall = (
        len(np.unique(table["agent"].to_numpy())) > 1
        and last.apples.mean() <= BELOW_RANDOM * level
        and peak >= PEAK_OVER_RANDOM * level
        and last.steps.mean() <= SHORT * longest
    )
    ends = {"while they learn": last, "in fresh worlds": fresh}
    return "\n".join([*parts, _verdict(ends, random, "agents who never learned", is_fall=bool(is_fall))])


@dataclass(frozen=True)
class Outcome:
    """What all agents together get in some episodes, and how long their boards last: means of each replica,
    [R]."""

    apples: Values
    steps: Values
    clock: float
    """The steps of an episode whose board lasts; infinity where none did."""

    @classmethod
    def of(cls, table: pa.Table) -> Self:
        curves = as_curves(table)
        terminated = table["terminated"].to_numpy(zero_copy_only=False)
        lasted = table["steps"].to_numpy()[~terminated]
        clock = float(lasted.max()) if len(lasted) else inf
        apples, steps = (curves[name].mean(1) for name in NEEDED)
        return cls(apples, steps, clock)

    def __str__(self) -> str:
        apples, steps = (estimate(each).of(name, self.clock) for each, name in zip(self, NEEDED, strict=True))
        return f"{apples} apples, and boards last {steps} steps"

    def __iter__(self) -> Iterator[Values]:
        yield from (self.apples, self.steps)


def last_text(table: pa.Table, number: int = LAST_EPISODES) -> str:
    """Return which episodes `last_of` takes, e.g. "the last 2 episodes of each of 16 worlds"."""
    replicas = last_of(table, number)
    worlds = worlds_of(table)
    lanes = len(np.unique(worlds[0]))
    episodes = as_curves(replicas)["return_0"].shape[1] // lanes
    last = f"the last {episodes} episodes" if episodes > 1 else "the last episode"
    return last if lanes == 1 else f"{last} of each of {lanes} worlds"


def _rise(table: pa.Table) -> tuple[float, float, int]:
    """Return what agents got in the first ten episodes, in the best ten, and around which episode these were,
    each as a mean over replicas."""
    returns = as_curves(table)["collective_return"]
    worlds = worlds_of(table)
    lanes = len(np.unique(worlds[0]))
    if lanes == 1:
        means = running_mean(returns.mean(0), PEAK_EPISODES)
        return float(means[0]), float(means.max()), min(int(means.argmax()) + 5, returns.shape[1])
    of_replicas = [mean_of_worlds(*of_one, PEAK_EPISODES) for of_one in zip(returns, worlds, strict=True)]
    means = np.mean(of_replicas, 0)
    first = int(np.flatnonzero(~np.isnan(means))[0])
    at = int(np.nanargmax(means))
    return float(means[first]), float(means[at]), at + 1 - rounds_of(PEAK_EPISODES, lanes) * lanes // 2


def _differs(agents: Sequence[AgentSpec], table: pa.Table) -> str:
    """Return what is otherwise in fresh worlds than at the end of the training."""
    replicas = len(np.unique(table["replica"].to_numpy()))
    steps = int(table["steps"].to_numpy()[table["agent"].to_numpy() == 0].sum()) // replicas
    settings = exploring(agents)
    before = sorted({f"{one.epsilon(steps):.0%}" for one in settings})
    after = sorted({f"{one.epsilon_evaluation:.0%}" for one in settings})
    if before == after:
        return "nobody learns"
    shares = f"{' or '.join(after)} of their steps, not {' or '.join(before)}"
    return f"nobody learns and agents act at random in {shares}"


def _replicas(fresh: Outcome, played: pa.Table) -> list[str]:
    """The replicas one by one, where they are few; and of how many most boards die, where they differ."""
    replicas = len(fresh.apples)
    terminated = played["terminated"].to_numpy(zero_copy_only=False)
    of = played["replica"].to_numpy()
    died = np.array([terminated[of == replica].mean() for replica in np.unique(of)])
    dead = int((died > 0.5).sum())
    if 1 < replicas <= FEW_REPLICAS:
        apples, steps = (_listed(values, form_for(*values)) for values in fresh)
        die = _listed(died, ".0%")
        return [f"By replica that is {apples} apples and {steps} steps; {die} of the boards die."]
    if not 0 < dead < replicas:
        return []
    return [f"There most boards of {dead} of the {replicas} replicas die, those of the others last."]


def _listed(values: Values, form: str) -> str:
    *others, last = (f"{value:{form}}" for value in values)
    return f"{', '.join(others)} and {last}"


def _verdict(ends: Mapping[str, Outcome], random: Outcome, others: str, *, is_fall: bool = False) -> str:
    """Return how agents end beside random play, as far as replicas can tell.

    Args:
        ends: What they get, by when.
        others: Who plays at random.
        is_fall: Whether what they get at first is a tragedy, if it can be told.
    """
    whether = f"Whether they end better or worse off than {others} cannot be told"
    if len(random.apples) == 1:
        return f"{whether}: one replica has no interval."
    gaps = {when: difference(end.apples, random.apples, paired=True) for when, end in ends.items()}
    beside = " and ".join(f"{one:+} {when}" for when, one in gaps.items())
    judged = {when: _judged(one) for when, one in gaps.items()}
    words = list(judged.values())
    if is_fall and words[0] == WORSE:
        ends_text = (
            "Each agent learned to take what pays now, and while they learn all of them end worse off than "
            f"{others}: the tragedy of the commons."
        )
        more = {WORSE: "", BETTER: " In fresh worlds they end better off.", "": f" {_unsure(list(ends)[-1])}"}
        meaning = ends_text + more[words[-1]]
    elif len(set(words)) == 1:
        no_fall = ": no tragedy so far" * (words[0] == BETTER and len(ends) > 1)
        meaning = f"They end {words[0]} than {others}{no_fall}." if words[0] else f"{whether}."
    else:
        known = [f"{when} they end {word} than {others}" for when, word in judged.items() if word]
        unsure = [_unsure(when) for when, word in judged.items() if not word]
        sentences = [f"{one[0].upper()}{one[1:]}." for one in known]
        meaning = " ".join([*sentences, *unsure])
    return f"Beside random play, in apples, that is {beside}.\n{meaning}"


def _judged(gap: Estimate) -> str:
    return BETTER if gap.low > 0 else WORSE if gap.high < 0 else ""


def _unsure(when: str) -> str:
    return f"Whether they do {when} cannot be told."
