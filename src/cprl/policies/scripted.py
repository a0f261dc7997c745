"""ScriptedActor: agents that never learn, and see no more than a learner sees, their observation window.

| manner | what it does |
|---|---|
| "random" | every action is equally likely, the beam too |
| "greedy" | goes the shortest way to the nearest apple in sight; wanders where it sees none |
| "sustainable" | the same, but bites an apple only if `spare` others are seen near it; walks over no other |
| "territorial" | fires where its beam covers another who is near an apple in sight; else as "greedy" |
| "aggressive" | fires where its beam covers another; else goes after the nearest in sight; else as "greedy" |
| "pacifist" | as "greedy", but leaves apples to which another in sight has fewer steps to go; never fires |

- Near: within `Rules.regrow_radius_cells`, by `Rules.regrow_norm`. In sight: in the window and reachable in
  it, around walls and around other agents.
- They walk ahead and to both sides, never backward, where they do not see; of equally near apples they take
  the first in reading order of the window.
- To wander is to go straight on with chance 0.9 where the cell ahead is free, else to turn, to either side.
- Before a cell that another agent stands right beside, they wait with chance 0.5: of two who want one cell
  neither gets it (docs/game.md), and two who always insisted would starve there.
- "greedy", "sustainable" and "pacifist" never fire. Without a beam "territorial" is "greedy", and
  "aggressive" follows others about.
- "aggressive" first turns to one who is farther to its side than ahead of it.
- With `Rules.self_paint_stays`, as in the study as run, an agent also sees others, even some out of play, in
  the colour of itself: every cell of that colour but its own is taken for another agent.

All but "random" can be told apart by the social outcomes of Perolat et al. (2017), `cprl.measuring.social`:
the harvest and how long it lasts ("greedy", "sustainable") and peace ("territorial", "aggressive").
"""

import hashlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, Final, Literal, get_args

import numba
import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl.commons import colours
from cprl.commons.compiled import compiled
from cprl.commons.game import Game
from cprl.commons.seeing import UNSEEN, classes_seen
from cprl.commons.tables import distance
from cprl.commons.world import Bytes
from cprl.policies import paths
from cprl.policies import scripted_rules as manners
from cprl.policies.lanes import random_lanes
from cprl.policies.paths import AGENT, APPLE, OPEN, UNKNOWN, WALL, Frame, Scratch
from cprl.policies.rng import LaneRng
from cprl.policies.scripted_rules import NUMBERS, Terms

ScriptedPolicy = Literal["random", "greedy", "sustainable", "territorial", "aggressive", "pacifist"]
SCRIPTED_POLICIES: Final[tuple[ScriptedPolicy, ...]] = get_args(ScriptedPolicy)
"""In the order of `cprl.policies.scripted_rules.RANDOM` and so on."""

SPARE: Final = 3
"""Apples that "sustainable" leaves near each that it bites. With the published probabilities a site with 3
near regrows five times as fast as one with 2, and a cross of five sites, each within reach of all others,
grows most with 3 hanging: 2 empty sites x 0.05 a turn, against 1 x 0.05 with 4 and 3 x 0.01 with 2."""


