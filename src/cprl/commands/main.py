"""The command `cprl`: train agents by recipes; watch, measure and compare stored runs."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import replace
from importlib import import_module
from inspect import getdoc
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import tyro

from cprl.commands.flags import with_help
from cprl.commands.recipe_command import (
    ALLOW,
    RunOptions,
    ended_by_sigterm,
    exit_with_message,
    refuse_mistyped_flags,
    run_with,
    trust_allowed,
    wrap_paragraphs,
)
from cprl.system.defaults import FILM_SEED
from cprl.system.output import OUT, quote_command, say
from cprl.system.process import obey_parent
from cprl.system.shipped import PROGRAM, is_shipped, recipe_named, run_shipped, shipped_recipes
from cprl.system.waiting_room import experimental
from cprl.system.working import working
from cprl.values import did_you_mean

_GROUPS: Final[Mapping[str, Mapping[str, str]]] = {
    "Train": {
        "run": "main",
        "recipe": "main",
        "sweep": "studies",
    },
    "Look": {
        "watch": "main",
        "film": "play_stored",
        "show": "play_stored",
        "report": "play_stored",
        "play": "play_stored",
        "host": "host_command",
        "sandbox": "sandbox_command",
    },
    "Measure": {
        "evaluate": "play_stored",
        "scenarios": "play_stored",
        "export": "main",
    },
    "Compare": {
        "table": "table_command",
        "crossplay": "play_stored",
    },
}
"""The commands in the order in which `cprl --help` lists them, each with the module of this package that has
a function of that name."""
_EXPERIMENTAL: Final = dict.fromkeys(
    ("egta", "exploit", "schelling", "search", "visits"), "experimental_commands"
)
"""The commands that may change, each with its module, too."""
_MODULES: Final = {
    name: module for group in (*_GROUPS.values(), _EXPERIMENTAL) for name, module in group.items()
}
COMMANDS: Final = tuple(_MODULES)
"""The names of all commands. A command imports torch, which takes seconds, after its words are checked."""

_OPTIONS: Final = RunOptions()
_TRIAL: Final[ContextVar[Path | None]] = ContextVar("trial", default=None)
"""The file of `cprl run --trial FILE`, a flag that no help lists: it means that a study started this process.
The run then writes its status to the file every second, draws no figure, and ends if the study's process
dies."""
_ARGS: Final = "\n\nArgs:"


def main() -> None:
    """Run the command of the command line; errors become a message and an exit code."""
    words = sys.argv[1:]
    if words == ["--version"]:
        from importlib.metadata import version

        say(f"cprl {version('cprl')}")
    elif not words or words[0] in ("-h", "--help"):
        _print_help()
        sys.exit(0)
    elif words[0] not in COMMANDS:
        hint = did_you_mean(words[0], COMMANDS)
        print(
            f"cprl: there is no command {words[0]!r}{hint}; allowed: {', '.join(COMMANDS)}", file=sys.stderr
        )
        sys.exit(2)
    elif words[0] in ("sweep", "search"):  # whose flags are those of a recipe
        with exit_with_message(f"cprl {words[0]}"):
            _function(words[0])(words[1:])
    elif words[0] != "run" or not _is_run_by_name(words[1:]):
        with exit_with_message("cprl"), ended_by_sigterm():
            _call_with_flags(words[0], words[1:])


def _call_with_flags(command: str, words: Sequence[str]) -> None:
    """Call the function of a command with the flags that tyro reads from the words."""
    function = _function(command)
    if {"-h", "--help"} & {*words}:
        function = with_help(function)
    text = (getdoc(function) or "").partition(_ARGS)[0].strip()
    flags = trust_allowed(words)
    if command == "run" and "--trial" in flags[:-1]:
        index = flags.index("--trial")
        _TRIAL.set(Path(flags[index + 1]))
        del flags[index : index + 2]
    tyro.cli(
        function,
        args=flags,
        prog=f"cprl {command}",
        description=wrap_paragraphs(f"{text}\n\n{ALLOW}"),
        config=(tyro.conf.HelptextFromCommentsOff, tyro.conf.DisallowNone),
    )


def _function(command: str) -> Callable[..., Any]:
    """Import and return the function of a command."""
    function: Callable[..., Any] = getattr(import_module(f"cprl.commands.{_MODULES[command]}"), command)
    return function


def _print_help() -> None:
    """Print the commands by their groups, each with the first paragraph of its docstring."""
    lines = ["usage: cprl [-h] [--version] COMMAND ...", "", wrap_paragraphs(__doc__ or "")]
    for group, names in _GROUPS.items():
        lines += ["", f"{group}:"]
        for name in names:
            about = (getdoc(_function(name)) or "").partition("\n\n")[0]
            lines.append(wrap_paragraphs(about, before=f"  {name:<10}  "))
    others = f"Experimental, and may change: {', '.join(_EXPERIMENTAL)}."
    say(
        "\n".join(
            [*lines, "", wrap_paragraphs(others), "", "cprl COMMAND --help lists the flags of a command."]
        )
    )


def run(
    recipe: Path,
    /,
    *,
    options: Annotated[RunOptions, tyro.conf.arg(name="")] = _OPTIONS,
    episodes: int | None = None,
    steps: int | None = None,
) -> None:
    """Train the experiment of a recipe or of a run anew, or resume a run that was stopped.

    A recipe that comes with cprl is run by its name, followed by its own flags: cprl run commons --episodes
    200; cprl run commons --help lists them, and cprl recipe lists the names. What follows is for the others.

    Args:
        recipe: A recipe.json, or the directory of a run.
        options: --out is with --resume the run itself.
        episodes: How many, instead of the recipe's number; with --resume more of them extend the run.
        steps: How many, of a recipe that trains so many steps.
    """
    trial = _TRIAL.get()
    if trial is not None:
        obey_parent()
    _refuse_unknown(recipe)
    from cprl.runs.recipe import read_recipe

    directory = recipe if recipe.is_dir() else recipe.parent
    table = read_recipe(recipe)

    with working("starting"):
        from cprl.experiment import Experiment

    experiment = Experiment.from_recipe(table, directory=directory)
    if options.resume and options.out is None:
        options = replace(options, out=directory)
    if episodes is not None or steps is not None:
        experiment = replace(experiment, episodes=episodes, steps=steps)
    if trial is None:
        say(run_with(experiment, options, command=sys.argv))
        return
    from cprl.studies.status import process_of_trial
    from cprl.training.running import run as run_experiment

    with process_of_trial(trial, experiment) as callback:
        say(run_experiment(experiment, **vars(options), callbacks=(callback,), figures=False))


def _is_run_by_name(words: Sequence[str]) -> bool:
    """Run the recipe whose name comes first, and return whether there is one.

    Words that name neither a recipe nor a file or directory are refused.
    """
    if not words or words[0].startswith("-"):
        return False
    name = words[0]
    with exit_with_message(f"{PROGRAM}{name}"):
        if not is_shipped(name):
            _refuse_unknown(Path(name))
            return False
        refuse_mistyped_flags(recipe_named(name), words[1:])
        with working("starting"):
            import_module("cprl.experiment")
        run_shipped(name, words[1:])
    return True


def _refuse_unknown(path: Path) -> None:
    """Refuse a path that does not exist, which may be a mistyped name of a recipe, and a Python file."""
    if path.suffix == ".py" and path.is_file():
        line = quote_command(["python", str(path)])
        raise ValueError(f"{path} is a recipe of your own, which Python runs: {line}")
    if path.exists():
        return
    name = path.as_posix()
    if name in shipped_recipes():
        raise ValueError(f"the name of a recipe stands first, its flags behind it: {PROGRAM}{name} [FLAGS]")
    raise ValueError(
        f"{name!r} is no file, no directory of a run and no recipe of cprl"
        f"{did_you_mean(name, shipped_recipes())}; allowed: those that are there, and the recipes that "
        "cprl recipe lists"
    )


def recipe(name: str | None = None, /) -> None:
    """List the recipes that come with cprl, or print one to be copied: cprl recipe commons > mine.py.

    Args:
        name: The recipe that is printed.
    """
    if name is not None:
        OUT.write(recipe_named(name).portable_source())
        OUT.flush()
        return
    recipes = [recipe for recipe in shipped_recipes().values() if recipe.is_runnable]
    width = max(len(recipe.name) for recipe in recipes)
    for recipe in recipes:
        say(f"{recipe.name:<{width}}  {recipe.summary}")


def watch(run: Path, /, *, serve: bool = False) -> None:
    """Open the recording of a run in the Rerun viewer, all files of it as one.

    Args:
        run: The run's directory, or a single .rrd file.
        serve: Serve it for browsers on 127.0.0.1 instead, until Ctrl-C, as without a display.
    """
    if run.is_file() and run.suffix != ".rrd":
        raise ValueError(f"{run} is no recording; allowed: a run's directory, or a file that ends in .rrd")
    from cprl.viewer.page import RECORDING_FILE, has_display, recordings_of, to_watch

    files = [run] if run.is_file() else recordings_of(run)
    if not files:
        raise ValueError(
            f"{run} holds no recording ({RECORDING_FILE}); recipes write one unless watch is off"
        )
    if serve or not has_display():
        why = "" if serve else "There is no display: "
        _serve(files, why=why)
        return
    command = to_watch(*files)
    if sys.platform == "win32":  # where execvp ends this process at once, and quotes nothing
        sys.exit(subprocess.call(command))
    os.execvp(command[0], command)


def _serve(files: Sequence[Path], *, why: str) -> None:
    """Serve recordings for browsers until Ctrl-C."""
    from cprl.viewer.live import served

    with suppress(KeyboardInterrupt), served(files) as page:
        say(f"Watch (browser): {page.addresses['browser']}")
        say(f"Watch (native): {page.addresses['native']}")
        say(f"{why}served on 127.0.0.1 until Ctrl-C")
        while True:
            time.sleep(1)


def export(
    run: Path,
    out: Path,
    /,
    *,
    weights: bool = True,
    format: Literal["results", "csv", "minari"] = "results",
    episodes: int = 20,
    replica: int = 0,
    seed: int = FILM_SEED,
) -> None:
    """Copy what a report needs of a finished run, small enough to be committed, or play fresh episodes of its
    agents and write them for other programs.

    Args:
        run: The run's directory.
        out: The folder of the results, the file of "csv", or the directory of the Minari data sets.
        weights: Copy the trained weights too. Without them a report tells of the training alone, and nothing
            can play the agents.
        format: "results"; "csv", a row for each episode, turn and agent, with what it did and got and where
            it stands; or "minari", a data set for each agent, of the extra "minari".
        episodes: Of "csv" and "minari": fresh episodes that are played.
        replica: Of "csv" and "minari": whose agents play.
        seed: Of "csv" and "minari": of the worlds and all chance, see cprl film; not that of the training.
    """
    from cprl.runs.recipe import read_recipe

    read_recipe(run)
    if format == "results":
        fresh = {"episodes": (episodes, 20), "replica": (replica, 0), "seed": (seed, FILM_SEED)}
        for name, (value, default) in fresh.items():
            if value != default:
                raise ValueError(f"--{name} is of fresh episodes; allowed: with --format csv or minari")
        from cprl.runs.export import export_results

        say(export_results(run, out, weights=weights))
        return
    if not weights:
        raise ValueError(f"--no-weights is of results; allowed: without --format {format}")
    export_turns = experimental("export_turns.export_turns")
    export_turns(run, out, format=format, episodes=episodes, replica=replica, seed=seed)
