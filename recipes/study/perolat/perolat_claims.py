"""Do claims after Perolat et al. (2017) hold in the finished studies of this folder? A table in Markdown.

    python recipes/study/perolat/perolat_claims.py --runs studies/runs --out docs/results/studies/perolat.md

A claim is a direction: some measure is larger under one condition than under another. They are claims as we
wrote them before the runs; docs/results/details.md says what others report of the paper. A row has both, and
their difference paired by replica, with 95 % intervals by Student's t over replicas. Social metrics are those
of the evaluation of each run, trained agents in fresh worlds and random ones in the same; measures of
territory are of 20 further episodes, played here.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import perolat_open
import perolat_unequal
import perolat_walls
import pyarrow as pa
import tyro
from perolat_base import BEAMS

from cprl import Study, maps
from cprl.commands.recipe_command import exit_with_message
from cprl.experimental.territory import TERRITORY_NUMBERS, maps_of, number_of, territory_of
from cprl.measuring.statistics import Estimate, difference, estimate
from cprl.measuring.table import by_replica
from cprl.runs.episodes import read_table
from cprl.studies.tables.sources import sources_of
from cprl.system.defaults import Fresh
from cprl.values.array_types import Float64

EPISODES: Final = 20
"""The episodes of each replica, as many as in the evaluation of a run."""
OVERLAP: Final = TERRITORY_NUMBERS["overlap"]
DEFENCE: Final = TERRITORY_NUMBERS["defence"]
OURS: Final = " (our reading)"
"""The end of a claim that no account of the paper makes."""
Measure = Callable[[Path, str], Float64]
"""From a run and "trained" or "random" to a number of each replica, [R]."""


@cache
def played(run: Path) -> pa.Table:
    """Return where the agents of a run go, and random ones."""
    return territory_of(run, Fresh(episodes=EPISODES))


@cache
def evaluated(run: Path, policy: str) -> pa.Table:
    """Return the episodes of the evaluation of a run."""
    return read_table(run / "evaluation" / f"{policy}.parquet")


def metric(name: str) -> Measure:
    """Return a social metric: each replica's mean over the episodes in which it is defined."""

    def measure(run: Path, policy: str) -> Float64:
        return by_replica(evaluated(run, policy), name).sort_by("replica")["value"].to_numpy()

    return measure


def rich_share(run: Path, policy: str) -> Float64:
    """Return the share of all apples that agents get who begin in the north-west room."""
    sums = evaluated(run, policy).group_by(["replica", "agent"]).aggregate([("return", "sum")])
    sums = sums.sort_by([("replica", "ascending"), ("agent", "ascending")])
    returns = sums["return_sum"].to_numpy().reshape(len(sums["replica"].unique()), -1)
    return returns[:, :: len(maps.ROOM_NAMES)].sum(1) / returns.sum(1)


def in_first_room(run: Path, policy: str) -> Float64:
    """Return the share of its time that an agent spends in the room in which it begins."""
    cells = maps.room_cells()
    visits = maps_of(played(run), "visits", policy)
    rooms = cells.reshape(len(cells), -1)[np.arange(visits.shape[1]) % len(cells)]
    return np.where(visits.any(-1), (visits * rooms).sum(-1), np.nan).mean(1)


def territory(name: str) -> Measure:
    """Return a measure of territory."""
    return lambda run, policy: number_of(played(run), name, policy)


def beyond_random(measure: Measure) -> Measure:
    """Return a measure of the agents that learned minus that of random ones, who are kept apart by walls
    too."""
    return lambda run, _: measure(run, "trained") - measure(run, "random")


MEASURES: Final[dict[str, Measure]] = {
    "harvest, apples": metric("collective_return"),
    "survival, steps": metric("survival_steps"),
    "mean time of harvest, steps": metric("sustainability"),
    "equality": metric("equality"),
    "exclusion beyond random": beyond_random(territory("exclusion")),
    "time in one's own room, beyond random": beyond_random(in_first_room),
    OVERLAP: territory("overlap"),
    DEFENCE: territory("defence"),
    "share of apples of those who begin in the north-west room": rich_share,
}


class Agents(NamedTuple):
    """The agents of a condition of a study."""

    study: Study
    condition: str
    policy: str = "trained"

    def __str__(self) -> str:
        return f"{self.condition}{', random agents' * (self.policy == 'random')}"


class Claim(NamedTuple):
    """Some measures are larger of the first agents than of the second."""

    text: str
    measures: tuple[str, ...]
    more: Agents
    less: Agents


