"""One call of a target: its arguments, and how they are drawn."""

import inspect
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, get_type_hints

from hypothesis import strategies as st

from . import hostile
from .hints import of_hint

CONSTRUCTOR, FUNCTION, FILE, COMMAND = "constructor", "function", "file format", "command"

_SHORT: Final = reprlib.Repr()
_SHORT.maxstring, _SHORT.maxother, _SHORT.maxlevel = 80, 120, 4


@dataclass
class Case:
    """The arguments of a call."""

    arguments: dict[str, Any]
    misfits: bool = False
    """Whether an argument is missing, or one is there that the signature does not have."""

    def shown(self) -> str:
        """The arguments in short."""
        return ", ".join(f"{name}={_shown(value)}" for name, value in self.arguments.items())


def _shown(value: Any) -> str:
    try:
        return _SHORT.repr(value)[:300]
    except Exception as error:
        return f"<{type(value).__name__}, whose repr raises {type(error).__name__}>"


@dataclass(frozen=True, kw_only=True)
class Target:
    """Something public, and how it is called."""

    name: str
    kind: str
    cases: st.SearchStrategy[Case]
    call: Callable[[Case], Any]
    refusals: tuple[type[BaseException], ...]
    """Beside TypeError for arguments that the signature does not have."""
    after: Callable[[Case, Any], str | None] | None = None
    """What is wrong with an accepted case; None for nothing."""
    weight: int = 1
    """How many times as many cases as the least are run; 0 for slow ones, which the default tests leave
    out."""
    is_command: bool = False
    in_folder: bool = False
    """Whether each case is run in an empty folder of its own."""


@dataclass(frozen=True, kw_only=True)
class Signature:
    """The parameters of a callable: how each is drawn, and which may be left out."""

    valid: dict[str, st.SearchStrategy[Any]] = field(default_factory=dict)
    required: frozenset[str] = frozenset()
    positional: tuple[str, ...] = ()
    variadic: str | None = None


def signature_of(function: Any, given: Mapping[str, st.SearchStrategy[Any]]) -> Signature:
    """The signature of a class or function; `given` says how some parameters are drawn, the others follow
    from their hints."""
    of = function.__init__ if inspect.isclass(function) else function
    try:
        hints = get_type_hints(of)
    except Exception:
        hints = {}
    valid, required, positional, variadic = {}, set(), [], None
    for name, own in inspect.signature(of).parameters.items():
        if name == "self":
            continue
        if own.kind is own.VAR_POSITIONAL:
            variadic = name
        elif own.kind is own.VAR_KEYWORD:
            continue
        valid[name] = given[name] if name in given else of_hint(hints.get(name, Any))
        if own.default is own.empty:
            required.add(name)
        if own.kind is own.POSITIONAL_ONLY:
            positional.append(name)
    return Signature(
        valid=valid,
        required=frozenset(required),
        positional=tuple(positional),
        variadic=variadic,
    )


@st.composite
def calls(draw: Any, signature: Signature) -> Case:
    """Calls with valid arguments, of which up to 2 are replaced by hostile ones; few misfit the signature."""
    arguments = {
        name: draw(own)
        for name, own in signature.valid.items()
        if name in signature.required or draw(st.integers(0, 2)) == 0
    }
    if signature.valid:
        for _ in range(draw(st.sampled_from((0, 0, 0, 1, 1, 1, 1, 2)))):
            name = draw(st.sampled_from(list(signature.valid)))
            arguments[name] = draw(hostile.values())
    misfit = draw(st.integers(0, 49))
    if misfit == 0:
        arguments[draw(st.sampled_from(("nothing", "size", "Seed")))] = draw(hostile.scalars())
    elif misfit == 1 and signature.required:
        arguments.pop(draw(st.sampled_from(sorted(signature.required))), None)
    misfits = not signature.required <= arguments.keys() or not arguments.keys() <= signature.valid.keys()
    return Case(arguments, misfits)


def called(function: Any, signature: Signature) -> Callable[[Case], Any]:
    """Calls a class or function with the arguments of a case."""

    def call(case: Case) -> Any:
        arguments = dict(case.arguments)
        positional = [arguments.pop(name) for name in signature.positional if name in arguments]
        if signature.variadic and signature.variadic in arguments:
            more = arguments.pop(signature.variadic)
            positional += more if isinstance(more, list | tuple) else [more]
        return function(*positional, **arguments)

    return call
