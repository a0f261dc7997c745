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
from cprl.evaluation.evaluate import evaluate_run
from cprl.evaluation.fresh import fresh_episodes
from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, title, unit
from cprl.measuring.statistics import Estimate, number_format
from cprl.measuring.table import complete, labelled
from cprl.pictures.readable import capitalised, growth_of, meaning_of, rule_of, tag_of
from cprl.population import has_people, learned
from cprl.runs.curves import curves_of
from cprl.runs.played import TURNS, absence
from cprl.studies.results import SUMMARY
from cprl.studies.tables.comparing import (
    compared_metrics,
    condition_differences,
    episodes_text,
    pairing_text,
)
from cprl.studies.tables.effects import effect_weights, effects_of
from cprl.studies.tables.tidy_table import EVALUATION_PART, StudyTable
from cprl.system.defaults import SEED, STUDY_TABLE, Fresh
from cprl.system.output import legible
from cprl.system.working import working
from cprl.terminal.course import NEEDED, course_of
from cprl.terminal.figures import training_curve
from cprl.terminal.summary import comparison_table
from cprl.terminal.text_tables import escape_cell, markdown
from cprl.training.stored import LoadedRun, load
from cprl.values.array_types import Float64
from cprl.web.show import Page, data_of, page

_LARGEST_SVG_BYTES: Final = 300_000
_INCOME: Final = "**Income** of all agents together (harvest - fines + transfers), apples"
_HARVEST: Final = "**Harvest** (collective return), apples"
_NONE: Final = "no difference shown"
_ALONE: Final = "not shown among so many, though it would be alone"
_UNTOLD: Final = "cannot be told, as one replica has no interval"


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
    and institutions; and its recipe. Of a run with people: the episodes that they played. Of a
    study: question, expectation, answer, and its summary.

    Args:
        path: the directory of a run or of a study, or their results.
        out: the page, an .html, complete or absent; by default `report.html` in that directory.
        episodes: of a run alone, fresh ones of each replica.
        seed: of a run alone, the seed of their worlds and all chance.

    Raises:
        FileExistsError: if the page exists.
    """
    folder = Path(path)
    if out is None:
        out = folder / "report.html"
    page_path = Page(out)
    page_path.refuse()
    is_study = (folder / STUDY_TABLE).is_file()
    run = None if is_study else load(folder)
    is_played = run is not None and not has_people(run.specs)
    for name, value, default in (("episodes", episodes, 20), ("seed", seed, SEED)):
        if not is_played and value != default:
            raise ValueError(
                f"{name} is {value}, and {folder} is a study, or of people; allowed: of a run of agents alone"
            )
    text = _study_page(folder) if run is None else _run_page(run, episodes, seed)
    page_path.write(text)
    return page_path


def _run_page(run: LoadedRun, episodes: int, seed: int) -> str:
    """Return the page of a run."""
    game = run.game
    name = legible(run.experiment.name.replace("_", " "))
    is_of_people = has_people(run.specs)
    is_commons = isinstance(game, Game)
    can_show = (run.path / TURNS).exists() if is_of_people else is_commons
    data = data_of(fresh_episodes([run]))[0] if can_show else None
    before = [growth_of(game)] if is_commons else []
    curves = {} if is_of_people else _curves(run)
    has_course = set(NEEDED) <= set(curves)
    if has_course and (run.path / "evaluation" / "random.parquet").is_file():
        *facts, meaning = course_of(run.path, run.specs).splitlines()
        before.append("  \n".join([*facts, f"**{meaning}**"]))
    before.append(f"{learned(run.specs)}, {run.experiment.trained_for}.")
    before.append(run.experiment.custom_code)
    sections = [
        _html("\n".join(_numbers(run, episodes, seed))),
        *([f"<h2>Training</h2>{_training_figure(run)}"] if curves else []),
        *([_rules(game)] if is_commons else []),
        _recipe(run),
    ]
    after_it = "".join(f"<section>{section}</section>" for section in sections)
    return page(name, _html("\n\n".join(before)), data, after_it)


def _numbers(run: LoadedRun, episodes: int, seed: int) -> list[str]:
    """Return the numbers of fresh episodes beside random play, or of those that people played, as lines of
    Markdown."""
    if has_people(run.specs):
        agents = learned(run.specs)
        played = labelled(complete(run.episodes()), policy=agents)
        table = comparison_table(played, "", reference=agents)
        after = f"Means over groups. {absence(run.path)}"
        return ["## The episodes that people played", "", *markdown(table), after]
    played = evaluate_run(run, Fresh(episodes=episodes, seed=seed))
    return [
        "## Fresh episodes, beside random play",
        "",
        *markdown(comparison_table(played, "", names={"trained": "run's agents"})),
        "These episodes were played for this page, in other worlds than those above, so that means differ by "
        f"chance. The same numbers: `cprl evaluate RUN --episodes {episodes} --seed {seed}`.",
    ]


def _curves(run: LoadedRun) -> dict[str, Float64]:
    """Return the curves of the training; none of a run that has played no episode."""
    try:
        return curves_of(run.path)
    except FileNotFoundError:
        return {}


def _rules(game: Game) -> str:
    """Return the institutions in words, what a tag does, and the settings that differ from the defaults, as
    HTML."""
    lines = [
        "## Rules",
        "",
        f"{game.agents} agents on a board of {game.map.height} x {game.map.width} cells.",
        "",
        *(f"- **{rule_of(one)}**: {meaning_of(one, game)}" for one in game.institutions),
    ]
    tag = tag_of(game)
    lines += ["", f"{capitalised(tag)}."] * bool(tag)
    return _html("\n".join(lines)) + _changed(game)


def _changed(game: Game) -> str:
    """Return the rules that differ from the defaults, for those who program, as HTML that is closed at
    first."""
    changed = game.rules.changed
    if not changed:
        return _html("All other rules: `Rules()`.")
    fields = "\n".join(f"- `{name}`: `{value}`" for name, value in changed.items())
    summary = "<summary>For programmers: the rules that differ from <code>Rules()</code></summary>"
    return f"<details>{summary}{_html(fields)}</details>"


def _recipe(run: LoadedRun) -> str:
    """Return how it was begun, and how to run it again, which people cannot, as HTML."""
    recipe = json.dumps(run.recipe["experiment"], separators=(", ", ": "))
    began = escape(str(run.recipe.get("command", "")))
    heading = "The recipe"
    again = ""
    if not has_people(run.specs):
        heading = "Run it again"
        again = (
            "<p>Its directory alone is enough, too, or the recipe below as the <code>experiment</code> of a "
            "<code>recipe.json</code>:</p><pre>cprl run RUN --out AGAIN</pre>"
        )
    return (
        f"<h2>{heading}</h2><p>It was begun by this command line:</p><pre>{began}</pre>{again}"
        f"<details><summary>The whole recipe</summary><pre>{escape(recipe)}</pre></details>"
    )


def _training_figure(run: LoadedRun) -> str:
    """Return the course of the training as SVG, or as PNG where so many lines make an SVG large."""
    kind = "svg+xml"
    with TemporaryDirectory() as folder:
        content = training_curve(run.path, title="", path=Path(folder, "course.svg")).read_bytes()
        if len(content) > _LARGEST_SVG_BYTES:
            kind = "png"
            content = training_curve(run.path, title="", path=Path(folder, "course.png")).read_bytes()
    return _figure(content, kind, "The course of the training")


def _study_page(folder: Path) -> str:
    """Return the page of a study: its summary, with the answer and the figures."""
    table = StudyTable.read(folder / STUDY_TABLE)
    summary = (folder / SUMMARY).read_text(encoding="utf-8")
    headline, _, rest = summary.partition("\n")
    answer = _answer_of(table)
    head, mark, tail = rest.partition("\n## ")
    text = f"{head}\n\n**Answer.** {answer}\n{mark}{tail}" if answer else rest

    def picture(image: re.Match[str]) -> str:
        path = folder / image[1]
        is_ours = path.resolve().parent == (folder / "figures").resolve() and path.suffix == ".png"
        return _figure(path.read_bytes(), "png", image[2]) if is_ours and path.is_file() else ""

    body = re.sub(r'<p><img src="([^"]*)" alt="([^"]*)"\s*/?></p>', picture, _html(text))
    return page(legible(headline.lstrip("# ")), body)


def _answer_of(table: StudyTable) -> str:
    """Return the answer of a study in Markdown: the differences that the evaluation shows or does not show.

    For a grid these are the effects of its factors, otherwise the differences from the reference. They are
    about income and harvest if money moves, otherwise about the first metric. "" if there is nothing to
    compare.
    """
    if not table.metrics or len(table.design.conditions) < 2:
        return ""
    metrics = compared_metrics(table, part=EVALUATION_PART)
    subjects = {INCOME: _INCOME, COLLECTIVE_RETURN: _HARVEST}
    if not subjects.keys() <= set(metrics):
        subjects = {metrics[0]: title(metrics[0])}
    beside = f"beside {escape_cell(table.design.reference)}, {pairing_text(table)}"
    family = condition_differences(table, metrics, part=EVALUATION_PART)
    tests = f"{family.tests} differences of their table below"
    parts = []
    for metric, subject in subjects.items():
        if effect_weights(table):
            family = effects_of(table, metric, part=EVALUATION_PART)
            beside = "effects of each factor over all cells of the grid, paired by replica"
            tests = f"{family.tests} effects on a metric"
        changes = {name: change for (name,), change in family.column(metric).items()}
        parts += [f"- {subject}:", *_verdict_lines(changes, unit(metric))]
    what = f"In {episodes_text(table, EVALUATION_PART)}, {beside}"
    what += f"; by Holm's method for the {tests}:" if family.tests else ":"
    return "\n".join([what, "", *parts])


def _verdict_lines(differences: Mapping[str, Estimate], unit_of: str) -> list[str]:
    """Return a line for each verdict: the differences above 0, below 0, and those that are not shown.

    For differences that are not shown, the line says how large they would have to be to show.
    """
    by_kind: dict[str, list[str]] = {kind: [] for kind in ("more", "less", _NONE, _ALONE, _UNTOLD)}
    for name, change in differences.items():
        text = f"{escape_cell(name)} {change:+}"
        if change.differs:
            kind = "more" if change.value > 0 else "less"
        elif isnan(change.reach):
            kind = _UNTOLD
        elif abs(change.value) > change.reach:
            kind = _ALONE
        else:
            kind = _NONE
            size = f"{change.reach:{number_format(change.value, change.low, change.high)}} {unit_of}".rstrip()
            text += f" (differences below {size} would not show)" if change.reach else ""
        by_kind[kind].append(text)
    return [f"  - {kind}: {'; '.join(texts)}" for kind, texts in by_kind.items() if texts]


def _html(text: str) -> str:
    """Return Markdown as HTML; HTML in it is text."""
    html: str = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
    return html.replace("<table>", '<div class="wide"><table>').replace("</table>", "</table></div>")


def _figure(content: bytes, kind: str, alternative: str) -> str:
    encoded = b64encode(content).decode("ascii")
    return f'<figure><img src="data:image/{kind};base64,{encoded}" alt="{alternative}"></figure>'
