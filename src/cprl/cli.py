"""The command `cprl`: what can be done with runs that are there. `cprl --version` prints its version."""

import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import tyro
from rich.table import Table

from cprl.commandline import in_a_sentence
from cprl.evaluation.cross_play import Diagonal
from cprl.evaluation.cross_play import crossplay as play_each_other
from cprl.evaluation.evaluate import SEED, evaluate_run
from cprl.evaluation.film import film as film_run
from cprl.evaluation.tables import agents_table, heading, matrices, run_table
from cprl.experiment import Experiment
from cprl.output import OUT, console, keep_output, say
from cprl.process import prepare_process
from cprl.reporting import write_report
from cprl.running import run as run_experiment
from cprl.runs.directory import read_recipe
from cprl.runs.export import export_results
from cprl.runs.labelled import refuse_to_write_over, write_table
from cprl.viewer.page import Page, has_display
from cprl.viewer.streams import viewer

Allow = tyro.conf.UseAppendAction[tuple[str, ...]]
"""--allow A --allow B."""


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
) -> None:
    """Trains the experiment of a recipe or of a run anew, or resumes a run that was stopped.

    Args:
        recipe: a recipe.json, or the directory of a run.
        out: the new run's directory; by default a new one under runs/, and with --resume the run itself.
        resume: resume the run, bit for bit as if it had not been stopped.
        episodes: instead of those of the recipe; with --resume more of them extend the run.
        take_over: resume a run that a process on another host has locked.
        keep_checkpoint: keep the state of the training of a finished run, so that it can be extended.
        watch: "file", or live as well: "serve", "spawn", "connect ADDRESS"; "off" for no recording.
        linger: keep the recording served after the run, until Ctrl-C; with --watch serve or spawn.
        allow: code of your own, module:Class, that the recipe may import; may be repeated.
    """
    _make_importable(allow)
    directory = recipe if recipe.is_dir() else recipe.parent
    experiment = Experiment.from_recipe(read_recipe(recipe), allow=allow, directory=directory)
    if resume and out is None:
        out = directory
    if episodes is not None:
        experiment = replace(experiment, episodes=episodes)
    done = run_experiment(
        experiment,
        out,
        resume=resume,
        take_over=take_over,
        keep_checkpoint=keep_checkpoint,
        watch=watch,
        linger=linger,
        allow=allow,
        command=sys.argv,
    )
    say(done)


def report(runs: tuple[Path, ...], /, *, out: Path = Path("report")) -> None:
    """Writes tables and figures of finished runs beside the published study.

    Args:
        runs: directories of runs, or of results.
        out: where to: tables.md and figures/.
    """
    if not runs:
        raise ValueError("cprl report wants at least one run: cprl report RUN...")
    prepare_process(SEED)
    say(write_report(runs, out))


def film(
    run: Path,
    /,
    *,
    replica: int = 0,
    episode: int = 0,
    out: Path | None = None,
    allow: Allow = (),
) -> None:
    """Lets the agents of a run play a fresh episode, and records every step for the Rerun viewer.

    Args:
        run: the run's directory, or its results.
        replica: whose agents.
        episode: which of the fresh episodes; the same number plays the same again.
        out: the recording; by default film-<replica>-<episode>.rrd in the run's directory.
        allow: code of your own, module:Class, that the run may import; see docs/changing.md.
    """
    _make_importable(allow)
    prepare_process(SEED)
    path, played = film_run(run, out, replica=replica, episode=episode, allow=allow)
    say(f"{played.steps} steps, {played.outcome}")
    say(f"Watch: {viewer()} {path}")


def watch(run: Path, /, *, serve: bool = False) -> None:
    """Opens the recording of a run in the Rerun viewer, all files of it as one.

    Args:
        run: the run's directory, or a single .rrd file.
        serve: serve it for browsers on 127.0.0.1 instead, until Ctrl-C, as without a display.
    """
    files = [run] if run.is_file() else sorted(run.glob("*.rrd"))
    if not files:
        raise ValueError(f"{run} holds no recording (*.rrd); recipes write one unless watch is off")
    if serve or not has_display():
        _serve(files, why="" if serve else "There is no display: ")
        return
    command = [viewer(), *map(str, files)]
    os.execvp(command[0], command)


