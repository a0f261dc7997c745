"""Rules: every number and switch of the game, with its unit, range and source.

Sources: [W] M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019);
[P] Perolat et al. (2017); [run] the program that produced the results of [W], where it differs from the text;
[J] Janssen, Holahan, Lee and Ostrom (2010); [MP] Melting Pot 2.4, commons_harvest; [SSD]
sequential_social_dilemma_games, harvest, [C] its cleanup; [SJ] SocialJax, harvest_open; see `docs/games.md`.
`docs/game.md` describes the game in words.
"""

import sys
from dataclasses import dataclass, fields
from typing import Annotated, Final, Literal, NamedTuple, get_args, get_type_hints

from cprl.commons import quirks, river
from cprl.commons.chance import Probability
from cprl.commons.quirks import Quirks2019
from cprl.commons.river import CLEAN, River
from cprl.values import MOST_INT32, Natural, Odd, Positive, Range, Value, Where

ACTIONS: Final = ("forward", "backward", "left", "right", "turn_left", "turn_right", "beam", "stay")
"""The actions by index. If no agent may fire, there is no "beam", and 6 is "stay"."""

HARVEST: Final = "harvest"
"""A further action under `Rules.harvest_action`, before `cprl.commons.river.CLEAN`."""

Clashes = Literal["all_back", "one_moves", "in_turn", "pairwise"]
Growth = Literal["from_start", "before_bites", "after_bites"]
Norm = Literal["euclidean", "manhattan", "chebyshev"]

LARGEST_WINDOW_CELLS: Final = 1000
"""The largest number of rows or columns of a window."""
Window = Annotated[int, Range(1, LARGEST_WINDOW_CELLS)]


@dataclass(frozen=True, kw_only=True)
class RandomEnd(Value):
    """An episode is truncated by chance; prob 0.15 from turn 1,099 on every 100 turns in [MP]."""

    prob: Probability
    """The probability of that after each turn in which it can be."""

    from_step: Positive = 1
    """The first turn after which it can be."""

    every_steps: Positive = 1
    """The number of turns from there to the next one."""


