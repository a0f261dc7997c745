"""Every TensorDict entry that the rooms of cprl hand on: its name, shape, type and meaning.

Axes, the same letters everywhere: B worlds, N agents, H x W the board, K sites, T time, A actions,
R replicas, C channels, X rows and Y columns of an agent's window (its own row included, farthest row first).
"""

from typing import Any, Final

from tensordict import TensorDictBase
from tensordict.base import NO_DEFAULT

AGENTS: Final = "agents"
"""The group of agents, a nested TensorDict of batch size [B, N]."""

OBSERVATION: Final = (AGENTS, "observation")
"""uint8 [B, N, C, X, Y]: what an agent sees, in the form that `Game.observation` says; as a rule its RGB
window, C = 3 channels, 0..255."""

ACTION: Final = (AGENTS, "action")
"""int64 [B, N]: what an agent does, an index into `cprl.commons.rules.ACTIONS`."""

REWARD: Final = (AGENTS, "reward")
"""float32 [B, N, 1]: what the learner is paid for the turn."""

HARVEST: Final = (AGENTS, "harvest")
"""float32 [B, N]: apples bitten this turn; rewards may be changed by an institution, this never is."""

IN_PLAY: Final = (AGENTS, "in_play")
"""bool [B, N]: the action of this very entry will count. Sum it at the root, not at "next"."""

FIRED: Final = (AGENTS, "fired")
"""bool [B, N]: who fired the beam this turn."""

HIT_BY: Final = (AGENTS, "hit_by")
"""bool [B, N, N]: row, whose cell a beam crossed this turn; column, whose beam it was."""

TAGGED_BY: Final = (AGENTS, "tagged_by")
"""bool [B, N, N]: row, who was tagged out this turn; column, by whom."""

SCOREBOARD: Final = (AGENTS, "scoreboard")
"""float32 [B, N, N]: apples bitten so far in this episode, a row per observer: its own first, then those of
the next numbers, round and round. Only where `Observation.scoreboard` asks for it."""

STOCK_GAUGE: Final = (AGENTS, "stock_gauge")
"""float32 [B, N, 1]: the share of all sites that hold an apple, 0..1. Only where
`Observation.stock_gauge` asks for it."""

STOCK: Final = "stock"
"""int64 [B, 1]: apples on the board."""

REGROWN: Final = "regrown"
"""int64 [B, 1]: apples grown this turn."""

STATE: Final = "state"
"""uint8 [B, 3, H, W]: the whole board as RGB, only where it was asked for."""

DONE: Final = "done"
"""bool [B, 1]: the episode is over, `terminated` or `truncated`. At the root only."""

TERMINATED: Final = "terminated"
"""bool [B, 1]: no apple is left and none can come."""

TRUNCATED: Final = "truncated"
"""bool [B, 1]: the clock ran out."""


def entry(tensordict: TensorDictBase, name: str) -> Any:
    """`tensordict.get(name)` without its search for nested keys: a tenth of the time, several times a step.

    Raises:
        KeyError: where there is no such entry.
    """
    return tensordict._get_str(name, NO_DEFAULT)


def put(tensordict: TensorDictBase, name: str, value: Any) -> None:
    """`tensordict.set(name, value)` for a value known to fit: without its search, and without a check."""
    tensordict._set_str(name, value, validated=True, inplace=False, non_blocking=False)
