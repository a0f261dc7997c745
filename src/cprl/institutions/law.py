"""Law: the institutions of a game together, and the hooks of a turn at which they act, on one world.

A hook is a function in the module of an institution with one of these names. It gets the module's `Arrays`,
the `Ledger`, and:

    breaks       n, i, cell, site, turn: whether a bite of agent i breaks limit n of the module. It does not
                 happen, by `is_stopped`, or is a violation, counted as `COUNT`, that costs `fine`
    note_bite    i, cell, site, turn: agent i has harvested
    note_step    i, cell: agent i, in play, ends its move on a cell
    note_growth  site: an apple has grown
    settle       turn, is_over: what is collected, paid and forgiven at the end of a turn
    begin        an episode begins, and all that is remembered of the last one is cleared
    refresh      stock: writes what is derived from the rest of a state, uint8 [K]
    open_turn    turn, stock_share: what begins with the coming turn, counted from 1
    shown        what, argument, i, turn: an entry that agent i sees after a turn, 0..1
    forbids      i, cell, site: whether agent i sees that a bite there breaks a rule about places

Rules are called one by one in the order of `MODULES`, so sums of fines do not depend on the order of
institutions in a game. What a tag costs and who is detected is asked of `sanctions`, `mediation`,
`punishment` and `monitoring` by the turn itself. Kinds that a game lacks have arrays of length 0, so that no
combination compiles anything.
"""

from importlib import import_module
from types import FunctionType
from typing import Any, Final, cast

from cprl.institutions import Law
from cprl.institutions.arrays import filled, slicer
from cprl.institutions.base import Institution, numbered
from cprl.institutions.ledger import COUNTS, Ledger, violate
from cprl.institutions.votes import MOST_DECISIONS

MODULES: Final = {
    name: import_module(kind.__module__)
    for name, kind in Law.__annotations__.items()
    if getattr(kind, "__name__", "") == "Arrays"
}
"""The modules of kinds, in the order in which their rules are called within a turn."""

KINDS: Final[tuple[type[Institution], ...]] = tuple(
    kind
    for module in MODULES.values()
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Institution) and kind.__module__ == module.__name__
)
"""All kinds of institutions that a game can have."""

_RULES: Final = {
    f"{name}_{word}": rule
    for name, module in MODULES.items()
    for word, rule in vars(module).items()
    if word == "COUNT" or (isinstance(rule, FunctionType) and rule.__module__ == module.__name__)
}
"""The functions and `COUNT` of modules, under names of their own."""

_SLICERS: Final = {
    f"one_{name}": slicer(kind) for name, kind in Law.__annotations__.items() if name != "decisions"
}


def _calls(hook: str, arguments: str) -> list[str]:
    """The calls of a hook in every module that has it."""
    return [
        f"{name}_{hook}(law.{name}, law.ledger, {arguments})"
        for name in MODULES
        if f"{name}_{hook}" in _RULES
    ]


def _written(head: str, lines: list[str]) -> Any:
    """Return a function of these lines, in which hooks are called one by one: rules cannot loop over them."""
    names: dict[str, Any] = {"__name__": __name__, "violate": violate, "Law": Law, **_RULES, **_SLICERS}
    exec(f"def {head}:\n    " + "\n    ".join(lines), names)
    return names[head.partition("(")[0]]


def _each(hook: str, arguments: str = "") -> Any:
    return _written(f"{hook}(law, {arguments})", _calls(hook, arguments))


def _limits(then: str) -> list[str]:
    """Lines that do something for each limit that a bite breaks."""
    lines = []
    for call in _calls("breaks", "n, i, cell, site, turn"):
        name = call.partition("_breaks")[0]
        lines.append(f"for n in range(law.{name}.fine.shape[0]):")
        lines.append(f"    if {then.format(name=name, call=call)}")
    return lines


one_law = _written(
    "one_law(law, decisions, payments, b)",
    [
        "if law is None: return None",
        "return Law(decisions[b], one_payments(payments, b), "
        + ", ".join(f"one_{name}(law.{name}, b)" for name in Law._fields[2:])
        + ")",
    ],
)
"""What institutions need in world b, without the axis B; shares memory. None without a law."""
stops_bite = _written(
    "stops_bite(law, i, cell, site, turn)",
    [*_limits("law.{name}.is_stopped[n] and {call}: return True"), "return False"],
)
note_bite = _written(
    "note_bite(law, i, cell, site, turn)",
    [
        *_limits("{call}: violate(law.ledger, i, {name}_COUNT, law.{name}.fine[n])"),
        *_calls("note_bite", "i, cell, site, turn"),
    ],
)
note_step = _each("note_step", "i, cell")
note_growth = _each("note_growth", "site")
settle = _each("settle", "turn, is_over")
begin = _each("begin")
refresh = _each("refresh", "stock")
open_turn = _each("open_turn", "turn, stock_share")
forbids = _written(
    "forbids(law, i, cell, site)", ["return " + " or ".join(_calls("forbids", "i, cell, site"))]
)
shown = _written(
    "shown(law, entry, i, turn)",
    [
        "module, what, argument = law.entries.module[entry], law.entries.what[entry], "
        "law.entries.argument[entry]",
        *(
            f"if module == {list(MODULES).index(call.partition('_shown')[0])}: return {call}"
            for call in _calls("shown", "what, argument, i, turn")
        ),
        "return 0.0",
    ],
)


def entries_shown(game: Any) -> list[tuple[str, int]]:
    """What the institutions of a game show agents, in their order, each with the number of which one."""
    entries: list[tuple[str, int]] = []
    seen = dict.fromkeys(KINDS, 0)
    for institution, ballot in numbered(game):
        for part in dict.fromkeys((institution, institution.rule)):
            if part.observed:
                entries += part.shows(number=seen[type(part)], ballot=ballot, agents=game.agents)
            seen[type(part)] += 1
    return entries


def parameters(game: Any) -> dict[str, dict[str, Any]]:
    """The parameters of a game's institutions, by the fields of `Law`."""
    modules = [module.__name__ for module in MODULES.values()]
    places = {
        entry: (modules.index(kind.__module__), what)
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
    """The law of B worlds of a game, in which nothing has happened and the first choice of each ballot is in
    force; without `decisions` and `payments`, which come with each turn."""
    given = game.law_parameters
    sizes = {"B": worlds, "N": game.agents, "C": len(COUNTS), "V": len(game.ballots)}
    kinds = Law.__annotations__
    parts = {name: filled(kinds[name], values, **sizes) for name, values in given.items()}
    ledger = filled(Ledger, {}, **sizes)
    ledger.in_force[:] = parts["votes"].choices[:, 0]
    return cast(Any, Law)(decisions=None, payments=None, ledger=ledger, **parts)


def check_institutions(game: Any) -> None:
    """Checks that the institutions of a game fit each other, its map, rules and observation."""
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
    """Whether agents of a game see where bites are forbidden."""
    return any(institution.shows_places and institution.observed for institution in game.institutions)
