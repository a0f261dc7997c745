"""Rules: every number and switch of the game, with its unit, range and source.

`docs/game.md` describes the game in words, and `docs/games.md` the games of the sources. They are cited by
these signs: [W] M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019);
[P] Perolat et al. (2017); [run] the program that produced the results of [W], where it differs from the text;
[J] Janssen, Holahan, Lee and Ostrom (2010); [MP] Melting Pot 2.4, commons_harvest; [SSD]
sequential_social_dilemma_games, harvest, [C] its cleanup; [SJ] SocialJax, harvest_open.
"""

from dataclasses import dataclass, fields
from typing import Annotated, Final, Literal, NamedTuple, get_args, get_type_hints

from cprl.commons.chance import Probability
from cprl.commons.quirks import QuirkArrays, Quirks2019
from cprl.commons.river import CLEAN, River, RiverArrays
from cprl.commons.signals import SignalArrays
from cprl.values import MOST_INT32, Natural, Odd, Positive, Range, Value, Where

ACTIONS: Final = ("forward", "backward", "left", "right", "turn_left", "turn_right", "beam", "stay")
"""The actions by index. If no agent may fire, there is no "beam", and 6 is "stay"."""

HARVEST_ACTION: Final = "harvest"
"""The name of a further action under `Rules.harvest_action`; `cprl.commons.river.CLEAN` comes after it."""

Clashes = Literal["all_back", "one_moves", "in_turn", "pairwise"]
Growth = Literal["from_start", "before_bites", "after_bites"]
Norm = Literal["euclidean", "manhattan", "chebyshev"]

LARGEST_WINDOW_CELLS: Final = 1000
"""The largest number of rows or columns of a window."""
Window = Annotated[int, Range(1, LARGEST_WINDOW_CELLS)]


@dataclass(frozen=True, kw_only=True)
class RandomEnd(Value):
    """The end of an episode by chance. In [MP] an episode is truncated with probability 0.15 after turn 1,099
    and after every 100th turn from there."""

    prob: Probability
    """The probability that the episode is truncated, after each turn in which it can be."""

    from_step: Positive = 1
    """The first turn after which the episode can be truncated."""

    every_steps: Positive = 1
    """The number of turns from one turn after which the episode can be truncated to the next."""


