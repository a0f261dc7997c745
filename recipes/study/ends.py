"""What has a population become? Restraint, territory or ruin: how it plays, and what others gain by it.

    python recipes/study/ends.py studies/many_worlds/runs/d50737d94dfe-s*-r2 --out ends.md

Takes finished runs of one experiment, whose replicas count together, and writes a table in Markdown: how they
do in fresh worlds, how far agents keep to cells of their own, in which dilemma they are with scripted agents,
what trained best responses gain, and the phases of the training. Intervals are over replicas, by Student's t.
Responses take the time: they are trained in the directory `responses` beside each run, and kept.
"""

from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import tyro
from phases import FEWEST_EPISODES, METRICS, UNNAMED, find_phases

import cprl
from cprl.evaluation import dilemma, margins, payoffs_of, schelling
from cprl.evaluation.cross_play import OF_FOCAL
from cprl.experimental.territory import WORDS, number_of, territory_of
from cprl.measuring.statistics import estimate
from cprl.measuring.table import by_replica, where
from cprl.measuring.windows import running_mean
from cprl.runs.curves import curves_of
from cprl.studies.exploit import BEST, compared, exploitability, plan_responses
from cprl.training.stored import LoadedRun, load
from cprl.values.arrays import Float64

POINTS: Final = 2_000
"""Of the courses in which phases are found: means of as many blocks of episodes."""


def together(values: list[dict[str, Float64]]) -> dict[str, str]:
    """Estimates over the replicas of all runs, from a number for each replica of each run."""
    return {name: str(estimate(np.concatenate([run[name] for run in values]))) for name in values[0]}


def fresh(run: LoadedRun, episodes: int) -> dict[str, Float64]:
    """Harvests and the like in fresh worlds, and where agents are, beside random play."""
    evaluated = cprl.evaluate_run(run, cprl.Fresh(episodes=episodes))
    territory = territory_of(run, cprl.Fresh(episodes=episodes))
    numbers = {}
    for name in METRICS:
        for policy in ("trained", "random"):
            means = by_replica(where(evaluated, policy=policy), name)
            numbers[f"{name}, {policy}"] = means["value"].to_numpy()
    for name, words in WORDS.items():
        for policy in ("trained", "random"):
            numbers[f"{words}, {policy}"] = number_of(territory, name, policy)
    return numbers


def gains(run: LoadedRun, episodes: int, training_episodes: int) -> dict[str, Float64]:
    """What best responses gain that learn as the agent did whose place they take, three for each replica."""
    fresh = cprl.Fresh(episodes=episodes)
    plan = plan_responses(run, fresh, algorithms=("own",), training_episodes=training_episodes)
    out = run.path.parent / "responses" / run.path.name
    responses = compared(exploitability(plan, out, progress=False))
    own, best = (
        by_replica(where(responses, response=name), OF_FOCAL).sort_by("replica")["value"].to_numpy()
        for name in ("", BEST)
    )
    return {"return of agent 0": own, "gain of the best of our responses in its place": best - own}


def mixes(runs: list[LoadedRun], episodes: int, **policies: str) -> dict[str, str]:
    """Margins of a Schelling diagram whose policies are the runs' where they are not given."""
    restrained, greedy = [], []
    for run in runs:
        both: dict[str, Any] = {"restrained": str(run.path), "greedy": str(run.path)} | policies
        payoffs = payoffs_of(schelling(run, cprl.Fresh(episodes=episodes), **both))
        restrained.append(payoffs.restrained)
        greedy.append(payoffs.greedy)
    found = margins(np.concatenate(restrained), np.concatenate(greedy))
    return {**{name: f"{margin:+}" for (name,), margin in found.items()}, "dilemma": dilemma(found)}


def training(curves: dict[str, Float64]) -> dict[str, Float64]:
    """The lowest harvest of any twentieth of the training, and that of the last."""
    harvest = curves["collective_return"]
    means = running_mean(harvest, max(1, harvest.shape[-1] // 20))
    return {"harvest in its lowest twentieth": means.min(1), "harvest in the last twentieth": means[:, -1]}


def course(curves: list[dict[str, Float64]]) -> list[str]:
    """The phases of the mean over all replicas, in millions of steps, with the harvest at each end."""
    episodes = min(len(of_run["collective_return"][0]) for of_run in curves)
    if episodes < FEWEST_EPISODES:
        return [f"fewer than {FEWEST_EPISODES:,} episodes, in which none are looked for"]
    block = max(1, episodes // POINTS)
    whole = episodes // block * block
    at = np.arange(whole // block)
    means = {
        name: np.concatenate(
            [np.nanmean(of_run[name][:, :whole].reshape(-1, len(at), block), -1) for of_run in curves]
        )
        for name in METRICS
    }
    steps = np.cumsum(means["survival_steps"].mean(0) * block) / 1e6
    harvest, lines = means["collective_return"].mean(0), []
    for phase in find_phases(at, means):
        first, last = int(phase.first), int(phase.last)
        inside = harvest[first:last]
        ends = inside[:20].mean(), inside[-20:].mean()
        label = phase.label or UNNAMED
        lines.append(
            f"{steps[first]:.0f} to {steps[last]:.0f}: {label}, {ends[0]:.0f} to {ends[1]:.0f} apples"
        )
    return lines


def main(
    runs: Annotated[list[Path], tyro.conf.Positional],
    /,
    *,
    out: Path,
    episodes: int = 20,
    training_episodes: int = 6_000,
) -> None:
    """Write the table.

    Args:
        runs: directories of finished runs of one experiment.
        out: the file.
        episodes: fresh episodes of each replica, in each choice of who plays.
        training_episodes: of each response.
    """
    loaded = [load(run) for run in runs]
    replicas = sum(len(run.replicas) for run in loaded)
    curves = [curves_of(run.path) for run in loaded]
    rows = together(list(map(training, curves))) | together([fresh(run, episodes) for run in loaded])
    rows |= together([gains(run, episodes, training_episodes) for run in loaded])
    for who, policies in {
        "scripted restraint, these agents greedy": {"restrained": "sustainable"},
        "these agents restrained, scripted greed": {"greedy": "greedy"},
    }.items():
        rows |= {f"{name}: {who}": value for name, value in mixes(loaded, episodes, **policies).items()}
    lines = [
        f"| over {replicas} replicas | |",
        "|---|---:|",
        *(f"| {name} | {rows[name]} |" for name in rows),
    ]
    phases = [f"- {line}" for line in course(curves)]
    text = "\n".join(
        [*lines, "", "Phases of the training, in millions of steps of each replica:", "", *phases, ""]
    )
    out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    tyro.cli(main)
