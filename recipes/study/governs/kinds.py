"""Who gets what on `commons`, without a rule and under a quota: chance, scripts, learners, a language model?

    python recipes/study/governs/kinds.py
    python recipes/study/governs/kinds.py --model qwen3:1.7b --base-url http://127.0.0.1:11434/v1

To be run in the root of the repository: plays four agents of each kind in 50 fresh worlds of 8 replicas,
takes trained ones, frozen, from docs/results/studies/changes, and writes docs/results/governs/kinds.md. With
a model one episode of it is added, since each takes many calls; where an answer is no plan, its agent acts
at random.
"""

from dataclasses import replace
from typing import Final

import pyarrow as pa
import tyro
from asking import GAME, RESULTS
from changes import QUOTA
from judging import mean_text, outcomes_of
from page import table

from cprl import Fresh
from cprl.commands.recipe_command import exit_with_message
from cprl.evaluation.populations import play_population
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.measuring.table import by_replica
from cprl.population import AgentSpec, Language, Scripted

GAMES: Final = {"no rule": GAME, "quota": replace(GAME, institutions=(QUOTA,))}
TRAINED: Final = {"no rule": "nothing changed", "quota": "quota (2)"}
"""The conditions of changes.py."""
SCRIPTS: Final = ("random", "greedy", "sustainable")
FRESH: Final = Fresh(episodes=50)
PAGE: Final = RESULTS.parent / "governs" / "kinds.md"


def harvest_text(played: pa.Table) -> str:
    """Return the harvest of all agents in an episode, the mean over replicas with its interval."""
    rows = by_replica(played, COLLECTIVE_RETURN)
    return mean_text(dict(zip(rows["replica"].to_pylist(), rows["value"].to_pylist(), strict=True)))


def played_row(kind: str, spec: AgentSpec, fresh: Fresh = FRESH) -> list[str]:
    """Return the row of a kind of agents that do not learn."""
    cells = [harvest_text(play_population(game, (spec,) * game.agents, fresh)) for game in GAMES.values()]
    return [kind, str(len(fresh.replicas) or 8), *cells]


def trained_row() -> list[str]:
    """Return the row of trained agents, frozen at an exploration of 0.05."""
    outcomes = outcomes_of("changes")
    harvests = [outcomes.values(TRAINED[name], COLLECTIVE_RETURN) for name in GAMES]
    return ["trained, frozen", str(len(harvests[0])), *map(mean_text, harvests)]


def main(*, model: str = "", base_url: str = "http://127.0.0.1:11434/v1", every_steps: int = 250) -> None:
    """Write the table.

    Args:
        model: the name of a language model; none by default.
        base_url: the address of its server.
        every_steps: the steps from one plan to the next.
    """
    rows = [*(played_row(kind, Scripted(kind)) for kind in SCRIPTS), trained_row()]
    if model:
        spec = Language(
            model=model, base_url=base_url, every_steps=every_steps, fallback="random", max_tokens=60
        )
        rows.append(
            played_row(f"{model}, a plan in {every_steps} steps", spec, Fresh(episodes=1, replicas=(0,)))
        )
    lines = [
        "# Kinds of agents on commons",
        "",
        "Apples of four agents of a kind in an episode, with intervals over replicas (`kinds.py`).",
        "",
        *table(["agents", "replicas", *GAMES], rows, numbers=3),
    ]
    PAGE.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    with exit_with_message("kinds.py"):
        tyro.cli(main)
