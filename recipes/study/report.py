"""How do runs of ours compare with the published study? Tables in Markdown, and figures as PNG.

    python recipes/study/report.py docs/results/single_basic docs/results/single_complex --out report

It needs only exported results (`cprl.runs.export`), so that anyone can reproduce it. Runs that repeat none of
the study's experiments have tables of their own, without columns for what was published.

The modules of the report, in the order in which one reads them:
    results     the files of a run that a report needs; runs of one experiment as one; random play
    published   the published numbers and curves, and the windows of their running means
    verdicts    when a number, a curve or a claim is contradicted
    curves      published numbers and curves beside ours
    claims      the study's claims on its five experiments
    tragedies   tragedy and combat, replica by replica
    phases      the phases of a training, and how figures draw them
    possible    what share of the possible runs got; planner and exact_yields say what is possible
    figures     a metric of a run beside the published curve
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
import tyro
from curves import appendix, phases_of, returns_of_others, turning_points_of
from figures import axis_title, draw_figures
from possible import shares_of
from results import PooledResult, Result, pooled, read_result, table, told, with_interval
from tragedies import combat_section

from cprl.commands.recipe import in_a_sentence, trust_allowed
from cprl.runs.files import write_atomically
from cprl.runs.recipe import read_recipe
from cprl.system.defaults import SEED
from cprl.system.output import say
from cprl.system.process import prepare_process
from cprl.system.shipped import is_cprl


def write_report(runs: Sequence[Path], out: Path, *, pool: bool = False) -> Path:
    """Writes `tables.md`, and figures that `figures.md` shows.

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
    results = [read_result(path) for path in runs]
    _refuse_equal_names(results)
    each = results
    if pool:
        results = pooled(each)
        _refuse_equal_names(results)
    (out / "figures").mkdir(parents=True, exist_ok=True)
    of_study = [result for result in results if result.study]
    lines = [
        "# Tables",
        "",
        "Made by `python recipes/study/report.py` from the results of these runs alone.",
        *_how(of_study),
        "",
        *_runs(each),
        *(told(results) if pool else []),
        *shares_of(results),
        *appendix(of_study),
        *returns_of_others([result for result in results if not result.study]),
        *(curves.windows() if of_study else []),
        *curves.distances(of_study),
        *curves.judged(of_study),
        *curves.parts(of_study),
        *phases_of(of_study),
        *turning_points_of(of_study),
        *combat_section(results),
        *_claims(of_study),
        *_measures(results),
    ]
    _write(out / "figures.md", _figures(results, out))
    return _write(out / "tables.md", lines)


def _write(path: Path, lines: Sequence[str]) -> Path:
    text = "\n".join(lines).rstrip("\n") + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))
    return path


def _refuse_equal_names(results: Sequence[Result]) -> None:
    """Tables and figures name runs by their directories."""
    first: dict[str, Path] = {}
    for result in results:
        if result.name in first:
            raise ValueError(
                f"runs has {first[result.name]} and {result.path}, both named {result.name!r}; allowed: runs "
                "whose directories have different names"
            )
        first[result.name] = result.path


def _how(of_study: Sequence[Result]) -> list[str]:
    lines = ["Brackets after a mean are its 95 % interval over replicas by Student's t."]
    if of_study:
        lines += [
            'Brackets under "one run" and "mean of two runs" are where further runs lie, with 95 % '
            "(`prediction` of `recipes/study/verdicts.py`); verdicts are explained there, too.",
            "Running means of ours are over the window of the published curve, drawn at its first episode.",
        ]
    return lines


def _runs(results: Sequence[Result]) -> list[str]:
    rows = []
    for result in results:
        git, versions = result.recipe["git"] or {}, result.recipe["versions"]
        took = timedelta(seconds=round(result.report["training_s"]))
        rows.append(
            [
                result.name,
                result.title,
                f"{took}",
                str(git.get("commit"))[:10],
                f"torch {versions['torch']}, torchrl {versions['torchrl']}",
                f"`{_command(result.recipe['command'])}`",
            ]
        )
    return ["## Runs", "", *table(["run", "what", "training", "commit", "versions", "command"], rows)]


def _command(line: str) -> str:
    """The command line from `recipes/` on, or of `cprl`, without the output directory and without
    `--resume`."""
    words = shlex.split(line)
    if "--out" in words:
        at = words.index("--out")
        del words[at : at + 2]
    kept = [word for word in words if word != "--resume"]
    script = kept[0]
    if is_cprl(script):
        return shlex.join(["cprl", *kept[1:]])
    return shlex.join(
        ["python", script[script.find("recipes/") :] if "recipes/" in script else script, *kept[1:]]
    )


def _claims(results: Sequence[Result]) -> list[str]:
    """A table of the study's claims for each of its runs."""
    lines: list[str] = []
    for result in results:
        assert result.study is not None
        found = {
            1: lambda one: claims.of_experiment_1(one),
            2: lambda one: claims.of_experiment_2(one),
            3: lambda one: claims.of_experiment_3(one, results),
            4: lambda one: claims.of_experiment_4(one, results),
            5: lambda one: claims.of_experiment_5(one),
        }[result.study.number](result)
        lines += [f"### {result.name}", "", *table(claims.HEAD, claims.rows_of(list(found)))]
    return ["## Claims", "", *lines] if lines else []


def _measures(results: Sequence[Result]) -> list[str]:
    lines = ["## Measures", ""]
    for result in results:
        own = result.measures
        rows = [[name, with_interval(values), ""] for name, values in own.training.items()]
        rows += [
            [name, with_interval(values), f"{np.nanmean(own.random[name]):.4g}"]
            for name, values in own.trained.items()
        ]
        agents = "trained" if result.learns else "agents"
        lines += [f"### {result.name}", "", *_without_weights(result)]
        lines += table(["measure", agents, "random policy"], rows)
    return lines


def _without_weights(result: Result) -> list[str]:
    if result.measures.random:
        return []
    some = ", some of the runs" if isinstance(result, PooledResult) else ""
    return [
        f"Exported without weights{some}: nobody could play, so measures and claims are of the training "
        "alone.",
        "",
    ]


def _figures(results: Sequence[Result], out: Path) -> list[str]:
    lines = ["# Figures", ""]
    for result, metric, path in draw_figures(results, out / "figures"):
        lines += [f"![{result.name}, {axis_title(metric)}](figures/{quote(path.name)})", ""]
    return lines


def main(runs: tuple[Path, ...], /, *, out: Path = Path("report"), pool: bool = False) -> None:
    """Writes tables and figures of finished runs beside the published study.

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
    with in_a_sentence("report.py"):
        tyro.cli(main, args=trust_allowed(sys.argv[1:]))
