"""What best responses gain, as tables for the terminal."""

from collections import Counter
from collections.abc import Iterator

from rich.table import Table

from cprl.evaluation.responses import Exploitability
from cprl.evaluation.tables import how_they_play
from cprl.measuring.statistics import estimate


def exploitability_tables(found: Exploitability) -> Iterator[Table]:
    """A row for each agent that was replaced and one for their mean, then one for each trained response."""
    yield _gains(found)
    yield _responses(found)


def _gains(found: Exploitability) -> Table:
    count = found.replicas
    how = how_they_play([found.run], greedy=False)
    table = Table(
        title=f"{found.run.path.name}: {count} replica{'s' * (count != 1)}, {found.episodes} episodes each, "
        f"seed {found.seed}{how}\nWhat trained responses gain is a lower bound of what can be gained.\n"
        "mean over replicas [95 % interval by Student's t]; gain and change paired by replica",
        title_justify="left",
    )
    headings = ("return of the agent", "of the best response", "gain", "change of the others, mean")
    table.add_column("agent")
    for heading in headings:
        table.add_column(heading, justify="right")
    table.add_column("chosen in replicas")
    for agent in found.responses:
        gain, returns = found.gain_of(agent), found.returns(agent)
        means = (str(estimate(values)) for values in returns)
        chosen = Counter(response.name for response in found.chosen(agent))
        names = "\n".join(f"{name}: {times}" for name, times in chosen.most_common())
        table.add_row(str(agent), *means, str(gain.focal), str(gain.background), names)
    if len(found.responses) > 1:
        table.add_row("mean", "", "", str(found.gain.focal), str(found.gain.background), "")
    return table


def _responses(found: Exploitability) -> Table:
    table = Table(title="each training, chosen or not", title_justify="left")
    for heading in ("agent", "response"):
        table.add_column(heading)
    table.add_column("gain", justify="right")
    for agent, responses in found.responses.items():
        for response in responses:
            table.add_row(str(agent), response.name, str(found.gain_of_response(response).focal))
    return table
