"""The TensorDict entries that the packages of cprl exchange: name, shape, dtype and meaning.

Axes have the same letters everywhere: B worlds, N agents, H x W the board, K sites, T time, A actions,
R replicas, C channels, X rows and Y columns of an agent's window (its own row included, farthest row first).
"""

from typing import Final, NamedTuple

from tensordict import TensorDictBase

from cprl.system.compat import Views
from cprl.system.compat import entry as entry
from cprl.system.compat import put as put

AGENTS: Final = "agents"
"""The group of agents, a nested TensorDict of batch size [B, N]."""

OBSERVATION: Final = (AGENTS, "observation")
"""uint8 [B, N, C, X, Y]: each agent's observation, as `Game.observation` specifies; by default its RGB window
with C = 3 channels, 0..255."""

ACTION: Final = (AGENTS, "action")
"""int64 [B, N]: each agent's action, an index into `Game.actions`."""

REWARD: Final = (AGENTS, "reward")
"""float32 [B, N, 1]: the reward of the turn, harvest - fines + transfers."""

HARVEST: Final = (AGENTS, "harvest")
"""float32 [B, N]: apples harvested this turn. An institution may change rewards, but never this entry."""

IN_PLAY: Final = (AGENTS, "in_play")
"""bool [B, N]: whether the agent is in play, so that its action at the same level of the TensorDict counts.
Sum it at the root, not under "next"."""

FIRED: Final = (AGENTS, "fired")
"""bool [B, N]: whether the agent fired its beam this turn."""

HIT_BY: Final = (AGENTS, "hit_by")
"""bool [B, N, N]: whether the beam of the column's agent hit the row's agent this turn."""

TAGGED_BY: Final = (AGENTS, "tagged_by")
"""bool [B, N, N]: whether the column's agent tagged out the row's agent this turn."""

APPLE_AHEAD: Final = (AGENTS, "apple_ahead")
"""bool [B, N, 1]: whether the cell ahead of the agent holds an apple. Only with `Quirks2019.paint_over`, by
which its own heading mark covers the cell; scripted policies read it, networks do not."""

RECURRENT_STATE: Final = (AGENTS, "recurrent_state")
"""float32 [B, N, M]: the states of recurrent networks after this turn's observation, zeros beyond an agent's
own. Policies write it, if an agent has such a network, and the next turn's policies read it; where it is
missing, and where an episode begins, it is zero."""

RECURRENT_STATE_BEFORE: Final = (AGENTS, "recurrent_state_before")
"""float32 [B, N, M]: the states that policies read in this turn."""

FINES: Final = (AGENTS, "fines")
"""float32 [B, N]: apples that institutions took from the agent this turn. This entry and all of institutions
below are there only in games that have any, or a transform that writes them."""

TRANSFERS: Final = (AGENTS, "transfers")
"""float32 [B, N]: apples that institutions gave the agent this turn."""

VIOLATED: Final = (AGENTS, "violated")
"""bool [B, N]: whether the agent broke a rule of an institution this turn, detected or not."""

COUNTS: Final = (AGENTS, "counts")
"""int32 [B, N, C]: what was counted for the agent in this episode so far, `cprl.institutions.COUNTS`."""

DECISION: Final = (AGENTS, "decision")
"""int64 [B, N]: each agent's decision where `Game.decisions` is above 0: an option, 0 to `Game.decisions`
- 1, read at an episode's first turn alone."""

IN_FORCE: Final = "in_force"
"""float32 [B, V]: what the agents' decisions put in force, one for each of `Game.ballots`."""

BALLOTS_DUE: Final = "ballots_due"
"""bool [B, V]: which of `Game.ballots` are held in the coming turn, which reads the agents' decisions."""

STOCK: Final = "stock"
"""int64 [B, 1]: apples on the board."""

REGROWN: Final = "regrown"
"""int64 [B, 1]: apples grown this turn."""

WASTE: Final = "waste"
"""int64 [B, 1]: cells of the river with waste; only with `Map.river`, as is the next."""

CLEANED: Final = (AGENTS, "cleaned")
"""float32 [B, N]: cells of the river that the agent cleaned this turn."""

STATE: Final = "state"
"""uint8 [B, 3, H, W]: the whole board as RGB; only with `CommonsEnv(state=True)`."""

DONE: Final = "done"
"""bool [B, 1]: the episode is over, `terminated` or `truncated`. At the root only."""

TERMINATED: Final = "terminated"
"""bool [B, 1]: no apple is left and none can grow."""

TRUNCATED: Final = "truncated"
"""bool [B, 1]: the episode reached its time limit."""


class Turn(NamedTuple):
    """One turn of all worlds, [B], or T of them, [B, T], read once for all who look at it: learners, the
    tracker of episodes, the search for NaN. All four are views of its entries, by the last part of the key.
    """

    batch: TensorDictBase
    """What a collector yielded."""
    world: Views
    """Of worlds, before the turn."""
    agents: Views
    """Of agents, before the turn, and what they did."""
    next_world: Views
    next_agents: Views

    @classmethod
    def of(cls, batch: "TensorDictBase | Turn") -> "Turn":
        if isinstance(batch, Turn):
            return batch
        following = entry(batch, "next")
        agents, next_agents = entry(batch, AGENTS), entry(following, AGENTS)
        return cls(batch, Views(batch), Views(agents), Views(following), Views(next_agents))
