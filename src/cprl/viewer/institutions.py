"""The lines and tabs of institutions in a recording."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import rerun as rr

from cprl.commons.colours import agent_colour
from cprl.measuring.institutions import METRICS
from cprl.measuring.series import OF_AGENTS
from cprl.viewer.panels import row
from cprl.viewer.scenery import BLUE, GREEN, GREY, ORANGE, PURPLE, RANDOM_PLAY, VERMILION, Curves, running

COLOURS: Final = {
    "violations": VERMILION,
    "violations_per_step": VERMILION,
    "own_share_of_bites": GREEN,
    "detection_rate": ORANGE,
    "recidivism": PURPLE,
    "unjust_share_of_tags": BLUE,
    "net_equality": BLUE,
    "net_equality_within": GREEN,
    "net_equality_between": ORANGE,
}
"""The colours of lines; those that no tab shows have a grey."""
SHARES: Final = (
    "violations_per_step",
    "own_share_of_bites",
    "detection_rate",
    "recidivism",
    "unjust_share_of_tags",
)
"""The metrics that share a plot; only their running means are shown there."""
EQUALITIES: Final = tuple(name for name in COLOURS if "equality" in name)
IN_FORCE: Final = (ORANGE, BLUE, GREEN, PURPLE)
"""The colours of decisions."""
PAID, GIVEN = "paid", "given"
"""The lines of each agent in a replay: what institutions take in a turn, downwards, and give, upwards."""

Plot = Callable[..., Any]


def has_institutions(curves: Curves) -> bool:
    return bool(curves.institutions or curves.in_force)


def tabs(curves: Curves, plot: Plot) -> list[Any]:
    """The tabs of a game with institutions: what each agent pays, gets and breaks; shares and decisions."""
    if not has_institutions(curves):
        return []
    there = [name for name in OF_AGENTS if name in curves.institutions]
    titles = {
        "violations": "Violations of each, turns",
        "fines": "Fines of each, apples",
        "transfers": "Transfers to each, apples",
    }
    of_each = [
        plot(title, *(f"{agent}/{name}" for agent in curves.agents))
        for name, title in titles.items()
        if name in there
    ]
    shares, equalities = (_entities(names, curves) for names in (SHARES, EQUALITIES))
    baseline = [f"{RANDOM_PLAY}/institutions/net_equality"]
    decided = [f"institutions/in_force_{ballot}" for ballot in range(len(curves.in_force))]
    rules = [
        plot("Shares of violations, bites, tags", *shares, share=True) if shares else None,
        plot("Equality of net incomes", *equalities, *baseline, share=True) if equalities else None,
        plot(f"In force: {', '.join(curves.in_force)}", *decided) if decided else None,
    ]
    return [tab for tab in (row("Institutions", *of_each), row("Rules kept", *rules)) if tab is not None]


def _entities(names: Sequence[str], curves: Curves) -> list[str]:
    return [f"institutions/{name}" for name in names if name in curves.institutions]


def lines(curves: Curves) -> dict[str, Any]:
    """The names, colours and widths of the lines, by entity; none for a game without institutions."""
    styles = {
        f"institutions/{name}": running(
            METRICS[name].words, COLOURS.get(name, GREY), curves.replicas, alone=name in SHARES
        )
        for name in curves.institutions
    }
    for ballot, title in enumerate(curves.in_force):
        colour = IN_FORCE[ballot % len(IN_FORCE)]
        styles[f"institutions/in_force_{ballot}"] = running(title, colour, curves.replicas)
    for name in curves.institutions:
        styles[f"{RANDOM_PLAY}/institutions/{name}"] = rr.SeriesLines(
            names=["random play"], colors=[GREY], widths=[1.0]
        )
    for agent, called in enumerate(curves.agents):
        for name in OF_AGENTS:
            if name in curves.institutions:
                styles[f"{called}/{name}"] = running(called, agent_colour(agent), replicas=1)
    return styles
