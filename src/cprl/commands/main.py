"""The command `cprl`: what can be done with runs that are there. `cprl --version` prints its version."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import tyro

from cprl.arguments import PLAY_SEED
from cprl.commands.play_stored import (
    check_runs,
    crossplay,
    egta,
    evaluate,
    exploit,
    film,
    scenarios,
    schelling,
    visits,
)
from cprl.commands.recipe import TAKES_NOTHING_OVER, Allow, ended_by_sigterm, in_a_sentence, make_importable
from cprl.commands.recipes import recipe as print_recipe
from cprl.commands.recipes import refuse_unknown, run_by_name
from cprl.commands.studies import runs_table, search, sweep
from cprl.presets import Variant, check_board
from cprl.runs.recipe import read_recipe, started_by
from cprl.system.output import printed, say
from cprl.system.process import obey_parent, prepare_process
from cprl.viewer.page import Page, has_display, headers_of

# Commands import what they need once their words are checked: torch takes seconds, which a mistake need not.


def run(
    recipe: Path,
    /,
    *,
    out: Path | None = None,
    resume: bool = False,
    episodes: int | None = None,
    take_over: bool = False,
    keep_checkpoint: bool = True,
    watch: str = "file",
    linger: bool = False,
    allow: Allow = (),
    trial: Path | None = None,
) -> None:
    """Trains the experiment of a recipe or of a run anew, or resumes a run that was stopped.

    A recipe that comes with cprl is run by its name, followed by its own flags: cprl run commons --episodes
    200; cprl run commons --help lists them, and cprl recipe lists the names. What follows is for the others.

    Args:
        recipe: a recipe.json, or the directory of a run.
        out: the new run's directory; by default a new one under runs/, and with --resume the run itself.
        resume: resume the run, bit for bit as if it had not been stopped.
        episodes: instead of those of the recipe; with --resume more of them extend the run.
        take_over: resume a run that a process on another host has locked.
        keep_checkpoint: keep the state of the training of a finished run, so that it can be extended.
        watch: "file", or live as well: "serve", "spawn"; "off" for no recording.
        linger: keep the recording served after the run, until Ctrl-C; with --watch serve or spawn.
        allow: code of your own, module:Class, that the recipe may import; may be repeated.
        trial: the file in which the run says every second how far it is, where a study started it: it draws
            no figure and ends with the process that has its standard input.
    """
    if trial is not None:
        obey_parent()
    refuse_unknown(recipe)
    if take_over and not resume:
        raise ValueError(TAKES_NOTHING_OVER)
    make_importable(allow)
    directory, kept = recipe if recipe.is_dir() else recipe.parent, read_recipe(recipe)

    from cprl.experiment import Experiment
    from cprl.training.running import run as run_experiment

    experiment = Experiment.from_recipe(kept, allow=allow, directory=directory)
    if resume and out is None:
        out = directory
    if episodes is not None:
        experiment = replace(experiment, episodes=episodes)
    with ExitStack() as stack:
        callbacks: tuple[object, ...] = ()
        if trial is None:
            stack.enter_context(started_by(sys.argv))
        else:
            from cprl.studies.status import process_of_trial

            callbacks = (stack.enter_context(process_of_trial(trial, experiment)),)
        done = run_experiment(
            experiment,
            out,
            resume=resume,
            take_over=take_over,
            keep_checkpoint=keep_checkpoint,
            watch=watch,
            linger=linger,
            allow=allow,
            callbacks=callbacks,
            figures=trial is None,
        )
    say(done)


def play(
    board: str,
    /,
    *,
    agent: int = 0,
    others: str | None = None,
    replica: int = 0,
    variant: Variant = "published",
    steps: int | None = None,
    seed: int = PLAY_SEED,
    decision: int | None = None,
    allow: Allow = (),
) -> None:
    """Lets you play in the terminal among trained or scripted agents, and measures the episode.

    Args:
        board: commons, two_complex, single_complex or single_basic; or the directory of a run, whose game it
            is then; or a file with a drawing.
        agent: yours.
        others: the directory of a run, whose agents play, or random, greedy, sustainable, territorial,
            aggressive or pacifist; by default the agents of the run that is the board, else greedy.
        replica: of the run whose agents play.
        variant: of the boards with a name: published, as_run or, of two_complex, as_run_10_april; see
            docs/game.md.
        steps: turns of the episode at most; by default those of the game.
        seed: of all chance; the same seed and the same keys play the same again.
        decision: what you vote for in a game with votes or elections, by its number; by default chance votes.
        allow: code of your own, module:Class, that a run may import; see docs/experiments.md.
    """
    make_importable(allow)
    check_board(board)

    from cprl.evaluation.play import open_session, play_in_terminal

    prepare_process(seed)
    session = open_session(
        board,
        agent=agent,
        others=others,
        replica=replica,
        variant=variant,
        steps=steps,
        seed=seed,
        decision=decision,
        allow=allow,
    )
    play_in_terminal(session)


def watch(run: Path, /, *, serve: bool = False) -> None:
    """Opens the recording of a run in the Rerun viewer, all files of it as one.

    Args:
        run: the run's directory, or a single .rrd file.
        serve: serve it for browsers on 127.0.0.1 instead, until Ctrl-C, as without a display.
    """
    if run.is_file() and run.suffix != ".rrd":
        raise ValueError(f"{run} is no recording; allowed: a run's directory, or a file that ends in .rrd")
    files = [run] if run.is_file() else sorted(run.glob("*.rrd"))
    if not files:
        raise ValueError(f"{run} holds no recording (*.rrd); recipes write one unless watch is off")
    if serve or not has_display():
        _serve(files, why="" if serve else "There is no display: ")
        return

    from cprl.viewer.page import to_watch

    command = to_watch(*files)
    if sys.platform == "win32":  # where execvp ends this process at once, and quotes nothing
        sys.exit(subprocess.call(command))
    os.execvp(command[0], command)


def _serve(files: Sequence[Path], *, why: str) -> None:
    """Serves recordings and the web viewer until Ctrl-C."""
    from cprl.viewer.page import viewer

    with TemporaryDirectory() as folder, suppress(KeyboardInterrupt):
        page = Page([*headers_of(files, Path(folder)), *files])
        say(f"Watch (browser): {page.address()}")
        say(f"Watch (native): {printed([viewer(), *page.recordings])}")
        say(f"{why}served on 127.0.0.1 until Ctrl-C")
        while True:
            time.sleep(1)


def export(run: Path, folder: Path, /, *, weights: bool = True) -> None:
    """Copies what a report needs of a finished run, small enough to be committed.

    Args:
        folder: where to.
        weights: also the trained weights. Without them a report tells of the training alone, and nothing can
            play the agents.
    """
    check_runs(run)

    from cprl.runs.export import export_results

    say(export_results(run, folder, weights=weights))


COMMANDS: Final[Mapping[str, Callable[..., None]]] = {
    "run": run,
    "recipe": print_recipe,
    "watch": watch,
    "film": film,
    "play": play,
    "export": export,
    "evaluate": evaluate,
    "visits": visits,
    "crossplay": crossplay,
    "schelling": schelling,
    "egta": egta,
    "scenarios": scenarios,
    "exploit": exploit,
    "sweep": sweep,
    "search": search,
    "table": runs_table,
}
"""The subcommands, in the order in which `cprl --help` lists them."""


def main() -> None:
    """The command line; what cannot be done is said in a line, and ends with exit code 1."""
    if sys.argv[1:] == ["--version"]:
        say(f"cprl {version('cprl')}")
        return
    if sys.argv[1:2] in (["sweep"], ["search"]):
        with in_a_sentence(f"cprl {sys.argv[1]}"):
            {"sweep": sweep, "search": search}[sys.argv[1]](sys.argv[2:])
        return
    if run_by_name():
        return
    with in_a_sentence("cprl"), ended_by_sigterm():
        tyro.extras.subcommand_cli_from_dict(dict(COMMANDS), description=__doc__)
