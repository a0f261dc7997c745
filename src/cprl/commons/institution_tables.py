"""The institutions of a game: that they fit, what they show agents, and their lookup tables."""

import math
import warnings
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from cprl.commons.chance import threshold
from cprl.commons.maps import Map
from cprl.commons.near import patches, sites_around
from cprl.commons.observation import Observation
from cprl.commons.rules import Rules
from cprl.commons.tables import Tables
from cprl.commons.world import Bools, Ints
from cprl.commons.yields import sustainable_yield
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
from cprl.institutions.base import MOST_INSTITUTIONS
from cprl.institutions.boundaries import OPEN
from cprl.institutions.choice import MOST_DECISIONS, Ballot, ballots, decision_options, is_decided
from cprl.institutions.limits import ROUNDING
from cprl.institutions.memory import InstitutionTables
from cprl.institutions.monitoring import ELECTED


def build_institution_tables(
    institutions: Sequence[Institution],
    board: Map,
    rules: Rules,
    tables: Tables,
    *,
    first_plane: int,
) -> InstitutionTables:
    """Builds the tables of a game's institutions."""
    voted = ballots(institutions, board.agents)
    entries = entries_shown(institutions, board.agents)
    return InstitutionTables(
        **_boundary_tables(institutions, board, tables),
        **_quota_tables(institutions, board, rules),
        **_season_tables(institutions),
        **_patch_tables(institutions, board, rules),
        **_tax_tables(institutions, board.agents),
        **_ballot_tables(voted),
        **_monitoring_tables(institutions, voted),
        **_sanction_tables(institutions, board.agents),
        **_firing_tables(institutions, voted, board.agents),
        shown_kind=np.array([kind for kind, _ in entries], np.int32),
        shown_argument=np.array([argument for _, argument in entries], np.int32),
        shows_places=shows_places(institutions),
        first_plane=first_plane,
    )


def _of(kind: Any, institutions: Sequence[Institution]) -> list[Any]:
    return [institution for institution in institutions if isinstance(institution, kind)]


def _floats(values: Sequence[float]) -> Any:
    return np.array(values, np.float64)


def _bools(values: Sequence[bool]) -> Bools:
    return np.array(values, np.bool_)


def _ints(values: Sequence[int]) -> Ints:
    return np.array(values, np.int32)


def _fine(value: float | None) -> float:
    return 0.0 if value is None else float(value)


def _voted(institutions: Sequence[Institution], kind: type[Any]) -> list[tuple[Any, int]]:
    """Institutions of a kind, each with the index of the ballot that decides its value, or -1."""
    voted_on, ballot = [], 0
    for institution in institutions:
        if isinstance(institution, kind):
            voted_on.append((institution, -1))
        elif isinstance(institution, Vote) and isinstance(institution.on, kind):
            voted_on.append((institution.on, ballot))
        ballot += is_decided(institution)
    return voted_on


def _boundary_tables(institutions: Sequence[Institution], board: Map, tables: Tables) -> dict[str, Any]:
    boundaries = _of(Boundaries, institutions)
    rows = tables.background.size // tables.stride
    may_use = np.ones((len(boundaries), board.agents, rows, tables.stride), np.bool_)
    inside = slice(tables.rim, tables.rim + board.height), slice(tables.rim, tables.rim + board.width)
    for number, boundary in enumerate(boundaries):
        signs = np.array([list(row) for row in boundary.regions])
        for agent in range(board.agents):
            may_use[(number, agent, *inside)] = np.isin(signs, [OPEN, *boundary.signs_of(agent)])
    return {
        "may_use": may_use.reshape(len(boundaries), board.agents, tables.background.size),
        "bite_stopped": _bools([boundary.bite_fine is None for boundary in boundaries]),
        "bite_fine": _floats([_fine(boundary.bite_fine) for boundary in boundaries]),
        "step_is_violation": _bools([boundary.step_fine is not None for boundary in boundaries]),
        "step_fine": _floats([_fine(boundary.step_fine) for boundary in boundaries]),
        "may_use_shown": _bools([boundary.observed for boundary in boundaries]),
    }


def _most(quota: Quota, ballot: int, voted: Sequence[Ballot]) -> float:
    """The largest share that a quota can have."""
    return quota.share if ballot < 0 else voted[ballot].choices[-1]


