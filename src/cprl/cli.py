"""The command `cprl`: what can be done with runs that are there."""

import os
import sys
from pathlib import Path

import tyro

from cprl.recording.bank import keep_results
from cprl.recording.report import write_report
from cprl.recording.streams import viewer
from cprl.replay import replay as play_again


def report(runs: tuple[Path, ...], /, *, out: Path = Path("report")) -> None:
    """Writes tables and figures of finished runs beside the published study.

    Args:
        runs: directories of runs, or of results.
        out: where to: tables.md and figures/.
    """
    if not runs:
        raise ValueError("cprl report wants at least one run: cprl report RUN...")
    print(write_report(runs, out))


def replay(run: Path, /, *, replica: int = 0, episode: int = 0, out: Path | None = None) -> None:
    """Lets the agents of a run play a fresh episode, and records every step for the Rerun viewer.

    Args:
        run: the run's directory, or its results.
        replica: whose agents.
        episode: which of the fresh episodes; the same number plays the same again.
        out: the recording; by default replay-<replica>-<episode>.rrd in the run's directory.
    """
    path, played = play_again(run, out, replica=replica, episode=episode)
    harvests = ", ".join(f"{apples:.0f}" for apples in played.harvest)
    print(f"{played.steps} steps, apples: {harvests}; {played.stock_left} left")
    print(f"Watch: {viewer()} {path}")


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
    print(keep_results(run, folder))


def main() -> None:
    """The command line; what cannot be done is said in a line, and ends with exit code 1."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            {"watch": watch, "replay": replay, "report": report, "keep": keep}, description=__doc__
        )
    except (ValueError, OSError) as error:
        sys.exit(f"cprl: {error}")
