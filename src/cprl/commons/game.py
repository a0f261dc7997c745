"""Game: joins a map, its rules, the form of observations, and institutions to one value."""

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
from cprl.institutions import COUNT_NAMES, Governor, Institution, law
from cprl.institutions.arrays import Form, forms_of
from cprl.institutions.institution import Ballot
from cprl.values import Value
from cprl.values.array_types import Int32, UInt8


@dataclass(frozen=True, kw_only=True)
class Game(Value):
    """A game: a map, the rules of nature, the observation of agents, and institutions, the rules of people.

    Warns (UserWarning) if no agent can reach a site that it may harvest, so that nobody ever gets an apple.
    """

    map: Map
    rules: Rules
    observation: Observation = field(default_factory=Observation)
    institutions: tuple[Institution, ...] = ()

    def _repr_html_(self) -> str:
        """Return the board and the rules in words, as HTML for notebooks."""
        # imported by name, since the game must not depend on pictures
        return import_module("cprl.pictures.readable").game_html(self)

    def __post_init__(self) -> None:
        super().__post_init__()
        rules = self.rules
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
        if self.observation.agents_apart and self.agents > cells.MAX_AGENTS_APART:
            raise ValueError(
                f"Observation.agents_apart is True and the map has {self.agents} agents; allowed: at most "
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
        """Return the number of agents N."""
        return self.map.agents

    @property
    def agent_names(self) -> tuple[str, ...]:
        """Return agent_0, agent_1, ..., one name for each agent."""
        return tuple(f"agent_{agent}" for agent in range(self.agents))

    @property
    def actions(self) -> tuple[str, ...]:
        """Return the names of the actions; an action is its index in this tuple."""
        return self.rules.actions

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the names of the channels of an observation, in their order.

        First come the channels of the board: "red", "green" and "blue", or the classes of cells. Then come a
        channel for each signal, the scoreboard and stock gauge of `Observation`, and the channels of
        institutions, see `cprl.commons.views`.
        """
        return *self.game_channels, *self._institution_channels

    @property
    def game_channels(self) -> tuple[str, ...]:
        """Return the names of the channels before those of institutions."""
        signals = (f"signal {number + 1}" for number in range(self.rules.signals))
        return *self.cell_channels, *signals, *self.score_channels

    @property
    def cell_channels(self) -> tuple[str, ...]:
        """Return the names of the first channels, which show the board."""
        if self.observation.encoding == "rgb":
            return "red", "green", "blue"
        return tuple(map(cells.class_name, self.cell_classes))

    @property
    def cell_classes(self) -> tuple[int, ...]:
        """Return the classes of cells that can occur, in the order of the channels of "one_hot"."""
        agent_classes = [cells.OTHER]
        if self.observation.agents_apart:
            agent_classes = [cells.FIRST_AGENT + agent for agent in range(self.agents)]
        river_classes = [cells.WATER, cells.WASTE, cells.CLEANING] if self.map.river else []
        common_classes = range(cells.GROUND, cells.BEAM + 1)
        return *common_classes, *sorted([*agent_classes, cells.SELF, *river_classes])

    @property
    def score_channels(self) -> tuple[str, ...]:
        """Return the names of the channels of scoreboard and stock gauge, if `Observation` has them."""
        names = ["scoreboard"] * self._planes_for(self.agents) + ["stock_gauge"]
        return tuple(name for name in names if getattr(self.observation, name))

    @property
    def _institution_channels(self) -> tuple[str, ...]:
        """Return the names of the channels in which institutions show something to agents."""
        place_channels = ("forbidden",) if law.shows_places(self) else ()
        return *place_channels, *("institutions",) * self._planes_for(len(self.entries_shown))

    def _planes_for(self, entries: int) -> int:
        """Return the number of channels that have at least one cell for each of these entries."""
        return -(-entries // prod(self._observed_size))

    @property
    def entries_shown(self) -> tuple[str, ...]:
        """Return the names of the entries in the channels "institutions".

        An entry is a number that an institution shows agents, e.g. "quota left 0", the apples left by the
        first quota of the game; see `cprl.institutions.hooks.shown_value`.
        """
        return tuple(f"{entry} {number}" for entry, number in law.entries_shown(self))

    @property
    def _observed_size(self) -> tuple[int, int]:
        """Return the numbers of rows and columns of an observation."""
        if self.observation.area == "full":
            return self.map.height, self.map.width
        return self.rules.window_rows + self.rules.window_rows_behind, self.rules.window_columns

    @property
    def observation_highest(self) -> int:
        """Return the largest value in observations: 255, or 1 for "one_hot" with channels of cells alone."""
        return 255 if self.score_channels or self._institution_channels else self.observation.highest

    @property
    def observation_shape(self) -> tuple[int, int, int]:
        """Return the shape (C, X, Y) of one agent's observation: channels, rows, columns."""
        return len(self.channels), *self._observed_size

    @property
    def ballots(self) -> tuple[Ballot, ...]:
        """Return the ballots of an episode's first turn, in the order of `institutions`.

        An agent's decision is one number for all ballots: the index of its choice on the first ballot, plus
        the number of choices there times the index of its choice on the second ballot, and so on.
        """
        ballots = (institution.ballot(self.agents) for institution in self.institutions)
        return tuple(ballot for ballot in ballots if ballot is not None)

    @property
    def governor(self) -> Governor | None:
        """Return the governor among `institutions`; None without one."""
        return next((one for one in self.institutions if isinstance(one, Governor)), None)

    @property
    def in_force(self) -> tuple[Ballot, ...]:
        """Return all that is decided: the ballots, and last what a governor sets."""
        return self.ballots if self.governor is None else (*self.ballots, self.governor.controlled)

    @property
    def decisions(self) -> int:
        """Return the number of options of ("agents", "decision"); 0 if agents decide nothing."""
        return prod(len(ballot.choices) for ballot in self.ballots) if self.ballots else 0

    @property
    def spaces(self) -> Spaces:
        """Return the observation and action spaces, which are the same for each agent."""
        return Spaces(
            agents=self.agents,
            observation_shape=self.observation_shape,
            observation_scale=float(self.observation_highest),
            actions=len(self.actions),
        )

    def make(self, worlds: int, seed: int, device: Any = "cpu", first_world: int = 0) -> Any:
        """Return a `CommonsEnv` of the game; every game that an experiment plays has such a method.

        Args:
            worlds: the number of worlds B.
            seed: the seed of all random numbers.
            device: "cpu", or "cuda" for a GPU.
            first_world: the index of the first world, as in `CommonsEnv`.
        """
        envs = import_module("cprl.envs.commons_env")  # imported by name: the game must not depend on torch
        return envs.CommonsEnv(self, worlds, seed=seed, device=device, first_world=first_world)

    @property
    def palette(self) -> UInt8:
        """Return the colour of each class of cell: uint8 [classes, 3], red, green and blue."""
        classes = cells.FIRST_AGENT + (self.agents if self.observation.agents_apart else 0)
        return np.array([cells.class_colour(kind) for kind in range(classes)], np.uint8)

    @cached_property
    def tables(self) -> Tables:
        """Build the lookup tables that the compiled rules read, once."""
        return build_tables(self)

    @cached_property
    def law_parameters(self) -> dict[str, dict[str, Any]]:
        """Compute the parameters of the game's institutions, once."""
        return law.parameters(self)

    @cached_property
    def sustainable_yield(self) -> float:
        """Compute the apples per turn that the map yields for ever, once; see `cprl.commons.yields`."""
        return sustainable_yield(self.map, self.rules)

    @cached_property
    def patches(self) -> Int32:
        """Find the index of each site's patch, int32 [K], once; see `cprl.commons.near.patches`."""
        return patches(sites_around(self.map, self.rules))

    def __getstate__(self) -> dict[str, object]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def _why_out_of_reach(game: Game) -> str | None:
    """Return a warning that says why no agent can ever harvest any site; None if an agent can.

    Agents can walk over all cells but walls, also over cells of other agents, which may move away.
    `Boundaries` without a fine stop harvests and not steps. Under `shuffle_starts` any agent may start at any
    start.
    """
    board = game.map
    if not board.walls and not game.institutions:
        return None
    allowed = np.ones((game.agents, len(board.sites)), np.bool_)
    for agent, site in np.ndindex(allowed.shape):
        allowed[agent, site] = all(rule.may_harvest(agent, *board.sites[site]) for rule in game.institutions)
    if not board.walls and allowed.all():
        return None
    from scipy.ndimage import label

    is_open = np.ones((board.height, board.width), np.bool_)
    for wall in board.walls:
        is_open[wall] = False
    room_of_cell = label(is_open)[0]  # a room is a part of the board that walls enclose
    room_of_site = room_of_cell[tuple(np.transpose(board.sites))]
    starts = [(row, col) for row, col, _ in board.starts]
    reachable = np.zeros_like(allowed)
    for agent, start in enumerate(starts):
        first_cells = board.spawns if start in board.spawns else (start,)
        reachable[agent] = np.isin(room_of_site, room_of_cell[tuple(np.transpose(first_cells))])
    if game.rules.shuffle_starts:
        reachable[:] = reachable.any(0)
    if (allowed & reachable).any():
        return None
    first_three = "; ".join(f"row {row}, column {col}" for row, col in starts[:3])
    return (
        f"no agent can harvest any of the {len(board.sites)} sites of Game.map: walls "
        f"{'keep' if allowed.all() else 'and Boundaries keep'} them out of reach of all starts "
        f"({first_three}{'; ...' if len(starts) > 3 else ''})"
    )


def output_forms(game: Game, worlds: int) -> dict[str, Form]:
    """Return the shape and dtype of each array of `StepOutput` for B worlds of a game, by name.

    Axes of entries that the game lacks have length 0, see `StepOutput`.
    """
    agents = game.agents
    return forms_of(
        StepOutput,
        **dict(zip("CXY", game.observation_shape, strict=True)),
        B=worlds,
        N=agents,
        P=int(bool(game.map.river)),
        M=agents * bool(game.map.river),
        L=agents * bool(game.institutions),
        V=len(game.ballots),
        F=len(game.in_force),
        U=int(paints_over(game.rules.quirks)),
        counts=len(COUNT_NAMES),
    )
