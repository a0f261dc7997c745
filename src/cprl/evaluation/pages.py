"""The printed tables that several kinds of evaluation share."""

from collections.abc import Iterable

from cprl.measuring.registry import with_unit
from cprl.measuring.statistics import Family, notes_on
from cprl.system.defaults import Fresh
from cprl.terminal.summary import OVER_REPLICAS
from cprl.terminal.text_tables import Change, TableCell, TextTable
from cprl.training.stored import LoadedRun


def heading(subject: str, fresh: Fresh, runs: Iterable[LoadedRun], per_part: str = "", end: str = "") -> str:
    """Return the heading of a table, e.g. "Cross-play: 100 episodes of each of 5 replicas, seed 1, greedy".

    Args:
        subject: what was evaluated.
        runs: the runs whose agents play; the heading says their epsilon of evaluation.
        per_part: words that follow the number of episodes, e.g. " in each placement".
        end: words at the end of the first line.
    """
    agents = [run.agent(agent, replica=run.replicas[0]) for run in runs for agent in range(run.game.agents)]
    epsilons = {agent.epsilon for agent in agents if agent.epsilon is not None}
    exploration = "".join(f", epsilon {epsilon:g}" for epsilon in sorted(epsilons))
    if fresh.greedy:
        exploration = ", greedy"
    return f"{subject}: {fresh}{per_part}, seed {fresh.seed}{exploration}{end}\n{OVER_REPLICAS}"


def row_table(family: Family, title: str, *, rewards: str = "") -> TextTable:
    """Return estimates as a table: a row for each combination of labels, a column for each metric.

    Args:
        rewards: the unit of rewards, see `with_unit`.
    """
    rows: list[list[TableCell]] = []
    for labels in family.labels:
        row_estimates = [family[(*labels, metric)] for metric in family.numbers]
        rows.append([*map(str, labels), *row_estimates])
    label_names = (name.replace("_", " ") for name in family.by)
    head = [*label_names, *(with_unit(metric, rewards=rewards) for metric in family.numbers)]
    return TextTable(title, head, rows, "\n".join(notes_on(family.values())), texts=len(family.by))


def matrix_table(family: Family, metric: str, title: str, note: str = "") -> TextTable:
    """Return one metric of a family with two labels as a matrix: rows for the first, columns for the second.

    Args:
        note: the text below the matrix; by default the notes on its estimates.
    """
    row_labels, column_labels = matrix_labels(family)
    estimates = family.column(metric)
    has_tests = family.tests is not None
    cells = {pair: Change(estimate) if has_tests else estimate for pair, estimate in estimates.items()}
    rows: list[list[TableCell]] = []
    for row_label in row_labels:
        row_cells = [cells.get((row_label, column_label), "") for column_label in column_labels]
        rows.append([row_label, *row_cells])
    head = [" \\ ".join(family.by), *column_labels]
    return TextTable(title, head, rows, note or "\n".join(notes_on(estimates.values())))


def matrix_labels(family: Family) -> tuple[list[str], list[str]]:
    """Return the labels of rows and of columns, in the same order if they are the same labels."""
    rows, columns = (list(dict.fromkeys(labels)) for labels in zip(*family.labels, strict=True))
    return rows, rows if set(rows) == set(columns) else columns
