"""The keys of the TensorDict entries that the packages of cprl exchange, with shape, dtype and meaning.

Axes have the same letters everywhere: B worlds, N agents, H x W the board, K sites, T time, A actions,
R replicas, C channels, X rows and Y columns of an agent's window (farthest row first, the agent's row too).

The module `recurrent_state` passes the states of recurrent networks from one turn to the next.
"""

from typing import Final, NamedTuple

from tensordict import TensorDictBase

from cprl.system.compat.tensordicts import Views, entry as entry, put as put

AGENTS: Final = "agents"
"""The group of agents, a nested TensorDict of batch size [B, N]."""

OBSERVATION: Final = (AGENTS, "observation")
"""uint8 [B, N, C, X, Y]: each agent's observation, as `Game.observation` specifies; by default its RGB window
with C = 3 channels, 0..255."""

ACTION: Final = (AGENTS, "action")
"""int64 [B, N]: each agent's action, an index into `Game.actions`."""

REWARD: Final = (AGENTS, "reward")
"""float32 [B, N, 1]: each agent's reward for the turn, harvest - fines + transfers."""

HARVEST: Final = (AGENTS, "harvest")
"""float32 [B, N]: apples harvested this turn. An institution may change rewards, but never this entry."""

IN_PLAY: Final = (AGENTS, "in_play")
"""bool [B, N]: whether the agent is in play, and not tagged out, in the turn that begins: then its action of
this turn, at the same level of the TensorDict, counts. To count turns in play, sum the entry at the root, not
the one under "next"."""

FIRED: Final = (AGENTS, "fired")
"""bool [B, N]: whether the agent fired its beam this turn."""

HIT_BY: Final = (AGENTS, "hit_by")
"""bool [B, N, N]: whether the beam of the column's agent hit the row's agent this turn."""

TAGGED_BY: Final = (AGENTS, "tagged_by")
"""bool [B, N, N]: whether the column's agent tagged out the row's agent this turn."""

APPLE_AHEAD: Final = (AGENTS, "apple_ahead")
"""bool [B, N, 1]: whether the cell ahead of the agent holds an apple. Only with `Quirks2019.paint_over`, with
which the agent's heading mark covers this cell in its window; scripted policies read it, networks do not."""

RECURRENT_STATE: Final = (AGENTS, "recurrent_state")
"""float32 [B, N, M]: the states of recurrent networks after this turn's observation. M is the size of the
largest state; an agent with a smaller one has zeros in the rest. Policies write the entry if an agent has a
recurrent network, and read it in the next turn. Where an episode begins, and where it is missing, states are
zero."""

RECURRENT_STATE_BEFORE: Final = (AGENTS, "recurrent_state_before")
"""float32 [B, N, M]: the states of recurrent networks after the turn before, which policies read in this
turn."""

FINES: Final = (AGENTS, "fines")
"""float32 [B, N]: apples that institutions took from the agent this turn. This entry and the other entries of
institutions below exist only in games with institutions, or with a transform that writes them."""

TRANSFERS: Final = (AGENTS, "transfers")
"""float32 [B, N]: apples that institutions gave the agent this turn."""

VIOLATED: Final = (AGENTS, "violated")
"""bool [B, N]: whether the agent broke a rule of an institution this turn, detected or not."""

COUNTS: Final = (AGENTS, "counts")
"""int32 [B, N, C]: the counts that institutions keep of the agent in this episode, in the order of
`cprl.institutions.COUNT_NAMES`."""

DECISION: Final = (AGENTS, "decision")
"""int64 [B, N]: each agent's decision, 0 to `Game.decisions` - 1, in games where that is above 0. It says the
agent's choice on every ballot, and is read in an episode's first turn alone, see BALLOTS_DUE."""

IN_FORCE: Final = "in_force"
"""float32 [B, F]: what is in force of all that is decided, see `Game.in_force`."""

SEEN: Final = "seen"
"""float32 [B, S]: what the governor sees, see `Governor.sees`; only in games with a governor."""

RULE: Final = "rule"
"""int64 [B]: the option that the governor puts in force in this turn, an index of `Governor.options`. A turn
without the entry leaves in force what is."""

BALLOTS_DUE: Final = "ballots_due"
"""bool [B, V]: which of `Game.ballots` are held in the coming turn, by the agents' decisions in it."""

STOCK: Final = "stock"
"""int64 [B, 1]: apples on the board."""

REGROWN: Final = "regrown"
"""int64 [B, 1]: apples grown this turn."""

WASTE: Final = "waste"
"""int64 [B, 1]: cells of the river with waste; only in games with `Map.river`."""

CLEANED: Final = (AGENTS, "cleaned")
"""float32 [B, N]: cells of the river that the agent cleaned this turn; only in games with `Map.river`."""

STATE: Final = "state"
"""uint8 [B, 3, H, W]: the whole board as RGB; only with `CommonsEnv(state=True)`."""

DONE: Final = "done"
"""bool [B, 1]: whether the episode is over, TERMINATED or TRUNCATED; of worlds, not of agents."""

TERMINATED: Final = "terminated"
"""bool [B, 1]: whether the episode is over because no apple is left and none can grow."""

TRUNCATED: Final = "truncated"
"""bool [B, 1]: whether the episode has reached its time limit."""


class Turn(NamedTuple):
    """One turn of all worlds, [B], or T turns, [B, T], as arrays.

    Learners, the tracker of episodes and the search for NaN all read a turn; each entry is made an array once
    for all of them. The four views give entries by the last part of their keys, e.g. `turn.agents["action"]`.
    """

    batch: TensorDictBase
    """The TensorDict that a collector yielded."""
    world: Views
    """The entries of worlds before the turn."""
    agents: Views
    """The entries of agents before the turn, and their actions."""
    next_world: Views
    """The entries of worlds after the turn."""
    next_agents: Views
    """The entries of agents after the turn, e.g. their rewards."""

    @classmethod
    def of(cls, batch: "TensorDictBase | Turn") -> "Turn":
        """Return the turn that a TensorDict holds; a `Turn` as it is."""
        if isinstance(batch, Turn):
            return batch
        next_batch = entry(batch, "next")
        agents = entry(batch, AGENTS)
        next_agents = entry(next_batch, AGENTS)
        return cls(batch, Views(batch), Views(agents), Views(next_batch), Views(next_agents))
