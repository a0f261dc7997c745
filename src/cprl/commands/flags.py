"""Values as flags of a command line, for tyro: each field of a dataclass by its place, and back.

tyro makes flags of a dataclass by its types alone. What is made here is made of a value: of each field the
type that a command line can say, with the value as default; a field that it cannot say is left out.
"""

import ast
import inspect
import re
import textwrap
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from cprl.commons import maps
from cprl.commons.maps import Map
from cprl.config import fits
from cprl.custom import Custom

_DRAWN: Final = "as drawn"
_BOARD: Final = "A board by its name; where agents start and apples grow."
_SCALARS: Final = (bool, int, float, str, NoneType)


def flags_type(name: str, of_fields: list[tuple[str, Any, Any]]) -> type[Any]:
    """A dataclass of fields, each with its type and default."""
    return make_dataclass(
        name,
        [(own, hint, field(default=default)) for own, hint, default in of_fields],
        frozen=True,
        kw_only=True,
    )


def flags_of(value: Any, *, all_agents: bool = True) -> tuple[Any, Any]:
    """The type of a dataclass of the flags of a dataclass, and its default, which says the same.

    Args:
        value: the dataclass.
        all_agents: whether values of a tuple that equal one before have flags; for `--help` they have none.
    """
    kind, help_of = type(value), docs(type(value))
    hints, of_fields = get_type_hints(kind), []
    for own in fields(value):
        held = getattr(value, own.name)
        flag = _flag(held, hints[own.name], all_agents) if own.init else None
        if flag is not None:
            text = _BOARD if isinstance(held, Map) else help_of.get(own.name, " ")
            nested = is_dataclass(flag[1]) or _are_dataclasses(flag[1])
            hint: Any = flag[0] if nested else Annotated[flag[0], tyro.conf.arg(help=text)]
            of_fields.append((own.name, hint, flag[1]))
    made = flags_type(kind.__name__, of_fields)
    return made, made()


def applied(value: Any, flags: Any) -> Any:
    """A value with what the flags of `flags_of` say.

    Raises:
        ValueError: where it refuses what they say.
    """
    if isinstance(value, Map):
        return value if flags == _DRAWN else maps.named(flags)
    if _are_dataclasses(flags):
        return tuple(applied(own, flag) for own, flag in zip(value, flags, strict=True))
    if not is_dataclass(flags):
        return flags
    new: dict[str, Any] = {
        own.name: applied(getattr(value, own.name), getattr(flags, own.name)) for own in fields(flags)
    }
    changes = {name: own for name, own in new.items() if own != getattr(value, name)}
    return replace(value, **changes) if changes else value


def docs(kind: type[Any]) -> dict[str, str]:
    """What each field of a dataclass is, in a sentence: the text below it, or its line under "Args:"."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not is_dataclass(base):
            continue
        arguments = (inspect.getdoc(base) or "").partition("\nArgs:\n")[2].partition("\n\n")[0]
        found |= {name: _sentence(text) for name, text in _ARGS.findall(arguments)}
        try:
            (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError, ValueError, SyntaxError):
            continue  # of a class that was made without source
        assert isinstance(tree, ast.ClassDef)
        for own, below in zip(tree.body, tree.body[1:], strict=False):
            if isinstance(own, ast.AnnAssign) and isinstance(own.target, ast.Name):
                text = below.value if isinstance(below, ast.Expr) else None
                if isinstance(text, ast.Constant) and isinstance(text.value, str):
                    found[own.target.id] = _sentence(text.value)
    return found


_ARGS: Final = re.compile(r"^    (\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)
_SENTENCE_ENDS: Final = re.compile(r"(?<!e\.g)(?<!et al)[.](?= [^a-z0-9]|$)")


def _sentence(text: str) -> str:
    return _SENTENCE_ENDS.split(" ".join(text.split()), maxsplit=1)[0]


def _flag(value: Any, hint: Any, all_agents: bool) -> tuple[Any, Any] | None:
    """The type of a field's flags and their default; None where a command line cannot say it."""
    if isinstance(value, Custom):
        return None
    if isinstance(value, Map):
        names = [name for name in maps.NAMES if maps.named(name) == value]
        default = names[0] if names else _DRAWN
        return Literal[tuple(dict.fromkeys([default, *maps.NAMES]))], default
    if is_dataclass(value):
        return flags_of(value, all_agents=all_agents)
    if _are_dataclasses(value):
        return _flags_of_all(value, all_agents)
    simple = _simple(hint)
    return None if simple in (None, NoneType) or not fits(value, simple) else (simple, value)


def _flags_of_all(values: tuple[Any, ...], all_agents: bool) -> tuple[Any, Any] | None:
    """Flags of each value by its number."""
    if any(isinstance(value, Custom) for value in values):
        return None
    kinds, defaults = [], []
    for place, value in enumerate(values):
        listed = all_agents or value not in values[:place]
        made, default = flags_of(value, all_agents=all_agents) if listed else (_Same, _Same())
        kinds.append(made)
        defaults.append(default)
    return tuple[tuple(kinds)], tuple(defaults)  # type: ignore[misc]


def _are_dataclasses(value: Any) -> bool:
    return isinstance(value, tuple) and bool(value) and all(map(is_dataclass, value))


@dataclass(frozen=True)
class _Same:
    """In place of the flags of a value that equals one before."""


def _simple(hint: Any) -> Any:
    """What a command line can say of a type: without nested tuples, tables and objects; None for nothing."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in _SCALARS or origin is Literal:
        return hint
    if origin in (Union, UnionType):
        kept = [simple for own in arguments if (simple := _simple(own)) is not None]
        return Union[tuple(kept)] if kept else None  # noqa: UP007
    if origin is tuple:
        inner = [own if own is Ellipsis else _simple(own) for own in arguments]
        flat = all(own is not None and get_origin(own) is not tuple for own in inner)
        return tuple[tuple(inner)] if flat else None  # type: ignore[misc]
    return None
