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

from cprl.commands import play_stored
from cprl.commands.flags import with_help
from cprl.commands.recipe import (
    ALLOW,
    RunOptions,
    ended_by_sigterm,
    in_a_sentence,
    refuse_mistyped_flags,
    run_with,
    trust_allowed,
    wrapped,
)
from cprl.system.defaults import FILM_SEED
from cprl.system.output import OUT, printed, say
from cprl.system.process import obey_parent
from cprl.system.shipped import PROGRAM, is_shipped, recipe_named, run_shipped, shipped_recipes
from cprl.system.working import working
from cprl.values import meant

GROUPS: Final[Mapping[str, Mapping[str, str]]] = {
    "Train": {
        "run": "main:run",
        "recipe": "main:recipe",
        "sweep": "studies:sweep",
        "search": "studies:search",
    },
    "Look": {
        "watch": "main:watch",
        **{name: f"play_stored:{name}" for name in play_stored.LOOK},
    },
    "Measure": {
        **{name: f"play_stored:{name}" for name in play_stored.MEASURE},
        "export": "main:export",
    },
    "Compare": {
        "table": "table:table",
        **{name: f"play_stored:{name}" for name in play_stored.COMPARE},
    },
}
"""The functions of the commands, each in a module of this package, in the order in which `cprl --help` lists
them."""
COMMANDS: Final = {name: place for group in GROUPS.values() for name, place in group.items()}
"""Those of all groups. A command imports what it needs once its words are checked: torch takes seconds,
which a mistake need not."""

_OPTIONS: Final = RunOptions()
_TRIAL: Final[ContextVar[Path | None]] = ContextVar("trial", default=None)
"""--trial FILE of `cprl run` where a study started it, which is in no help: the run says there every second
how far it is, draws no figure, and ends with the process that has its standard input."""
_ARGS: Final = "\n\nArgs:"


def main() -> None:
    """Carry out the command line; what cannot be done is said in a line, and ends with exit code 1."""
    words = sys.argv[1:]
    if words == ["--version"]:
        from importlib.metadata import version

        say(f"cprl {version('cprl')}")
    elif not words or words[0] in ("-h", "--help"):
        _print_help()
        sys.exit(0)
    elif words[0] not in COMMANDS:
        hint = meant(words[0], COMMANDS)
        print(
            f"cprl: there is no command {words[0]!r}{hint}; allowed: {', '.join(COMMANDS)}", file=sys.stderr
        )
        sys.exit(2)
    elif words[0] in ("sweep", "search"):  # whose flags are those of a recipe
        with in_a_sentence(f"cprl {words[0]}"):
            _function(words[0])(words[1:])
    elif words[0] != "run" or not _is_run_by_name(words[1:]):
        with in_a_sentence("cprl"), ended_by_sigterm():
            function = _function(words[0])
            function = with_help(function) if {"-h", "--help"} & {*words} else function
            about = wrapped(f"{(getdoc(function) or '').partition(_ARGS)[0].strip()}\n\n{ALLOW}")
            config = (tyro.conf.HelptextFromCommentsOff, tyro.conf.DisallowNone)
            others = trust_allowed(words[1:])
            if words[0] == "run" and "--trial" in others[:-1]:
                place = others.index("--trial")
                _TRIAL.set(Path(others[place + 1]))
                del others[place : place + 2]
            tyro.cli(function, args=others, prog=f"cprl {words[0]}", description=about, config=config)


def _function(command: str) -> Callable[..., Any]:
    module, _, name = COMMANDS[command].partition(":")
    function: Callable[..., Any] = getattr(import_module(f"cprl.commands.{module}"), name)
    return function


def _print_help() -> None:
    lines = ["usage: cprl [-h] [--version] COMMAND ...", "", wrapped(__doc__ or "")]
    for group, names in GROUPS.items():
        lines += ["", f"{group}:"]
        for name in names:
            about = (getdoc(_function(name)) or "").partition("\n\n")[0]
            lines.append(wrapped(about, before=f"  {name:<10}  "))
    say("\n".join([*lines, "", "cprl COMMAND --help lists the flags of a command."]))


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
    """Run the recipe that words name, with its own flags, if they name one; refuse what is nothing at all."""
    if not words or words[0].startswith("-"):
        return False
    name = words[0]
    with in_a_sentence(f"{PROGRAM}{name}"):
        if not is_shipped(name):
            _refuse_unknown(Path(name))
            return False
        refuse_mistyped_flags(recipe_named(name), words[1:])
        with working("starting"):
            import_module("cprl.experiment")
        run_shipped(name, words[1:])
    return True


def _refuse_unknown(path: Path) -> None:
    """Refuse what is no file or directory and so was meant as the name of a recipe, and a Python file."""
    if path.suffix == ".py" and path.is_file():
        line = printed(["python", str(path)])
        raise ValueError(f"{path} is a recipe of your own, which Python runs: {line}")
    if path.exists():
        return
    name = path.as_posix()
    if name in shipped_recipes():
        raise ValueError(f"the name of a recipe stands first, its flags behind it: {PROGRAM}{name} [FLAGS]")
    raise ValueError(
        f"{name!r} is no file, no directory of a run and no recipe of cprl{meant(name, shipped_recipes())}; "
        "allowed: those that are there, and the recipes that cprl recipe lists"
    )


def recipe(name: str | None = None, /) -> None:
    """List the recipes that come with cprl, or print one to be copied: cprl recipe commons > mine.py.

    Args:
        name: The recipe that is printed.
    """
    if name is not None:
        OUT.write(recipe_named(name).text())
        OUT.flush()
        return
    recipes = [recipe for recipe in shipped_recipes().values() if recipe.runs]
    width = max(len(recipe.name) for recipe in recipes)
    for recipe in recipes:
        say(f"{recipe.name:<{width}}  {recipe.about}")


def watch(run: Path, /, *, serve: bool = False) -> None:
    """Open the recording of a run in the Rerun viewer, all files of it as one.

    Args:
        run: The run's directory, or a single .rrd file.
        serve: Serve it for browsers on 127.0.0.1 instead, until Ctrl-C, as without a display.
    """
    if run.is_file() and run.suffix != ".rrd":
        raise ValueError(f"{run} is no recording; allowed: a run's directory, or a file that ends in .rrd")
    from cprl.viewer.page import FILE_NAME, has_display, recordings_of, to_watch

    files = [run] if run.is_file() else recordings_of(run)
    if not files:
        raise ValueError(f"{run} holds no recording ({FILE_NAME}); recipes write one unless watch is off")
    if serve or not has_display():
        _serve(files, why="" if serve else "There is no display: ")
        return
    command = to_watch(*files)
    if sys.platform == "win32":  # where execvp ends this process at once, and quotes nothing
        sys.exit(subprocess.call(command))
    os.execvp(command[0], command)


def _serve(files: Sequence[Path], *, why: str) -> None:
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
    from cprl.evaluation.export import export_episodes

    export_episodes(run, out, format=format, episodes=episodes, replica=replica, seed=seed)
