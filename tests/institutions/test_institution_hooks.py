"""How institutions are put together: every rule of theirs is called, and none takes another's name."""

import sys
from types import FunctionType
from typing import Annotated, NamedTuple, get_args, get_type_hints

import permits
import pytest
from boards import Play

from cprl.commons import apples, loops, threads, world
from cprl.commons.rules import GROUP_ARRAYS
from cprl.institutions import Tax, hooks, ledger
from cprl.institutions.arrays import IN_STATE, InState, filled
from cprl.institutions.law import MODULES
from cprl.system.jit.compiled import PLAIN_RULES, RULES_VARIABLE
from cprl.values.array_types import Int32

GROUPS = [sys.modules[kind.__module__] for kind in GROUP_ARRAYS.values()]
TOGETHER = (world, *GROUPS, ledger, *MODULES.values(), permits)


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
    by_values = {"parameters", "_warn_of_less_than_an_apple", "_may_use"}
    assert idle <= by_values, "call it in institutions/hooks.py, or in commons/turn.py"


def claimed(module):
    """The names of arrays of the state and of entries shown to agents that the classes of a module claim."""
    for kind in vars(module).values():
        if isinstance(kind, type) and kind.__module__ == module.__name__:
            for name, hint in get_type_hints(kind, include_extras=True).items():
                if any(isinstance(mark, InState) for mark in get_args(hint)):
                    yield name
            yield from map("entry {}".format, getattr(kind, "entries", ()))


class Remembered(NamedTuple):
    times: int
    taken_step: Annotated[Int32, "B K times", IN_STATE]


def test_an_axis_may_have_the_length_of_a_number_beside_it():
    remembered = filled(Remembered, {"times": 4}, B=2, K=3)
    assert remembered.taken_step.shape == (2, 3, 4)


def test_no_two_modules_claim_a_name_of_the_state_or_of_an_entry_shown_to_agents():
    names = [name for module in TOGETHER for name in claimed(module)]
    assert {"taken", "heading", "counts", "entry quota left", "bought"} <= set(names)
    assert len(set(names)) == len(names)


def test_an_institution_that_sells_harvests_forbids_nothing(monkeypatch):
    sold = filled(permits.PermitArrays, {"price": [0.25]}, B=1, N=2)

    def note_harvest(law, i, cell, site, turn):
        hooks.note_harvest(law, i, cell, site, turn)
        permits.sell_permits(permits.PermitArrays(sold.price, sold.bought[0]), law.ledger, i)

    monkeypatch.setenv(RULES_VARIABLE, PLAIN_RULES)
    monkeypatch.setattr(threads, "RUN_CODE", {})
    monkeypatch.setattr(apples, "note_harvest", note_harvest)
    play = Play(">AA..\n...^.", institutions=[Tax(rate=0.0)])
    for harvest in (1.0, 1.0, 0.0):
        play.turn("forward", "stay")
        assert play.harvest == [harvest, 0.0]
        assert play.fines == [0.25 * harvest, 0.0]
        assert play.reward == [0.75 * harvest, 0.0]
        assert play.violated == [False, False]
    assert sold.bought[0].tolist() == [[2, 0]]
    assert not play.output.counts.any()
