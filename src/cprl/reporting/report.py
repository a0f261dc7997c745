"""The report that compares finished runs with the published study: tables in Markdown, figures as PNG.

It needs only exported results (`cprl.runs.export`), so that anyone can reproduce it.
"""

import os
import shlex
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path

import numpy as np

from cprl import arguments
from cprl.arguments import objects
from cprl.measuring.published import EXPERIMENTS, SMOOTHED_EPISODES, agreement, curve
from cprl.measuring.statistics import estimate
from cprl.reporting.claims import measures
from cprl.reporting.figures import axis_title, draw_figures
from cprl.reporting.markdown import table
from cprl.reporting.result import TOO_FEW, Result, Values, read_result
from cprl.reporting.turning import phases_of, turning_points_of
from cprl.runs.curves import running_mean
from cprl.runs.files import write_atomically


def write_report(runs: Sequence[Path], out: Path) -> Path:
    """Writes `tables.md` and its figures.

    Args:
        runs: The directories of runs, or of exported results.
        out: The folder of the report; created if missing.

    Returns:
        The path `out/tables.md`.

    Raises:
        ValueError: If a path has no run.
        FileNotFoundError: If a run has no episodes or has not ended.
    """
    folders = objects("runs", runs, (str, os.PathLike), "paths")
    out = arguments.path("out", out)
    results = [read_result(arguments.path("runs", path)) for path in folders]
    (out / "figures").mkdir(parents=True, exist_ok=True)
    lines = [
        "# Tables and figures",
        "",
        "Made by `cprl report` from the results in this folder alone.",
        "Intervals are 95 % bootstrap intervals over replicas; figures are running means over "
        f"{SMOOTHED_EPISODES} episodes, drawn at the first of them, as in the study. "
        f"The published curves are means over other windows: {_windows()}.",
        "",
        *_runs(results),
        *_appendix(results),
        *_agreements(results),
        *phases_of(results),
        *turning_points_of(results),
        *_claims(results),
        *_figures(results, out),
    ]
    path = out / "tables.md"
    text = "\n".join(lines) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))
    return path


def _windows() -> str:
    found: dict[int, list[str]] = {}
    for study in EXPERIMENTS:
        found.setdefault(study.window_episodes, []).append(f"{study.number}")
    by_window = (
        f"{window} episodes (experiment{'s' * (len(numbers) > 1)} {' and '.join(numbers)})"
        for window, numbers in found.items()
    )
    return ", ".join(by_window)


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
    """The command line from `recipes/` on, without the output directory and without `--go-on`."""
    words = shlex.split(line)
    if "--out" in words:
        at = words.index("--out")
        del words[at : at + 2]
    kept = [word for word in words if word not in ("--resume", "--go-on")]
    script = kept[0]
    return shlex.join(
        ["python", script[script.find("recipes/") :] if "recipes/" in script else script, *kept[1:]]
    )


def _appendix(results: Sequence[Result]) -> list[str]:
    rows = []
    for result in results:
        study, returns = result.study, result.curves["collective_return"]
        evaluated = {name: _evaluated(result, name) for name in ("random", "trained")}
        rows.append(
            [
                result.name,
                f"{study.number}" if study else "",
                f"{study.random}" if study and study.random is not None else "",
                _estimate_cell(evaluated["random"]),
                f"{study.trained}" if study else "",
                _estimate_cell(returns.mean(1)),
                _estimate_cell(evaluated["trained"]),
            ]
        )
    head = ["run", "experiment", "random, published", "random, ours", "trained, published"]
    head += ["mean over training, ours", "evaluation at epsilon 0.05, ours"]
    return ["## Appendix A beside ours: collective return", "", *table(head, rows)]


def _agreements(results: Sequence[Result]) -> list[str]:
    rows = []
    for result in results:
        for metric, name in (result.study.curves if result.study else {}).items():
            rows.append(
                [result.name, metric, *_agreement_cells(name, running_mean(result.curves[metric]).mean(0))]
            )
    head = ["run", "metric", "correlation", "mean absolute difference", "of the published curve's range"]
    return ["## Published curves beside ours", "", *table(head, rows)]


def _agreement_cells(name: str, ours: Values) -> list[str]:
    if len(ours) <= SMOOTHED_EPISODES:
        return [TOO_FEW, "", ""]
    correlation, difference = agreement(name, ours)
    return [f"{correlation:.2f}", f"{difference:.3g}", f"{difference / np.ptp(curve(name)[1]):.0%}"]


def _claims(results: Sequence[Result]) -> list[str]:
    lines = ["## What the claims are judged by", ""]
    for result in results:
        rows = [
            [measure.name, str(measure.trained), "" if measure.random is None else f"{measure.random:.4g}"]
            for measure in measures(result.path)
        ]
        lines += [f"### {result.name}", "", *table(["measure", "trained", "random policy"], rows)]
    return lines


def _figures(results: Sequence[Result], out: Path) -> list[str]:
    lines = ["## Figures", ""]
    for result, metric, path in draw_figures(results, out / "figures"):
        lines += [f"![{result.name}, {axis_title(metric)}](figures/{path.name})", ""]
    return lines


def _evaluated(result: Result, policy: str) -> Values | None:
    """The mean collective return of each replica in its evaluation, [R]; None if there is no evaluation."""
    found = result.evaluated(policy)
    return None if found is None else found["collective_return"]


def _estimate_cell(values: Values | None) -> str:
    return "" if values is None else str(estimate(values))
