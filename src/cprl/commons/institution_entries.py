"""Which entries the institutions of a game show agents; what each holds, see `cprl.institutions.showing`."""

from collections.abc import Callable, Sequence
from typing import Any, Final

from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    GraduatedSanctions,
    Institution,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Sanctioner,
    Tax,
    Vote,
)
from cprl.institutions import memory as shows
from cprl.institutions.choice import is_decided
from cprl.institutions.monitoring import ELECTED

_ABOUT_PLACES: Final = (Boundaries, ClosedPatches)


def shows_places(institutions: Sequence[Institution]) -> bool:
    """Whether agents see where bites are forbidden."""
    return any(isinstance(own, _ABOUT_PLACES) and own.observed for own in institutions)


def entries_shown(institutions: Sequence[Institution], agents: int) -> list[tuple[int, int]]:
    """(what, which one) of each entry that institutions show agents; see `cprl.institutions.showing`."""
    entries: list[tuple[int, int]] = []
    quotas, seasons, ballot = 0, 0, 0
    for own in institutions:
        if own.observed or isinstance(own, Vote):  # what is voted on has an "observed" of its own
            entries += _SHOWN_BY[type(own)](own, quotas, seasons, ballot, agents)
        quotas += isinstance(own, Quota) or (isinstance(own, Vote) and isinstance(own.on, Quota))
        seasons += isinstance(own, ClosedSeason)
        ballot += is_decided(own)
    return entries


_Entries = list[tuple[int, int]]


def _shown_by_quota(own: Any, quotas: int, seasons: int, ballot: int, agents: int) -> _Entries:
    return [(shows.QUOTA_LEFT, quotas), (shows.QUOTA_TIME, quotas)]


def _shown_by_season(own: Any, quotas: int, seasons: int, ballot: int, agents: int) -> _Entries:
    return [(shows.CLOSED, seasons), (shows.SEASON_TIME, seasons)]


def _shown_by_vote(own: Any, quotas: int, seasons: int, ballot: int, agents: int) -> _Entries:
    also = _shown_by_quota(own.on, quotas, seasons, ballot, agents) if isinstance(own.on, Quota) else []
    return [*([(shows.IN_FORCE, ballot)] if own.observed else []), *(also if own.on.observed else [])]


def _shown_by_monitoring(own: Any, quotas: int, seasons: int, ballot: int, agents: int) -> _Entries:
    return [(shows.DETECTED, 0), *([(shows.IS_ELECTED, ballot)] if own.monitor == ELECTED else [])]


_SHOWN_BY: Final[dict[type[Any], Callable[..., _Entries]]] = {
    Boundaries: lambda *_: [],
    ClosedPatches: lambda *_: [],
    Quota: _shown_by_quota,
    ClosedSeason: _shown_by_season,
    Tax: lambda *_: [],
    Levies: lambda *_: [],
    Vote: _shown_by_vote,
    Monitoring: _shown_by_monitoring,
    GraduatedSanctions: lambda *_: [(shows.LEVEL, 0)],
    Mediation: lambda *rest: [(shows.MARK, agent) for agent in range(rest[-1])],
    Sanctioner: lambda *_: [(shows.MAY_FIRE, 0)],
}

KINDS: Final = tuple(_SHOWN_BY)
"""All kinds of institutions that a game can have."""