class ScriptedActor(TensorDictModuleBase):
    """The agents at some seats of every replica, all of one manner; see the table above.

    A lane's choices follow from its own seed and from what it sees alone, whoever else plays. The first
    choice compiles for some seconds; what was compiled is kept on disk.

    Args:
        policy: how they behave.
        game: what is played; agents see a window of it.
        seeds: of each lane's random numbers, lane = replica x seats + seat.
        agents: how many seats S of a replica they take.
        worlds: how many worlds k of each replica are played at once, side by side in the batch.
        spare: for "sustainable", how many other apples have to stay near one that it bites, at least 1.

    `epsilon`, 0 at first, is the chance of a random action, under `ExplorationType.RANDOM` alone.

    Raises:
        ValueError: for an unknown manner, a game whose agents see no window, seeds that do not share out
            evenly among seats, or numbers below 1; in `choose`, for observations that do not fit.
    """

    in_keys = ("observation",)
    out_keys = ("action",)

    def __init__(
        self,
        policy: ScriptedPolicy,
        game: Game,
        *,
        seeds: Sequence[Sequence[int]],
        agents: int,
        worlds: int = 1,
        spare: int = SPARE,
    ) -> None:
        super().__init__()
        _check(policy, game, seeds=len(seeds), agents=agents, worlds=worlds, spare=spare)
        self.policy, self.game, self.epsilon = policy, game, 0.0
        self.agents, self.worlds, self.replicas = agents, worlds, len(seeds) // agents
        self.rng = LaneRng(seeds, NUMBERS * worlds)
        self._terms, self._role_of_class = _terms(game, spare), _roles()
        self._rim, self._frame = _frame(game)
        size = self._frame.stride * (game.observation_shape[1] + 2 * self._rim)
        self._scratch = Scratch(*np.zeros((2, size), np.bool_), *np.zeros((3, size), np.int32))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 [replicas x k, S], for "observation" [replicas x k, S, C, X, Y]."""
        return tensordict.set("action", self.choose(tensordict.get("observation")))

    def choose(self, observation: Tensor) -> Tensor:
        """Actions, int64 [replicas x k, S], for what is seen, uint8 [replicas x k, S, C, X, Y]."""
        wanted = (self.replicas * self.worlds, self.agents, *self.game.observation_shape)
        if observation.shape != wanted:
            raise ValueError(f"the observation is {list(observation.shape)}; {list(wanted)} is wanted")
        explores = exploration_type() in (ExplorationType.RANDOM, None)
        chosen = np.empty(observation.shape[:2], np.int64)
        _choose_all()(
            SCRIPTED_POLICIES.index(self.policy),
            float(self.epsilon) if explores else 0.0,
            self._framed(observation.numpy(force=True)),
            self._frame,
            self._numbers(),
            self._terms,
            self._scratch,
            chosen.reshape(-1),
        )
        return torch.from_numpy(chosen).to(observation.device)

    def _framed(self, observation: Bytes) -> Bytes:
        """The roles of what each agent sees, in a frame of wall, uint8 [replicas x k x S, cells]."""
        seen, rim = classes_seen(self.game, observation), self._rim
        count, (rows, columns) = seen.shape[0] * seen.shape[1], seen.shape[2:]
        roles = np.full((count, rows + 2 * rim, columns + 2 * rim), WALL, np.uint8)
        roles[:, rim:-rim, rim:-rim] = self._role_of_class[seen].reshape(count, rows, columns)
        roles[:, rim + rows - 1, rim + columns // 2] = OPEN
        return roles.reshape(count, -1)

    def _numbers(self) -> Any:
        """This turn's random numbers in the order of the batch, float64 [replicas x k x S, NUMBERS]."""
        drawn = self.rng.next().numpy().reshape(self.replicas, self.agents, self.worlds, NUMBERS)
        return drawn.transpose(0, 2, 1, 3).reshape(-1, NUMBERS)

    def get_extra_state(self) -> dict[str, Any]:
        """Where its random numbers stand; part of `state_dict`."""
        return self.rng.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See `get_extra_state`."""
        self.rng.load_state_dict(state)


def scripted_lanes(
    policy: ScriptedPolicy, game: Game, *, seeds: Sequence[Sequence[int]], agents: int, worlds: int = 1
) -> nn.Module:
    """Agents of one manner at some seats of every replica, by the quickest actor that there is; see
    `ScriptedActor`."""
    if policy == "random":
        return random_lanes(len(game.actions), seeds=seeds, agents=agents, worlds=worlds)
    return ScriptedActor(policy, game, seeds=seeds, agents=agents, worlds=worlds)


def _check(policy: str, game: Game, **numbers: int) -> None:
    if policy not in SCRIPTED_POLICIES:
        raise ValueError(f"policy is {policy!r}; allowed: {', '.join(SCRIPTED_POLICIES)}")
    if game.observation.area != "window":
        raise ValueError(
            f"Observation.area is {game.observation.area!r}; scripted agents see a window and go by where "
            'they stand in it, so area="window" is what fits'
        )
    for name, number in numbers.items():
        if number < 1:
            raise ValueError(f"{name} is {number}; at least 1 is wanted")
    if numbers["seeds"] % numbers["agents"]:
        raise ValueError(
            f"{numbers['seeds']} seeds for {numbers['agents']} agents; a seed for each lane is wanted"
        )


def _terms(game: Game, spare: int) -> Terms:
    rules = game.rules
    return Terms(
        actions=len(game.actions),
        has_beam=rules.has_beam,
        beam_length=min(*rules.beam_lengths_cells, rules.window_rows - 1),
        beam_half_width=min(rules.beam_width_cells, rules.window_columns) // 2,
        spare=spare,
    )


def _frame(game: Game) -> tuple[int, Frame]:
    """How wide the frame is on each side, and where the cells of a window are in it."""
    rules, (_, rows, columns) = game.rules, game.observation_shape
    reach = min(int(rules.regrow_radius_cells), max(rows, columns))
    rim, around = max(1, reach), range(-reach, reach + 1)
    stride = columns + 2 * rim
    near = [
        r * stride + c
        for r in around
        for c in around
        if (r, c) != (0, 0) and distance(rules.regrow_norm, r, c) <= rules.regrow_radius_cells
    ]
    cells = np.add.outer((np.arange(rows) + rim) * stride, np.arange(columns) + rim)
    return rim, Frame(
        stride=stride,
        own=int(cells[-1, columns // 2]),
        cells=cells.reshape(-1).astype(np.int32),
        ways=np.array([-stride, -1, 1, stride], np.int32),
        near=np.array(near, np.int32),
    )


def _roles() -> Bytes:
    """The role of each class of cell, uint8 [256]."""
    roles = np.full(256, AGENT, np.uint8)
    roles[[colours.GROUND, colours.MARK, colours.BEAM]] = OPEN
    roles[colours.APPLE], roles[colours.WALL] = APPLE, WALL
    roles[[colours.HIDDEN, UNSEEN]] = UNKNOWN
    return roles


@cache
def _choose_all() -> Callable[..., None]:
    """`manners.choose_all`, compiled; kept on disk under a name that follows from the text of its modules."""
    text = b"".join(Path(str(module.__file__)).read_bytes() for module in (manners, paths))
    name = f"choose_all_{hashlib.sha256(text).hexdigest()[:16]}"

    def jit(function: FunctionType) -> Any:
        options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
        if function.__name__ != "choose_all":
            options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
            return numba.njit(**options)(function)
        function.__name__ = function.__qualname__ = name
        try:
            return numba.njit(**options, cache=True)(function)
        except RuntimeError:  # there is nowhere to keep it
            return numba.njit(**options)(function)

    return compiled(manners.FUNCTIONS, jit)["choose_all"]
