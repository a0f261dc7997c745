"""The claims of Perolat et al. (2017) beside the finished studies of this folder, as a Markdown table.

    python recipes/study/perolat/perolat_claims.py --runs studies/runs --out docs/results/studies/perolat.md

A claim is a direction: some measure is larger under one condition than under another. Its row has both, and
their difference paired by replica, with 95 % intervals by Student's t over replicas. Social metrics are those
of the evaluation of each run, trained agents in fresh worlds and random ones in the same; measures of
territory are of 20 further episodes, played here.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import perolat_open
import perolat_unequal
import perolat_walls
import pyarrow as pa
import tyro
from numpy.typing import NDArray
from perolat_base import BEAMS

from cprl import Study, maps
from cprl.commands.recipe import in_a_sentence
from cprl.experimental.territory import WORDS, maps_of, number_of, territory_of
from cprl.measuring.statistics import Estimate, difference, estimate
from cprl.runs.curves import as_curves
from cprl.runs.episodes import read_table
from cprl.studies.tables.sources import sources_of
from cprl.system.defaults import Fresh

Values = NDArray[np.float64]
EPISODES: Final = 20
"""Of each replica, as many as the evaluation of a run."""


OVERLAP: Final = WORDS["overlap"]
DEFENCE: Final = WORDS["defence"]
TAGS: Final = WORDS["tag_rate"]


@cache
def played(run: Path) -> pa.Table:
    """Where the agents of a run go, and random ones."""
    return territory_of(run, Fresh(episodes=EPISODES))


@cache
def evaluated(run: Path, policy: str) -> dict[str, Values]:
    """The evaluation of a run: metrics by name, [R, E]."""
    return as_curves(read_table(run / "evaluation" / f"{policy}.parquet"))


def metric(name: str) -> Callable[[Path, str], Values]:
    """A social metric of the evaluation: each replica's mean over the episodes in which it is defined."""

    def measure(run: Path, policy: str) -> Values:
        values = np.asarray(evaluated(run, policy)[name], np.float64)
        with np.errstate(invalid="ignore"):
            means: Values = np.nansum(values, 1) / np.isfinite(values).sum(1)
        return means

    return measure


def rich_share(run: Path, policy: str) -> Values:
    """The share of all apples that agents get who begin in the north-west room."""
    every = evaluated(run, policy)
    returns = np.stack([every[name] for name in every if name.startswith("return_")])
    share: Values = returns[:: len(maps.ROOM_NAMES)].sum((0, 2)) / returns.sum((0, 2))
    return share


def in_own_room(run: Path, policy: str) -> Values:
    """The share of its time that an agent spends in the room in which it begins."""
    cells = maps.room_cells()
    flat = maps_of(played(run), "visits", policy)
    visits = flat.reshape(*flat.shape[:2], *cells.shape[1:])
    own = np.stack([cells[agent % len(cells)] for agent in range(visits.shape[1])])
    inside = (visits * own).sum((-2, -1))
    shares: Values = np.where(visits.any((-2, -1)), inside, np.nan).mean(1)
    return shares


def of_territory(name: str) -> Callable[[Path, str], Values]:
    """A measure of territory."""
    return lambda run, policy: number_of(played(run), name, policy)


def beyond_random(measure: Callable[[Path, str], Values]) -> Callable[[Path, str], Values]:
    """A measure of the agents that learned minus that of random ones, who are kept apart by walls too."""
    return lambda run, _: measure(run, "trained") - measure(run, "random")


MEASURES: Final[dict[str, Callable[[Path, str], Values]]] = {
    "harvest, apples": metric("collective_return"),
    "survival, steps": metric("survival_steps"),
    "mean time of harvest, steps": metric("sustainability"),
    "equality": metric("equality"),
    "exclusion beyond random": beyond_random(of_territory("exclusion")),
    "time in one's own room, beyond random": beyond_random(in_own_room),
    OVERLAP: of_territory("overlap"),
    DEFENCE: of_territory("defence"),
    TAGS: of_territory("tag_rate"),
    "share of apples of those who begin in the north-west room": rich_share,
}