def claims() -> Iterator[Claim]:
    """Yield the claims, each for both lengths of the beam; the first one also without a beam."""
    study = perolat_open.STUDY
    *beams, none = study.conditions
    text = f"in the end agents who learn harvest less than random ones, and deplete the open commons{OURS}"
    for condition in study.conditions:
        measures = ("harvest, apples", "survival, steps")
        yield Claim(text, measures, Agents(study, condition, "random"), Agents(study, condition))
    text = "without a beam the open commons is depleted sooner"
    for condition in beams:
        measures = ("survival, steps", "mean time of harvest, steps", "harvest, apples")
        yield Claim(text, measures, Agents(study, condition), Agents(study, none))
    for beam in BEAMS:
        walls, no_walls = _rooms(perolat_walls.STUDY, beam, "walls", "no walls")
        text = "with walls agents keep to territories and keep others out"
        measures = ("exclusion beyond random", "time in one's own room, beyond random", DEFENCE)
        yield Claim(text, measures, walls, no_walls)
        text = "with walls the stock lasts longer and the harvest is higher"
        yield Claim(text, ("survival, steps", "harvest, apples"), walls, no_walls)
        text = "without walls agents are more equal and meet more"
        yield Claim(text, ("equality", OVERLAP), no_walls, walls)
    for beam in BEAMS:
        equal, unequal = _rooms(perolat_unequal.STUDY, beam, "equal", "unequal")
        yield Claim(f"with unequal rooms agents are less equal{OURS}", ("equality",), equal, unequal)
        text = f"those who begin in the richer room get more, and all together do{OURS}"
        share = "share of apples of those who begin in the north-west room"
        yield Claim(text, (share, "harvest, apples"), unequal, equal)


def _rooms(study: Study, beam: int, *rooms: str) -> list[Agents]:
    return [Agents(study, f"beam_length_cells={beam}, rooms={room}") for room in rooms]


def verdict(change: Estimate) -> str:
    """Return what the interval of a difference that should be positive says."""
    if change.low > 0:
        return "as claimed"
    several = "s" * (change.replicas != 1)  # of some a measure is undefined
    return "contradicted" if change.high < 0 else f"cannot be told with {change.replicas} replica{several}"


def finished_runs(study: Study, runs: Path, episodes: int | None) -> dict[str, Path]:
    """Return the finished runs of a study by condition; with `episodes`, those of as many."""
    if episodes is not None:
        study = replace(study, experiment=replace(study.experiment, episodes=episodes))
    return {source.condition: source.run for source in sources_of(study, runs) if not source.reason}


def compared(claim: Claim, name: str, runs: Path, episodes: int | None) -> list[str]:
    """Return the last four cells of a row: both means, their difference, and what it says."""
    both = [claim.more, claim.less]
    texts = [*map(str, both)]
    values = []
    for agents in both:
        finished = finished_runs(agents.study, runs, episodes)
        if agents.condition not in finished:
            return [*texts, "", f"not run: {agents.condition}"]
        values.append(MEASURES[name](finished[agents.condition], agents.policy))
    pairs = np.stack(values)
    pairs = pairs[:, np.isfinite(pairs).all(0)]
    if not pairs.size:
        return [*texts, "", "undefined in all replicas"]
    change = difference(*pairs, paired=True)
    means = [f"{text}: {estimate(mean):.4g}" for text, mean in zip(texts, pairs, strict=True)]
    return [*means, f"{change:.4g}", verdict(change)]


def table(runs: Path, episodes: int | None = None) -> str:
    """Return all claims as a Markdown table.

    Args:
        runs: the directory of the runs of the three studies.
        episodes: how many episodes they were trained for, where it is not as the studies say.
    """
    lines = [
        "| claim | measure | should have more | should have less | difference | |",
        "|---|---|---|---|---|---|",
    ]
    for claim in claims():
        for name in claim.measures:
            lines.append(f"| {' | '.join([claim.text, name, *compared(claim, name, runs, episodes)])} |")
    return "\n".join(lines)


def main(*, runs: Path = Path("studies/runs"), episodes: int | None = None, out: Path | None = None) -> None:
    """Print the table, or write it.

    Args:
        runs: the directory of the runs of the three studies.
        episodes: how many episodes they were trained for, where it is not as the studies say.
        out: a .md to be, which is written over.
    """
    if out is None:
        print(table(runs, episodes))
        return
    if out.is_dir():
        raise IsADirectoryError(f"--out is {out}, a directory; allowed: the name of a file")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(table(runs, episodes) + "\n", encoding="utf-8")


if __name__ == "__main__":
    with exit_with_message("perolat_claims.py"):
        tyro.cli(main)
