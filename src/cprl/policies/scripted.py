"""ScriptedActor: agents that follow a fixed rule, a scripted policy, and do not learn.

`BEHAVIOURS` says what each policy does. They see what a learning agent sees: their observation window. Under
`Quirks2019.paint_over`, where an agent's own heading mark covers the cell ahead of it, they also see whether
this cell holds an apple.

- "Near" means within `Rules.regrow_radius_cells`, measured by `Rules.regrow_norm`. "In sight" means in the
  window and reachable in it, around walls and other agents.
- Agents walk forward and sideways, never backward, where most cannot see: they do not read
  `Rules.window_rows_behind`. Of equally near apples they take
  the first in reading order of the window.
- A wandering agent walks forward with probability 0.9 if the cell ahead is free; otherwise it turns left or
  right with equal probability.
- Before it enters a cell next to another agent, an agent waits with probability 0.5: if two agents want the
  same cell, neither gets it (docs/game.md), and two that never waited would starve there.
- "greedy", "sustainable" and "pacifist" fire at nobody but agents to `tag`. Without a beam, "territorial"
  equals "greedy", and "aggressive" follows other agents.
- "aggressive" first turns towards an agent that is farther to its side than ahead of it.
- With `Quirks2019.self_paint_stays`, as in the study as run, an agent sees some other agents, even some out
  of play, in its own colour: it treats every cell of that colour except its own as another agent.

The social outcomes of Perolat et al. (2017), `cprl.measuring.social`, distinguish all of them but "random":
the harvest and how long it lasts ("greedy", "sustainable"), and peace ("territorial", "aggressive").
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, get_args

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl import keys
from cprl.commons import cells
from cprl.commons.game import Game
from cprl.commons.near import near_cells
from cprl.commons.quirks import paints_over
from cprl.commons.spaces import Spaces
from cprl.pictures.decoding import UNSEEN, classes_seen
from cprl.policies import scripted_rules
from cprl.policies.actors import ActorOfLanes, LaneActor
from cprl.policies.scripted_rules import (
    AGENT,
    APPLE,
    NUMBERS,
    OPEN,
    UNKNOWN,
    WALL,
    Frame,
    SearchBuffers,
    Settings,
)
from cprl.system.jit.compiled import compiled_for_cpu
from cprl.values import Natural, Range, Value, checked
from cprl.values.array_types import Int64, UInt8

ScriptedPolicy = Literal["random", "greedy", "sustainable", "territorial", "aggressive", "pacifist"]
SCRIPTED_POLICIES: Final[tuple[ScriptedPolicy, ...]] = get_args(ScriptedPolicy)
"""The names of all scripted policies, in the order of the constants RANDOM, GREEDY, ... of
`cprl.policies.scripted_rules`."""

BEHAVIOURS: Final[Mapping[ScriptedPolicy, str]] = {
    "random": "chooses every action with equal probability, including the beam",
    "greedy": "takes the shortest path to the nearest apple in sight; wanders if it sees none",
    "sustainable": "as greedy, but steps on an apple only if it sees at least `spare` others near it",
    "territorial": "fires if its beam covers an agent that is near an apple in sight; else as greedy",
    "aggressive": "fires if its beam covers an agent; else follows the nearest in sight; else as greedy",
    "pacifist": "as greedy, but leaves apples that another agent in sight reaches in fewer steps",
}
"""What agents of each policy do."""
_NEAR: Final = ("regrow_radius_cells", "regrow_norm")
_BEAM: Final = (
    "beam_length_cells",
    "beam_width_cells",
    "beam_tapers",
    "beam_from_beside",
    "beam_stops_at_agents",
)
RULES_READ: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(SCRIPTED_POLICIES, ("quirks",)),
    "sustainable": ("quirks", *_NEAR),
    "territorial": ("quirks", *_NEAR, *_BEAM),
    "aggressive": ("quirks", *_BEAM),
}
"""The fields of `Rules` that each policy goes by, beside those of actions and windows."""
SPARE: Final = 3
"""The number of apples that "sustainable" leaves near each apple it harvests. With the published
probabilities, a site with 3 apples near it regrows five times as fast as one with 2. A cross of five sites,
all near each other, grows fastest with 3 apples: 2 empty sites x 0.05 per turn, against 1 x 0.05 with 4
apples and 3 x 0.01 with 2."""
_FIRE: Final = ("territorial", "aggressive")


@dataclass(frozen=True)
class Plan(Value, stored=False):
    """How agents follow a scripted policy.

    Args:
        policy: the scripted policy.
        spare: for "sustainable": the number of other apples near an apple that it harvests.
        region: the rows ahead, and the columns to each side, of its window, in which it harvests; None for
            all. Elsewhere it goes around apples.
        tag: the agents at whom it fires, in place of those at whom the policy fires; None for these.
    """

    policy: ScriptedPolicy
    spare: Annotated[int, Range(1, 8)] = SPARE
    region: tuple[Natural, Natural] | None = None
    tag: tuple[Natural, ...] | None = None

    def numbers(self, game: Game) -> tuple[int, ...]:
        """Return the plan in a game as 4 + N numbers: the index of the policy, `spare`, the rows and columns
        of `region`, and for each agent of the game 1 if it is fired at.

        Raises:
            ValueError: if the region is larger than the window; if `tag` names an agent that is not in the
                game, or any in a game whose windows show all other agents alike, or without a beam.
        """
        rows = game.rules.window_rows - 1
        columns = game.rules.window_columns // 2
        limits = tuple[Annotated[int, Range(0, rows)], Annotated[int, Range(0, columns)]]
        region = checked("region", self.region or (rows, columns), limits)
        foes: Sequence[int] = range(game.agents) if self.policy in _FIRE else ()
        if self.tag is not None:
            foes = checked("tag", self.tag, tuple[Annotated[int, Range(0, game.agents - 1)], ...])
            if foes and not can_tag(game):
                raise ValueError(f"tag is {foes}; allowed without a beam and Observation.agents_apart: ()")
        are_foes = (agent in foes for agent in range(game.agents))
        return SCRIPTED_POLICIES.index(self.policy), self.spare, *region, *are_foes


def can_tag(game: Game) -> bool:
    """Return whether agents can tell at whom they fire."""
    return game.rules.may_fire and game.observation.agents_apart


class ScriptedActor(ActorOfLanes):
    """S agents of every replica that follow one scripted policy; see the table above.

    The actions of a lane depend only on its own seed and observations. The first call compiles for some
    seconds; the compiled code is cached on disk.

    Args:
        plan: the scripted policy, and how the agents follow it.
        game: the game that the agents play.
        seeds: the seed of each lane, lane = replica x S + agent.
        agents: the number of agents S of each replica.
        worlds: the number of worlds k of each replica, consecutive in the batch.

    `epsilon`, initially 0, is the probability of a random action under `ExplorationType.RANDOM`; under other
    exploration types it has no effect.
    """

    def __init__(
        self,
        plan: Plan,
        game: Game,
        *,
        seeds: Sequence[Sequence[int]],
        agents: int,
        worlds: int = 1,
    ) -> None:
        super().__init__(seeds, agents, worlds, NUMBERS)
        if game.observation.area != "window":
            raise ValueError(
                f"Observation.area is {game.observation.area!r}; allowed with scripted policies: 'window', "
                "because they rely on the agent's position in it"
            )
        if game.rules.harvest_action:
            raise ValueError(
                "Rules.harvest_action is True; allowed with scripted policies but 'random': False, because "
                "no window shows what is under an agent"
            )
        self.policy = plan.policy
        self.game = game
        self.epsilon = 0.0
        if paints_over(game.rules.quirks):
            self.in_keys = ("observation", keys.APPLE_AHEAD[1])
        self._plan = np.array(plan.numbers(game))
        self._settings = _settings(game)
        self._rim, self._frame = _frame(game)
        size = self._frame.stride * (game.rules.window_rows + 2 * self._rim)
        self._scratch = SearchBuffers(*np.zeros((2, size), np.bool_), *np.zeros((3, size), np.int32))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", self.choose(*map(tensordict.get, self.in_keys)))

    def choose(
        self, observation: Tensor, apple_ahead: Tensor | None = None, *, plans: Int64 | None = None
    ) -> Tensor:
        """Choose actions, int64 [replicas x k, S].

        Args:
            observation: uint8 [replicas x k, S, C, X, Y].
            apple_ahead: `cprl.keys.APPLE_AHEAD`, bool [replicas x k, S, 1], under `Quirks2019.paint_over`.
            plans: the numbers of `Plan.numbers` by which each agent chooses instead, int64
                [replicas x k, S, 4 + N].
        """
        explores = exploration_type() in (ExplorationType.RANDOM, None)
        epsilon = float(self.epsilon) if explores else 0.0
        framed = self._framed(observation, apple_ahead)
        chosen = np.empty(len(framed), np.int64)
        if plans is None:
            plans = np.tile(self._plan, (len(framed), 1))
        compiled_for_cpu(scripted_rules.choose_all, inline=False)(
            np.ascontiguousarray(plans.reshape(len(framed), -1)),
            epsilon,
            framed,
            np.take(_ROLES, framed),
            self._frame,
            self._numbers(),
            self._settings,
            self._scratch,
            chosen,
        )
        return torch.from_numpy(chosen.reshape(observation.shape[:2])).to(observation.device)

    def _framed(self, observation: Tensor, apple_ahead: Tensor | None) -> UInt8:
        """Return the classes of the cells in each agent's window, with a frame of wall around them: uint8
        [replicas x k x S, cells]."""
        ahead = observation.numpy(force=True)[..., : self.game.rules.window_rows, :]
        seen = classes_seen(self.game, ahead)
        rim = self._rim
        rows, columns = seen.shape[2:]
        count = seen.shape[0] * seen.shape[1]
        framed = np.full((count, rows + 2 * rim, columns + 2 * rim), cells.WALL, np.uint8)
        framed[:, rim:-rim, rim:-rim] = seen.reshape(count, rows, columns)
        row = rim + rows - 1
        middle = rim + columns // 2
        framed[:, row, middle] = cells.GROUND
        if apple_ahead is not None:
            cell_ahead = framed[:, row - 1, middle]  # a wall of the frame if the window has a single row
            is_open = _ROLES[cell_ahead] == OPEN
            cell_ahead[apple_ahead.numpy(force=True).reshape(-1) & is_open] = cells.APPLE
        return framed.reshape(count, -1)

    def _numbers(self) -> Any:
        """Draw the random numbers of this turn in the order of the batch: float64 [replicas x k x S,
        NUMBERS]."""
        drawn = self.rng.next().numpy().reshape(self.replicas, self.agents, self.worlds, NUMBERS)
        return drawn.transpose(0, 2, 1, 3).reshape(-1, NUMBERS)


def scripted_lanes(
    policy: ScriptedPolicy,
    playing: Game | Spaces,
    *,
    seeds: Sequence[Sequence[int]],
    agents: int,
    worlds: int = 1,
) -> nn.Module:
    """Return the fastest actor for agents that follow a scripted policy in a game, or at random in any
    spaces."""
    if policy == "random":
        spaces = playing if isinstance(playing, Spaces) else playing.spaces
        return LaneActor(None, spaces.actions, seeds=seeds, agents=agents, worlds=worlds)
    if isinstance(playing, Spaces):
        raise ValueError(
            f"Scripted({policy!r}) reads the window of a cprl.Game; in a game of another kind, allowed: "
            "'random'"
        )
    return ScriptedActor(Plan(policy), playing, seeds=seeds, agents=agents, worlds=worlds)


def _settings(game: Game) -> Settings:
    """Return the properties of a game by which scripted agents choose."""
    rules = game.rules
    return Settings(
        actions=game.tables.silent_actions,
        stay=game.actions.index("stay"),
        may_fire=rules.may_fire,
        beam_length=min(rules.beam_lengths_cells),
        beam_half_width=min(rules.beam_width_cells, rules.window_columns) // 2,
        beam_tapers=rules.beam_tapers,
        beam_from_beside=rules.beam_from_beside,
        beam_stops_at_agents=rules.beam_stops_at_agents,
    )


def _frame(game: Game) -> tuple[int, Frame]:
    """Return the width of the frame on each side, and its layout."""
    rules = game.rules
    rows = rules.window_rows
    columns = rules.window_columns
    reach = min(int(rules.regrow_radius_cells), max(rows, columns))
    rim = max(1, reach)
    stride = columns + 2 * rim
    near = [row * stride + col for row, col in near_cells(rules, rows=reach, cols=reach)]
    window = np.add.outer((np.arange(rows) + rim) * stride, np.arange(columns) + rim)
    return rim, Frame(
        stride=stride,
        middle=int(window[-1, columns // 2]),
        cells=window.reshape(-1).astype(np.int32),
        neighbours=np.array([-stride, -1, 1, stride], np.int32),
        near=np.array(near, np.int32),
    )


def _roles() -> UInt8:
    """Return the role of each class of cell, uint8 [256]."""
    roles = np.full(256, AGENT, np.uint8)
    open_ground = (cells.GROUND, cells.MARK, cells.BEAM)
    roles[[*open_ground, cells.WATER, cells.WASTE, cells.CLEANING]] = OPEN
    roles[cells.APPLE] = APPLE
    roles[cells.WALL] = WALL
    roles[UNSEEN] = UNKNOWN
    return roles


_ROLES: Final = _roles()
