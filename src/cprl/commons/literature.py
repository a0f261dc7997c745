"""Games of the literature by name, each with its source; `docs/games.md` lists what differs from the sources.

A name never changes its meaning: a game with other rules gets another version. Layouts and numbers come from
the sources, and cprl's own rules play them.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from cprl.commons.game import Game
    from cprl.commons.maps import Entrances, Map

# The signs of the boards are those of their programs, see `cprl.commons.maps.LEGENDS`: "melting_pot" (open,
# closed, partnership), "ssd" (harvest), "ssd_cleanup" (cleanup).
_OPEN_BOARD: Final = """
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
_CLOSED_BOARD: Final = """
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
_PARTNERSHIP_BOARD: Final = """
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
_HARVEST_BOARD: Final = """
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

_CLEANUP_BOARD: Final = """
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

_MELTING_POT_RULES: Final[dict[str, Any]] = {
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
"""The rules of closed and partnership, from `meltingpot/configs/substrates/commons_harvest__closed.py` and
`..__partnership.py`: growth from `REGROWTH_PROBABILITIES`, the beam from `Zapper`, the window from `view`,
the end from `StochasticIntervalEpisodeEnding` and `maxEpisodeLengthFrames`. `freeze_steps` is
`framesTillRespawn` + 1, as turns of the original show."""
_OPEN_RULES: Final[dict[str, Any]] = _MELTING_POT_RULES | {
    "regrow_prob": (0.0, 0.0025, 0.005, 0.025),
    "beam_length_cells": 3,
    "cooldown_steps": 2,
    "freeze_steps": 5,
}
"""The rules of open, from `meltingpot/configs/substrates/commons_harvest__open.py`, where
`framesTillRespawn` is 4."""
_SSD_RULES: Final[dict[str, Any]] = {
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
"""The rules of harvest, from `social_dilemmas/envs/harvest.py` and `map_env.py`: growth from `SPAWN_PROB`;
`APPLE_RADIUS`, 2, is compared with a squared distance there, so apples are near up to its root."""
_CLEANUP_RULES: Final[dict[str, Any]] = _SSD_RULES | {
    "regrow_prob": (0.05,),
    "regrow_radius_cells": 0,
    "first_stock_share": 0.0,
    "river": {"may_clean": True, "pollution_prob": 0.5},
}
"""The rules of cleanup, from `social_dilemmas/envs/cleanup.py`: `appleRespawnProbability` and
`wasteSpawnProbability`; its thresholds are the defaults of `River`."""
_SOCIALJAX_RULES: Final[dict[str, Any]] = {
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
"""The rules of SocialJax' harvest_open."""
_PEROLAT_RULES: Final[dict[str, Any]] = {
    "regrow_prob": (0.0, 0.01, 0.01, 0.05, 0.05, 0.1),
    "beam_length_cells": 10,
    "beam_width_cells": 5,
    "window_rows": 20,
    "window_columns": 21,
}
"""The rules of the paper, with what it does not say at second hand, see `docs/results/details.md`."""
_JANSSEN_RULES: Final[dict[str, Any]] = {
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
"""The rules of the paper and its supporting material. A turn is an eighth of a second, the time that a
person takes for a move in the laboratory: growth of 0.01 per second, and episodes of 240 seconds."""


class LiteratureGame(NamedTuple):
    """A game of the literature: where it comes from, and the board and rules from which it is made."""

    citation: str
    """Authors, title and year, or the name of a program."""
    url: str
    make_board: Callable[[], "Map"]
    """A function that makes the board."""
    rules: Mapping[str, Any]
    """The fields of `Rules` that differ from their defaults."""
    punishment: Mapping[str, Any] | None = None
    """The fields of the game's `Punishment`; None for a game without fines."""
    sees_all: bool = False
    """Whether agents observe the whole board."""


def _drawn(drawing: str, *, legend: str, agents: int) -> "Map":
    """Return a drawn board, see `cprl.commons.maps.parse`."""
    from cprl.commons import maps

    return maps.parse(drawing, legend=legend, agents=agents)


def _open_field() -> "Map":
    """Return a board with the size and the number of sites of Perolat's open map, but with sites drawn by
    chance."""
    from cprl.commons import maps

    return maps.random(20, 40, agents=12, density=246 / 800, clustering=0.8, seed=1)


def _rooms(entrances: "Entrances") -> "Map":
    """Return a board of Perolat's rooms, see `cprl.commons.maps.rooms`."""
    from cprl.commons import maps

    return maps.rooms(entrances)


def _laboratory() -> "Map":
    """Return the board of Janssen's experiment: every cell is a site, and agents start in the middle row."""
    from cprl.commons import maps
    from cprl.commons.headings import UP

    cells = tuple((row, col) for row in range(29) for col in range(29))
    starts = tuple((14, 4 + 5 * agent, UP) for agent in range(5))
    return maps.Map(height=29, width=29, sites=cells, starts=starts)


def _without_walls(drawing: str) -> str:
    """Return a drawing without its outermost rows and columns, which are walls."""
    return "\n".join(line[1:-1] for line in drawing.strip("\n").splitlines()[1:-1])


_SSD_URL: Final = "https://github.com/eugenevinitsky/sequential_social_dilemma_games"
_SSD_PUNISHMENT: Final = {"fine": 50.0, "cost": 0.0, "shot_cost": 1.0}


def _melting_pot(name: str, drawing: str, rules: Mapping[str, Any]) -> LiteratureGame:
    """Return a game of Melting Pot, by the last part of its name there."""
    return LiteratureGame(
        citation=f"Melting Pot 2.4, commons_harvest__{name}",
        url="https://github.com/google-deepmind/meltingpot",
        make_board=partial(_drawn, drawing, legend="melting_pot", agents=7),
        rules=rules,
    )


def _perolat(make_board: Callable[[], "Map"]) -> LiteratureGame:
    """Return a game of Perolat et al. on a board."""
    return LiteratureGame(
        citation=(
            "J. Perolat et al., A multi-agent reinforcement learning model of common-pool resource "
            "appropriation, NeurIPS 2017"
        ),
        url="https://arxiv.org/abs/1707.06600",
        make_board=make_board,
        rules=_PEROLAT_RULES,
    )


LITERATURE_GAMES: Final[dict[str, LiteratureGame]] = {
    "melting_pot/commons_harvest__open-v1": _melting_pot("open", _OPEN_BOARD, _OPEN_RULES),
    "melting_pot/commons_harvest__closed-v1": _melting_pot("closed", _CLOSED_BOARD, _MELTING_POT_RULES),
    "melting_pot/commons_harvest__partnership-v1": _melting_pot(
        "partnership", _PARTNERSHIP_BOARD, _MELTING_POT_RULES
    ),
    "ssd/harvest-v1": LiteratureGame(
        citation="sequential_social_dilemma_games, HarvestEnv",
        url=_SSD_URL,
        make_board=partial(_drawn, _HARVEST_BOARD, legend="ssd", agents=5),
        rules=_SSD_RULES,
        punishment=_SSD_PUNISHMENT,
    ),
    "ssd/cleanup-v1": LiteratureGame(
        citation="sequential_social_dilemma_games, CleanupEnv",
        url=_SSD_URL,
        make_board=partial(_drawn, _CLEANUP_BOARD, legend="ssd_cleanup", agents=5),
        rules=_CLEANUP_RULES,
        punishment=_SSD_PUNISHMENT,
    ),
    "socialjax/harvest_open-v1": LiteratureGame(
        citation="SocialJax, harvest_open",
        url="https://github.com/cooperativex/SocialJax",
        make_board=partial(_drawn, _without_walls(_OPEN_BOARD), legend="socialjax", agents=7),
        rules=_SOCIALJAX_RULES,
    ),
    "perolat/open-v1": _perolat(_open_field),
    "perolat/rooms-v1": _perolat(partial(_rooms, "single")),
    "perolat/rooms_many_entrances-v1": _perolat(partial(_rooms, "multiple")),
    "perolat/rooms_unequal-v1": _perolat(partial(_rooms, "unequal")),
    "perolat/rooms_without_walls-v1": _perolat(partial(_rooms, "none")),
    "janssen/foraging-v1": LiteratureGame(
        citation=(
            "M. A. Janssen, R. Holahan, A. Lee and E. Ostrom, Lab experiments for the study of "
            "social-ecological systems, Science 328, 2010"
        ),
        url="https://doi.org/10.1126/science.1183532",
        make_board=_laboratory,
        rules=_JANSSEN_RULES,
        punishment={"fine": 2.0, "cost": 1.0},
        sees_all=True,
    ),
}
"""All games of the literature, by name."""


def game_of_literature(name: str) -> "Game":
    """Return a game of the literature by its name, one of `LITERATURE_GAMES`."""
    from cprl.commons.game import Game
    from cprl.commons.observation import Area, Observation
    from cprl.commons.river import River
    from cprl.commons.rules import RandomEnd, Rules
    from cprl.institutions import Punishment

    entry = LITERATURE_GAMES[name]
    rules = dict(entry.rules)
    for group, kind in {"river": River, "random_end": RandomEnd}.items():
        if group in rules:
            rules[group] = kind(**rules[group])
    area: Area = "full" if entry.sees_all else "window"
    return Game(
        map=entry.make_board(),
        rules=Rules(**rules),
        observation=Observation(area=area),
        institutions=(Punishment(**entry.punishment),) if entry.punishment else (),
    )
