"""Annotated types: whether a value is of one, and how one reads in a message."""

from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin


def fits(value: object, hint: Any) -> bool:
    """Whether a value is of an annotated type; whole numbers are numbers too, True and False are not."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if origin in (Union, UnionType):
        return any(fits(value, own) for own in arguments)
    if origin is Literal:
        return any(value == own and type(value) is type(own) for own in arguments)
    if origin is tuple:
        if not isinstance(value, tuple | list):
            return False
        if arguments[-1:] == (Ellipsis,):
            return all(fits(entry, arguments[0]) for entry in value)
        return len(value) == len(arguments) and all(map(fits, value, arguments))
    if hint is float:
        return isinstance(value, float | int) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, origin or hint)


def type_text(hint: Any) -> str:
    """A type in words, for messages."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join(map(type_text, arguments))
    if origin is Literal:
        return ", ".join(map(repr, arguments))
    if origin is tuple:
        inner = ", ".join("..." if own is Ellipsis else type_text(own) for own in arguments)
        return f"({inner})"
    words = {int: "a whole number", float: "a number", bool: "True or False", str: "a text", NoneType: "None"}
    return words.get(hint) or f"a {getattr(hint, '__name__', hint)}"
