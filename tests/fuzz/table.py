"""The table of outcomes, as Markdown."""

from collections.abc import Mapping

from . import cases
from .cases import Target
from .runner import ACCEPTED, REFUSED, Outcome

KINDS = (cases.CONSTRUCTOR, cases.FUNCTION, cases.FILE, cases.COMMAND)


def markdown(outcomes: Mapping[str, Outcome], targets: Mapping[str, Target], *, command: str) -> str:
    """A row for each target, by kind, and one for all."""
    lines = [
        "# What generated inputs come to",
        "",
        f"Written by `{command}`; [reliability](reliability.md) says what is tried and what counts.",
        "",
        "| target | accepted | refused as documented | anything else |",
        "|:--|---:|---:|---:|",
    ]
    for kind in KINDS:
        own = {name: outcomes[name] for name in outcomes if targets[name].kind == kind}
        if own:
            lines.append(_row(f"**{kind}s**", *own.values(), bold=True))
            lines += [_row(f"`{_short(name)}`", outcome) for name, outcome in sorted(own.items())]
    return "\n".join([*lines, _row("**all**", *outcomes.values(), bold=True), ""])


def _short(name: str) -> str:
    return name.split(":", 1)[1] if name.startswith(("file:", "command:")) else name.replace(":", ".")


def _row(name: str, *outcomes: Outcome, bold: bool = False) -> str:
    numbers = (
        sum(own.counts[ACCEPTED] for own in outcomes),
        sum(own.counts[REFUSED] for own in outcomes),
        sum(own.elsewise for own in outcomes),
    )
    shown = (f"**{number:,}**" if bold else f"{number:,}" for number in numbers)
    return f"| {name} | {' | '.join(shown)} |"