def _quota_tables(institutions: Sequence[Institution], board: Map, rules: Rules) -> dict[str, Any]:
    voted = ballots(institutions, board.agents)
    quotas = _voted(institutions, Quota)
    of_agent = sustainable_yield(board, rules) / board.agents if quotas else 0.0
    for quota, ballot in quotas:
        _warn_of_less_than_an_apple(quota, of_agent * _most(quota, ballot, voted))
    return {
        "quota_unit": _floats([of_agent * quota.window_steps for quota, _ in quotas]),
        "quota_full": _floats(
            [of_agent * quota.window_steps * _most(quota, ballot, voted) for quota, ballot in quotas]
        ),
        "quota_share": _floats([quota.share for quota, _ in quotas]),
        "quota_ballot": _ints([ballot for _, ballot in quotas]),
        "quota_steps": _ints([quota.window_steps for quota, _ in quotas]),
        "quota_by_stock": _bools([quota.by_stock for quota, _ in quotas]),
        "quota_stopped": _bools([quota.fine is None for quota, _ in quotas]),
        "quota_fine": _floats([_fine(quota.fine) for quota, _ in quotas]),
    }


def _warn_of_less_than_an_apple(quota: Quota, apples_a_turn: float) -> None:
    """Warns of a quota that stops every bite although its share is not 0."""
    apples = apples_a_turn * quota.window_steps
    if quota.fine is None and 0 < apples < 1 - ROUNDING:
        warnings.warn(
            f"Quota.window_steps is {quota.window_steps}: in such a window an agent may take {apples:.3g} "
            "apples at most, so nobody ever harvests; an apple is allowed in windows of "
            f"{math.ceil((1 - ROUNDING) / apples_a_turn)} turns or more",
            UserWarning,
            stacklevel=2,
        )


def _season_tables(institutions: Sequence[Institution]) -> dict[str, Any]:
    seasons = _of(ClosedSeason, institutions)
    return {
        "season_steps": _ints([season.period_steps for season in seasons]),
        "season_open": _ints([season.period_steps - season.closed_steps for season in seasons]),
        "season_stopped": _bools([season.fine is None for season in seasons]),
        "season_fine": _floats([_fine(season.fine) for season in seasons]),
    }


def _patch_tables(institutions: Sequence[Institution], board: Map, rules: Rules) -> dict[str, Any]:
    closures = _of(ClosedPatches, institutions)
    patch = patches(sites_around(board, rules)) if closures else np.zeros(len(board.sites), np.int32)
    return {
        "patch_of": patch,
        "patch_sites": np.bincount(patch).astype(np.int32) if closures else _ints([]),
        "patch_below": int(closures[0].below) if closures else 0,
        "patch_stopped": bool(closures and closures[0].fine is None),
        "patch_fine": _fine(closures[0].fine) if closures else 0.0,
        "patch_shown": bool(closures and closures[0].observed),
    }


def _tax_tables(institutions: Sequence[Institution], agents: int) -> dict[str, Any]:
    rows: list[tuple[int, int, tuple[int, ...], tuple[tuple[float, float], ...]]] = []
    for tax, ballot in _voted(institutions, Tax):
        group = (0 if tax.redistribution == "equal" else -1,) * agents
        rows.append((ballot, tax.period_steps, group, tax.brackets or ((0.0, tax.rate),)))
    for levies in _of(Levies, institutions):
        rows.append((-1, 1, levies.group_of, ((0.0, levies.local_rate),)))
        rows.append((-1, 1, (0,) * agents, ((0.0, levies.joint_rate),)))
    most = max((len(brackets) for *_, brackets in rows), default=1)
    from_, rate = np.full((len(rows), most), np.inf), np.zeros((len(rows), most))
    for row_number, (*_, brackets) in enumerate(rows):
        from_[row_number, : len(brackets)] = [start for start, _ in brackets]
        rate[row_number, : len(brackets)] = [share for _, share in brackets]
    return {
        "tax_from": from_,
        "tax_rate": rate,
        "tax_ballot": _ints([row[0] for row in rows]),
        "tax_steps": _ints([row[1] for row in rows]),
        "tax_group": np.array([row[2] for row in rows], np.int32).reshape(len(rows), agents),
    }


