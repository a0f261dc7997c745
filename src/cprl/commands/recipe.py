"""recipe_main: the command line of a recipe, made of the experiment that it describes.

Its own arguments stand first; every number of the experiment can be changed by its place, e.g.
`--game.rules.freeze-steps 50 --agents.0.algorithm.settings.gamma 0.9`.
"""

import ast
import inspect
import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType, NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Final,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import tyro

from cprl.checks import checked, instance
from cprl.commons import maps
from cprl.commons.maps import Map
from cprl.custom import Custom
from cprl.runs.recipe import started_by
from cprl.system.output import RESUMES, say
from cprl.system.shipped import program_of

if TYPE_CHECKING:
    from cprl.experiment import Experiment

OptionsT = TypeVar("OptionsT")
Allow = tyro.conf.UseAppendAction[tuple[str, ...]]
"""--allow A --allow B."""

TAKES_NOTHING_OVER: Final = "--take-over is for runs that are there; allowed: with --resume"

_NOTE: Final = (
    "Every value of the experiment below can be changed by its place. Agents that equal one before are not "
    "listed; they have the same arguments by their own number. What is not listed cannot be changed on the "
    "command line, but in a copy of the recipe: the kind of an agent (Learning, Team, Scripted, Frozen), of "
    "its algorithm (DQN, PPO and so on), of its network and of what it wants; institutions that are not "
    "there, transforms, callbacks, drawn boards."
)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How an experiment is run; nothing of it changes a number."""

    out: Path | None = None
    """The run's directory; by default a new one under runs/."""
    resume: bool = False
    """Resume the run in `out`, which was stopped; bit for bit as if it had not been; with more episodes,
    extend it."""
    take_over: bool = False
    """Resume a run that a process on another host has locked."""
    keep_checkpoint: bool = True
    """Keep the state of the training of a finished run, buffers included, so that it can be extended."""
    watch: str = "file"
    """"file", or live as well: "serve", "spawn"; "off" for no recording."""
    linger: bool = False
    """Keep the recording served after the run is finished, until Ctrl-C; with watch "serve" or "spawn"."""
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A class of somebody's own that a frozen agent's run may import, "module:Class"; may be repeated."""


def recipe_main(
    make_experiment: "Callable[..., Experiment]",
    argv: Sequence[str] | None = None,
    *,
    at_end: Callable[[Path], object] | None = None,
) -> Path:
    """Runs the experiment of a recipe as the command line asks for it.

    Args:
        make_experiment: gives the experiment; its arguments become flags, so each has a type and a default,
            and a line under "Args:".
        argv: the command line, script first; by default that of this process.
        at_end: called with the directory of a run that has just finished, when all is written and said.

    Returns:
        The run's directory.

    Raises:
        ValueError: where `argv` is no list of texts.
        SystemExit: where the command line or an experiment is refused, with the reason; with code 130 or 143
            where SIGINT (Ctrl-C) or SIGTERM interrupted the run.
    """
    command = list(sys.argv if argv is None else argv)
    with in_a_sentence(program_of(command[0])):
        experiment, options = parse(make_experiment, command)
        if options.take_over and not options.resume:
            raise ValueError(TAKES_NOTHING_OVER)
    from cprl.training.running import run

    callbacks = [] if at_end is None else [_AtEnd(at_end)]
    with in_a_sentence(program_of(command[0])), started_by(command):
        return run(experiment, callbacks=callbacks, **vars(options))


@dataclass(frozen=True)
class _AtEnd:
    """A callback that calls a function with the directory of a run that has finished."""

    on_finished: Callable[[Path], object]


@contextmanager
def in_a_sentence(program: str) -> Iterator[None]:
    """Ends the process with a sentence and exit code 1 for what is refused, for files that cannot be written
    or read, and for a package that is not installed; with exit code 130 after Ctrl-C, and with 143 after a
    SIGTERM that something here turns into `SystemExit`. Any other error keeps its traceback, as a ValueError
    of a training that has begun does."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit) as error:
        notes = [note for note in getattr(error, "__notes__", []) if not note.startswith(RESUMES)]
        if isinstance(error, SystemExit) and not notes:
            raise
        say("\n".join([f"{program}: interrupted", *notes]))
        sys.exit(130 if isinstance(error, KeyboardInterrupt) else error.code)
    except (ValueError, OSError, MemoryError, ModuleNotFoundError) as error:
        notes = getattr(error, "__notes__", [])
        if notes and not isinstance(error, OSError | MemoryError):
            from cprl.training.finite import NotFiniteError  # which the training that has begun has imported

            if not isinstance(error, NotFiniteError):
                raise
        if isinstance(error, BrokenPipeError) and not notes:  # `--help | head`: its reader has seen enough
            sys.exit(0)
        sys.exit("\n".join([_shortened(f"{program}: {error}"), *notes]))


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Ends the block at SIGTERM as Ctrl-C does, so that no half of a file stays, by `SystemExit` with 143."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    if current_thread() is not main_thread():  # which alone gets signals
        yield
        return
    usual = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, usual)


