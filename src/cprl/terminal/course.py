"""Tells the course of a run in sentences, for the terminal, reports and notebooks.

The sentences say how many apples the agents get while they learn and in fresh worlds, why the two differ, and
whether they end better or worse off than random play. Verdicts rest on intervals over replicas. For the
definition of a tragedy see `cprl.measuring.outcome`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from cprl.measuring.outcome import TRAGEDY, outcome_of
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.measuring.statistics import Estimate, Family, differences, estimates, number_format
from cprl.measuring.table import by_replica, labelled, where, world_of
from cprl.measuring.windows import last_of
from cprl.pictures.readable import capitalised
from cprl.population import AgentSpec, any_learns, exploring
from cprl.runs.episodes import read_episodes, read_rows
from cprl.system.defaults import LAST_EPISODES

_FEW_REPLICAS: Final = 5
"""The largest number of replicas that are listed one by one."""
_BETTER: Final = "better off"
_WORSE: Final = "worse off"
_LIFE: Final = "survival_steps"
NEEDED: Final = (COLLECTIVE_RETURN, _LIFE)
"""The metrics that a game must report for its runs to have a course."""
_COLUMNS: Final = ("replica", "episode", "agent", *NEEDED, "steps", "terminated")
_LEARNING: Final = "while they learn"
_FRESH: Final = "in fresh worlds"
_RANDOM: Final = "random play"


def course_of(run: Path, agents: Sequence[AgentSpec]) -> str:
    """Return the course of a run: one line for each fact, and a last line with their meaning.

    Args:
        run: the directory of the run, with its evaluation.
        agents: the specifications of its agents.

    Raises:
        ValueError: if the game does not report harvests.
    """
    table = read_episodes(run)
    if missing := sorted(set(NEEDED) - set(table.column_names)):
        raise ValueError(f"the episodes of {run} lack {', '.join(missing)}; allowed: games that report them")
    learns = any_learns(agents)
    fresh = read_rows(run / "evaluation" / "trained.parquet")
    random = read_rows(run / "evaluation" / "random.parquet")
    phases = {_FRESH: fresh, _RANDOM: random}
    if learns:
        phases = {_LEARNING: last_of(table, LAST_EPISODES), **phases}
    played = pa.concat_tables(labelled(rows.select(_COLUMNS), when=phase) for phase, rows in phases.items())
    levels = estimates(played, NEEDED, "when")
    gaps = differences(played, COLLECTIVE_RETURN, "when", {"when": _RANDOM})
    baseline = "agents who never learned" if learns else _RANDOM
    lines = []
    conditions = ""
    is_tragedy = False
    if learns:
        outcome = outcome_of(table, random=levels[_RANDOM, COLLECTIVE_RETURN].value)
        lines = [
            f"The agents began at {outcome.first_mean:.0f} apples an episode, all together, and reached "
            f"{outcome.peak:.0f} around episode {outcome.peak_episode}.",
            f"While they learn, in {last_text(table)}, they get {_harvest_and_life(levels, _LEARNING)}.",
        ]
        conditions = f", where {_fresh_conditions(agents, table)},"
        is_tragedy = outcome.word == TRAGEDY
    lines += [
        f"In fresh worlds{conditions} they get {_harvest_and_life(levels, _FRESH)}.",
        *_replica_sentences(fresh),
        f"Random play gets {_harvest_and_life(levels, _RANDOM)}.",
        _verdict(gaps, baseline, is_tragedy),
    ]
    return "\n".join(lines)


def last_text(table: pa.Table) -> str:
    """Name the last episodes that a course is about, e.g. "the last 2 episodes of each of 16 worlds"."""
    taken = where(last_of(table, LAST_EPISODES), agent=0)
    replicas = len(taken["replica"].unique())
    worlds = len(np.unique(world_of(taken))) // replicas
    episodes = len(taken) // replicas // worlds
    last = f"the last {episodes} episodes" if episodes > 1 else "the last episode"
    return last if worlds == 1 else f"{last} of each of {worlds} worlds"


def _harvest_and_life(levels: Family, phase: str) -> str:
    """Return how many apples agents get and how long boards last, in words."""
    return f"{levels[phase, COLLECTIVE_RETURN]} apples, and boards last {levels[phase, _LIFE]} steps"


def _fresh_conditions(agents: Sequence[AgentSpec], table: pa.Table) -> str:
    """Return in words how playing in fresh worlds differs from the end of the training."""
    replicas = len(table["replica"].unique())
    steps = int(where(table, agent=0)["steps"].to_numpy().sum()) // replicas
    settings = exploring(agents)
    training_epsilons = sorted({f"{setting.epsilon(steps):.0%}" for setting in settings})
    fresh_epsilons = sorted({f"{setting.epsilon_evaluation:.0%}" for setting in settings})
    if training_epsilons == fresh_epsilons:
        return "nobody learns"
    shares = f"{' or '.join(fresh_epsilons)} of their steps, not {' or '.join(training_epsilons)}"
    return f"nobody learns and agents act at random in {shares}"


def _replica_sentences(fresh: pa.Table) -> list[str]:
    """Return a sentence about the differences between replicas, or no sentence if there are none to tell.

    A few replicas are listed one by one. Of many, the sentence says in how many most boards die.
    """
    apples = by_replica(fresh, COLLECTIVE_RETURN).sort_by("replica")["value"].to_pylist()
    steps = by_replica(fresh, _LIFE).sort_by("replica")["value"].to_pylist()
    deaths = fresh.group_by("replica").aggregate([("terminated", "mean")])
    death_shares = deaths.sort_by("replica")["terminated_mean"].to_pylist()
    replicas = len(apples)
    if 1 < replicas <= _FEW_REPLICAS:
        harvests = f"{_enumerated(apples, number_format(*apples))} apples"
        lives = f"{_enumerated(steps, number_format(*steps))} steps"
        deaths_text = _enumerated(death_shares, ".0%")
        return [f"By replica that is {harvests} and {lives}; {deaths_text} of the boards die."]
    dying = sum(share > 0.5 for share in death_shares)
    if not 0 < dying < replicas:
        return []
    return [f"There most boards of {dying} of the {replicas} replicas die, those of the others last."]


def _enumerated(values: Sequence[float], format_spec: str) -> str:
    """Return numbers as "1, 2 and 3", each in the same format."""
    *firsts, last = (f"{value:{format_spec}}" for value in values)
    return f"{', '.join(firsts)} and {last}"


def _verdict(gaps: Family, baseline: str, is_tragedy: bool) -> str:
    """Return how the agents end in comparison with random play, as far as the replicas can tell.

    Args:
        gaps: how much more they get than random play, while they learn and in fresh worlds.
        baseline: the name of the agents that play at random.
        is_tragedy: whether the harvest falls as in a tragedy while they learn.
    """
    gap_by_phase = {phase: gap for (phase, _), gap in gaps.items()}
    undecided = f"Whether they end better or worse off than {baseline} cannot be told"
    if all(gap.replicas == 1 for gap in gap_by_phase.values()):
        return f"{undecided}: one replica has no interval."
    comparison = " and ".join(f"{gap:+} {phase}" for phase, gap in gap_by_phase.items())
    verdicts = {phase: _phase_verdict(gap) for phase, gap in gap_by_phase.items()}
    meaning = _meaning(verdicts, baseline, undecided, is_tragedy)
    return f"Beside random play, in apples, that is {comparison}.\n{meaning}"


def _meaning(verdict_by_phase: Mapping[str, str], baseline: str, undecided: str, is_tragedy: bool) -> str:
    """Return the last line of a course.

    Args:
        verdict_by_phase: "better off", "worse off" or, if the replicas cannot tell, "", in each phase.
        undecided: the sentence, without its full stop, for the case that no phase can tell.
    """
    verdicts = set(verdict_by_phase.values())
    if is_tragedy and verdict_by_phase[_LEARNING] == _WORSE:
        in_fresh = {_WORSE: "", _BETTER: " In fresh worlds they end better off.", "": f" {_unsure(_FRESH)}"}
        return (
            "Each agent learned to take what pays now, and while they learn all of them end worse off than "
            f"{baseline}: the tragedy of the commons.{in_fresh[verdict_by_phase[_FRESH]]}"
        )
    if verdicts == {""}:
        return f"{undecided}."
    if len(verdicts) == 1:
        has_two_phases = len(verdict_by_phase) > 1
        no_tragedy = ": no tragedy so far" if verdicts == {_BETTER} and has_two_phases else ""
        return f"They end {verdict_by_phase[_FRESH]} than {baseline}{no_tragedy}."
    sentences = []
    for phase, verdict in verdict_by_phase.items():
        if verdict:
            sentences.append(f"{capitalised(phase)} they end {verdict} than {baseline}.")
    sentences += [_unsure(phase) for phase, verdict in verdict_by_phase.items() if not verdict]
    return " ".join(sentences)


def _phase_verdict(gap: Estimate) -> str:
    """Return whether the interval of a difference is above or below 0; "" if it holds 0."""
    if gap.low > 0:
        return _BETTER
    return _WORSE if gap.high < 0 else ""


def _unsure(phase: str) -> str:
    return f"Whether they do {phase} cannot be told."
