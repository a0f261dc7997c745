"""The institutions of a game taken together: make their arrays, and check that they fit the game.

`cprl.institutions.hooks` has the moments of a turn at which they act.
"""

from importlib import import_module
from typing import Any, Final, cast

from cprl.institutions import Entries, Law
from cprl.institutions.arrays import filled
from cprl.institutions.governor import Governor
from cprl.institutions.institution import Institution, field_values, with_ballot_index
from cprl.institutions.ledger import COUNT_NAMES, Ledger
from cprl.institutions.votes import MOST_DECISIONS

MODULES: Final = {
    name: import_module(kind.__module__)
    for name, kind in Law.__annotations__.items()
    if kind not in (Ledger, Entries)
}
"""The modules of institutions by their fields in `Law`, which have the names of the modules."""


INSTITUTION_KINDS: Final[tuple[type[Institution], ...]] = (
    *(
        kind
        for module in MODULES.values()
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, Institution) and kind.__module__ == module.__name__
    ),
    Governor,
)
"""The classes of all institutions that a game can have."""


def entries_shown(game: Any) -> list[tuple[str, int]]:
    """Return the (entry, argument) pairs that the institutions of a game show agents, in their order."""
    entries: list[tuple[str, int]] = []
    earlier_of_kind = dict.fromkeys(INSTITUTION_KINDS, 0)
    for institution, ballot in with_ballot_index(game):
        # A vote shows its result, and the institution that is voted on shows its own entries.
        for rule in dict.fromkeys((institution, institution.rule)):
            if rule.observed:
                index_in_kind = earlier_of_kind[type(rule)]
                entries += rule.shown_entries(number=index_in_kind, ballot=ballot, agents=game.agents)
            earlier_of_kind[type(rule)] += 1
    return entries


def parameters(game: Any) -> dict[str, dict[str, Any]]:
    """Return the parameters of a game's institutions by the field of `Law`, then by the array's name."""
    module_and_index = {
        entry: (Law._fields.index(kind.__module__.rpartition(".")[2]), index)
        for kind in INSTITUTION_KINDS
        for index, entry in enumerate(kind.entries)
    }
    shown_entries = entries_shown(game)
    entries = {
        "module": [module_and_index[entry][0] for entry, _ in shown_entries],
        "entry": [module_and_index[entry][1] for entry, _ in shown_entries],
        "argument": [argument for _, argument in shown_entries],
        "shows_places": shows_places(game),
        "first_plane": len(game.game_channels),
    }
    return {"entries": entries} | {name: _parameters(name, game) for name in MODULES}


def _parameters(name: str, game: Any) -> dict[str, Any]:
    """Return the parameters of one module: those of its function `parameters`, or else the fields of its
    institutions in the game."""
    module: Any = MODULES[name]
    if hasattr(module, "parameters"):
        return module.parameters(game)
    (kind,) = (kind for kind in INSTITUTION_KINDS if kind.__module__ == module.__name__)
    return field_values(kind, Law.__annotations__[name], game)


def new_law(game: Any, worlds: int) -> Law:
    """Return the arrays of a game's institutions for B worlds in which nothing has happened yet.

    The first choice of each ballot, and the first option of a governor, is in force.
    """
    sizes = {"B": worlds, "N": game.agents, "C": len(COUNT_NAMES), "V": len(game.in_force)}
    classes = Law.__annotations__
    arrays = {name: filled(classes[name], values, **sizes) for name, values in game.law_parameters.items()}
    ledger = filled(Ledger, {}, **sizes)
    ledger.in_force[:] = arrays["votes"].choices[:, 0]
    return cast(Any, Law)(ledger=ledger, **arrays)


def check_institutions(game: Any) -> None:
    """Raise a ValueError if the institutions of a game do not fit each other or the rest of the game."""
    for institution in game.institutions:
        _check_kind(institution, game)
        _check_needs(institution, game)
        institution.check(game)
    if game.decisions > MOST_DECISIONS:
        raise ValueError(
            f"Game.institutions lets agents choose from {game.decisions:,} options; allowed: at most "
            f"{MOST_DECISIONS:,}"
        )


def _check_kind(institution: Institution, game: Any) -> None:
    """Refuse an institution of an unknown class, and too many of one class."""
    kind = type(institution)
    if kind not in INSTITUTION_KINDS:
        raise ValueError(
            f"Game.institutions has a {kind.__name__}; allowed: "
            f"{', '.join(known.__name__ for known in INSTITUTION_KINDS)}; an institution of your own is "
            "a TorchRL transform, see docs/institutions.md"
        )
    count = sum(type(other) is kind for other in game.institutions)
    if kind.most_in_game is not None and count > kind.most_in_game:
        raise ValueError(
            f"Game.institutions has {count} of {kind.__name__}; allowed: at most {kind.most_in_game}"
        )


def _check_needs(institution: Institution, game: Any) -> None:
    """Refuse an institution in a game without the observations or beams that it needs."""
    kind = type(institution)
    for switch in kind.needed_switches:
        if institution.observed and not getattr(game.observation, switch):
            raise ValueError(
                f"{kind.__name__}.observed is True and Observation.{switch} is False; allowed: "
                f"Observation({switch}=True), or {kind.__name__}(observed=False)"
            )
    if institution.needs_tags and not game.rules.may_fire:
        raise ValueError(
            f"Game.institutions has a {kind.__name__} and Rules.may_fire is False; allowed: a game in "
            "which agents may fire"
        )


def shows_places(game: Any) -> bool:
    """Return whether institutions show agents the cells where they may not harvest."""
    return any(institution.shows_places and institution.observed for institution in game.institutions)
