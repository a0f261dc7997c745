"""One HTML page about a run or a study: its results, with intervals, and how to run it again."""

import json
import re
from base64 import b64encode
from collections.abc import Mapping
from html import escape
from math import isnan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from markdown_it import MarkdownIt

from cprl.commons.game import Game
from cprl.commons.readable import growth_of, meaning_of, rule_of, tag_of
from cprl.evaluation.evaluate import evaluate_run
from cprl.evaluation.fresh import fresh_episode
from cprl.evaluation.show import Page, page, shown
from cprl.measuring.registry import INCOME, title, unit
from cprl.measuring.statistics import Estimate, form_for
from cprl.measuring.windows import Values
from cprl.population import learned
from cprl.runs.curves import curves_of
from cprl.studies.results import SUMMARY
from cprl.studies.tables.comparing import (
    Family,
    Place,
    compare,
    differences_in,
    family_of,
    metrics_of,
)
from cprl.studies.tables.effects import effects_of, estimated
from cprl.studies.tables.table import EVALUATION, StudyTable
from cprl.system.defaults import SEED, STUDY_TABLE, Fresh
from cprl.system.output import legible
from cprl.system.working import working
from cprl.terminal.figures import training_curve
from cprl.terminal.summary import compared
from cprl.terminal.tables import cell, markdown
from cprl.training.agents import LoadedRun, load
from cprl.training.course import course_of

_LARGEST_SVG_BYTES: Final = 300_000


@working("making a report")
def report(
    path: str | Path,
    out: str | Path | None = None,
    *,
    episodes: int = 20,
    seed: int = SEED,
) -> Page:
    """Write one HTML page about a run or a study, which opens from the disk without a network.

    Of a run: what happened in sentences; its numbers beside those of random play, which are those of
    `evaluate_run` with the same episodes and seed; the course of its training; an episode to play; its rules
    and institutions; and its recipe. Of a study: question, expectation, answer, and its summary.

    Args:
        path: the directory of a run or of a study, or their results.
        out: the page, an .html, complete or absent; by default `report.html` in that directory.
        episodes: of a run alone, fresh ones of each replica.
        seed: likewise: of their worlds and all chance.

    Raises:
        FileExistsError: if the page exists.
    """
    folder = Path(path)
    page_path = Page(folder / "report.html" if out is None else out)
    page_path.refuse()
    is_study = (folder / STUDY_TABLE).is_file()
    for name, value, default in (("episodes", episodes, 20), ("seed", seed, SEED)):
        if is_study and value != default:
            raise ValueError(f"{name} is {value}, and {folder} is a study; allowed: of a run alone")
    text = _of_study(folder) if is_study else _of_run(load(folder), episodes, seed)
    page_path.write(text)
    return page_path


def _of_run(run: LoadedRun, episodes: int, seed: int) -> str:
    game, name = run.game, legible(run.experiment.name.replace("_", " "))
    played = evaluate_run(run, Fresh(episodes=episodes, seed=seed))
    is_commons = isinstance(game, Game)
    data = shown([fresh_episode(run)])[0] if is_commons else None
    before = [growth_of(game)] if is_commons else []
    curves = _curves(run)
    has_course = {"collective_return", "survival_steps"} <= set(curves)
    if has_course and (run.path / "evaluation" / "random.parquet").is_file():
        *facts, meaning = course_of(run.path, run.specs).splitlines()
        before.append("  \n".join([*facts, f"**{meaning}**"]))
    before.append(f"{learned(run.specs)}, {run.experiment.trained_for}.")
    before.append(run.experiment.own_code)
    page_of_numbers = compared(played, "", names={"trained": "run's agents"})
    after = ["## Fresh episodes, beside random play", "", *markdown(page_of_numbers)]
    after += [
        "These episodes were played for this page, in other worlds than those above, so that means differ by "
        f"chance. The same numbers: `cprl evaluate RUN --episodes {episodes} --seed {seed}`."
    ]
    sections = [
        _html("\n".join(after)),
        *([f"<h2>Training</h2>{_training_figure(run)}"] if curves else []),
        *([_rules(game)] if is_commons else []),
        _recipe(run),
    ]
    after_it = "".join(f"<section>{section}</section>" for section in sections)
    return page(name, _html("\n\n".join(before)), data, after_it)


def _curves(run: LoadedRun) -> dict[str, Values]:
    """The curves of the training; none of a run that has played no episode."""
    try:
        return curves_of(run.path)
    except FileNotFoundError:
        return {}


def _rules(game: Game) -> str:
    """The institutions in words, what a tag does, and which settings differ from the defaults, as HTML."""
    lines = [
        "## Rules",
        "",
        f"{game.agents} agents on a board of {game.map.height} x {game.map.width} cells.",
        "",
        *(f"- **{rule_of(one)}**: {meaning_of(one, game)}" for one in game.institutions),
    ]
    tag = tag_of(game)
    lines += ["", f"{tag[:1].upper()}{tag[1:]}."] * bool(tag)
    return _html("\n".join(lines)) + _changed(game)


def _changed(game: Game) -> str:
    """The rules that differ from the defaults, for those who program, as HTML that is closed at first."""
    changed = game.rules.changed
    if not changed:
        return _html("All other rules: `Rules()`.")
    fields = "\n".join(f"- `{name}`: `{value}`" for name, value in changed.items())
    summary = "<summary>For programmers: the rules that differ from <code>Rules()</code></summary>"
    return f"<details>{summary}{_html(fields)}</details>"


