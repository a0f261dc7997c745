"""What each institution costs: the time of a turn on the commons board, as a multiple of a turn without any.

4 agents, 1024 worlds, one thread, RGB windows, random actions drawn beforehand; nothing is shown to agents
(`observed=False`), since a further plane costs what any other costs. All games in one run, in turns, each at
its best of many short rounds: others who use the machine disturb most rounds, and some not at all.

    make bench
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import chain
from typing import Final

import torch
import tyro
from env_steps import actions_for, best_us
from rich.console import Console
from rich.table import Table

from cprl import CommonsEnv, Game, keys, presets
from cprl.commons.batch import Batch
from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    Governor,
    GraduatedSanctions,
    Institution,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Rotation,
    Sanctioner,
    Tax,
    Vote,
)

DEFECT = 1.3
"""The multiple of a turn through `CommonsEnv.step` above which an institution costs more than is allowed."""
HIDDEN: Final = {"observed": False}
EACH: Final[dict[str, tuple[Institution, ...]]] = {
    "Boundaries, stopped": (Boundaries.strips(height=12, width=24, agents=4, **HIDDEN),),
    "Boundaries, fined": (
        Boundaries.strips(height=12, width=24, agents=4, bite_fine=1.0, step_fine=0.1, **HIDDEN),
    ),
    "Quota": (Quota(**HIDDEN),),
    "ClosedSeason": (ClosedSeason(**HIDDEN),),
    "ClosedPatches": (ClosedPatches(**HIDDEN),),
    "Rotation": (Rotation(**HIDDEN),),
    "Tax": (Tax(**HIDDEN),),
    "Tax, per 50 turns, 3 brackets": (
        Tax(period_steps=50, brackets=((0, 0.1), (2, 0.3), (5, 0.5)), **HIDDEN),
    ),
    "Levies": (Levies(groups=((0, 1), (2, 3)), **HIDDEN),),
    "Vote on a Tax": (Vote(on=Tax(**HIDDEN), **HIDDEN),),
    "Governor of a Tax": (Tax(**HIDDEN), Governor(sets="tax.rate", **HIDDEN)),
    "Monitoring": (Monitoring(cost=0.01, **HIDDEN),),
    "GraduatedSanctions": (GraduatedSanctions(**HIDDEN),),
    "Mediation": (Mediation(**HIDDEN),),
    "Sanctioner, elected": (Sanctioner(**HIDDEN),),
}
"""Each kind, as cheap and as dear as it gets."""


def kernel_timer(game: Game, worlds: int, turns: int) -> Callable[[], float]:
    """Return what measures the microseconds of a turn of the compiled rules alone."""
    batch = Batch(game, worlds, threads=1)
    output = batch.new_output()
    actions = actions_for(game, worlds, turns)
    return lambda: best_us(
        lambda turn: batch.play(actions[turn], output), lambda: batch.begin(output), turns, 1
    )


def step_timer(game: Game, worlds: int, turns: int) -> Callable[[], float]:
    """Return what measures the microseconds of a turn through `CommonsEnv.step`."""
    env = CommonsEnv(game, worlds, seed=0, threads=1)
    actions = torch.as_tensor(actions_for(game, worlds, turns))
    decisions = torch.zeros((worlds, game.agents), dtype=torch.int64)
    now = {"entries": env.reset()}

    def begin() -> None:
        now["entries"] = env.reset()

    def step(turn: int) -> None:
        agents = now["entries"].get(keys.AGENTS)
        agents.set("action", actions[turn])
        if game.decisions:
            agents.set("decision", decisions)
        now["entries"] = env.step(now["entries"]).get("next")

    return lambda: best_us(step, begin, turns, 1)


def main(*, worlds: int = 1024, turns: int = 4, rounds: int = 200) -> None:
    """Print the table; end with exit code 1 where an institution costs more than is allowed.

    Args:
        worlds: the batch size.
        turns: turns timed at a time.
        rounds: of which the best counts.
    """
    plain = presets.game("commons")
    every = tuple(chain.from_iterable(EACH.values()))
    games = {"none": plain, **{name: replace(plain, institutions=kind) for name, kind in EACH.items()}}
    games["all at once"] = replace(plain, institutions=every)
    ways = {"kernel": kernel_timer, "CommonsEnv.step": step_timer}
    measures = {
        (name, way): measure(game, worlds, turns)
        for name, game in games.items()
        for way, measure in ways.items()
    }
    best = dict.fromkeys(measures, float("inf"))
    for _ in range(rounds):
        for place, measure_us in measures.items():
            best[place] = min(best[place], measure_us())
    ratios = {(name, way): us / best["none", way] for (name, way), us in best.items()}
    table = Table(title=f"a turn of {worlds:,} worlds, as a multiple of one without institutions")
    table.add_column("institution", no_wrap=True)
    for way in ways:
        table.add_column(way, justify="right", no_wrap=True)
    for name in games:
        table.add_row(name, *(f"{ratios[name, way]:.2f}" for way in ways))
    Console().print(table)
    dear = [name for name in EACH if ratios[name, "CommonsEnv.step"] > DEFECT]
    if dear:
        sys.exit(f"more than {DEFECT} of a turn: {', '.join(dear)}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(main)
