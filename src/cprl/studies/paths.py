"""Places of values in an experiment, as texts, e.g. "agents.*.algorithm.settings.gamma".

A name is a field of a dataclass or an argument of a `Custom`, a number a place in a tuple.
`*` stands for each value of a tuple; in `agents` for each agent that learns.
Words may be written with "-", as flags are.
"""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from typing import Any, Final, get_args, get_origin, get_type_hints

from cprl.arguments import refusal
from cprl.checks import shown
from cprl.commons import maps
from cprl.commons.maps import Map
from cprl.config import fits, type_text
from cprl.custom import Custom
from cprl.experiment import Experiment
from cprl.population import Learning, Team

ALL: Final = "*"
_SELF: Final = object()


def normalised(path: object) -> str:
    """A path as it is kept, without "-"; raises a ValueError for what is no path."""
    if not isinstance(path, str) or not path or not all(path.split(".")):
        raise refusal("path", path, 'names with dots between them, e.g. "game.rules.freeze_steps"')
    return path.replace("-", "_")


def changed(experiment: Experiment, changes: Mapping[str, Any]) -> Experiment:
    """An experiment with other values in some places, all of them changed at once.

    A path within a value that is changed too applies to the new value, and one with a number after one
    with `*`.

    Args:
        experiment: as it is.
        changes: the new values by path; lists become tuples, and a board may be given by its name.

    Raises:
        ValueError: for a path that matches nothing, a value of another type, and for whatever the experiment
            refuses; names the path.
    """
    tree: dict[Any, Any] = {}
    for path, value in changes.items():
        node = tree
        for name in normalised(path).split("."):
            node = node.setdefault(name, {})
        node[_SELF] = value
    try:
        made: Experiment = _applied(experiment, tree, ())
    except ValueError as error:
        if "path" in str(error):
            raise
        raise ValueError(f"with {', '.join(changes)}: {error}") from error
    return made


def values_at(experiment: Experiment, path: str) -> list[Any]:
    """The values in the places that a path names, at least one.

    Raises:
        ValueError: for a path that matches nothing.
    """
    return [value for value, _ in _found(experiment, normalised(path).split("."), (), Experiment)]


def types_at(experiment: Experiment, path: str) -> list[Any]:
    """The annotated types of the places that a path names; see `values_at`."""
    return [hint for _, hint in _found(experiment, normalised(path).split("."), (), Experiment)]


def _found(value: Any, left: list[str], at: tuple[str, ...], hint: Any) -> Iterator[tuple[Any, Any]]:
    if not left:
        yield value, hint
        return
    for name in _names(value, left[0], at):
        yield from _found(_child(value, name), left[1:], (*at, name), _hint(value, name, hint))


def _applied(value: Any, tree: Mapping[Any, Any], at: tuple[str, ...]) -> Any:
    """A value with the changes of a tree; see `changed`."""
    new: dict[str, Any] = {}
    for name in sorted((own for own in tree if own is not _SELF), key=lambda own: own != ALL):
        for place in _names(value, name, at):
            old = new.get(place, _child(value, place))
            node, where = tree[name], (*at, place)
            if _SELF in node:
                old = _fitting(node[_SELF], _hint(value, place, None), where)
            new[place] = _applied(old, node, where)
    return _with(value, new) if new else value


def _names(value: Any, name: str, at: tuple[str, ...]) -> list[str]:
    """The children that a word of a path names, at least one."""
    children = _children(value)
    where = ".".join(at) or "the experiment"
    if name == ALL and isinstance(value, tuple):
        named = [
            own for own in children if at != ("agents",) or isinstance(_child(value, own), Learning | Team)
        ]
        if named:
            return named
        raise ValueError(
            f"the path {'.'.join((*at, name))} matches nothing: {where} has no agent that learns"
        )
    if name in children:
        return [name]
    close = get_close_matches(name, children, n=1)
    meant = f" (did you mean {close[0]!r}?)" if close else ""
    has = f"{where} has {', '.join(children)}" if children else f"{where} is {shown(value)}"
    raise ValueError(f"the path {'.'.join((*at, name))} matches nothing{meant}; {has}")


def _children(value: Any) -> list[str]:
    if isinstance(value, Custom):
        return ["target", "arguments"]
    if isinstance(value, Mapping):
        return [str(own) for own in value]
    if isinstance(value, tuple):
        return list(map(str, range(len(value))))
    return [own.name for own in fields(value) if own.init] if is_dataclass(value) else []


def _child(value: Any, name: str) -> Any:
    if isinstance(value, Mapping):
        return value[name]
    return value[int(name)] if isinstance(value, tuple) else getattr(value, name)


def _hint(value: Any, name: str, own: Any) -> Any:
    """The annotated type of a child; `Any` where nothing says it."""
    if is_dataclass(value):
        return get_type_hints(type(value))[name]
    if isinstance(value, tuple):
        kinds = get_args(own) if get_origin(own) is tuple else ()
        if kinds[1:] == (Ellipsis,):
            return kinds[0]
        return kinds[int(name)] if len(kinds) == len(value) else Any
    return Any


def _with(value: Any, new: Mapping[str, Any]) -> Any:
    if isinstance(value, tuple):
        return tuple(new.get(str(place), own) for place, own in enumerate(value))
    if isinstance(value, Mapping):
        return {**value, **new}
    return replace(value, **new)


def _fitting(value: Any, hint: Any, at: tuple[str, ...]) -> Any:
    """A value as a place of this type has it."""
    found = _as_tuples(value)
    if hint is Map and isinstance(found, str):
        try:
            return maps.named(found)
        except ValueError as error:
            raise ValueError(f"at the path {'.'.join(at)}: {error}") from error
    if not fits(found, hint):
        raise ValueError(f"at the path {'.'.join(at)} is {shown(value)}; allowed: {type_text(hint)}")
    return found


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple) else value
