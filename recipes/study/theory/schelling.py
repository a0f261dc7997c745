"""Which social dilemma are the boards? Schelling diagrams under four rules, measured with scripted agents.

    python recipes/study/theory/schelling.py --out docs/results/schelling

Expected before it was run: restraint of all beats greed of all everywhere. With a beam and without, who meets
greedy agents had better be greedy (fear), since apples that are spared go to others; who meets restrained
agents gains by greed, too, so that the boards are prisoner's dilemmas, `commons` more than `two_complex`,
where the damage falls on one of two. A tax that shares half of the harvests takes from greed, but not enough;
a quota with sanctions ends it: a greedy agent is out of play most of the time.

All take about half an hour of a core.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Final

import pyarrow as pa
import tyro

from cprl import Fresh, Game, presets
from cprl.commands.recipe_command import exit_with_message
from cprl.experimental.schelling import dilemma, draw_schelling, margins, payoffs_of, schelling
from cprl.institutions import GraduatedSanctions, Quota, Tax
from cprl.measuring.statistics import estimate
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.runs.recipe import RECIPE_FILE
from cprl.system.output import say
from cprl.terminal.picture_files import check_picture

BOARDS: Final = ("commons", "two_complex")
RULES: Final = {
    "as run": {},
    "no beam": {"may_fire": False},
    "tax of a half, shared equally": {},
    "quota, graduated sanctions": {},
}
INSTITUTIONS: Final = {
    "tax of a half, shared equally": (Tax(rate=0.5),),
    "quota, graduated sanctions": (
        Quota(share=0.5, window_steps=50, fine=0.0),
        GraduatedSanctions(freeze_steps=(5, 25, 100, 100), fines=(0, 1, 2, 4), recovery_steps=50),
    ),
}
GREEDY: Final = ("greedy", "territorial")
"""Without a beam the second one plays as the first."""


def game_of(board: str, rules: str) -> Game:
    """Return a board under rules, by their names."""
    game = presets.game(board, variant="as_run")
    return replace(game, rules=replace(game.rules, **RULES[rules]), institutions=INSTITUTIONS.get(rules, ()))


def row_of(board: str, rules: str, greedy: str, table: pa.Table) -> list[str]:
    """Return a line of the table."""
    payoffs = payoffs_of(table)
    ends = [payoff[:, at] for at in (-1, 0) for payoff in (payoffs.cooperators, payoffs.defectors)]
    differences = margins(payoffs.cooperators, payoffs.defectors)
    agents = greedy if greedy in SCRIPTED_POLICIES else "trained DQN"
    return [
        *(f"`{board}`", rules, agents),
        *(f"{estimate(values):.4g}" for values in ends),
        *(f"{differences[name]:.4g}" for name in ("restraint", "fear", "greed")),
        dilemma(differences),
    ]


HEADINGS: Final = (
    "board",
    "rules",
    "greedy agents",
    "R(N-1)",
    "G(N-1)",
    "R(0)",
    "G(0)",
    "restraint, R(N-1) - G(0)",
    "fear, G(0) - R(0)",
    "greed, G(N-1) - R(N-1)",
    "dilemma",
)


def diagrams(trained: Path) -> Iterator[tuple[str, str, str]]:
    """Yield board, rules and greedy agents of each diagram; say where there is no run of trained agents."""
    for board, rules in product(BOARDS, RULES):
        for policy in GREEDY:
            if rules != "no beam" or policy == GREEDY[0]:
                yield board, rules, policy
        if rules == "as run":
            run = trained / board
            if (run / RECIPE_FILE).exists():
                yield board, rules, str(run)
            else:
                say(f"{run} holds no run; the diagram of {board} with trained agents is left out")


def main(
    *,
    out: Path,
    trained: Path = Path("docs/results"),
    episodes: int = 5,
    replicas: tuple[int, ...] = (),
) -> None:
    """Measure all diagrams; restrained agents are the scripted "sustainable".

    Args:
        out: where to: table.md and a figure for each diagram.
        trained: a directory of runs by the names of boards, whose agents play greedy in further diagrams;
            a board without a run there has none.
        episodes: of each replica and choice of restrained agents.
        replicas: which ones, by number; by default all of trained agents, and 0 to 7 of scripted ones.
    """
    figures = {}
    for board, rules, greedy in diagrams(trained):
        agents = greedy if greedy in SCRIPTED_POLICIES else "trained"
        name = f"{board}_{rules}_{agents}".replace(",", "").replace(" ", "_")
        figures[board, rules, greedy] = check_picture(out / f"{name}.png", refuse_existing=True)
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for (board, rules, greedy), figure in figures.items():
        fresh = Fresh(episodes=episodes, replicas=replicas)
        table = schelling(game_of(board, rules), fresh, greedy=greedy)
        draw_schelling(table, figure)
        rows.append(row_of(board, rules, greedy, table))
        say("; ".join(rows[-1]))
    lines = [f"| {' | '.join(cells)} |" for cells in (HEADINGS, ["---"] * len(HEADINGS), *rows)]
    (out / "table.md").write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    with exit_with_message("schelling.py"):
        tyro.cli(main)