def _shortened(text: str) -> str:
    """A message without its middle where it is longer than a screen, e.g. because it names a file."""
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"


def parse(
    make_experiment: "Callable[..., Experiment]", command: Sequence[str]
) -> "tuple[Experiment, RunOptions]":
    """The experiment that a command line, script first, asks for, and how it is to be run.

    Raises:
        SystemExit: for `--help`, and for an argument that is unknown or of another type.
    """
    return parse_with(make_experiment, command[1:], _OPTIONS, program=program_of(command[0]))


def parse_with(
    make_experiment: "Callable[..., Experiment]",
    words: Sequence[str],
    options: OptionsT,
    *,
    program: str,
    note: str = "",
) -> "tuple[Experiment, OptionsT]":
    """Like `parse`, with options of another kind.

    Args:
        make_experiment: gives the experiment.
        words: what stands after the program.
        options: a dataclass whose fields become flags, with their values as defaults.
        program: what stands before these words, for messages.
        note: what `--help` says after the recipe's own text.
    """
    from cprl.experiment import Experiment

    given = list(words)
    _check_names(make_experiment, options)
    made, _ = tyro.cli(
        make_experiment, args=given, prog=program, return_unknown_args=True, add_help=False, config=_CONFIG
    )
    checked("what the recipe makes", made, instance(Experiment, "an Experiment"))
    kind, default = flags_of(made, all_agents=not {"-h", "--help"} & set(given))
    options_kind: Any = type(options)

    def read(
        own: Annotated[Any, tyro.conf.arg(name="", constructor=make_experiment)],
        options: Annotated[options_kind, tyro.conf.arg(name="")] = options,
        experiment: Annotated[kind, tyro.conf.arg(name="")] = default,  # type: ignore[valid-type]
    ) -> tuple[Any, Any]:
        return experiment, options

    flags, read_options = tyro.cli(
        read, args=given, prog=program, description=_description(make_experiment, note), config=_CONFIG
    )
    experiment: Experiment = applied(made, flags)
    return experiment, read_options


_LONGEST: Final = 1500
_OPTIONS: Final = RunOptions()
_CONFIG: Final = (tyro.conf.HelptextFromCommentsOff,)


def _check_names(make_experiment: "Callable[..., Experiment]", options: Any) -> None:
    from cprl.experiment import Experiment

    taken = {
        *Experiment.__dataclass_fields__,
        *RunOptions.__dataclass_fields__,
        *options.__dataclass_fields__,
        "runs",  # the directory of a study's runs, which no recipe.json and no line that resumes keeps
    }
    for name in inspect.signature(make_experiment).parameters:
        if name in taken:
            raise ValueError(
                f"the recipe has an argument {name!r} of its own, which every experiment has on the command "
                "line; allowed: another name"
            )


def _description(make_experiment: "Callable[..., Experiment]", note: str) -> str:
    text = (inspect.getdoc(make_experiment) or "").partition("\nArgs:")[0].strip()
    return "\n\n".join(filter(None, [text, note, " ".join(_NOTE.split())]))


def make_importable(allow: tuple[str, ...]) -> None:
    """Lets modules in the working directory be imported, as they are for a recipe that stands there."""
    if allow:
        sys.path.insert(0, os.getcwd())


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
    """A value with what the flags of `flags_of` say."""
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
    from cprl.values import fits  # which needs torch, as flags do and mistakes do not

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
