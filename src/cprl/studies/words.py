"""Factors as words of a command line, e.g. "game.rules.freeze-steps=5,25,100".

Commas stand between values. A value of several numbers has "x" or spaces between them, or parentheses around
it: "32x32", "32 32" and "(32, 32)" are the same. What a word means is decided by the type of the field that
the path names: a number, True or False, None, a name, a board by its name.
"""

import re
from collections.abc import Iterable, Mapping
from math import isfinite
from types import NoneType, UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin

from cprl.checks import shown
from cprl.commons.maps import Map
from cprl.config import fits, type_text
from cprl.experiment import Experiment
from cprl.studies import factors
from cprl.studies.factors import Distribution, Factor, Integers
from cprl.studies.paths import normalised, types_at

DISTRIBUTIONS: Final[Mapping[str, Any]] = {name.lower(): kind for name, kind in factors.DISTRIBUTIONS.items()}
"""What draws values, by the word before its range: "loguniform(1e-5, 1e-3)"."""

_DRAWN: Final = re.compile(r"\s*([a-z_]+)\((.*)\)\s*", re.IGNORECASE)
_FORM: Final = "PATH=VALUE,VALUE..., e.g. game.rules.freeze-steps=5,25,100"
_INNER: Final = re.compile(r"[\s,]+|(?<=[\d.])\s*x\s*(?=[-+\d.])")
_BOOLS: Final = {"true": True, "false": False}


def factors_of(experiment: Experiment, words: Iterable[str]) -> dict[str, Factor]:
    """Factors for a `Study` of this experiment.

    Args:
        experiment: whose fields the paths name.
        words: "PATH=VALUES" each; values with commas between them, or a distribution with its range.

    Raises:
        ValueError: for a path that matches nothing or stands twice, and for values that the field cannot
            have or that a command line cannot say.
    """
    found: dict[str, Factor] = {}
    for word in words:
        path, equals, text = word.partition("=")
        if not equals or not path:
            raise ValueError(f"--vary is {shown(word)}; allowed: {_FORM}")
        path = normalised(path)
        if path in found:
            raise ValueError(f"--vary has {path} twice; allowed: once, with all its values")
        found[path] = _factor(experiment, path, text)
    return found


def _factor(experiment: Experiment, path: str, text: str) -> Factor:
    hints = types_at(experiment, path)
    drawn = _DRAWN.fullmatch(text)
    if drawn is not None and not any(fits(text, hint) for hint in hints):
        return _distribution(path, *drawn.groups())
    pieces = _pieces(text)
    if not pieces or not all(pieces):
        raise ValueError(f"the values at the path {path} are {shown(text)}; allowed: {_FORM}")
    return tuple(_value(piece, hints, path) for piece in pieces)


def _distribution(path: str, name: str, inside: str) -> Distribution:
    kind = DISTRIBUTIONS.get(name.lower().replace("_", ""))
    ends = [_scalar(end.strip(), int if kind is Integers else float) for end in inside.split(",")]
    if kind is None or len(ends) != 2 or _UNREAD in ends:
        allowed = ", ".join(f"{own}(LOW, HIGH)" for own in DISTRIBUTIONS)
        raise ValueError(
            f"at the path {path} is {name}({inside}); allowed: {allowed}, whole numbers for integers"
        )
    made: Distribution = kind(*ends)
    return made


def _value(text: str, hints: list[Any], path: str) -> Any:
    """A value that every place of the path can have."""
    for hint in hints:
        value = _read(text, hint)
        if value is not _UNREAD and all(own is Map or fits(value, own) for own in hints):
            return value
    kinds = [kind for hint in dict.fromkeys(hints) if (kind := _sayable(hint)) is not None]
    if not kinds:
        raise ValueError(
            f"the path {path} holds {type_text(hints[0])}, which a command line cannot say; allowed: paths "
            "of its fields, or a Study in Python"
        )
    raise ValueError(f"at the path {path} is {text!r}; allowed: {' and '.join(map(type_text, kinds))}")


_UNREAD: Final = object()


def _read(text: str, hint: Any) -> Any:
    """A text as a value of a type; `_UNREAD` for one that it cannot have."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        ordered = sorted(arguments, key=lambda own: own in (str, Any))
        return next((value for own in ordered if (value := _read(text, own)) is not _UNREAD), _UNREAD)
    if origin is Literal:
        return next((own for own in arguments if str(own) == text), _UNREAD)
    if origin is tuple:
        return _tuple(text, arguments)
    if hint is Any:
        return _read(text, None | bool | int | float | str)
    return text if hint is Map else _scalar(text, hint)


def _scalar(text: str, hint: Any) -> Any:
    if hint is str:
        return text
    if hint is NoneType:
        return None if text.lower() == "none" else _UNREAD
    if hint is bool:
        return _BOOLS.get(text.lower(), _UNREAD)
    if hint not in (int, float):
        return _UNREAD
    try:
        number = hint(text)
    except ValueError:
        return _UNREAD
    return number if isfinite(number) else _UNREAD


def _tuple(text: str, arguments: tuple[Any, ...]) -> Any:
    inside = text.removeprefix("(").removesuffix(")").strip(" ,")
    words = _INNER.split(inside) if inside else []
    if arguments[-1:] == (Ellipsis,):
        arguments = (arguments[0],) * len(words)
    if len(words) != len(arguments):
        return _UNREAD
    values = tuple(_read(word, hint) for word, hint in zip(words, arguments, strict=True))
    return _UNREAD if _UNREAD in values else values


def _sayable(hint: Any) -> Any:
    """The part of a type that words can be; None for nothing."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        kept = [own for argument in arguments if (own := _sayable(argument)) not in (None, NoneType)]
        if kept and NoneType in arguments:
            kept.append(NoneType)
        return Union[tuple(kept)] if kept else None  # noqa: UP007
    if origin is tuple:
        inner = [own for own in arguments if own is not Ellipsis]
        return (
            hint if inner and all(get_origin(own) is not tuple and _sayable(own) for own in inner) else None
        )
    return hint if hint in (bool, int, float, str, NoneType, Map, Any) or origin is Literal else None


def _pieces(text: str) -> list[str]:
    """The texts between commas that are in no parentheses."""
    pieces, depth = [""], 0
    for sign in text:
        depth += (sign == "(") - (sign == ")")
        if sign == "," and depth <= 0:
            pieces.append("")
        else:
            pieces[-1] += sign
    return [piece.strip() for piece in pieces]
