"""Law: the institutions of a game together: which kinds there are, their arrays, and whether they fit.

How they act in a turn is in `cprl.institutions.hooks`.
"""

from collections.abc import Iterable
from importlib import import_module
from types import ModuleType
from typing import Any, Final, cast

from cprl.institutions import Law
from cprl.institutions.arrays import filled, names_kept
from cprl.institutions.base import Institution, numbered
from cprl.institutions.ledger import COUNTS, Ledger
from cprl.institutions.votes import MOST_DECISIONS

MODULES: Final = {
    name: import_module(kind.__module__)
    for name, kind in Law.__annotations__.items()
    if kind.__name__ == "Arrays"
}
"""The modules of kinds by their fields of `Law`, which have the modules' names."""


def _classes_of(module: ModuleType) -> list[type[Any]]:
    """Return the classes that a module defines."""
    return [
        kind
        for kind in vars(module).values()
        if isinstance(kind, type) and kind.__module__ == module.__name__
    ]


KINDS: Final[tuple[type[Institution], ...]] = tuple(
    kind for module in MODULES.values() for kind in _classes_of(module) if issubclass(kind, Institution)
)
"""All kinds of institutions that a game can have."""


def check_names(modules: Iterable[ModuleType]) -> None:
    """Check that no name is claimed twice, of arrays in the state of a world or of entries shown to agents:
    states, and what is shown, go by these names alone.

    Raises:
        ValueError: with the name, and both classes with their modules.
    """
    owners: dict[str, str] = {}
    for kind in (kind for module in modules for kind in _classes_of(module)):
        owner = f"{kind.__module__}.{kind.__name__}"
        for name in _claims_of(kind):
            if owners.setdefault(name, owner) != owner:
                raise ValueError(
                    f"{owners[name]} and {owner} both have the {name}; allowed: a name of its own in each"
                )


def _claims_of(kind: type[Any]) -> list[str]:
    """Return the arrays, or the entries shown to agents, whose names no other class may claim."""
    if issubclass(kind, Institution):
        return [f"entry {name!r}" for name in kind.entries]
    if issubclass(kind, tuple):
        return [f"array {name!r}" for name in names_kept(kind)]
    return []


def entries_shown(game: Any) -> list[tuple[str, int]]:
    """Return what the institutions of a game show agents, in their order, each with the number of which
    one."""
    entries: list[tuple[str, int]] = []
    seen = dict.fromkeys(KINDS, 0)
    for institution, ballot in numbered(game):
        for part in dict.fromkeys((institution, institution.rule)):
            if part.observed:
                entries += part.shows(number=seen[type(part)], ballot=ballot, agents=game.agents)
            seen[type(part)] += 1
    return entries


def parameters(game: Any) -> dict[str, dict[str, Any]]:
    """Return the parameters of a game's institutions, by the fields of `Law`."""
    places = {
        entry: (Law._fields.index(kind.__module__.rpartition(".")[2]), what)
        for kind in KINDS
        for what, entry in enumerate(kind.entries)
    }
    shown_entries = entries_shown(game)
    entries = {
        "module": [places[entry][0] for entry, _ in shown_entries],
        "what": [places[entry][1] for entry, _ in shown_entries],
        "argument": [number for _, number in shown_entries],
        "places": shows_places(game),
        "first_plane": len(game.own_channels),
    }
    of_modules = {name: module.parameters(game) for name, module in MODULES.items()}
    return {"entries": entries, **of_modules}


def new_law(game: Any, worlds: int) -> Law:
    """Return the law of B worlds of a game, in which nothing has happened and the first choice of each ballot
    is in force."""
    given = game.law_parameters
    sizes = {"B": worlds, "N": game.agents, "C": len(COUNTS), "V": len(game.ballots)}
    kinds = Law.__annotations__
    parts = {name: filled(kinds[name], values, **sizes) for name, values in given.items()}
    ledger = filled(Ledger, {}, **sizes)
    ledger.in_force[:] = parts["votes"].choices[:, 0]
    return cast(Any, Law)(ledger=ledger, **parts)


def check_institutions(game: Any) -> None:
    """Check that the institutions of a game fit each other, its map, rules and observation."""
    for institution in game.institutions:
        kind = type(institution)
        if kind not in KINDS:
            raise ValueError(
                f"Game.institutions has a {kind.__name__}; allowed: "
                f"{', '.join(known.__name__ for known in KINDS)}; an institution of your own is a "
                "TorchRL transform, see docs/institutions.md"
            )
        of_kind = sum(type(other) is kind for other in game.institutions)
        if kind.at_most is not None and of_kind > kind.at_most:
            raise ValueError(
                f"Game.institutions has {of_kind} of {kind.__name__}; allowed: at most {kind.at_most}"
            )
        for switch in kind.needs:
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
        institution.check(game)
    if game.decisions > MOST_DECISIONS:
        raise ValueError(
            f"Game.institutions lets agents choose from {game.decisions:,} options; allowed: at most "
            f"{MOST_DECISIONS:,}"
        )


def shows_places(game: Any) -> bool:
    """Return whether agents of a game see where bites are forbidden."""
    return any(institution.shows_places and institution.observed for institution in game.institutions)
