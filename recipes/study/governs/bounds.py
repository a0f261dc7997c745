"""How many apples could an episode give? At most, proven, and on the best that is known, by board.

    python recipes/study/governs/bounds.py

To be run in the root of the repository: adds the boards of all studies in docs/results/studies that it lacks
to docs/results/governs/bounds.csv, in some minutes of a core (`--again` computes all anew), and reads there
what populations of these studies harvest. A board is a map with the rules by which it grows, the number of
agents and of turns; institutions, beams and sight are left out: what counts is what the board gives.

Nobody gets more on average than the first stock and the most that the board grows (`yield_bounds`), nor more
than an apple for each agent and turn. The best known is the largest of what a planner gets that sees all
(possible.py, boards with a name alone), what the scripted "sustainable" agents get in 50 worlds without
institutions, and what any population gets, frozen in fresh worlds, that was trained on the same board in a
study of docs/results/studies, under whichever rules.
"""

import csv
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import tyro
from asking import RESULTS
from finished import studies_in
from possible import KNOWN, Possible
from yield_bounds import yield_bounds

from cprl import Fresh, presets
from cprl.commands.recipe_command import exit_with_message
from cprl.commons.game import Game
from cprl.commons.observation import Observation
from cprl.commons.yields import sustainable_yield
from cprl.evaluation.populations import play_population
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.measuring.table import by_replica, where
from cprl.population import Scripted
from cprl.runs.files import digest_of
from cprl.studies.tables.tidy_table import EVALUATION_PART, StudyTable
from cprl.system.output import say

BOUNDS: Final = RESULTS.parent / "governs" / "bounds.csv"
EPISODES: Final = 50
"""Of the scripted agents."""
LEFT_OUT: Final = (
    *("beam_length_cells", "beam_width_cells", "hits_to_tag", "freeze_steps", "beam_tapers"),
    *("beam_from_beside", "beam_stops_at_agents", "cooldown_steps", "may_fire", "signals"),
    *("window_rows", "window_rows_behind", "window_columns"),
)
"""Rules of what agents see and do to each other, which do not change what a board gives."""


@dataclass(frozen=True, kw_only=True)
class Bound:
    """What a board could give in an episode, in apples of all agents together."""

    board: str
    """Its key, see `board_key`."""
    first: str
    """The first condition that has it, "STUDY/CONDITION"."""
    agents: int
    turns: int
    sites: int
    at_most: float
    """The apples that nobody exceeds on average."""
    limit: str
    """What says so: "regrowth", or "an apple a turn" for each agent."""
    planner: float | None
    scripted: float | None
    """None where scripted agents cannot play."""
    trained: float
    trained_in: str
    """The condition with the largest harvest, "STUDY/CONDITION"."""

    @property
    def best_known(self) -> float:
        """Return the largest harvest that is known."""
        return max(self.planner or 0.0, self.scripted or 0.0, self.trained)

    @property
    def best(self) -> str:
        """Return who has it."""
        if self.best_known == self.trained:
            return self.trained_in
        return "planner" if self.best_known == self.planner else "scripted restraint"


def board_key(game: Game) -> str:
    """Return what is the same for games with the same map, growth, agents and turns."""
    plain = replace(game.rules, **{name: getattr(type(game.rules)(), name) for name in LEFT_OUT})
    content = {"map": game.map.to_config(), "rules": plain.to_config(), "agents": game.agents}
    return digest_of(json.dumps(content, sort_keys=True), size=6)


@cache
def named() -> Mapping[str, Possible]:
    """Return what boards with a name could give, see possible.py."""
    return {
        board_key(presets.game(board, variant=variant)): known for (board, variant), known in KNOWN.items()
    }


def at_most(game: Game) -> tuple[float, str]:
    """Return the apples that nobody exceeds on average in an episode, and why."""
    turns = game.rules.episode_steps
    sites = len(game.map.sites)
    bitten = float(game.agents * turns)
    known = named().get(board_key(game))
    try:
        if sites + sustainable_yield(game.map, game.rules) * turns >= bitten:
            return bitten, "an apple a turn"  # whatever the search below would prove
        grown = known.at_most if known else sites + yield_bounds(game.map, game.rules).at_most * turns
    except ValueError as error:  # rules under which no yield is proven
        say(str(error))
        return bitten, "an apple a turn"
    return (grown, "regrowth") if grown < bitten else (bitten, "an apple a turn")


