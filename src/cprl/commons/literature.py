"""Games of the literature by name, each with its source; `docs/games.md` lists what differs from the sources.

A name never changes its meaning: a game with other rules gets another version. Layouts and numbers come from
the sources, and cprl's own rules play them.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from cprl.commons.game import Game
    from cprl.commons.maps import Map

_OPEN: Final = """
WWWWWWWWWWWWWWWWWWWWWWWW
WAAA    A      A    AAAW
WAA    AAA    AAA    AAW
WA    AAAAA  AAAAA    AW
W      AAA    AAA      W
W       A      A       W
W  A                A  W
W AAA  Q        Q  AAA W
WAAAAA            AAAAAW
W AAA              AAA W
W  A                A  W
W                      W
W                      W
W                      W
W  PPPPPPPPPPPPPPPPPP  W
W PPPPPPPPPPPPPPPPPPPP W
WPPPPPPPPPPPPPPPPPPPPPPW
WWWWWWWWWWWWWWWWWWWWWWWW
"""
_CLOSED: Final = """
WWWWWWWWWWWWWWWWWWWWWWWW
WAAA    A  WW  A    AAAW
WAA    AAA WW AAA    AAW
WA    AAAAAWWAAAAA    AW
W      AAA WW AAA      W
W       A  WW  A       W
W  A       WW       A  W
W AAA  Q   WW   Q  AAA W
WAAAAA     WW     AAAAAW
W AAA  WWWWWWWWWW  AAA W
W  A       WW       A  W
WWWWWWWWWW WW WWWWWWWWWW
W          WW          W
W  WWWWWWWWWWWWWWWWWW  W
W  PPPPPPPPPPPPPPPPPP  W
W PPPPPPPPPPPPPPPPPPPP W
WPPPPPPPPPPPPPPPPPPPPPPW
WWWWWWWWWWWWWWWWWWWWWWWW
"""
_PARTNERSHIP: Final = """
WWWWWWWWWWWWWWWWWWWWWWWW
WAAA    A  II  A    AAAW
WAA    AAA II AAA    AAW
WA    AAAAAIIAAAAA    AW
W      AAA II AAA      W
W       A  II  A       W
W  A       II       A  W
W AAA  Q   WW   Q  AAA W
WAAAAA     II     AAAAAW
W AAA  WWWWWWWWWW  AAA W
W  A       WW       A  W
WWWWWWWWWW WW WWWWWWWWWW
W          WW          W
W  WWWWWWWWWWWWWWWWWW  W
W  PPPPPPPPPPPPPPPPPP  W
W PPPPPPPPPPPPPPPPPPPP W
WPPPPPPPPPPPPPPPPPPPPPPW
WWWWWWWWWWWWWWWWWWWWWWWW
"""
_HARVEST: Final = """
@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@
@ P   P      A    P AAAAA    P  A P  @
@  P     A P AA    P    AAA    A  A  @
@     A AAA  AAA    A    A AA AAAA   @
@ A  AAA A    A  A AAA  A  A   A A   @
@AAA  A A    A  AAA A  AAA        A P@
@ A A  AAA  AAA  A A    A AA   AA AA @
@  A A  AAA    A A  AAA    AAA  A    @
@   AAA  A      AAA  A    AAAA       @
@ P  A       A  A AAA    A  A      P @
@A  AAA  A  A  AAA A    AAAA     P   @
@    A A   AAA  A A      A AA   A  P @
@     AAA   A A  AAA      AA   AAA P @
@ A    A     AAA  A  P          A    @
@       P     A         P  P P     P @
@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@
"""

_CLEANUP: Final = """
@@@@@@@@@@@@@@@@@@
@RRRRRR     BBBBB@
@HHHHHH      BBBB@
@RRRRRR     BBBBB@
@RRRRR  P    BBBB@
@RRRRR    P BBBBB@
@HHHHH       BBBB@
@RRRRR      BBBBB@
@HHHHHHSSSSSSBBBB@
@HHHHHHSSSSSSBBBB@
@RRRRR   P P BBBB@
@HHHHH   P  BBBBB@
@RRRRRR    P BBBB@
@HHHHHH P   BBBBB@
@RRRRR       BBBB@
@HHHH    P  BBBBB@
@RRRRR       BBBB@
@HHHHH  P P BBBBB@
@RRRRR       BBBB@
@HHHH       BBBBB@
@RRRRR       BBBB@
@HHHHH      BBBBB@
@RRRRR       BBBB@
@HHHH       BBBBB@
@@@@@@@@@@@@@@@@@@
"""

_MELTING_POT: Final[dict[str, Any]] = {
    "regrow_prob": (0.0, 0.001, 0.005, 0.025),
    "growth": "before_bites",
    "beam_length_cells": 4,
    "beam_tapers": True,
    "beam_from_beside": True,
    "beam_stops_at_agents": True,
    "cooldown_steps": 1,
    "freeze_steps": 101,
    "respawn_at_spawns": True,
    "random_headings": True,
    "clashes": "in_turn",
    "window_rows": 10,
    "window_rows_behind": 1,
    "window_columns": 11,
    "episode_steps": 5000,
    "random_end": {"prob": 0.15, "from_step": 1099, "every_steps": 100},
    "plays_on_when_empty": True,
}
_OPEN_RULES: Final[dict[str, Any]] = _MELTING_POT | {
    "regrow_prob": (0.0, 0.0025, 0.005, 0.025),
    "beam_length_cells": 3,
    "cooldown_steps": 2,
    "freeze_steps": 5,
}
_SSD: Final[dict[str, Any]] = {
    "regrow_prob": (0.0, 0.005, 0.02, 0.05),
    "regrow_radius_cells": 1.5,
    "regrow_under_agents": False,
    "growth": "after_bites",
    "beam_tapers": True,
    "beam_from_beside": True,
    "beam_stops_at_agents": True,
    "freeze_steps": 0,
    "random_headings": True,
    "clashes": "one_moves",
    "window_rows": 8,
    "window_rows_behind": 7,
    "window_columns": 15,
    "plays_on_when_empty": True,
}
_CLEANUP_RULES: Final[dict[str, Any]] = _SSD | {
    "regrow_prob": (0.05,),
    "regrow_radius_cells": 0,
    "first_stock_share": 0.0,
    "river": {"may_clean": True, "pollution_prob": 0.5},
}
_SOCIALJAX: Final[dict[str, Any]] = {
    "regrow_prob": (0.0, 0.001, 0.005, 0.025),
    "regrow_under_agents": False,
    "growth": "before_bites",
    "beam_length_cells": 2,
    "beam_tapers": True,
    "freeze_steps": 0,
    "respawn_at_spawns": True,
    "random_headings": True,
    "clashes": "one_moves",
    "window_rows": 10,
    "window_rows_behind": 1,
    "window_columns": 11,
    "plays_on_when_empty": True,
}
_PEROLAT: Final[dict[str, Any]] = {
    "regrow_prob": (0.0, 0.01, 0.01, 0.05, 0.05, 0.1),
    "beam_length_cells": 10,
    "beam_width_cells": 5,
    "window_rows": 20,
    "window_columns": 21,
}
# A turn is an eighth of a second, the time that a person takes for a move in the laboratory.
_JANSSEN: Final[dict[str, Any]] = {
    "regrow_prob": (0.0, 0.01 / 8),
    "regrow_by": "share",
    "regrow_radius_cells": 1,
    "regrow_norm": "chebyshev",
    "first_stock_share": 0.25,
    "harvest_action": True,
    "freeze_steps": 0,
    "beam_length_cells": 29,
    "beam_width_cells": 1,
    "episode_steps": 1920,
}


class Source(NamedTuple):
    """A game of the literature: where it comes from, and the board and rules from which it is made."""

    work: str
    """Authors, title and year, or the name of a program."""
    url: str
    board: Callable[[Any], "Map"]
    """A function that makes the board. Its argument is the module `cprl.commons.maps`, which is only imported
    when a game is made."""
    rules: Mapping[str, Any]
    """The fields of `Rules` that differ from their defaults."""
    fines: Mapping[str, Any] | None = None
    """The fields of the game's `Punishment`; None for a game without fines."""
    sees_all: bool = False
    """Whether agents observe the whole board."""


