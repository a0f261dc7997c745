"""How do runs of ours compare with the published study? Tables in Markdown, and figures as PNG.

    python recipes/study/report.py docs/results/single_basic docs/results/single_complex --out report

It needs only exported results (`cprl.runs.export`), so that anyone can reproduce it. Runs that repeat none of
the study's experiments have tables of their own, without columns for what was published.

The modules of the report, in the order in which one reads them:
    published     the published numbers and curves
    results       the files of runs; runs of one experiment as one
    measures      of a training, and of trained agents at play
    random_play   of a game, over 10,000 episodes
    verdicts      when a number, a curve or a claim is contradicted
    returns       appendix A beside ours
    curves        published curves beside ours
    phases        the phases of a training
    tragedies     tragedy and combat, replica by replica
    possible      what share of the possible runs got; planner and yield_bounds say what is possible
    claims        the study's claims on its five experiments
    published_figures   a metric of a run beside the published curve
    page          sections and tables in Markdown
"""

import shlex
import sys
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from urllib.parse import quote

import claims
import curves
import numpy as np
import phases
import possible
import returns
import tragedies
import tyro
from measures import with_interval
from page import section, table
from published_figures import axis_title, draw_figures
from results import Result, pooled, pooling_text, read_result

from cprl.commands.recipe_command import exit_with_message, trust_allowed
from cprl.runs.files import write_atomically
from cprl.runs.recipe import read_recipe
from cprl.system.defaults import SEED
from cprl.system.output import say
from cprl.system.process import prepare_process
from cprl.system.shipped import is_cprl


def write_report(runs: Sequence[Path], out: Path, *, pool: bool = False) -> Path:
    """Write `tables.md`, and figures that `figures.md` shows.

    Args:
        runs: The directories of runs, or of exported results.
        out: The folder of the report; created if missing.
        pool: Whether runs whose experiments differ in nothing but name, seed, the number of replicas and
            `on_nan` are one, of all their replicas.

    Returns:
        The path `out/tables.md`.

    Raises:
        ValueError: If a path has no run, or code of the user's own that is not allowed, or two runs have the
            same name; in a pool, if two runs of one experiment have the same seed.
        FileNotFoundError: If a run has no episodes or has not ended.
    """
    singles = [read_result(path) for path in runs]
    _refuse_equal_names(singles)
    results = pooled(singles) if pool else singles
    _refuse_equal_names(results)
    repeating = [result for result in results if result.study]
    lines = [
        "# Tables",
        "",
        "Made by `python recipes/study/report.py` from the results of these runs alone.",
        *_reading(repeating),
        "",
        *_runs(singles),
        *(pooling_text(results) if pool else []),
        *possible.sections(results),
        *returns.appendix(repeating),
        *returns.returns_of_others([result for result in results if not result.study]),
        *curves.sections(repeating),
        *returns.parts(repeating),
        *phases.sections(repeating),
        *tragedies.sections(results),
        *claims.sections(repeating),
        *_measures(results),
    ]
    (out / "figures").mkdir(parents=True, exist_ok=True)
    pictures = ["# Figures", ""]
    for result, metric, path in draw_figures(results, out / "figures"):
        pictures += [f"![{result.name}, {axis_title(metric)}](figures/{quote(path.name)})", ""]
    _write(out / "figures.md", pictures)
    return _write(out / "tables.md", lines)


def _write(path: Path, lines: Sequence[str]) -> Path:
    text = "\n".join(lines).rstrip("\n") + "\n"
    return write_atomically(path, lambda file: file.write(text.encode()))


def _refuse_equal_names(results: Sequence[Result]) -> None:
    """Raise a ValueError for two runs of one name: tables and figures name runs by their directories."""
    paths: dict[str, Path] = {}
    for result in results:
        path = result.paths[0]
        if paths.setdefault(result.name, path) is not path:
            raise ValueError(
                f"runs has {paths[result.name]} and {path}, both named {result.name!r}; allowed: runs whose "
                "directories have different names"
            )


def _reading(repeating: Sequence[Result]) -> list[str]:
    """Return how to read the tables."""
    lines = ["Brackets after a mean are its 95 % interval over replicas by Student's t."]
    if repeating:
        lines += [
            'Brackets under "one run" and "mean of two runs" are where further runs lie, with 95 % '
            "(`prediction` of `recipes/study/verdicts.py`); verdicts are explained there, too.",
            "Running means of ours are over the window of the published curve, drawn at its first episode.",
        ]
    return lines


def _runs(results: Sequence[Result]) -> list[str]:
    rows = []
    for result in results:
        git = result.recipe["git"] or {}
        versions = result.recipe["versions"]
        rows.append(
            [
                result.name,
                result.title,
                str(timedelta(seconds=round(result.report["training_s"]))),
                str(git.get("commit"))[:10],
                f"torch {versions['torch']}, torchrl {versions['torchrl']}",
                f"`{command_line(result.recipe['command'])}`",
            ]
        )
    return section("Runs", ["run", "what", "training", "commit", "versions", "command"], rows)


def command_line(stored: str) -> str:
    """Return a command line from `recipes/` on, or of `cprl`, without the output directory and without
    `--resume`."""
    script, *arguments = (word for word in shlex.split(stored) if word != "--resume")
    if "--out" in arguments:
        at = arguments.index("--out")
        del arguments[at : at + 2]
    if is_cprl(script):
        return shlex.join(["cprl", *arguments])
    return shlex.join(["python", script[max(script.find("recipes/"), 0) :], *arguments])


def _measures(results: Sequence[Result]) -> list[str]:
    lines = ["## Measures", ""]
    for result in results:
        measures = result.measures
        rows = [[name, with_interval(values)] for name, values in measures.training.items()]
        for name, values in measures.trained.items():
            rows.append([name, with_interval(values), f"{np.nanmean(measures.random[name]):.4g}"])
        lines += [f"### {result.name}", ""]
        if not measures.random:
            some = ", some of the runs" if len(result.paths) > 1 else ""
            lines += [
                f"Exported without weights{some}: nobody could play, so measures and claims are of the "
                "training alone.",
                "",
            ]
        lines += table(["measure", "trained" if result.learns else "agents", "random policy"], rows)
    return lines


def main(runs: tuple[Path, ...], /, *, out: Path = Path("report"), pool: bool = False) -> None:
    """Write tables and figures of finished runs beside the published study.

    Args:
        runs: directories of runs, or of results.
        out: where to: tables.md, figures.md and figures/.
        pool: runs whose experiments differ in nothing but name, seed, replicas and on_nan are one, of all
            their replicas.
    """
    if not runs:
        raise ValueError("the report wants at least one run: python recipes/study/report.py RUN...")
    for run in runs:
        read_recipe(run)
    prepare_process(SEED)
    say(write_report(runs, out, pool=pool))


if __name__ == "__main__":
    with exit_with_message("report.py"):
        tyro.cli(main, args=trust_allowed(sys.argv[1:]))
