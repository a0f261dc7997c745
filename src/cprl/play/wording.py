"""What a person who plays reads."""

from collections.abc import Iterator
from math import isnan

from cprl.measuring.names import title
from cprl.play.session import Session, TurnPlayed


def state(session: Session) -> str:
    """The turn, the apples on the board, and everybody's score."""
    scores = [
        f"{apples} by {'you' if agent == session.agent else f'agent {agent}'}{_out(session, agent)}"
        for agent, apples in enumerate(session.harvested)
    ]
    of_steps = f"turn {session.turn:,} of {session.game.rules.episode_steps:,}"
    return f"{of_steps}; {session.stock} apples on the board; harvested: {', '.join(scores)}"


def _out(session: Session, agent: int) -> str:
    return "" if session.moments[-1].in_play[agent] else " (out of play)"


def happened(session: Session, turn: TurnPlayed) -> Iterator[str]:
    """What a turn brought the person, and who tagged whom."""
    me = session.agent
    if turn.harvest[me]:
        yield "you harvest an apple"
    if turn.fired[me] and not turn.tagged_by[:, me].any():
        yield "your beam tags nobody out"
    for tagged, by in zip(*turn.tagged_by.nonzero(), strict=True):
        whom = "you out" if tagged == me else f"agent {tagged} out"
        yield f"you tag {whom}" if by == me else f"agent {by} tags {whom}"


def ending(session: Session) -> str:
    """Why it is over, if it is."""
    if not session.has_ended:
        return f"stopped after turn {session.turn:,}"
    return "no apple is left" if session.stock == 0 else "time is over"


def results_text(session: Session) -> str:
    """Return the social metrics of the turns played, a line each: name, value, words and unit."""
    lines = [f"{name:17s} {_number(value):>9s}  {title(name)}" for name, value in session.metrics().items()]
    return "\n".join(lines) or "No turn was played, so there is nothing to measure."


def _number(value: float) -> str:
    return "undefined" if isnan(value) else f"{value:.4g}"