def _serve(files: Sequence[Path], *, why: str) -> None:
    """Serves recordings and the web viewer until Ctrl-C."""
    page = Page(files)
    say(f"Watch (browser): {page.address()}")
    say(f"Watch (native): {viewer()} {' '.join(page.recordings)}")
    say(f"{why}served on 127.0.0.1 until Ctrl-C")
    with suppress(KeyboardInterrupt):
        while True:
            time.sleep(1)


def export(run: Path, folder: Path, /) -> None:
    """Copies what a report needs of a finished run, small enough to be committed.

    Args:
        run: the run's directory.
        folder: where to.
    """
    say(export_results(run, folder))


def evaluate(
    run: Path,
    /,
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: tuple[int, ...] = (),
    out: Path | None = None,
    allow: Allow = (),
) -> None:
    """Lets all replicas of a run play fresh worlds, and prints the social metrics beside the random policy's.

    Args:
        run: the run's directory, or its results; of one that has not ended the newest checkpoint plays.
        episodes: of each replica.
        greedy: whether agents play what they hold best, without exploring or drawing.
        seed: of the worlds and all chance; the same one gives the same numbers.
        replicas: their numbers; by default all.
        out: a parquet file to be, with every episode.
        allow: code of your own, module:Class, that the run may import; see docs/changing.md.
    """
    _make_importable(allow)
    if out is not None:
        refuse_to_write_over(out)
    prepare_process(seed)
    evaluation = evaluate_run(
        run, episodes=episodes, greedy=greedy, seed=seed, replicas=replicas, allow=allow
    )
    if out is not None:
        write_table(out, evaluation.table())
    _print(run_table(evaluation))
    say(f"Weights: {evaluation.run.weights_from}")
    if out is not None:
        say(f"Episodes: {out}")


def crossplay(
    runs: tuple[Path, ...],
    /,
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: tuple[int, ...] = (),
    diagonal: Diagonal = "self",
    out: Path | None = None,
    allow: Allow = (),
) -> None:
    """Lets agents of each run play among those of each other run, and prints how all fare.

    Args:
        runs: directories of runs of the same game, or their results.
        episodes: of each replica with each focal agent.
        greedy: whether agents play what they hold best, without exploring or drawing.
        seed: of the worlds and all chance; the same one gives the same numbers.
        replicas: their numbers; by default all that every run has.
        diagonal: whom a run's agents meet there: "self", those they were trained with, or "cross_seed", those
            of the run's next replica.
        out: a parquet file to be, with every episode.
        allow: code of your own, module:Class, that the run may import; see docs/changing.md.
    """
    _make_importable(allow)
    if out is not None:
        refuse_to_write_over(out)
    prepare_process(seed)
    played = play_each_other(
        runs, episodes=episodes, greedy=greedy, seed=seed, replicas=replicas, diagonal=diagonal, allow=allow
    )
    if out is not None:
        write_table(out, played.table())
    say(heading(played))
    _print(*matrices(played), agents_table(played))
    if out is not None:
        say(f"Episodes: {out}")


def _make_importable(allow: tuple[str, ...]) -> None:
    """Lets modules in the working directory be imported, as they are for a recipe that stands there."""
    if allow:
        sys.path.insert(0, os.getcwd())


def _print(*tables: Table) -> None:
    """Prints tables; into a file or pipe as wide as they are."""
    shown = console(width=None if OUT.isatty() else 250)
    for table in tables:
        shown.print(table)


def main() -> None:
    """The command line; what cannot be done is said in a line, and ends with exit code 1."""
    keep_output()
    if sys.argv[1:] == ["--version"]:
        say(f"cprl {version('cprl')}")
        return
    with in_a_sentence("cprl"):
        tyro.extras.subcommand_cli_from_dict(
            {
                "run": run,
                "watch": watch,
                "film": film,
                "report": report,
                "export": export,
                "evaluate": evaluate,
                "crossplay": crossplay,
            },
            description=__doc__,
        )