def _open_field(maps: Any) -> "Map":
    """Return a board with the size and the number of sites of Perolat's open map, but with sites drawn by
    chance."""
    board: Map = maps.random(20, 40, agents=12, density=246 / 800, clustering=0.8, seed=1)
    return board


def _laboratory(maps: Any) -> "Map":
    """Return the board of Janssen's experiment: every cell is a site, and agents start in the middle row."""
    cells = tuple((row, col) for row in range(29) for col in range(29))
    starts = tuple((14, 4 + 5 * i, maps.UP) for i in range(5))
    board: Map = maps.Map(height=29, width=29, sites=cells, starts=starts)
    return board


def _without_walls(drawing: str) -> str:
    """Return a drawing without its outermost rows and columns, which are walls."""
    return "\n".join(line[1:-1] for line in drawing.strip("\n").splitlines()[1:-1])


_SSD_URL: Final = "https://github.com/eugenevinitsky/sequential_social_dilemma_games"
_SSD_FINES: Final = {"fine": 50.0, "cost": 0.0, "shot_cost": 1.0}
_PEROLAT_SOURCE: Final = (
    "J. Perolat et al., A multi-agent reinforcement learning model of common-pool resource appropriation, "
    "NeurIPS 2017",
    "https://arxiv.org/abs/1707.06600",
)


