"""Rules: every number and switch of the game, with its unit, range and source.

Sources: [W] M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019);
[P] Perolat et al. (2017); [run] the program that produced the results of [W], where it differs from the text;
[J] Janssen, Holahan, Lee and Ostrom (2010); [MP] Melting Pot 2.4, commons_harvest; [SSD]
sequential_social_dilemma_games, harvest, [C] its cleanup; [SJ] SocialJax, harvest_open; see `docs/games.md`.
`docs/game.md` describes the game in words.
"""

from dataclasses import dataclass, fields
from typing import Annotated, Final, Literal

from cprl.values import MOST_INT32, Natural, Odd, Positive, Range, Value, Where

ACTIONS: Final = ("forward", "backward", "left", "right", "turn_left", "turn_right", "beam", "stay")
"""The actions by index. If no agent may fire, there is no "beam", and 6 is "stay"."""

HARVEST, CLEAN = "harvest", "clean"
"""Further actions, the last ones, under `Rules.harvest_action` and `Rules.may_clean`."""

Norm = Literal["euclidean", "manhattan", "chebyshev"]

LARGEST_WINDOW_CELLS: Final = 1000
"""The largest number of rows or columns of a window."""
SMALLEST_PROBABILITY: Final = 2**-32
"""Chance is compared in 32 bits: a smaller probability could never come true, or would be rounded up."""

Probability = Annotated[
    float,
    Where(
        lambda value: value == 0 or SMALLEST_PROBABILITY <= value <= 1,
        "a number that is 0, or 2**-32 (2.3e-10) to 1",
    ),
]
Window = Annotated[int, Range(1, LARGEST_WINDOW_CELLS)]


@dataclass(frozen=True, kw_only=True)
class Rules(Value):
    """The numbers of a game.

    Defaults are those of `published`: every quirk of the study as run is off. Lists and arrays are stored as
    tuples, so that rules can be compared, hashed and printed.
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

    regrow_after_bites: bool = False
    """[SSD] Growth is counted from the stock after the bites of the turn, not from that at its start."""

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

    may_clean: bool = False
    """[C] Whether agents may clean the river, `Map.river`: a further action "clean", a beam of the size of
    the other one that removes the waste of the first cell of each column that has some, and ends there, at a
    wall or at an agent. The picture shows it up to walls, as the other one: also beyond waste, and beyond
    agents without `beam_stops_at_agents`."""

    pollution_prob: Probability = 0.0
    """[C] The probability per turn with which a clean cell of the river gets waste, tried cell by cell in an
    order drawn by chance until one gets some; so it is one cell a turn at most."""

    pollution_limit: Annotated[float, Range(0, 1)] = 0.4
    """[C] The share of the river's cells with waste from which on no apple grows, and no waste comes."""

    pollution_free: Annotated[float, Range(0, 1)] = 0.0
    """[C] The share up to which apples grow with `regrow_prob`; between the two it falls linearly to 0."""

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

    walls_block_sight: bool = False
    """Whether a window shows only cells in line of sight, that is, the straight line between the two cell
    centres crosses the interior of no wall (ours)."""

    episode_steps: Positive = 1000
    """The number of turns after which an episode is truncated [W]."""

    end_prob: Probability = 0.0
    """The probability with which an episode is truncated by chance, after `end_from_step` turns and every
    `end_every_steps` turns from there on; 0.15 from turn 1,099 on every 100 turns in [MP]."""

    end_from_step: Positive = 1
    """The first turn after which it can be."""

    end_every_steps: Positive = 1
    """The number of turns from there to the next one."""

    plays_on_when_empty: bool = False
    """Whether an episode goes on where no apple is left and none can grow [MP, SSD, SJ]."""

    shuffle_starts: bool = False
    """Whether each episode permutes the agents' starts, all permutations equally likely (ours)."""

    random_headings: bool = False
    """Whether agents begin, and return to play at spawn places, with a heading drawn by chance [MP, SSD]."""

    respawn_at_spawns: bool = False
    """Whether a tagged agent returns at a free place of `Map.spawns`, drawn by chance [MP, SJ], and not where
    it was tagged."""

    clashes: Literal["all_back", "one_moves", "in_turn"] = "all_back"
    """What becomes of agents that want the same cell: all go back (ours); or one gets it, drawn by chance,
    unless an agent stays on it [SSD, SJ]; or agents move one after another, in an order drawn at each turn,
    and onto no cell where an agent is [MP]."""

    pairwise_clashes: bool = False
    """[run] All agents move at once. Then, pair by pair in the order of agent indices, two agents on one
    cell, or two that swapped, both go back to where they began the turn, even if a third agent stands there.
    Agents out of play return at once, even onto an occupied cell."""

    regrow_before_bites: bool = False
    """[run] Apples grow before agents harvest, so an apple can grow and be harvested in the same turn."""

    freeze_counts_tag_turn: bool = False
    """[run] The turn of the tag counts as the first of `freeze_steps`, so the agent misses one turn less."""

    ends_one_turn_late: bool = False
    """[run] The episode terminates in the turn that begins with an empty stock, one turn later."""

    picture_shows_old_stock: bool = False
    """[run] The picture shows the apples of the start of the turn."""

    paint_over: bool = False
    """[run] Heading marks cover apples and agents of lower indices; beams cover everything."""

    mark_behind_if_vertical: bool = False
    """[run] The heading mark of an agent that faces up or down is painted behind the agent."""

    self_paint_stays: bool = False
    """[run] Windows are drawn in the order of agent indices; each agent's cell is painted as "self" and
    stays so in the windows of later agents, whether the agent is in play or not."""

    agent_1_right_moves_agent_0: bool = False
    """[run] The action "right" of agent 1 moves agent 0 in its place, to the right of agent 0's own heading,
    after agent 0's own action and even while agent 0 is out of play; a beam that agent 0 fires in this turn
    begins where it fired. A fault of the program for two agents until 13 April 2019. At least two agents."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, other in (
            ("regrow_after_bites", "regrow_before_bites"),
            ("clashes", "pairwise_clashes"),
            ("clashes", "agent_1_right_moves_agent_0"),
        ):
            if {name, other} <= set(self.changed):
                raise ValueError(
                    f"Rules.{name} is {getattr(self, name)!r} and Rules.{other} is True; allowed: one of them"
                )
        if self.pollution_free >= self.pollution_limit:
            raise ValueError(
                f"Rules.pollution_free is {self.pollution_free} and Rules.pollution_limit is "
                f"{self.pollution_limit}; allowed: a smaller share of waste than that"
            )

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
        last = (*((HARVEST,) if self.harvest_action else ()), *((CLEAN,) if self.may_clean else ()))
        silent = *(name for name in ACTIONS if self.may_fire or name != "beam"), *last
        spoken = (f"{name} {signal + 1}" for signal in range(self.signals) for name in silent)
        return *silent, *spoken
