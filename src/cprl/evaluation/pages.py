"""What is printed and drawn of the table of an evaluation, whatever its kind: cells, and a matrix."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from cprl.measuring.registry import with_unit
from cprl.measuring.statistics import Family, notes_on
from cprl.system.defaults import Fresh
from cprl.terminal import style
from cprl.terminal.panels import draw_matrix, matrix_height
from cprl.terminal.summary import OVER_REPLICAS
from cprl.terminal.tables import Cell, Cells, Change
from cprl.training.stored import LoadedRun


def heading(what: str, fresh: Fresh, runs: Iterable[LoadedRun], each: str = "", end: str = "") -> str:
    """Return what was played, with the epsilon of the agents that learned values, and what numbers are.

    Args:
        each: of what there are so many episodes, beside replicas.
    """
    agents = [run.agent(agent, replica=run.replicas[0]) for run in runs for agent in range(run.game.agents)]
    epsilons = {agent.epsilon for agent in agents if agent.scripted is None and not agent.stochastic}
    exploring = ", greedy" if fresh.greedy else "".join(f", epsilon {one:g}" for one in sorted(epsilons))
    return f"{what}: {fresh}{each}, seed {fresh.seed}{exploring}{end}\n{OVER_REPLICAS}"


def row_cells(family: Family, title: str, *, rewards: str = "") -> Cells:
    """Return a row for each choice of labels of a family, a column for each of its numbers.

    Args:
        rewards: their unit, see `with_unit`.
    """
    rows: list[list[Cell]] = [
        [*map(str, labels), *(family[(*labels, number)] for number in family.numbers)]
        for labels in family.labels
    ]
    labels_in_words = (name.replace("_", " ") for name in family.by)
    head = [*labels_in_words, *(with_unit(number, rewards=rewards) for number in family.numbers)]
    return Cells(title, head, rows, "\n".join(notes_on(family.values())), texts=len(family.by))


def matrix_cells(family: Family, number: str, title: str, note: str = "") -> Cells:
    """Return a row for each of the first labels, a column for each of the second, of a number of a family."""
    rows, columns = _sides(family)
    cells = {key[:-1]: one for key, one in family.items() if key[-1] == number}
    texts = {pair: Change(one) if family.name else one for pair, one in cells.items()}
    return Cells(
        title,
        [" \\ ".join(family.by), *columns],
        [[row, *(texts.get((row, column), "") for column in columns)] for row in rows],
        note or "\n".join(notes_on(cells.values())),
    )


def _sides(family: Family) -> tuple[list[str], list[str]]:
    """Return the first labels of a family and the second, in one order where they are the same."""
    rows, columns = (list(dict.fromkeys(side)) for side in zip(*family.labels, strict=True))
    return rows, rows if set(rows) == set(columns) else columns


def draw_matrices(
    path: Path | str,
    family: Family,
    titles: Mapping[str, str],
    *,
    title: str,
    caption: str,
    more: Mapping[tuple[str, str], str] | None = None,
    width: style.Width = "page",
) -> Path:
    """Draw numbers of a family that has two labels, a matrix each; a star where one is not 0.

    Args:
        titles: of the panels, by number.
        more: texts of cells without a number.
    """
    rows, columns = ({name: name for name in side} for side in _sides(family))
    with style.drawing(path, width=width, colours=style.SHADES) as sheet:
        panels = sheet.panels(len(titles), high=matrix_height(len(rows)))
        for axes, (number, panel_title) in zip(panels, titles.items(), strict=True):
            cells = {key[:-1]: one for key, one in family.items() if key[-1] == number}
            texts = {pair: f"{one.value:+.3g}" + " *" * one.differs for pair, one in cells.items()}
            values = {pair: one.value for pair, one in cells.items()}
            draw_matrix(sheet, axes, rows, columns, values, {**texts, **(more or {})})
            axes.set(xlabel=family.by[1], ylabel=family.by[0])
            axes.set_title(panel_title)
        sheet.title = title
        sheet.caption = caption
    return Path(path)