@dataclass(frozen=True, kw_only=True)
class Rules(Value):
    """The numbers of a game.

    Defaults are those of `published`. A group of rules is a value of its own, or None for a game without it.
    Lists and arrays are stored as tuples, so that rules can be compared, hashed and printed.
    """

    regrow_prob: Annotated[
        tuple[Probability, ...],
        Where(
            lambda probabilities: len(probabilities) > 0,
            "one or more numbers, each 0 or 2**-32 (2.3e-10) to 1",
        ),
    ] = (0.0, 0.01, 0.01, 0.05, 0.05, 0.1)
    """Probability per turn that an empty site grows an apple, indexed by the number of apples near it [W];
    the last entry also applies to every larger number.

    With K sites, growth is logistic in the stock by `tuple(r * s / K for s in range(K + 1))` and
    `regrow_radius_cells=1000`."""

    regrow_radius_cells: Annotated[float, Range(0, 1000)] = 2.0
    """The distance up to which apples count as near, in cells, measured by `regrow_norm`, inclusive [W]."""

    regrow_norm: Norm = "euclidean"
    """The norm that measures this distance [W]."""

    regrow_by: Literal["count", "share", "share_with_own"] = "count"
    """What `regrow_prob` is a function of: the number of apples near a site; or the share of the sites near
    it that hold one [J], at which its entries stand at equal distances from 0 to 1, with straight lines
    between them. "share_with_own" counts the site itself, which is empty, among those near it."""

    regrow_under_agents: bool = True
    """Whether a site grows an apple while an agent stands on it; not in [SSD] and [SJ]."""

    growth: Growth = "from_start"
    """When apples grow: after the bites of the turn, as many as the stock at its start lets grow [W]; or
    before the bites, so that an apple can grow and be harvested in the same turn [run, MP, SJ]; or after
    them, as many as the stock that they leave lets grow [SSD]."""

    first_stock_share: Annotated[float, Range(0, 1)] = 1.0
    """The share of the sites that hold an apple when an episode begins, rounded to a number of sites; which
    ones is drawn by chance at each episode. 0.25 in [J]."""

    harvest_action: bool = False
    """[J] Whether an agent harvests the apple on its cell in turns in which its action was "harvest" alone, a
    further one. Otherwise it does at the end of every turn in which it is there [W]."""

    beam_length_cells: Positive | tuple[Positive, Positive, Positive, Positive] = 5
    """The length of a beam in cells: one number, or four by heading (up, right, down, left)."""

    beam_width_cells: Odd = 3
    """The width of a beam in cells [W]."""

    hits_to_tag: Positive = 1
    """The hits, at most one per turn, after which an agent is tagged [W]; 2 in [run]."""

    freeze_steps: Annotated[
        int,
        Where(
            lambda steps: 0 <= steps <= MOST_INT32,
            "an integer >= 0; by shooter or by offence with cprl.institutions.GraduatedSanctions",
        ),
    ] = 25
    """The number of turns that a tagged agent misses [W]; by shooter or by offence with
    `cprl.institutions.GraduatedSanctions`."""

    beam_tapers: bool = False
    """Whether each column of a beam is one cell shorter than its neighbour nearer to the middle [MP, SSD,
    SJ]."""

    beam_from_beside: bool = False
    """Whether the outer columns of a beam begin beside the agent, not ahead of that [MP, SSD]."""

    beam_stops_at_agents: bool = False
    """Whether an agent stops the column of a beam that hits it [MP, SSD]; the picture shows that where it
    still stands."""

    cooldown_steps: Natural = 0
    """The number of turns in play after a shot in which an agent cannot fire; 2 in [MP]."""

    may_fire: bool = True
    """Whether agents may fire; if not, there is no beam action. For some agents alone:
    `cprl.institutions.Sanctioner`."""

    signals: Annotated[int, Range(0, 15)] = 0
    """How many signals an agent can send (ours). With each action it sends one of them or none, so there are
    1 + `signals` times as many actions. An observation has a plane for each signal, with its largest value on
    the cells of agents that sent it in the last turn. Signals have no other effect."""

    window_rows: Window = 6
    """The rows of a window: the agent's own and those ahead of it [W]."""

    window_rows_behind: Annotated[int, Range(0, LARGEST_WINDOW_CELLS)] = 0
    """Further rows of a window, behind the agent's own; 1 in [MP] and [SJ], 7 in [SSD]."""

    window_columns: Annotated[
        int,
        Where(
            lambda columns: 1 <= columns <= LARGEST_WINDOW_CELLS and columns % 2 == 1,
            f"an odd integer from 1 to {LARGEST_WINDOW_CELLS}",
        ),
    ] = 13
    """The columns of a window, the agent's own in the middle [W]."""

    episode_steps: Positive = 1000
    """The number of turns after which an episode is truncated [W]."""

    random_end: RandomEnd | None = None
    """How an episode is truncated by chance, if it is."""

    plays_on_when_empty: bool = False
    """Whether an episode goes on where no apple is left and none can grow [MP, SSD, SJ]."""

    shuffle_starts: bool = False
    """Whether each episode permutes the agents' starts, all permutations equally likely (ours)."""

    random_headings: bool = False
    """Whether agents begin, and return to play at spawn places, with a heading drawn by chance [MP, SSD]."""

    respawn_at_spawns: bool = False
    """Whether a tagged agent returns at a free place of `Map.spawns`, drawn by chance [MP, SJ], and not where
    it was tagged."""

    clashes: Clashes = "all_back"
    """What becomes of agents that want the same cell: all go back (ours); or one gets it, drawn by chance,
    unless an agent stays on it [SSD, SJ]; or agents move one after another, in an order drawn at each turn,
    and onto no cell where an agent is [MP]; or "pairwise" [run]: all move at once, then, pair by pair in the
    order of agent indices, two agents on one cell, or two that swapped, both go back to where they began the
    turn, even if a third agent stands there, and agents out of play return at once, even onto an occupied
    cell."""

    river: River | None = None
    """[C] The rules of a river; a map with `Map.river` needs them, and another map has none."""

    quirks: Quirks2019 | None = None
    """[run] What only the program of 2019 does."""

    def __repr__(self) -> str:
        return f"Rules({', '.join(f'{name}={value!r}' for name, value in self.changed.items())})"

    @property
    def changed(self) -> dict[str, object]:
        """The fields that differ from their defaults, by name."""
        pairs = ((field, getattr(self, field.name)) for field in fields(self))
        return {field.name: value for field, value in pairs if value != field.default}

    @property
    def beam_lengths_cells(self) -> tuple[int, int, int, int]:
        """`beam_length_cells` by heading: up, right, down, left."""
        length = self.beam_length_cells
        return length if isinstance(length, tuple) else (length,) * 4

    @property
    def actions(self) -> tuple[str, ...]:
        """The names of the actions, by index: 8 of them, or 7 without a beam, and then perhaps "harvest" and
        "clean"; with signals all of them again for each signal, e.g. "forward 1"."""
        may_clean = self.river is not None and self.river.may_clean
        last = (*((HARVEST,) if self.harvest_action else ()), *((CLEAN,) if may_clean else ()))
        silent = *(name for name in ACTIONS if self.may_fire or name != "beam"), *last
        spoken = (f"{name} {signal + 1}" for signal in range(self.signals) for name in silent)
        return *silent, *spoken


class Groups(NamedTuple):
    """What the compiled rules read and remember of each group of rules, by its name in `Rules`; None without
    the group, and then nothing of what asks for it is compiled."""

    river: river.Arrays | None
    quirks: quirks.Arrays | None


GROUPS: Final = {
    name: sys.modules[get_args(kind)[0].__module__] for name, kind in get_type_hints(Groups).items()
}
"""The module of each group, which has its `Arrays` and `parameters`."""