def scripted_harvest(game: Game) -> float | None:
    """Return the mean harvest of restrained scripted agents, without institutions; None if none can play."""
    plain = replace(game, institutions=(), observation=Observation())
    agents = (Scripted("sustainable"),) * game.agents
    try:
        table = play_population(plain, agents, Fresh(episodes=EPISODES, replicas=(0,)))
    except ValueError as error:
        say(str(error))
        return None
    return float(np.mean(where(table, agent=0)[COLLECTIVE_RETURN].to_numpy()))


def harvests_in(table: StudyTable) -> dict[str, float]:
    """Return the mean harvest of frozen agents in fresh worlds, by condition."""
    means: dict[str, list[float]] = {}
    for row in by_replica(table.windows(EVALUATION_PART), COLLECTIVE_RETURN, ["condition"]).to_pylist():
        means.setdefault(row["condition"], []).append(row["value"])
    return {condition: float(np.mean(values)) for condition, values in means.items()}


def computed(results: Path, known: Mapping[str, Bound], out: Path) -> dict[str, Bound]:
    """Return the bounds of all boards of the studies in a directory.

    Args:
        known: bounds that are not computed again; what trained agents get is read again.
        out: the file that has each new bound as soon as it is known.
    """
    bounds: dict[str, Bound] = {}
    for name, study in studies_in(results).items():
        harvests = harvests_in(StudyTable.read(results / name / "table.parquet"))
        for condition in () if study is None else study.all_conditions:
            game = condition.experiment.game
            if not isinstance(game, Game):
                continue
            key = board_key(game)
            label = f"{name}/{condition.name}"
            harvest = harvests.get(condition.name, 0.0)
            if key not in bounds and key in known:
                bounds[key] = replace(known[key], trained=harvest, trained_in=label)
            elif key not in bounds:
                bounds[key] = replace(new_bound(key, game, label), trained=harvest)
                write_bounds({**known, **bounds}, out)
            elif harvest > bounds[key].trained:
                bounds[key] = replace(bounds[key], trained=harvest, trained_in=label)
    return bounds


def new_bound(key: str, game: Game, first: str) -> Bound:
    """Return the bound of a board, without what trained agents get."""
    most, limit = at_most(game)
    say(f"{first}: at most {most:,.0f} apples, by {limit}")
    return Bound(
        board=key,
        first=first,
        agents=game.agents,
        turns=game.rules.episode_steps,
        sites=len(game.map.sites),
        at_most=most,
        limit=limit,
        planner=named()[key].best_known if key in named() else None,
        scripted=scripted_harvest(game),
        trained=0.0,
        trained_in=first,
    )


def read_bounds(path: Path = BOUNDS) -> dict[str, Bound]:
    """Return the bounds of a file by the key of the board; {} if there is no file."""
    if not path.exists():
        return {}
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {row["board"]: _bound(row) for row in rows}


def _bound(row: Mapping[str, str]) -> Bound:
    numbers = {name: int(row[name]) for name in ("agents", "turns", "sites")}
    apples = {name: float(row[name]) if row[name] != NONE else None for name in _APPLES}
    return Bound(**{**row, **numbers, **apples})  # type: ignore[arg-type]


_APPLES: Final = ("at_most", "planner", "scripted", "trained")
NONE: Final = "none"


def bound_of(game: object, bounds: Mapping[str, Bound]) -> Bound | None:
    """Return the bound of a game's board; None if it was not computed."""
    return bounds.get(board_key(game)) if isinstance(game, Game) else None


def write_bounds(bounds: Mapping[str, Bound], path: Path = BOUNDS) -> None:
    """Write bounds as a file that `read_bounds` reads."""
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Bound)], lineterminator="\n")
        writer.writeheader()
        for bound in bounds.values():
            row = asdict(bound)
            rounded = {name: NONE if row[name] is None else round(row[name], 2) for name in _APPLES}
            writer.writerow({**row, **rounded})


def main(*, results: Path = RESULTS, out: Path = BOUNDS, again: bool = False) -> None:
    """Write the bounds of all boards.

    Args:
        results: the directory of the results of all studies.
        out: the file.
        again: compute also what the file has.
    """
    write_bounds(computed(results, {} if again else read_bounds(out), out), out)


if __name__ == "__main__":
    with exit_with_message("bounds.py"):
        tyro.cli(main)
