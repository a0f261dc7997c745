"""Lawgivers: between episodes a language model reads what came of them, and answers institutions."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from cprl.commons.game import Game
from cprl.institutions import Institution
from cprl.measuring.table import all_metrics
from cprl.pictures.readable import NO_RULES, instructions_of, rules_of
from cprl.policies.asking import Calls, Model, Question, Text
from cprl.policies.rng import seed_of
from cprl.values import KINDS, defaults_of, describe_type, from_config, hints_of


@dataclass(frozen=True, kw_only=True)
class Lawgiver(Model, stored=False):
    """A language model that gives a game its institutions."""

    instructions: Text = ""
    """Text before all else, e.g. what the lawgiver is to reach."""

    def give(self, game: Game, table: pa.Table, calls: Calls, *, number: int = 0) -> Game:
        """Return the game under the institutions that the model answers; as it is without a usable answer.

        Args:
            game: the game so far, whose institutions are replaced.
            table: the episodes that were played in it, e.g. of `cprl.evaluation.populations.play_population`.
            calls: makes the call, and keeps it.
            number: the number of the law, which names the call.
        """

        def read(answer: Any) -> Game:
            return replace(game, institutions=from_config(answer.get("institutions"), "institutions"))

        prompt = "\n".join(
            [f"Institutions now: {rules_of(game) or NO_RULES}.", "What came of it:", *_metrics(table)]
        )
        question = Question(f"law {number}", seed_of((number,)) % 2**31, self._system(game), prompt)
        (new,) = calls.ask(self, [question], read)
        return new or game

    def _system(self, game: Game) -> str:
        kinds = sorted(name for name, kind in KINDS.items() if issubclass(kind, Institution))
        return "\n".join(
            [
                *filter(None, [self.instructions]),
                f"You give laws to {game.agents} agents on a board.",
                *instructions_of(game, "board"),
                "Answer with one JSON object and nothing else, in this form:",
                '{"why": "...", "institutions": [{"kind": "Quota", "share": 0.25}, ...]}',
                "An empty list is no institution. The kinds, and what their fields may be:",
                *(f"- {name}: {_fields(KINDS[name])}" for name in kinds),
            ]
        )


def _fields(kind: type[Any]) -> str:
    """Return the fields of an institution in words, with their defaults."""
    defaults = defaults_of(kind)
    words = []
    for name, hint in hints_of(kind).items():
        default = f" ({defaults[name]})" if name in defaults else ""
        words.append(f"{name}, {describe_type(hint)}{default}")
    return "; ".join(words)


def _metrics(table: pa.Table) -> list[str]:
    """Return the means of a table's metrics in words, without those that are undefined."""
    columns = {name: table[name].to_numpy() for name in all_metrics(table)}
    means = {name: np.nanmean(column) for name, column in columns.items() if not np.isnan(column).all()}
    return [f"- {name}: {mean:.4g}" for name, mean in means.items()]