def _ballot_tables(voted: Sequence[Ballot]) -> dict[str, Any]:
    choices = np.zeros((len(voted), max((len(ballot.choices) for ballot in voted), default=1)))
    for number, ballot in enumerate(voted):
        choices[number, : len(ballot.choices)] = ballot.choices
    return {
        "ballot_options": _ints([len(ballot.choices) for ballot in voted]),
        "ballot_choice": choices,
        "ballot_is_election": _bools([ballot.is_election for ballot in voted]),
        "ballot_episodes": _ints([ballot.period_episodes for ballot in voted]),
        "ballot_override": np.array([threshold(ballot.override_prob) for ballot in voted], np.int64),
    }


def _ballot_called(voted: Sequence[Ballot], title: str) -> int:
    return next((number for number, ballot in enumerate(voted) if ballot.title == title), -1)


def _monitoring_tables(institutions: Sequence[Institution], voted: Sequence[Ballot]) -> dict[str, Any]:
    monitorings = _of(Monitoring, institutions)
    monitoring = monitorings[0] if monitorings else Monitoring(prob=1.0)
    return {
        "detected_below": threshold(monitoring.prob),
        "monitor_cost": float(monitoring.cost),
        "monitor": monitoring.monitor if isinstance(monitoring.monitor, int) else -1,
        "monitor_ballot": _ballot_called(voted, "who monitors"),
    }


def _sanction_tables(institutions: Sequence[Institution], agents: int) -> dict[str, Any]:
    sanctions, mediated = _of(GraduatedSanctions, institutions), _of(Mediation, institutions)
    steps = np.zeros((agents, 0), np.int32)
    if sanctions:
        row = sanctions[0].freeze_steps
        steps = np.broadcast_to(
            np.array(row, np.int32), (agents, len(row[0] if sanctions[0].is_table else row))
        )
    on = sanctions[0].on if sanctions else ""
    return {
        "sanction_steps": np.ascontiguousarray(steps),
        "sanction_fine": _floats(sanctions[0].fines if sanctions else ()),
        "sanction_recovery": int(sanctions[0].recovery_steps or 0) if sanctions else 0,
        "sanctions_tags": on in ("tags", "both"),
        "sanctions_violations": on in ("violations", "both"),
        "mediation_turns": int(mediated[0].turns) if mediated else 0,
        "mediation_refund": float(mediated[0].refund) if mediated else 0.0,
    }


def _firing_tables(
    institutions: Sequence[Institution], voted: Sequence[Ballot], agents: int
) -> dict[str, Any]:
    named = [
        sanctioner.agents for sanctioner in _of(Sanctioner, institutions) if sanctioner.agents is not None
    ]
    return {
        "may_fire": _bools([not named or agent in named[0] for agent in range(agents)]),
        "fire_ballot": _ballot_called(voted, "who may fire"),
    }


_ABOUT_PLACES: Final = (Boundaries, ClosedPatches)


def shows_places(institutions: Sequence[Institution]) -> bool:
    """Whether agents see where bites are forbidden."""
    return any(
        isinstance(institution, _ABOUT_PLACES) and institution.observed for institution in institutions
    )


def entries_shown(institutions: Sequence[Institution], agents: int) -> list[tuple[int, int]]:
    """(what, which one) of each entry that institutions show agents; see `cprl.institutions.showing`."""
    entries: list[tuple[int, int]] = []
    quotas, seasons, ballot = 0, 0, 0
    for institution in institutions:
        rule: Any = institution.on if isinstance(institution, Vote) else institution
        if isinstance(institution, Vote) and institution.observed:
            entries.append((shows.IN_FORCE, ballot))
        if isinstance(rule, Quota) and rule.observed:  # what is voted on has an "observed" of its own
            entries += [(shows.QUOTA_LEFT, quotas), (shows.QUOTA_TIME, quotas)]
        elif isinstance(rule, ClosedSeason) and rule.observed:
            entries += [(shows.CLOSED, seasons), (shows.SEASON_TIME, seasons)]
        elif isinstance(rule, Monitoring) and rule.observed:
            entries.append((shows.DETECTED, 0))
            if rule.monitor == ELECTED:
                entries.append((shows.IS_ELECTED, ballot))
        elif isinstance(rule, GraduatedSanctions) and rule.observed:
            entries.append((shows.LEVEL, 0))
        elif isinstance(rule, Mediation) and rule.observed:
            entries += [(shows.MARK, agent) for agent in range(agents)]
        elif isinstance(rule, Sanctioner) and rule.observed:
            entries.append((shows.MAY_FIRE, 0))
        quotas += isinstance(rule, Quota)
        seasons += isinstance(rule, ClosedSeason)
        ballot += is_decided(institution)
    return entries


