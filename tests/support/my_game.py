"""A game of somebody's own, and what else an experiment may name, for tests."""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Dilemma:
    """A frozen value with `agents`, `to_config` and `make`, as `Experiment.game` takes it."""

    payoffs: tuple[tuple[float, ...], ...] = ((3.0, 0.0), (5.0, 1.0))
    agents: int = 2

    def to_config(self) -> dict[str, Any]:
        return asdict(self)

    def make(self, worlds, seed, device):
        raise NotImplementedError("these tests do not play")


def dilemma(temptation: float) -> Dilemma:
    """A function that makes a game."""
    return Dilemma(payoffs=((3.0, 0.0), (temptation, 1.0)))


class Callback:
    """Of a live object."""
