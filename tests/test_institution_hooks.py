"""How institutions are put together: every rule of theirs is called, and none takes another's name."""

from types import FunctionType, ModuleType
from typing import Annotated, ClassVar, NamedTuple

import permits
import pytest
from boards import Play

from cprl.commons import apples, loops, threads, world
from cprl.commons.compiled import PLAIN, RULES_VARIABLE
from cprl.commons.rules import GROUPS
from cprl.institutions import Institution, Tax, hooks, ledger
from cprl.institutions.arrays import STATE, filled
from cprl.institutions.law import MODULES, check_names
from cprl.values.arrays import Int32

TOGETHER = (world, *GROUPS.values(), ledger, *MODULES.values())


def reached(function, found):
    """The functions that a rule calls, and those that they call."""
    for name in function.__code__.co_names:
        called = function.__globals__.get(name)
        if isinstance(called, FunctionType) and called not in found:
            found.add(called)
            reached(called, found)
    return found


@pytest.mark.parametrize("name", ["ledger", *MODULES])
def test_every_rule_of_an_institution_is_called_by_a_turn(name):
    module = MODULES.get(name, ledger)
    rules = {
        rule
        for rule in vars(module).values()
        if isinstance(rule, FunctionType) and rule.__module__ == module.__name__
    }
    idle = {rule.__name__ for rule in rules - reached(loops.run_worlds, set())}
    by_values = {"parameters", "_warn_of_less_than_an_apple"}
    assert idle <= by_values, "call it in institutions/hooks.py, or in commons/turn.py"


class Taken(NamedTuple):
    taken: Annotated[Int32, "B N", STATE]


class Heading(NamedTuple):
    heading: Annotated[Int32, "B N", STATE]


class Counts(NamedTuple):
    counts: Annotated[Int32, "B N", STATE]


class QuotaLeft(Institution, stored=False):
    entries: ClassVar[tuple[str, ...]] = ("quota left",)


@pytest.mark.parametrize(
    ("kind", "name", "owner"),
    [
        (Taken, "taken", "cprl.institutions.quotas.Arrays"),
        (Heading, "heading", "cprl.commons.world.Worlds"),
        (Counts, "counts", "cprl.institutions.ledger.Ledger"),
        (QuotaLeft, "quota left", "cprl.institutions.quotas.Quota"),
    ],
)
def test_a_name_that_another_module_has_is_refused_and_both_are_named(kind, name, owner, monkeypatch):
    module = ModuleType("newcomer")
    monkeypatch.setattr(kind, "__module__", "newcomer")
    setattr(module, kind.__name__, kind)
    with pytest.raises(ValueError, match=rf"{owner} and newcomer\.{kind.__name__} both have .*'{name}'"):
        check_names((*TOGETHER, module))


def test_an_institution_that_sells_harvests_forbids_nothing_and_claims_no_name_of_others(monkeypatch):
    check_names((*TOGETHER, permits))
    sold = filled(permits.Arrays, {"price": [0.25]}, B=1, N=2)

    def note_bite(law, i, cell, site, turn):
        hooks.note_bite(law, i, cell, site, turn)
        permits.sell_permits(permits.Arrays(sold.price, sold.bought[0]), law.ledger, i)

    monkeypatch.setenv(RULES_VARIABLE, PLAIN)
    monkeypatch.setattr(threads, "RUN", {})
    monkeypatch.setattr(apples, "note_bite", note_bite)
    play = Play(">AA..\n...^.", institutions=[Tax(rate=0.0)])
    for harvest in (1.0, 1.0, 0.0):
        play.turn("forward", "stay")
        assert play.harvest == [harvest, 0.0]
        assert play.fines == [0.25 * harvest, 0.0]
        assert play.reward == [0.75 * harvest, 0.0]
        assert play.violated == [False, False]
    assert sold.bought[0].tolist() == [[2, 0]]
    assert not play.output.counts.any()
