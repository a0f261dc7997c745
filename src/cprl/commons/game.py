"""Game: a Map, its Rules, the agents' Observation, and the institutions that they live under."""

import warnings
from dataclasses import dataclass, field, fields
from functools import cached_property
from importlib import import_module
from math import prod
from typing import Any

import numpy as np

from cprl.commons import cells
from cprl.commons.maps import Map
from cprl.commons.near import patches, sites_around
from cprl.commons.observation import Observation
from cprl.commons.quirks import paints_over
from cprl.commons.rules import Rules
from cprl.commons.spaces import Spaces
from cprl.commons.tables import Tables, build_tables, check_sizes
from cprl.commons.world import StepOutput
from cprl.commons.yields import sustainable_yield
from cprl.institutions import COUNTS, Institution, law
from cprl.institutions.arrays import Form, forms_of
from cprl.institutions.base import Ballot
from cprl.values import Value
from cprl.values.arrays import Int32, UInt8


@dataclass(frozen=True, kw_only=True)
class Game(Value):
    """A map, its rules, what agents observe, and the rules that people make.

    Warns (UserWarning) if no agent can reach a site that it may harvest: nobody then gets an apple.
    """

    map: Map
    rules: Rules
    observation: Observation = field(default_factory=Observation)
    institutions: tuple[Institution, ...] = ()

    def _repr_html_(self) -> str:
        """Return the board and the rules in words, for notebooks; the game knows nothing of pictures."""
        return import_module("cprl.pictures.readable").game_html(self)

    def __post_init__(self) -> None:
        super().__post_init__()
        agents, rules = self.agents, self.rules
        if rules.respawn_at_spawns and not self.map.spawns:
            raise ValueError(
                "Rules.respawn_at_spawns is True and Map.spawns is empty; allowed: a map with spawn places"
            )
        if bool(self.map.river) != (rules.river is not None):
            count = len(self.map.river)
            raise ValueError(
                f"Map.river has {count} cell{'' if count == 1 else 's'} and Rules.river is {rules.river}; "
                "allowed: Rules(river=River(...)) on a map with a river, and None on any other"
            )
        if round(rules.first_stock_share * len(self.map.sites)) == 0 and rules.regrow_prob[0] == 0:
            raise ValueError(
                f"Rules.first_stock_share is {rules.first_stock_share} of {len(self.map.sites)} sites, and "
                "regrow_prob[0] is 0, so no apple can ever grow; allowed: a share of at least one site"
            )
        check_sizes(self.map, rules)
        if self.observation.agents_apart and agents > cells.MAX_AGENTS_APART:
            raise ValueError(
                f"Observation.agents_apart is True and the map has {agents} agents; allowed: at most "
                f"{cells.MAX_AGENTS_APART}"
            )
        law.check_institutions(self)
        warning = _why_out_of_reach(self)
        if warning is not None:
            warnings.warn(warning, UserWarning, stacklevel=3)

    def __repr__(self) -> str:
        names = "".join(f", {type(institution).__name__}" for institution in self.institutions)
        return f"Game({self.map.height} x {self.map.width}, {self.agents} agents{names})"

    @property
    def agents(self) -> int:
        """The number of agents N."""
        return self.map.agents

    @property
    def agent_names(self) -> tuple[str, ...]:
        """agent_0, agent_1, ..., one for each agent."""
        return tuple(f"agent_{i}" for i in range(self.agents))

    @property
    def actions(self) -> tuple[str, ...]:
        """The names of the actions; an action is its index in this tuple."""
        return self.rules.actions

    @property
    def channels(self) -> tuple[str, ...]:
        """The name of each channel of an observation: "red", "green", "blue", or the classes of cells, then
        one for each signal, then the planes of `Observation`, then those of institutions, see
        `cprl.commons.views`."""
        return *self.own_channels, *self._institution_channels

    @property
    def own_channels(self) -> tuple[str, ...]:
        """All channels but those of institutions, which come last."""
        signals = (f"signal {number + 1}" for number in range(self.rules.signals))
        return *self.cell_channels, *signals, *self.score_channels

    @property
    def cell_channels(self) -> tuple[str, ...]:
        """The channels that show the board, which come first."""
        if self.observation.encoding == "rgb":
            return "red", "green", "blue"
        return tuple(map(cells.class_name, self.cell_classes))

    @property
    def cell_classes(self) -> tuple[int, ...]:
        """The classes of cells that can occur, in the order of the channels of "one_hot"."""
        apart = [cells.FIRST_AGENT + agent for agent in range(self.agents)]
        agents = apart if self.observation.agents_apart else [cells.OTHER]
        river = [cells.WATER, cells.WASTE, cells.CLEANING] if self.map.river else []
        always = range(cells.GROUND, cells.BEAM + 1)
        return *always, *sorted([*agents, cells.SELF, *river])

    @property
    def score_channels(self) -> tuple[str, ...]:
        """The channels "scoreboard" and "stock_gauge", for those that `Observation` has."""
        planes = {"scoreboard": -(-self.agents // prod(self._seen)), "stock_gauge": 1}
        return tuple(
            name for name, count in planes.items() if getattr(self.observation, name) for _ in range(count)
        )

    @property
    def _institution_channels(self) -> tuple[str, ...]:
        entries = len(self.entries_shown)
        places = ("forbidden",) if law.shows_places(self) else ()
        return *places, *("institutions",) * -(-entries // prod(self._seen))

    @property
    def entries_shown(self) -> tuple[str, ...]:
        """What the entries of the channels "institutions" show, each with the number of its kind: "quota left
        0"; see `shown` in the modules of institutions."""
        return tuple(f"{entry} {number}" for entry, number in law.entries_shown(self))

    @property
    def _seen(self) -> tuple[int, int]:
        """The rows and columns of an observation."""
        if self.observation.area == "full":
            return self.map.height, self.map.width
        return self.rules.window_rows + self.rules.window_rows_behind, self.rules.window_columns

    @property
    def observation_highest(self) -> int:
        """The largest value of an entry of observations: 255, or 1 for "one_hot" without planes."""
        return 255 if self.score_channels or self._institution_channels else self.observation.highest

    @property
    def observation_shape(self) -> tuple[int, int, int]:
        """The shape (C, X, Y) of one agent's observation: channels, rows, columns."""
        return len(self.channels), *self._seen

    @property
    def ballots(self) -> tuple[Ballot, ...]:
        """What agents decide on at an episode's first turn, in the order of `institutions`.

        A decision is one number for all ballots: the choice of the first one plus its number of choices times
        the choice of the second one, and so on.
        """
        ballots = (institution.ballot(self.agents) for institution in self.institutions)
        return tuple(ballot for ballot in ballots if ballot is not None)

    @property
    def decisions(self) -> int:
        """The number of options of ("agents", "decision"); 0 where there is nothing to decide."""
        return prod(len(ballot.choices) for ballot in self.ballots) if self.ballots else 0

    @property
    def spaces(self) -> Spaces:
        """What each agent observes and may do."""
        return Spaces(
            agents=self.agents,
            observation_shape=self.observation_shape,
            observation_scale=float(self.observation_highest),
            actions=len(self.actions),
        )

    def make(self, worlds: int, seed: int, device: Any = "cpu", first_world: int = 0) -> Any:
        """Return a `CommonsEnv` of so many worlds, as every game that an experiment plays makes one.

        Args:
            first_world: the index of the first world, as `CommonsEnv` takes it.
        """
        envs = import_module("cprl.envs.commons_env")  # the game itself knows nothing of torch
        return envs.CommonsEnv(self, worlds, seed=seed, device=device, first_world=first_world)

    @property
    def palette(self) -> UInt8:
        """The colour of each class of cell: uint8 [classes, 3], red, green and blue."""
        classes = cells.FIRST_AGENT + (self.agents if self.observation.agents_apart else 0)
        return np.array([cells.class_colour(kind) for kind in range(classes)], np.uint8)

    @cached_property
    def tables(self) -> Tables:
        """The lookup tables that the compiled rules read; computed once and cached."""
        return build_tables(self)

    @cached_property
    def law_parameters(self) -> dict[str, dict[str, Any]]:
        """The parameters of the game's institutions; computed once and cached."""
        return law.parameters(self)

    @cached_property
    def sustainable_yield(self) -> float:
        """Apples a turn that the map can bear, see `cprl.commons.yields`; computed once and cached."""
        return sustainable_yield(self.map, self.rules)

    @cached_property
    def patches(self) -> Int32:
        """The patch of each site, int32 [K]: sites that are connected by being near each other; computed once
        and cached."""
        return patches(sites_around(self.map, self.rules))

    def __getstate__(self) -> dict[str, object]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def _why_out_of_reach(game: Game) -> str | None:
    """Return a sentence that says why no agent can harvest any site, e.g. since a wall parts them; None if
    one can.

    Agents walk over all cells but walls, also through each other's, since others may move away. `Boundaries`
    without a fine stop bites, not steps. Under `shuffle_starts` any agent may start at any start.
    """
    board = game.map
    if not board.walls and not game.institutions:
        return None
    allowed = np.array(
        [
            [all(rule.may_harvest(agent, *site) for rule in game.institutions) for site in board.sites]
            for agent in range(game.agents)
        ]
    )
    if not board.walls and allowed.all():
        return None
    from scipy.ndimage import label

    is_open = np.ones((board.height, board.width), np.bool_)
    for wall in board.walls:
        is_open[wall] = False
    part = label(is_open)[0]  # the number of the part of the board around each cell that walls enclose
    starts = [(row, col) for row, col, _ in board.starts]
    begins = [board.spawns if start in board.spawns else (start,) for start in starts]
    of_sites = np.array([part[site] for site in board.sites])
    walks = np.array([np.isin(of_sites, [part[cell] for cell in places]) for places in begins])
    if game.rules.shuffle_starts:
        walks[:] = walks.any(0)
    if (allowed & walks).any():
        return None
    first_three = "; ".join(f"row {row}, column {col}" for row, col in starts[:3])
    return (
        f"no agent can harvest any of the {len(board.sites)} sites of Game.map: walls "
        f"{'keep' if allowed.all() else 'and Boundaries keep'} them out of reach of all starts "
        f"({first_three}{'; ...' if len(starts) > 3 else ''})"
    )


def output_forms(game: Game, worlds: int) -> dict[str, Form]:
    """Return the shape and dtype of each array of `StepOutput`, for B worlds of a game."""
    sizes = {"B": worlds, "N": game.agents}
    turn = dict(zip("CXY", game.observation_shape, strict=True))
    turn |= {"P": 1, "M": game.agents} if game.map.river else {"P": 0, "M": 0}
    governed = {"L": game.agents if game.institutions else 0, "counts": len(COUNTS), "V": len(game.ballots)}
    return forms_of(StepOutput, **sizes, **turn, **governed, U=int(paints_over(game.rules.quirks)))
