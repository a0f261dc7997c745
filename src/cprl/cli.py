"""The command `cprl`: what can be done with runs that are there."""

import os
import sys
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from cprl.evaluation.cross_play import Diagonal
from cprl.evaluation.cross_play import crossplay as play_each_other
from cprl.evaluation.evaluate import SEED, evaluate_run
from cprl.evaluation.film import replay as play_again
from cprl.evaluation.tables import heading, matrices, run_table, seats_table
from cprl.process import prepare_process
from cprl.reporting import write_report
from cprl.runs.export import export_results
from cprl.runs.labelled import refuse_to_write_over, write_table
from cprl.viewer.streams import viewer


def report(runs: tuple[Path, ...], /, *, out: Path = Path("report")) -> None:
    """Writes tables and figures of finished runs beside the published study.

    Args:
        runs: directories of runs, or of results.
        out: where to: tables.md and figures/.
    """
    if not runs:
        raise ValueError("cprl report wants at least one run: cprl report RUN...")
    prepare_process(SEED)
    print(write_report(runs, out))


def replay(run: Path, /, *, replica: int = 0, episode: int = 0, out: Path | None = None) -> None:
    """Lets the agents of a run play a fresh episode, and records every step for the Rerun viewer.

    Args:
        run: the run's directory, or its results.
        replica: whose agents.
        episode: which of the fresh episodes; the same number plays the same again.
        out: the recording; by default replay-<replica>-<episode>.rrd in the run's directory.
    """
    prepare_process(SEED)
    path, played = play_again(run, out, replica=replica, episode=episode)
    harvests = ", ".join(f"{apples:.0f}" for apples in played.harvest)
    print(f"{played.steps} steps, apples: {harvests}; {played.stock_left} left")
    print(f"ViewerCallback: {viewer()} {path}")


def watch(run: Path, /) -> None:
    """Opens the recording of a run in the Rerun viewer, all files of it as one.

    Args:
        run: the run's directory, or a single .rrd file.
    """
    files = [run] if run.is_file() else sorted(run.glob("*.rrd"))
    if not files:
        raise ValueError(f"{run} holds no recording (*.rrd); recipes write one unless watch is off")
    command = [viewer(), *map(str, files)]
    os.execvp(command[0], command)


def keep(run: Path, folder: Path, /) -> None:
    """Copies what a report needs of a finished run, small enough to be committed.

    Args:
        run: the run's directory.
        folder: where to.
    """
    print(export_results(run, folder))


def evaluate(
    run: Path,
    /,
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: tuple[int, ...] = (),
    out: Path | None = None,
) -> None:
    """Lets all replicas of a run play fresh worlds, and tells the social metrics beside the random policy's.

    Args:
        run: the run's directory, or its results; of one that has not ended the newest checkpoint plays.
        episodes: of each replica.
        greedy: whether agents play what they hold best, without exploring or drawing.
        seed: of the worlds and all chance; the same one gives the same numbers.
        replicas: their numbers; by default all.
        out: a parquet file to be, with every episode.
    """
    if out is not None:
        refuse_to_write_over(out)
    prepare_process(seed)
    evaluation = evaluate_run(run, episodes=episodes, greedy=greedy, seed=seed, replicas=replicas)
    if out is not None:
        write_table(out, evaluation.table())
    _tell(run_table(evaluation))
    print(f"Weights: {evaluation.run.weights_from}")
    if out is not None:
        print(f"Episodes: {out}")


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
) -> None:
    """AgentPolicies each run's agents among each other run's, one visitor at a time, and tells how all fare.

    Args:
        runs: directories of runs of the same game, or their results.
        episodes: of each replica with the visitor at each seat.
        greedy: whether agents play what they hold best, without exploring or drawing.
        seed: of the worlds and all chance; the same one gives the same numbers.
        replicas: their numbers; by default all that every run has.
        diagonal: whom a run's agents meet there: "self", those they were trained with, or "strangers", those
            of the run's next replica.
        out: a parquet file to be, with every episode.
    """
    if out is not None:
        refuse_to_write_over(out)
    prepare_process(seed)
    played = play_each_other(
        runs, episodes=episodes, greedy=greedy, seed=seed, replicas=replicas, diagonal=diagonal
    )
    if out is not None:
        write_table(out, played.table())
    print(heading(played))
    _tell(*matrices(played), seats_table(played))
    if out is not None:
        print(f"Episodes: {out}")


def _tell(*tables: Table) -> None:
    """Prints tables; into a file or pipe as wide as they are."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=250)
    for table in tables:
        console.print(table)


def main() -> None:
    """The command line; what cannot be done is said in a line, and ends with exit code 1."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            {
                "watch": watch,
                "replay": replay,
                "report": report,
                "keep": keep,
                "evaluate": evaluate,
                "crossplay": crossplay,
            },
            description=__doc__,
        )
    except (ValueError, OSError) as error:
        sys.exit(f"cprl: {error}")
