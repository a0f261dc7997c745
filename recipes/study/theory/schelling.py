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
from pathlib import Path
from typing import Final

import pyarrow as pa
import tyro

from cprl import Fresh, Game, presets
from cprl.commands.recipe import in_a_sentence
from cprl.evaluation import dilemma, draw_schelling, margins, payoffs_of, schelling
from cprl.institutions import GraduatedSanctions, Quota, Tax
from cprl.measuring.statistics import estimate
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.runs.recipe import RECIPE_FILE
from cprl.system.output import say
from cprl.terminal.style import check_picture

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
    """A board under rules, by their names."""
    game = presets.game(board, variant="as_run")
    return replace(game, rules=replace(game.rules, **RULES[rules]), institutions=INSTITUTIONS.get(rules, ()))


def row_of(board: str, rules: str, greedy: str, table: pa.Table) -> list[str]:
    """A line of the table."""
    payoffs = payoffs_of(table)
    ends = [of_kind[:, at] for at in (-1, 0) for of_kind in (payoffs.restrained, payoffs.greedy)]
    found = margins(payoffs.restrained, payoffs.greedy)
    return [
        *(f"`{board}`", rules, greedy if greedy in SCRIPTED_POLICIES else "trained DQN"),
        *(f"{estimate(values):.4g}" for values in ends),
        *(f"{found[name]:.4g}" for name in ("restraint", "fear", "greed")),
        dilemma(found),
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
    """Board, rules and who plays greedy of each diagram; says where there is no run of trained agents."""
    for board in BOARDS:
        for rules in RULES:
            greedy = [*GREEDY[: 1 if rules == "no beam" else None]]
            yield from ((board, rules, who) for who in greedy)
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
    """Measures all diagrams; restrained agents are the scripted "sustainable".

    Args:
        out: where to: table.md and a figure for each diagram.
        trained: a directory of runs by the names of boards, whose agents play greedy in further diagrams;
            a board without a run there has none.
        episodes: of each replica and choice of restrained agents.
        replicas: which ones, by number; by default all of trained agents, and 0 to 7 of scripted ones.
    """
    asked = []
    for board, rules, who in diagrams(trained):
        name = f"{board}_{rules}_{who if who in SCRIPTED_POLICIES else 'trained'}"
        figure = check_picture(out / f"{name.replace(',', '').replace(' ', '_')}.png")
        asked.append((board, rules, who, figure))
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for board, rules, who, figure in asked:
        fresh = Fresh(episodes=episodes, replicas=replicas)
        table = schelling(game_of(board, rules), fresh, greedy=who)
        draw_schelling(table, figure)
        rows.append(row_of(board, rules, who, table))
        say("; ".join(rows[-1]))
    lines = [f"| {' | '.join(cells)} |" for cells in (HEADINGS, ["---"] * len(HEADINGS), *rows)]
    (out / "table.md").write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    with in_a_sentence("schelling.py"):
        tyro.cli(main)
