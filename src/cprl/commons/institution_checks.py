"""Checks that the institutions of a game fit each other, the map, the rules and the observation."""

from typing import Any

from cprl.commons.institution_entries import KINDS
from cprl.commons.maps import Map
from cprl.commons.observation import Observation
from cprl.commons.rules import Rules
from cprl.institutions import GraduatedSanctions, Institution, Mediation, Sanctioner
from cprl.institutions.base import MOST_INSTITUTIONS
from cprl.institutions.choice import MOST_DECISIONS, decision_options


def check_institutions(institutions: tuple[Any, ...], board: Map, rules: Rules, form: Observation) -> None:
    """Checks that institutions fit each other, the map, the rules and the observation.

    Raises:
        ValueError: If not; names the institution and says what is allowed.
    """
    if len(institutions) > MOST_INSTITUTIONS:
        raise ValueError(
            f"Game.institutions has {len(institutions)} entries; allowed: at most {MOST_INSTITUTIONS}"
        )
    for own in institutions:
        kind = type(own)
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
        own.check_board(agents=board.agents, height=board.height, width=board.width)
        _check_observation(own, form)
        needs_tags = isinstance(own, Sanctioner | Mediation) or (
            isinstance(own, GraduatedSanctions) and own.on == "tags"
        )
        if needs_tags and not rules.may_fire:
            raise ValueError(
                f"Game.institutions has a {kind.__name__} and Rules.may_fire is False; allowed: a game in "
                "which agents may fire"
            )
    options = decision_options(institutions, board.agents)
    if options > MOST_DECISIONS:
        raise ValueError(
            f"Game.institutions lets agents choose from {options:,} options; allowed: at most "
            f"{MOST_DECISIONS:,}"
        )


def _check_observation(own: Institution, form: Observation) -> None:
    lacking = [name for name in type(own).needs if own.observed and not getattr(form, name)]
    if lacking:
        raise ValueError(
            f"{type(own).__name__}.observed is True and Observation.{lacking[0]} is False; allowed: "
            f"Observation({lacking[0]}=True), or {type(own).__name__}(observed=False)"
        )
