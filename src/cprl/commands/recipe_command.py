"""recipe_main: the command line of a recipe, made of the experiment that it describes.

Its own arguments stand first; every number of the experiment can be changed by its place, e.g.
`--game.rules.freeze-steps 50 --agents.0.algorithm.settings.gamma 0.9`.
"""

import ast
import inspect
import re
import shutil
import signal
import sys
import textwrap
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import tyro

from cprl.commands.flags import RefusedError, Shape, ValueFlags, in_shape, shape_of, with_groups, with_numbers
from cprl.runs.length import UNITS, without_length
from cprl.system.output import RESUME_PREFIX, legible, say
from cprl.system.process import on_signals
from cprl.system.shipped import Recipe, program_name
from cprl.system.working import working
from cprl.values import did_you_mean, refusal, trust

if TYPE_CHECKING:
    from cprl.experiment import Experiment

OptionsT = TypeVar("OptionsT")
Words = tyro.conf.UseAppendAction[tuple[str, ...]]
"""A flag that may be repeated: `--vary A --vary B`."""
ALLOW: Final = (
    "Code of your own: --allow module:Class trusts what a stored run or a recipe.json names, see "
    "docs/experiments.md; it may be repeated."
)

_LISTED: Final = (
    *("out", "resume", "watch", "episodes", "steps", "replicas", "worlds", "seed"),
    *("map", "agents", "institutions"),
    *("game.rules.episode_steps", "game.rules.freeze_steps"),
    *("agents.0.policy", "agents.0.algorithm.settings.learning_rate", "agents.0.algorithm.settings.gamma"),
)
"""The flags that `--help` lists: those that people change most."""
_SHORT_NOTE: Final = (
    "More: --help-all lists all flags, as every number of the experiment can be changed by its place."
)
_NOTE: Final = (
    "Every value of the experiment below can be changed by its place. Agents that equal one before are not "
    "listed; they have the same arguments by their own number. What is not listed cannot be changed on the "
    "command line, but in a copy of the recipe: the kind of an agent (Learning, Scripted and so on), of its "
    "algorithm (DQN, PPO and so on), of its network and of what it wants; transforms, callbacks, drawn "
    "boards. A group of rules that is None is made by a flag of its fields, e.g. "
    "--game.rules.random-end.prob 0.15."
)
_HELP: Final = {"-h", "--help", "--help-all", "--help_all"}
_CONFIG: Final = (tyro.conf.HelptextFromCommentsOff,)
_LONGEST: Final = 1500
_UNSHAPED: Final = Shape()


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of a run. None of them changes a number."""

    out: Path | None = None
    """The run's directory; by default a new one under runs/."""
    resume: bool = False
    """Resume the run in `out`, which was stopped; bit for bit as if it had not been; with more episodes,
    extend it."""
    take_over: bool = False
    """Resume a run that a process on another host has locked."""
    keep_checkpoint: bool = False
    """Keep the state of the training of a finished run, hundreds of megabytes, so that it can be extended."""
    watch: str = "file"
    """"file", or live as well: "serve", "spawn"; "off" for no recording."""
    threads: int = 1
    """Torch's threads. Several are faster for large minibatches of many worlds, where no other program wants
    the cores, and a hundred times slower where one does; numbers then differ in their last bits."""
    linger: bool = False
    """Keep the recording served after the run is finished, until Ctrl-C; with watch "serve" or "spawn"."""

    def __post_init__(self) -> None:
        if self.take_over and not self.resume:
            raise ValueError("--take-over is for runs that are there; allowed: with --resume")


def recipe_main(
    make_experiment: "Callable[..., Experiment]",
    argv: Sequence[str] | None = None,
    *,
    at_end: Callable[[Path], object] | None = None,
) -> Path:
    """Run the experiment of a recipe as the command line asks for it.

    Args:
        make_experiment: returns the experiment. Its arguments become flags, so each needs a type, a default
            and a line under "Args:" in the docstring.
        argv: the command line, beginning with the script; by default that of this process.
        at_end: called with the run's directory when the run has finished and everything is written.

    Returns:
        The run's directory.

    Raises:
        SystemExit: if the command line or the experiment is refused, with the reason; with code 130 or 143
            if SIGINT (Ctrl-C) or SIGTERM interrupted the run.
    """
    command = list(sys.argv if argv is None else argv)
    with exit_with_message(program_name(command[0])):
        experiment, options = parse_command(make_experiment, command)
        callbacks = [] if at_end is None else [SimpleNamespace(on_finished=at_end)]
        return run_with(experiment, options, command=command, callbacks=callbacks)


