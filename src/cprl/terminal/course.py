"""The course of a run in sentences: what its agents get while they learn, what in fresh worlds, and why the
two differ.

The terminal, reports and notebooks say it in these words. Verdicts rest on intervals over replicas; what a
tragedy is says `cprl.measuring.outcome`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from cprl.measuring.outcome import TRAGEDY, outcome_of
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.measuring.statistics import Estimate, Family, differences, estimates, form_for
from cprl.measuring.table import by_replica, labelled, where, world_of
from cprl.measuring.windows import LAST_EPISODES, last_of
from cprl.population import AgentSpec, any_learns, exploring
from cprl.runs.episodes import read_episodes, read_rows

FEW_REPLICAS: Final = 5
"""So many are told one by one."""
BETTER: Final = "better off"
WORSE: Final = "worse off"
LIFE: Final = "survival_steps"
NEEDED: Final = (COLLECTIVE_RETURN, LIFE)
"""The metrics of which a course is made."""
_COLUMNS: Final = ("replica", "episode", "agent", *NEEDED, "steps", "terminated")
LEARNING: Final = "while they learn"
FRESH: Final = "in fresh worlds"
RANDOM: Final = "random play"


def course_of(run: Path, agents: Sequence[AgentSpec]) -> str:
    """Return what became of a run, in sentences: a line for each fact, and last what they mean.

    Args:
        run: Its directory, with the evaluation.
        agents: Who plays in it.

    Raises:
        ValueError: If the game does not report harvests.
    """
    table = read_episodes(run)
    if lacking := sorted(set(NEEDED) - set(table.column_names)):
        raise ValueError(f"the episodes of {run} lack {', '.join(lacking)}; allowed: games that report them")
    learns = any_learns(agents)
    last = last_of(table, LAST_EPISODES)
    fresh = read_rows(run / "evaluation" / "trained.parquet")
    random = read_rows(run / "evaluation" / "random.parquet")
    parts = {**({LEARNING: last} if learns else {}), FRESH: fresh, RANDOM: random}
    played = pa.concat_tables(labelled(rows.select(_COLUMNS), when=when) for when, rows in parts.items())
    levels = estimates(played, NEEDED, "when")
    gaps = differences(played, COLLECTIVE_RETURN, "when", {"when": RANDOM})
    others = "agents who never learned" if learns else RANDOM
    of_random = f"Random play gets {_got(levels, RANDOM)}."
    if not learns:
        lines = [f"In fresh worlds they get {_got(levels, FRESH)}.", *_replicas(fresh), of_random]
        return "\n".join([*lines, _verdict(gaps, others)])
    went = outcome_of(table, random=levels[RANDOM, COLLECTIVE_RETURN].value)
    lines = [
        f"The agents began at {went.begins:.0f} apples an episode, all together, and reached "
        f"{went.peak:.0f} around episode {went.around}.",
        f"While they learn, in {last_text(table)}, they get {_got(levels, LEARNING)}.",
        f"In fresh worlds, where {_differs(agents, table)}, they get {_got(levels, FRESH)}.",
        *_replicas(fresh),
        of_random,
    ]
    return "\n".join([*lines, _verdict(gaps, others, is_tragedy=went.word == TRAGEDY)])


def last_text(table: pa.Table, number: int = LAST_EPISODES) -> str:
    """Return which episodes `last_of` takes, e.g. "the last 2 episodes of each of 16 worlds"."""
    taken = where(last_of(table, number), agent=0)
    replicas = len(taken["replica"].unique())
    worlds = len(np.unique(world_of(taken))) // replicas
    episodes = len(taken) // replicas // worlds
    last = f"the last {episodes} episodes" if episodes > 1 else "the last episode"
    return last if worlds == 1 else f"{last} of each of {worlds} worlds"


def _got(levels: Family, when: str) -> str:
    return f"{levels[when, COLLECTIVE_RETURN]} apples, and boards last {levels[when, LIFE]} steps"


def _differs(agents: Sequence[AgentSpec], table: pa.Table) -> str:
    """Return what is otherwise in fresh worlds than at the end of the training."""
    replicas = len(table["replica"].unique())
    steps = int(where(table, agent=0)["steps"].to_numpy().sum()) // replicas
    settings = exploring(agents)
    before = sorted({f"{one.epsilon(steps):.0%}" for one in settings})
    after = sorted({f"{one.epsilon_evaluation:.0%}" for one in settings})
    if before == after:
        return "nobody learns"
    shares = f"{' or '.join(after)} of their steps, not {' or '.join(before)}"
    return f"nobody learns and agents act at random in {shares}"


def _replicas(fresh: pa.Table) -> list[str]:
    """Return replicas one by one, where they are few; else in how many most boards die, where they differ."""
    apples = by_replica(fresh, COLLECTIVE_RETURN).sort_by("replica")["value"].to_pylist()
    steps = by_replica(fresh, LIFE).sort_by("replica")["value"].to_pylist()
    died = fresh.group_by("replica").aggregate([("terminated", "mean")])
    shares = died.sort_by("replica")["terminated_mean"].to_pylist()
    replicas = len(apples)
    if 1 < replicas <= FEW_REPLICAS:
        got = f"{_listed(apples, form_for(*apples))} apples and {_listed(steps, form_for(*steps))} steps"
        return [f"By replica that is {got}; {_listed(shares, '.0%')} of the boards die."]
    dead = sum(share > 0.5 for share in shares)
    if not 0 < dead < replicas:
        return []
    return [f"There most boards of {dead} of the {replicas} replicas die, those of the others last."]


def _listed(values: Sequence[float], form: str) -> str:
    *others, last = (f"{value:{form}}" for value in values)
    return f"{', '.join(others)} and {last}"


def _verdict(gaps: Family, others: str, *, is_tragedy: bool = False) -> str:
    """Return how agents end beside random play, as far as replicas can tell.

    Args:
        gaps: How much more they get than random play, by when.
        others: Who plays at random.
        is_tragedy: Whether what they get while they learn is a tragedy, if it can be told.
    """
    by_when = {when: one for (when, _), one in gaps.items()}
    whether = f"Whether they end better or worse off than {others} cannot be told"
    if all(one.replicas == 1 for one in by_when.values()):
        return f"{whether}: one replica has no interval."
    beside = " and ".join(f"{one:+} {when}" for when, one in by_when.items())
    judged = {when: _judged(one) for when, one in by_when.items()}
    meaning = _meaning(judged, others, whether, is_tragedy)
    return f"Beside random play, in apples, that is {beside}.\n{meaning}"


def _meaning(judged: Mapping[str, str], others: str, whether: str, is_tragedy: bool) -> str:
    words = set(judged.values())
    if is_tragedy and judged[LEARNING] == WORSE:
        in_fresh = {WORSE: "", BETTER: " In fresh worlds they end better off.", "": f" {_unsure(FRESH)}"}
        return (
            "Each agent learned to take what pays now, and while they learn all of them end worse off than "
            f"{others}: the tragedy of the commons.{in_fresh[judged[FRESH]]}"
        )
    if words == {""}:
        return f"{whether}."
    if len(words) == 1:
        no_tragedy = ": no tragedy so far" if words == {BETTER} and len(judged) > 1 else ""
        return f"They end {judged[FRESH]} than {others}{no_tragedy}."
    known = [f"{when} they end {word} than {others}" for when, word in judged.items() if word]
    unsure = [_unsure(when) for when, word in judged.items() if not word]
    return " ".join([*(f"{one[0].upper()}{one[1:]}." for one in known), *unsure])


def _judged(gap: Estimate) -> str:
    if gap.low > 0:
        return BETTER
    return WORSE if gap.high < 0 else ""


def _unsure(when: str) -> str:
    return f"Whether they do {when} cannot be told."