@dataclass(frozen=True, kw_only=True)
class Rules(Value):
    """The rules of a game: its numbers and switches.

    The defaults are those of the variant "published". A group of rules, such as `river`, is a value of its
    own, or None for a game without it. Lists and arrays are stored as tuples, so that rules can be compared,
    hashed and printed.
    """

    regrow_prob: Annotated[
        tuple[Probability, ...],
        Where(
            lambda probabilities: len(probabilities) > 0,
            "one or more numbers, each 0 or 2**-32 (2.3e-10) to 1",
        ),
    ] = (0.0, 0.01, 0.01, 0.05, 0.05, 0.1)
    """The probability per turn that an empty site grows an apple, indexed by the number of apples near it
    [W]. The last entry also applies to every larger number.

    For growth that is logistic in the stock of K sites, use `tuple(r * s / K for s in range(K + 1))` with
    `regrow_radius_cells=1000`."""

    regrow_radius_cells: Annotated[float, Range(0, 1000)] = 2.0
    """The distance up to which apples count as near, in cells, measured by `regrow_norm`, inclusive [W]."""

    regrow_norm: Norm = "euclidean"
    """The norm that measures the distance between cells for `regrow_radius_cells` [W]."""

    regrow_by: Literal["count", "share", "share_with_own"] = "count"
    """What the probability of growth depends on. "count": the number of apples near a site [W]. "share": the
    share of the sites near it that hold one [J]; the entries of `regrow_prob` then belong to shares at equal
    distances from 0 to 1, with straight lines between them. "share_with_own": the same, but the site itself,
    which is empty, counts as one of the sites near it."""

    regrow_under_agents: bool = True
    """Whether a site can grow an apple while an agent stands on it; False in [SSD] and [SJ]."""

    growth: Growth = "from_start"
    """The moment of a turn when apples grow. "from_start": after the harvest, but as many as the stock at the
    start of the turn lets grow [W]. "before_bites": before the harvest, so that an apple can grow and be
    harvested in the same turn [run, MP, SJ]. "after_bites": after the harvest, as many as the stock that it
    leaves lets grow [SSD]."""

    first_stock_share: Annotated[float, Range(0, 1)] = 1.0
    """The share of the sites that hold an apple when an episode begins, rounded to a number of sites. These
    sites are drawn by chance for each episode. 0.25 in [J]."""

    harvest_action: bool = False
    """Whether an agent harvests the apple on its cell only by the further action "harvest" [J]. Otherwise it
    harvests at the end of every turn in which it stands on a cell with an apple [W]."""

    beam_length_cells: Positive | tuple[Positive, Positive, Positive, Positive] = 5
    """The length of a beam in cells: one number, or four by heading (up, right, down, left)."""

    beam_width_cells: Odd = 3
    """The width of a beam in cells [W]."""

    hits_to_tag: Positive = 1
    """The number of hits, at most one per turn, after which an agent is tagged [W]; 2 in [run]."""

    freeze_steps: Annotated[
        int,
        Where(
            lambda steps: 0 <= steps <= MOST_INT32,
            "an integer >= 0; by shooter or by offence with cprl.institutions.GraduatedSanctions",
        ),
    ] = 25
    """The number of turns that a tagged agent misses [W]. With `cprl.institutions.GraduatedSanctions` it
    depends on the shooter or on earlier offences."""

    beam_tapers: bool = False
    """Whether each column of a beam is one cell shorter than the next one towards the middle [MP, SSD,
    SJ]."""

    beam_from_beside: bool = False
    """Whether the outer columns of a beam begin beside the agent [MP, SSD], not one cell further ahead."""

    beam_stops_at_agents: bool = False
    """Whether an agent stops the column of a beam that hits it [MP, SSD]. The picture shows this only for
    agents that are still on the board."""

    cooldown_steps: Natural = 0
    """The number of turns in play after a shot in which an agent cannot fire; 2 in [MP]."""

    may_fire: bool = True
    """Whether agents may fire; otherwise there is no beam action. `cprl.institutions.Sanctioner` lets only
    some agents fire."""

    signals: Annotated[int, Range(0, 15)] = 0
    """The number of signals that an agent can send, an addition of cprl. An agent sends one of them or none
    with each action, so there are 1 + `signals` times as many actions. An observation has a plane for each
    signal, with its largest value on the cells of agents that sent it in the last turn. Signals have no other
    effect."""

    window_rows: Window = 6
    """The number of rows of a window: the agent's own row and those ahead of it [W]."""

    window_rows_behind: Annotated[int, Range(0, LARGEST_WINDOW_CELLS)] = 0
    """The number of further rows of a window, behind the agent; 1 in [MP] and [SJ], 7 in [SSD]."""

    window_columns: Annotated[
        int,
        Where(
            lambda columns: 1 <= columns <= LARGEST_WINDOW_CELLS and columns % 2 == 1,
            f"an odd integer from 1 to {LARGEST_WINDOW_CELLS}",
        ),
    ] = 13
    """The number of columns of a window, with the agent's own in the middle [W]."""

    episode_steps: Positive = 1000
    """The number of turns after which an episode is truncated [W]."""

    random_end: RandomEnd | None = None
    """The end of an episode by chance; None for a game without it."""

    plays_on_when_empty: bool = False
    """Whether an episode goes on when no apple is left and none can grow [MP, SSD, SJ]."""

    shuffle_starts: bool = False
    """Whether each episode permutes the agents' starts, all permutations equally likely; an addition of
    cprl."""

    random_headings: bool = False
    """Whether the headings of agents are drawn by chance when an episode begins and when they return at spawn
    places [MP, SSD]."""

    respawn_at_spawns: bool = False
    """Whether a tagged agent returns at a free place of `Map.spawns` that is drawn by chance [MP, SJ], and
    not on the cell where it was tagged."""

    clashes: Clashes = "all_back"
    """The outcome when agents move to the same cell.

    "all_back": all of them go back, a rule of cprl. "one_moves": one of them, drawn by chance, gets the cell,
    unless an agent stays on it [SSD, SJ]. "in_turn": agents move one after another, in an order drawn in each
    turn, and never onto a cell with an agent [MP].

    "pairwise" [run]: all agents move at once. Then, pair by pair in the order of agent indices, two agents on
    one cell, or two that swapped cells, both go back to where they began the turn, even if a third agent
    stands there. Agents out of play return at once, even onto an occupied cell."""

    river: River | None = None
    """The rules of a river [C]: required for a map with `Map.river`, and None for any other map."""

    quirks: Quirks2019 | None = None
    """The quirks of the program of 2019 [run]; None for a game without them."""

    def __repr__(self) -> str:
        return f"Rules({', '.join(f'{name}={value!r}' for name, value in self.changed.items())})"

    @property
    def changed(self) -> dict[str, object]:
        """Return the values that differ from their defaults, by the name of the field."""
        field_values = ((field, getattr(self, field.name)) for field in fields(self))
        return {field.name: value for field, value in field_values if value != field.default}

    @property
    def beam_lengths_cells(self) -> tuple[int, int, int, int]:
        """Return `beam_length_cells` by heading: up, right, down, left."""
        length = self.beam_length_cells
        return length if isinstance(length, tuple) else (length,) * 4

    @property
    def actions(self) -> tuple[str, ...]:
        """Return the names of the actions, by index.

        First come `ACTIONS`, without "beam" if nobody may fire, and "harvest" and "clean" if the rules have
        them. With signals, all of these follow again for each signal, e.g. "forward 1".
        """
        silent = [name for name in ACTIONS if self.may_fire or name != "beam"]
        if self.harvest_action:
            silent.append(HARVEST_ACTION)
        if self.river is not None and self.river.may_clean:
            silent.append(CLEAN)
        with_signal = (f"{name} {signal + 1}" for signal in range(self.signals) for name in silent)
        return *silent, *with_signal


class RuleGroups(NamedTuple):
    """The arrays of each group of rules, by its name in `Rules`.

    An entry is None for a game without the group. Numba then compiles no code that depends on the group.
    """

    river: RiverArrays | None
    quirks: QuirkArrays | None
    signals: SignalArrays | None


GROUP_ARRAYS: Final = {name: get_args(kind)[0] for name, kind in get_type_hints(RuleGroups).items()}
"""The class of the arrays of each group of rules; its module defines `parameters(game)`, which returns the
values that follow from the game."""
