"""What came of institutions, as a table beside the summary of a run."""

from collections.abc import Callable, Mapping, Sequence
from math import isnan
from statistics import fmean
from typing import Final

from rich.table import Table

from cprl.measuring.episodes import Episode
from cprl.measuring.names import title
from cprl.measuring.replicas import institution_metrics
from cprl.measuring.reported import INSTITUTIONAL

_OF_AGENTS: Final = {"fines": "fined", "transfers": "given", "violations": "violations"}


def institutions_table(
    played: Mapping[str, Sequence[Episode]], mean: Callable[[list[dict[str, float]], str, int], str]
) -> Table | None:
    """A column for each policy; a row for each metric, then one for each agent: what it was fined and given,
    and its violations. None for a game without institutions.

    Shares of something that never happened have no row.

    Args:
        played: episodes by the name of the policy, at least one of each.
        mean: the text for a metric of several episodes, from its name and digits.
    """
    first = next(iter(played.values()))[0]
    if all(getattr(first, name) is None for name in INSTITUTIONAL):
        return None
    table = Table(title="institutions", caption="means over episodes")
    table.add_column()
    for name in played:
        table.add_column(name, justify="right", no_wrap=True)
    measured = {policy: [institution_metrics(episode) for episode in own] for policy, own in played.items()}
    for metric in institution_metrics(first):
        values = [metrics[metric] for own in measured.values() for metrics in own]
        if "equality" in metric or not all(map(isnan, values)):
            table.add_row(_title(metric), *(mean(own, metric, 2) for own in measured.values()))
    fields = {name: word for name, word in _OF_AGENTS.items() if getattr(first, name) is not None}
    if fields:
        table.add_section()
        table.add_row(f"of each agent: {' / '.join(fields.values())}")
    for agent in range(len(first.return_)) if fields else ():
        cells = [
            " / ".join(f"{fmean(getattr(one, name)[agent] for one in own):.1f}" for name in fields)
            for own in played.values()
        ]
        table.add_row(f"  agent {agent}", *cells)
    return table


def _title(metric: str) -> str:
    prefix = "in_force_"
    if metric.startswith(prefix):
        return f"in force: decision {metric.removeprefix(prefix)}"
    return title(f"institutions/{metric}")