def _melting_pot(name: str, drawing: str, rules: Mapping[str, Any]) -> Source:
    """Return the source of a game of Melting Pot, by the last part of its name there."""
    return Source(
        f"Melting Pot 2.4, commons_harvest__{name}",
        "https://github.com/google-deepmind/meltingpot",
        lambda maps: maps.parse(drawing, legend="melting_pot", agents=7),
        rules,
    )


SOURCES: Final[dict[str, Source]] = {
    "melting_pot/commons_harvest__open-v1": _melting_pot("open", _OPEN, _OPEN_RULES),
    "melting_pot/commons_harvest__closed-v1": _melting_pot("closed", _CLOSED, _MELTING_POT),
    "melting_pot/commons_harvest__partnership-v1": _melting_pot("partnership", _PARTNERSHIP, _MELTING_POT),
    "ssd/harvest-v1": Source(
        "sequential_social_dilemma_games, HarvestEnv",
        _SSD_URL,
        lambda maps: maps.parse(_HARVEST, legend="ssd", agents=5),
        _SSD,
        _SSD_FINES,
    ),
    "ssd/cleanup-v1": Source(
        "sequential_social_dilemma_games, CleanupEnv",
        _SSD_URL,
        lambda maps: maps.parse(_CLEANUP, legend="ssd_cleanup", agents=5),
        _CLEANUP_RULES,
        _SSD_FINES,
    ),
    "socialjax/harvest_open-v1": Source(
        "SocialJax, harvest_open",
        "https://github.com/cooperativex/SocialJax",
        lambda maps: maps.parse(_without_walls(_OPEN), legend="socialjax", agents=7),
        _SOCIALJAX,
    ),
    "perolat/open-v1": Source(*_PEROLAT_SOURCE, _open_field, _PEROLAT),
    "perolat/rooms-v1": Source(*_PEROLAT_SOURCE, lambda maps: maps.rooms("single"), _PEROLAT),
    "perolat/rooms_many_entrances-v1": Source(
        *_PEROLAT_SOURCE, lambda maps: maps.rooms("multiple"), _PEROLAT
    ),
    "perolat/rooms_unequal-v1": Source(*_PEROLAT_SOURCE, lambda maps: maps.rooms("unequal"), _PEROLAT),
    "perolat/rooms_without_walls-v1": Source(*_PEROLAT_SOURCE, lambda maps: maps.rooms("none"), _PEROLAT),
    "janssen/foraging-v1": Source(
        "M. A. Janssen, R. Holahan, A. Lee and E. Ostrom, Lab experiments for the study of social-ecological "
        "systems, Science 328, 2010",
        "https://doi.org/10.1126/science.1183532",
        _laboratory,
        _JANSSEN,
        {"fine": 2.0, "cost": 1.0},
        sees_all=True,
    ),
}
"""All games of the literature, by name."""


def game_of_literature(name: str) -> "Game":
    """Return a game of the literature by its name, one of `SOURCES`."""
    from cprl.commons import maps
    from cprl.commons.game import Game
    from cprl.commons.observation import Area, Observation
    from cprl.commons.river import River
    from cprl.commons.rules import RandomEnd, Rules
    from cprl.institutions import Punishment

    source = SOURCES[name]
    rules = dict(source.rules)
    for group, kind in {"river": River, "random_end": RandomEnd}.items():
        if group in rules:
            rules[group] = kind(**rules[group])
    fines = (Punishment(**source.fines),) if source.fines else ()
    area: Area = "full" if source.sees_all else "window"
    return Game(
        map=source.board(maps), rules=Rules(**rules), observation=Observation(area=area), institutions=fines
    )