@dataclass(frozen=True, kw_only=True)
class Of:
    """Agents of a condition."""

    study: Study
    condition: str
    policy: str = "trained"

    def __str__(self) -> str:
        return f"{self.condition}{', random agents' * (self.policy == 'random')}"


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Some measures are larger of the first than of the second."""

    text: str
    measures: tuple[str, ...]
    more: Of
    less: Of


def claims() -> Iterator[Claim]:
    """The claims, each for both lengths of the beam; the first one also without a beam."""
    *beams, none = perolat_open.STUDY.conditions
    for here in (*beams, none):
        yield Claim(
            text="agents who learn harvest less than random ones, and deplete the open commons",
            measures=("harvest, apples", "survival, steps"),
            more=Of(study=perolat_open.STUDY, condition=here, policy="random"),
            less=Of(study=perolat_open.STUDY, condition=here),
        )
    for here in beams:
        yield Claim(
            text="without a beam the open commons is depleted sooner",
            measures=("survival, steps", "mean time of harvest, steps", "harvest, apples"),
            more=Of(study=perolat_open.STUDY, condition=here),
            less=Of(study=perolat_open.STUDY, condition=none),
        )
    for beam in BEAMS:
        walls, none = (
            Of(study=perolat_walls.STUDY, condition=f"beam_length_cells={beam}, rooms={rooms}")
            for rooms in ("walls", "no walls")
        )
        yield Claim(
            text="with walls agents keep to territories and keep others out",
            measures=("exclusion beyond random", "time in one's own room, beyond random", DEFENCE),
            more=walls,
            less=none,
        )
        yield Claim(
            text="with walls the stock lasts longer and the harvest is higher",
            measures=("survival, steps", "harvest, apples"),
            more=walls,
            less=none,
        )
        yield Claim(
            text="without walls agents are more equal and meet more",
            measures=("equality", OVERLAP),
            more=none,
            less=walls,
        )
    for beam in BEAMS:
        equal, unequal = (
            Of(study=perolat_unequal.STUDY, condition=f"beam_length_cells={beam}, rooms={rooms}")
            for rooms in ("equal", "unequal")
        )
        yield Claim(
            text="with unequal rooms agents are less equal", measures=("equality",), more=equal, less=unequal
        )
        yield Claim(
            text="those who begin in the richer room get more, and all together do",
            measures=("share of apples of those who begin in the north-west room", "harvest, apples"),
            more=unequal,
            less=equal,
        )


def verdict(found: Estimate) -> str:
    """What the interval of a difference that should be positive says."""
    if found.low > 0:
        return "as claimed"
    several = "s" * (found.replicas != 1)  # of some a measure is undefined
    return "contradicted" if found.high < 0 else f"cannot be told with {found.replicas} replica{several}"


def finished_runs(study: Study, runs: Path, episodes: int | None) -> dict[str, Path]:
    """The finished runs of a study by condition; with `episodes`, those of as many, not of its own."""
    if episodes is not None:
        study = replace(study, experiment=replace(study.experiment, episodes=episodes))
    return {source.condition: source.run for source in sources_of(study, runs) if not source.reason}


def row(claim: Claim, name: str, runs: Path, episodes: int | None = None) -> str:
    """A row of the table."""
    both = claim.more, claim.less
    cells = [claim.text, name, *map(str, both)]
    found: list[Values] = []
    for own in both:
        finished = finished_runs(own.study, runs, episodes)
        if own.condition not in finished:
            return line(*cells, "", f"not run: {own.condition}")
        found.append(MEASURES[name](finished[own.condition], own.policy))
    pairs = np.stack(found)
    pairs = pairs[:, np.isfinite(pairs).all(0)]
    if not pairs.size:
        return line(*cells, "", "undefined in all replicas")
    cells[2:] = [f"{own}: {estimate(one):.4g}" for own, one in zip(both, pairs, strict=True)]
    apart = difference(*pairs, paired=True)
    return line(*cells, f"{apart:.4g}", verdict(apart))


def line(*cells: str) -> str:
    """A line of the table."""
    return f"| {' | '.join(cells)} |"


def table(runs: Path, episodes: int | None = None) -> str:
    """All claims as a Markdown table.

    Args:
        runs: the directory of the runs of the three studies.
        episodes: how many episodes they were trained for, where it is not as the studies say.
    """
    head = [
        "| claim | measure | should have more | should have less | difference | |",
        "|---|---|---|---|---|---|",
    ]
    rows = (row(claim, name, runs, episodes) for claim in claims() for name in claim.measures)
    return "\n".join([*head, *rows])


def main(*, runs: Path = Path("studies/runs"), episodes: int | None = None, out: Path | None = None) -> None:
    """Prints the table, or writes it.

    Args:
        runs: the directory of the runs of the three studies.
        episodes: how many episodes they were trained for, where it is not as the studies say.
        out: a .md to be, which is written over.
    """
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.is_dir():
            raise IsADirectoryError(f"--out is {out}, a directory; allowed: the name of a file")
    text = table(runs, episodes)
    if out is None:
        print(text)
    else:
        out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    with in_a_sentence("perolat_claims.py"):
        tyro.cli(main)
