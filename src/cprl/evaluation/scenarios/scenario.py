"""Scenario: a background population on a board, and how many of the agents are focal."""

from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias, get_args

from cprl.checks import Check, check_fields, instance, one_of
from cprl.commons.game import Game
from cprl.population import Frozen, Scripted

Focal: TypeAlias = Literal["majority", "minority"]
"""How many agents are focal: "majority", all but one; "minority", one."""

_BACKGROUND: Final = "Scripted(policy) or Frozen(run, agent, replica) for each agent of the game"


def _is_background(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(spec, Scripted | Frozen) for spec in value)


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and value.isidentifier()


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A background on a board, and how many of the agents are focal.

    Raises:
        ValueError: names the field, what came and what is allowed.
    """

    name: str
    """What it is called, e.g. "minority_among_greedy": letters, digits and underscores."""
    game: Game
    """The board with its rules, for at least 2 agents; scripted policies need windows as observations."""
    focal: Focal
    """How many agents are focal, see `Focal`; in a game of two agents both are one."""
    background: tuple[Scripted | Frozen, ...]
    """Who plays with each agent index where it is not focal. `Frozen(run, agent, replica=None)` is, beside
    replica r of the focal run, the agent of the next replica that its own run keeps, the first one after
    the last: so agents of one replica, trained together or from the same seed, never meet."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            {
                "name": Check(_is_name, "letters, digits and underscores, not a digit first"),
                "game": instance(Game, "a cprl.Game"),
                "focal": one_of(*get_args(Focal)),
                "background": Check(_is_background, _BACKGROUND),
            },
        )
        if self.game.agents < 2:
            raise ValueError(
                f"Scenario.game has {self.game.agents} agent; allowed: at least 2, focal and background"
            )
        if len(self.background) != self.game.agents:
            raise ValueError(
                f"Scenario.background has {len(self.background)} agents for a game of {self.game.agents} "
                f"agents; allowed: {_BACKGROUND}"
            )

    @property
    def placements(self) -> tuple[tuple[int, ...], ...]:
        """The indices of the focal agents in turn, so that every agent is focal equally often: as a minority
        each alone, as a majority all without agent 0, without agent 1 and so on."""
        everyone = range(self.game.agents)
        if self.focal == "minority":
            return tuple((agent,) for agent in everyone)
        return tuple(tuple(agent for agent in everyone if agent != other) for other in everyone)
