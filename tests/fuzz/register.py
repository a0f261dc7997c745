"""The register: a target for each public name. How most are drawn follows from their hints; see `drawn`."""

import builtins
import re
from dataclasses import MISSING, fields
from functools import cache
from typing import Any, Final

from hypothesis import strategies as st

from cprl.config import KINDS, from_config, to_config

from . import calling, cases, commands, drawn, formats, hostile, public, things
from .cases import Case, Target, called, calls, signature_of

MORE_OF_CHEAP: Final = 5
"""Constructors of plain values are tried so many times as often."""

REFUSALS: Final = (ValueError, MemoryError)


@cache
def targets() -> dict[str, Target]:
    """Every target by name: constructors, functions, file formats, commands."""
    found = [_target(name, value) for name, value in public.public_names().items()]
    return {own.name: own for own in (*found, *formats.targets(), *commands.targets())}


def _target(name: str, value: Any) -> Target:
    kind = cases.CONSTRUCTOR if isinstance(value, type) else cases.FUNCTION
    own = drawn.OWN.get(name, {})
    signature = signature_of(value, own)
    is_value = KINDS.get(value.__name__) is value or name == "cprl.experiment:Experiment"
    drawn_cases = dataclass_cases(value) if is_value else calls(signature)
    return Target(
        name=name,
        kind=kind,
        cases=drawn_cases,
        call=calling.CALLS.get(name) or called(value, signature),
        refusals=(*REFUSALS, *_documented(value), *((OSError,) if name in calling.OF_FILES else ())),
        after=calling.AFTER.get(name, _kept if is_value else None),
        weight=MORE_OF_CHEAP if is_value else 0 if name in calling.SLOW else 1,
        in_folder=name in calling.OF_FILES,
    )


def _documented(value: Any) -> tuple[type[BaseException], ...]:
    """The errors that a docstring names under "Raises:"."""
    _, _, raises = (value.__doc__ or "").partition("Raises:")
    names = re.findall(r"\b(?!KeyError|AttributeError|IndexError)\w+(?:Error|Exit)\b", raises)
    return tuple(getattr(builtins, name) for name in names if hasattr(builtins, name))


@st.composite
def dataclass_cases(draw: Any, kind: type) -> Case:
    """A valid value with 0 to 3 fields of other values, or one from scratch."""
    strategies = things.fields_of(kind)
    if draw(st.integers(0, 3)):
        example = draw(st.sampled_from(things.EXAMPLES[kind]))
        arguments = {name: getattr(example, name) for name in strategies}
        number = draw(st.sampled_from((0, 1, 1, 1, 2, 2, 3)))
        names = draw(st.lists(st.sampled_from(list(strategies)), min_size=number, max_size=number))
    else:
        required = {
            own.name for own in fields(kind) if own.default is MISSING and own.default_factory is MISSING
        }
        names = [name for name in strategies if name in required or draw(st.booleans())]
        arguments = {}
    for name in names:
        arguments[name] = draw(strategies[name] if draw(st.booleans()) else hostile.values())
    if draw(st.integers(0, 49)) == 0:
        arguments["nothing"] = draw(hostile.scalars())
        return Case(arguments, misfits=True)
    return Case(arguments)


def _kept(case: Case, value: Any) -> str | None:
    """A value that was accepted is kept by a recipe, and is the same when it comes back."""
    hash(value), repr(value)
    try:
        table = value.to_config() if hasattr(value, "engine") else to_config(value)
    except ValueError as error:
        return f"no recipe can keep it: {str(error)[:200]}"
    allow = [part["target"] for part in _tables(table) if part.get("kind") == "Custom"]
    read = type(value).from_config if hasattr(value, "engine") else from_config
    try:
        back = read(table, allow=allow)
    except ValueError as error:
        return f"its recipe is refused: {str(error)[:200]}"
    return None if back == value else f"comes back as {back!r:.300}"


def _tables(table: Any) -> list[dict[str, Any]]:
    if isinstance(table, dict):
        return [table, *(own for entry in table.values() for own in _tables(entry))]
    return [own for entry in table for own in _tables(entry)] if isinstance(table, list) else []