def _recipe(run: LoadedRun) -> str:
    recipe = json.dumps(run.recipe["experiment"], separators=(", ", ": "))
    began = escape(str(run.recipe.get("command", "")))
    return (
        "<h2>Run it again</h2><p>It was begun by this command line:</p>"
        f"<pre>{began}</pre>"
        "<p>Its directory alone is enough, too, or the recipe below as the <code>experiment</code> of a "
        "<code>recipe.json</code>:</p><pre>cprl run RUN --out AGAIN</pre>"
        f"<details><summary>The whole recipe</summary><pre>{escape(recipe)}</pre></details>"
    )


def _training_figure(run: LoadedRun) -> str:
    """As SVG, or as PNG where so many lines make an SVG large."""
    with TemporaryDirectory() as folder:
        content = training_curve(run.path, title="", path=Path(folder, "course.svg")).read_bytes()
        is_large = len(content) > _LARGEST_SVG_BYTES
        if is_large:
            content = training_curve(run.path, title="", path=Path(folder, "course.png")).read_bytes()
    return _figure(content, "png" if is_large else "svg+xml", "The course of the training")


def _of_study(folder: Path) -> str:
    table = StudyTable.read(folder / STUDY_TABLE)
    summary = (folder / SUMMARY).read_text(encoding="utf-8")
    title, _, rest = summary.partition("\n")
    answer = _answer(table)
    head, found, tail = rest.partition("\n## ")
    text = f"{head}\n\n**Answer.** {answer}\n{found}{tail}" if answer else rest

    def picture(image: re.Match[str]) -> str:
        path = folder / image[1]
        is_ours = path.resolve().parent == (folder / "figures").resolve() and path.suffix == ".png"
        return _figure(path.read_bytes(), "png", image[2]) if is_ours and path.is_file() else ""

    body = re.sub(r'<p><img src="([^"]*)" alt="([^"]*)"\s*/?></p>', picture, _html(text))
    return page(legible(title.lstrip("# ")), body)


def _answer(table: StudyTable) -> str:
    """Return what differs in the episodes of the evaluation: of a grid the effects of its factors, else
    conditions from the reference; "" without any.

    It is about income where money moves, and then about the harvest too; else about the first metric.
    """
    if not table.metrics or len(table.design.conditions) < 2:
        return ""
    metrics = metrics_of(table, part=EVALUATION)
    comparisons = {metric: compare(table, metric, part=EVALUATION) for metric in metrics}
    has_income = {INCOME, "collective_return"} <= set(metrics)
    compared = (
        {INCOME: _INCOME, "collective_return": _HARVEST} if has_income else {metrics[0]: title(metrics[0])}
    )
    unit_of = "apples" if has_income else unit(metrics[0])
    first = comparisons[metrics[0]]
    beside = f"beside {cell(first.reference)}, {first.pairing_text}"
    family = family_of(differences_in(list(comparisons.values())))
    tests = f"{family.tests} differences of their table below"
    parts = []
    for metric, words in compared.items():
        differences = differences_in([comparisons[metric]])
        if effects_of(table):
            effects = estimated(table, comparisons[metric])
            differences = {(metric, name): one for name, one in effects.estimates.items()}
            family = effects.family
            beside = "effects of each factor over all cells of the grid, paired by replica"
            tests = f"{family.tests} effects on a metric"
        parts += [f"- {words}:", *_said(differences, family, unit_of)]
    what = f"In {first.episodes_text}, {beside}"
    what += f"; by Holm's method for the {tests}:" if family.tests else ":"
    return "\n".join([what, "", *parts])


_INCOME: Final = "**Income** of all agents together (harvest - fines + transfers), apples"
_HARVEST: Final = "**Harvest** (collective return), apples"
_NONE: Final = "no difference shown"
_ALONE: Final = "not shown among so many, though it would be alone"
_UNTOLD: Final = "cannot be told, as one replica has no interval"


def _said(differences: Mapping[Place, Estimate | None], family: Family, unit_of: str) -> list[str]:
    """Lines on which differences are more and less than 0; of those not shown, how large one would have to
    be."""
    said: dict[str, list[str]] = {kind: [] for kind in ("more", "less", _NONE, _ALONE, _UNTOLD)}
    for place, one in differences.items():
        if one is None:
            continue
        text = f"{cell(place[1])} {one:+}"
        half = (one.high - one.low) / 2
        if place in family.marked:
            kind = "more" if one.value > 0 else "less"
        elif isnan(half):
            kind = _UNTOLD
        elif abs(one.value) > half:
            kind = _ALONE
        else:
            kind = _NONE
            size = f"{half:{form_for(one.value, one.low, one.high)}} {unit_of}".rstrip()
            text += f" (differences below {size} would not show)" if half else ""
        said[kind].append(text)
    return [f"  - {kind}: {'; '.join(texts)}" for kind, texts in said.items() if texts]


def _html(text: str) -> str:
    """Markdown as HTML; HTML in it is text."""
    html: str = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
    return html.replace("<table>", '<div class="wide"><table>').replace("</table>", "</table></div>")


def _figure(content: bytes, kind: str, words: str) -> str:
    encoded = b64encode(content).decode("ascii")
    return f'<figure><img src="data:image/{kind};base64,{encoded}" alt="{words}"></figure>'