def run_with(
    experiment: "Experiment", options: RunOptions, *, command: Sequence[str], callbacks: Sequence[object] = ()
) -> Path:
    """Run an experiment with the options of a command line, which the run's recipe stores."""
    from cprl.runs.recipe import started_by
    from cprl.training.running import run

    with started_by(command):
        return run(experiment, callbacks=callbacks, **vars(options))


@contextmanager
def exit_with_message(program: str) -> Iterator[None]:
    """Turn the errors that users can mend into a message and an exit code, without a traceback.

    The exit code is 1 for refused values, for files that cannot be read or written, and for packages that
    are not installed. It is 130 after Ctrl-C, and 143 after SIGTERM. All other errors keep their traceback,
    and so does a ValueError of a training that has begun.

    Args:
        program: the name of the program, with which the message begins.
    """
    try:
        yield
    except (KeyboardInterrupt, SystemExit) as error:
        notes = [note for note in getattr(error, "__notes__", []) if not note.startswith(RESUME_PREFIX)]
        if isinstance(error, SystemExit) and not notes:
            raise
        say("\n".join([f"{program}: interrupted", *notes]))
        code = 130 if isinstance(error, KeyboardInterrupt) else error.code
        sys.exit(code)
    except (ValueError, OSError, MemoryError, ModuleNotFoundError) as error:
        notes = getattr(error, "__notes__", [])
        if notes and not isinstance(error, OSError | MemoryError):
            # The training that has begun has imported it.
            from cprl.training.nan_check import NotFiniteError

            if not isinstance(error, NotFiniteError):
                raise
        if isinstance(error, BrokenPipeError) and not notes:  # `--help | head`: its reader has seen enough
            sys.exit(0)
        text = re.sub(r"^Fresh\.", "--", str(error))  # whose fields are flags
        sys.exit(legible("\n".join([_without_middle(f"{program}: {text}"), *notes])))


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Let SIGTERM end the block by `SystemExit` with code 143, so that no half-written file stays."""

    def stop(number: int) -> None:
        raise SystemExit(128 + number)

    with on_signals(stop, signal.SIGTERM):
        yield


def _without_middle(text: str) -> str:
    """Return a message, without its middle if it is longer than a screen."""
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"


def parse_command(
    make_experiment: "Callable[..., Experiment]", command: Sequence[str]
) -> "tuple[Experiment, RunOptions]":
    """Parse the command line of a recipe, beginning with the script: the experiment, and how to run it."""
    words = trust_allowed(command[1:])
    program = program_name(command[0])
    return parse_with(make_experiment, words, RunOptions(), program=program)


def parse_with(
    make_experiment: "Callable[..., Experiment]",
    words: Sequence[str],
    options: OptionsT,
    *,
    program: str,
    note: str = "",
) -> "tuple[Experiment, OptionsT]":
    """Parse words as `parse_command` does, with options of any dataclass.

    Args:
        make_experiment: returns the experiment of the recipe.
        words: the words after the program.
        options: a dataclass with the defaults of the options, whose fields become flags.
        program: the program, for messages.
        note: a text that `--help` shows after the recipe's own text.
    """
    with working("starting"):
        from cprl.experiment import Experiment

    _refuse_names(make_experiment, {*Experiment.__dataclass_fields__, *vars(options)})
    is_help = bool(_HELP & {*words})
    is_short = bool({"-h", "--help"} & {*words})
    settings = [word for word in words if word not in _HELP]
    recipe: Any = Annotated[Any, tyro.conf.arg(name="", constructor=make_experiment)]

    def first(
        experiment: recipe, shape: Annotated[Shape, tyro.conf.arg(name="")] = _UNSHAPED
    ) -> tuple[Any, Shape]:
        return experiment, shape

    (experiment, shape), _ = tyro.cli(
        first, args=settings, prog=program, return_unknown_args=True, add_help=False, config=_CONFIG
    )
    if not isinstance(experiment, Experiment):
        raise refusal("what the recipe makes", experiment, "an Experiment")
    start = with_groups(_counted_in(in_shape(experiment, shape), settings), settings)
    shaped = shape_of(start)

    def read(
        unchanged: recipe,
        options: Annotated[Any, tyro.conf.arg(name="")] = options,
        shape: Annotated[Shape, tyro.conf.arg(name="")] = shaped,
        experiment: Annotated[Experiment, tyro.conf.arg(name="")] = start,
    ) -> tuple[Experiment, Any]:
        return experiment, options

    notes = [_about(make_experiment), note, _SHORT_NOTE if is_short else _NOTE, ALLOW]
    listed = None
    if is_short:
        listed = _LISTED if isinstance(options, RunOptions) else (*_LISTED, *vars(options))
    flags = ValueFlags(listed, is_help=is_help)
    try:
        return tyro.cli(
            read,
            args=[*with_numbers(settings, start), *(["--help"] if is_help else [])],
            prog=program,
            description=wrap_paragraphs("\n\n".join(filter(None, notes))),
            config=_CONFIG,
            registry=flags,
        )
    except RefusedError as error:
        raise ValueError(str(error)) from error.__cause__


def _counted_in(experiment: "Experiment", words: Sequence[str]) -> "Experiment":
    """Return the experiment with its length in the unit of the flag --episodes or --steps, if one is given.

    The number is only a placeholder, which the flag replaces.
    """
    names = {word.partition("=")[0] for word in words}
    said = [unit for unit in UNITS if f"--{unit}" in names]
    if len(said) != 1 or said[0] == experiment.length.unit:
        return experiment
    length: Any = {**without_length({}), said[0]: 1}
    return replace(experiment, **length)


def _refuse_names(make_experiment: "Callable[..., Experiment]", taken: set[str]) -> None:
    # "runs" is the directory of a study's runs, which no recipe.json and no line that resumes keeps.
    """Refuse arguments of a recipe that have the name of a flag of every experiment."""
    taken = {*taken, *RunOptions.__dataclass_fields__, "runs"}
    for name in inspect.signature(make_experiment).parameters:
        if name in taken:
            raise ValueError(
                f"the recipe has an argument {name!r} of its own, which every experiment has on the command "
                "line; allowed: another name"
            )


def wrap_paragraphs(text: str, *, before: str = "") -> str:
    """Wrap the paragraphs of a text at the width of the terminal.

    All lines of a paragraph but the first are indented, since tyro would join them otherwise.

    Args:
        before: a text before the first line; the other lines are indented by its width.
    """
    width = shutil.get_terminal_size().columns
    indent = " " * (len(before) or 2)
    paragraphs = [" ".join(part.split()) for part in text.split("\n\n")]
    return "\n\n".join(
        textwrap.fill(part, width, initial_indent=before, subsequent_indent=indent) for part in paragraphs
    )


def _about(make_experiment: "Callable[..., Experiment]") -> str:
    return (inspect.getdoc(make_experiment) or "").partition("\nArgs:")[0].strip()


def refuse_mistyped_flags(recipe: Recipe, words: Sequence[str]) -> None:
    """End the process with exit code 2 if a flag is mistyped, before importing torch takes seconds.

    Flags with dots are fields of the experiment, which needs torch. `parse_command` refuses those.
    """
    names = _names_of(recipe)
    if names is None:
        return
    for word in words:
        name = word.partition("=")[0].replace("_", "-")
        if name.startswith("--") and "." not in name and name not in names:
            print(
                f"cprl run {recipe.name}: there is no flag {name}{did_you_mean(name, sorted(names))}; "
                f"cprl run {recipe.name} --help-all lists all",
                file=sys.stderr,
            )
            sys.exit(2)


def _names_of(recipe: Recipe) -> set[str] | None:
    """Return the flags without dots of a recipe; None if the recipe does not call `recipe_main`.

    They are read from the source texts of the recipe and of `Experiment`, since importing these would import
    torch.
    """
    tree = ast.parse(recipe.path.read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and node.args]
    makers = [ast.unparse(call.args[0]) for call in calls if ast.unparse(call.func).endswith("recipe_main")]
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    experiment = find_spec("cprl.experiment.experiment")
    if not makers or makers[0] not in functions or experiment is None or experiment.origin is None:
        return None
    arguments = functions[makers[0]].args
    names = {argument.arg for argument in (*arguments.args, *arguments.kwonlyargs)}
    for node in ast.parse(Path(experiment.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef) and node.name == "Experiment":
            names |= {ast.unparse(line.target) for line in node.body if isinstance(line, ast.AnnAssign)}
    names |= {*RunOptions.__dataclass_fields__, "allow"}
    names -= {"game", "transforms", "callbacks"}  # whose places alone, or nothing, a word can say
    flags = {f"--{name.replace('_', '-')}" for name in names}
    return {*flags, *(f"--no-{flag.removeprefix('--')}" for flag in flags), *_HELP}


def trust_allowed(words: Sequence[str]) -> list[str]:
    """Trust the code that `--allow` names on a command line, and return the other words.

    The working directory becomes importable, since the code may be there.
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--allow", action="append", default=[])
    options, others = parser.parse_known_args(words)
    if options.allow:
        trust(*options.allow)
        sys.path.insert(0, str(Path.cwd()))
    return others