KINDS: Final = (
    *(Boundaries, ClosedPatches, Quota, ClosedSeason, Tax, Levies, Vote),
    *(Monitoring, GraduatedSanctions, Mediation, Sanctioner),
)
"""All kinds of institutions that a game can have."""


def check_institutions(institutions: tuple[Any, ...], board: Map, rules: Rules, form: Observation) -> None:
    """Checks that institutions fit each other, the map, the rules and the observation."""
    if len(institutions) > MOST_INSTITUTIONS:
        raise ValueError(
            f"Game.institutions has {len(institutions)} entries; allowed: at most {MOST_INSTITUTIONS}"
        )
    for institution in institutions:
        kind = type(institution)
        if kind not in KINDS:
            raise ValueError(
                f"Game.institutions has a {kind.__name__}; allowed: "
                f"{', '.join(known.__name__ for known in KINDS)}; an institution of your own is a "
                "TorchRL transform, see docs/institutions.md"
            )
        of_kind = sum(type(other) is kind for other in institutions)
        if kind.at_most is not None and of_kind > kind.at_most:
            raise ValueError(
                f"Game.institutions has {of_kind} of {kind.__name__}; allowed: at most {kind.at_most}"
            )
        institution.check_board(agents=board.agents, height=board.height, width=board.width)
        _check_observation(institution, form)
        needs_tags = isinstance(institution, Sanctioner | Mediation) or (
            isinstance(institution, GraduatedSanctions) and institution.on == "tags"
        )
        if needs_tags and not rules.may_fire:
            raise ValueError(
                f"Game.institutions has a {kind.__name__} and Rules.may_fire is False; allowed: a game in "
                "which agents may fire"
            )
        _check_effect(institution, institutions, rules)
    options = decision_options(institutions, board.agents)
    if options > MOST_DECISIONS:
        raise ValueError(
            f"Game.institutions lets agents choose from {options:,} options; allowed: at most "
            f"{MOST_DECISIONS:,}"
        )


def _check_effect(institution: Institution, institutions: tuple[Any, ...], rules: Rules) -> None:
    """Refuses what pursues violations of rules where there is no rule that can be broken."""
    if any(_can_be_broken(other) for other in institutions):
        return
    name, allowed = (
        type(institution).__name__,
        "a Boundaries, Quota or the like with a fine, or a Mediation, beside it",
    )
    if isinstance(institution, Monitoring) and institution.cost == 0:
        raise ValueError(f"{name} has no violation to detect; allowed: {allowed}, or a cost above 0")
    if isinstance(institution, GraduatedSanctions) and (institution.on == "violations" or not rules.may_fire):
        raise ValueError(f'{name} with on="{institution.on}" has no offence to sanction; allowed: {allowed}')


def _can_be_broken(institution: Any) -> bool:
    """Whether an institution is a rule that agents can break."""
    institution = institution.on if isinstance(institution, Vote) else institution
    if isinstance(institution, Boundaries):
        return institution.bite_fine is not None or institution.step_fine is not None
    if isinstance(institution, Quota | ClosedSeason | ClosedPatches):
        return institution.fine is not None
    return isinstance(institution, Mediation)


def _check_observation(institution: Institution, form: Observation) -> None:
    lacking = [name for name in type(institution).needs if institution.observed and not getattr(form, name)]
    if lacking:
        raise ValueError(
            f"{type(institution).__name__}.observed is True and Observation.{lacking[0]} is False; allowed: "
            f"Observation({lacking[0]}=True), or {type(institution).__name__}(observed=False)"
        )
