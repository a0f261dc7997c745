"""A game for readers: its rules and institutions in words, beside its board."""

import re
from collections.abc import Iterable
from dataclasses import fields
from html import escape
from inspect import getdoc
from typing import TYPE_CHECKING, Final

from cprl.commons.svg import board_svg
from cprl.institutions import (
    Boundaries,
    ClosedSeason,
    Institution,
    Monitoring,
    Punishment,
    Quota,
    Rotation,
    Tax,
)
from cprl.institutions.base import Limit

if TYPE_CHECKING:
    from cprl.commons.game import Game


def game_html(game: "Game") -> str:
    """A game's board and its rules in words, as HTML."""
    return (
        f"<p>{escape(growth_of(game))} Rules: {escape(rules_of(game) or NO_RULES)}.</p>{board_svg(game.map)}"
    )


NO_RULES: Final = "none beyond the game"


def growth_of(game: "Game") -> str:
    """How apples grow back, for readers who see the game for the first time."""
    if game.map.river:
        return "Agents pick apples. Apples grow only while the river is clean; who cleans it picks nothing."
    probs = game.rules.regrow_prob
    if probs[0] > 0 or len(probs) < 2:
        return "Agents pick apples, which grow back."
    return (
        "Agents pick apples. Apples grow back only near other apples, faster where there are more: "
        "a place that is picked bare stays bare."
    )


def rules_of(game: "Game | None") -> str:
    """The institutions of a game, each with its first number and all that are not the defaults, e.g.
    "quota (share 0.25, fine 2), monitoring (prob 0.5)"."""
    return ", ".join(rule_of(institution) for institution in (game.institutions if game else ()))


def rule_of(institution: Institution) -> str:
    """An institution with its first number and all that are not the defaults."""
    words = re.sub("(?<!^)(?=[A-Z])", " ", type(institution).__name__).lower()
    settings: list[str] = []
    for field in fields(institution):
        value = getattr(institution, field.name)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if isinstance(value, Institution):
            settings.append(f"on {rule_of(value)}")
        elif is_number and (not settings or value != field.default):
            settings.append(f"{field.name.replace('_', ' ')} {value:g}")
    return f"{words} ({', '.join(settings)})" if settings else words


def meaning_of(institution: Institution, game: "Game") -> str:
    """What an institution does in this game, in sentences for readers who do not know its settings."""
    match institution:
        case Quota(window_steps=window):
            apples = int(institution.share * game.sustainable_yield * window / game.agents + 1e-9)
            fewer = ", and fewer as the board empties" if institution.by_stock else ""
            words = f"Each agent may pick at most {apples:,} apples in {window:,} turns{fewer}. "
            return words + _breach(institution, game)
        case ClosedSeason(period_steps=period, closed_steps=closed):
            words = f"Nobody may pick in the last {closed:,} of every {period:,} turns. "
            return words + _breach(institution, game)
        case Rotation(window_steps=window):
            words = f"Only one agent may pick; every {window:,} turns it is another one. "
            return words + _breach(institution, game)
        case Tax(brackets=(), rate=rate):
            goes = "shared equally among all" if institution.redistribution == "equal" else "lost"
            return f"{rate:.0%} of what each agent picks is taken and {goes}."
        case Monitoring(prob=prob):
            return f"Of the turns in which an agent breaks a rule, {prob:.0%} are noticed."
        case Punishment(fine=fine, cost=cost, shot_cost=shot_cost):
            words = f"A hit costs the agent that is hit {fine:g} apples and the shooter {cost:g}."
            return words + f" Each shot costs {shot_cost:g}." * (shot_cost > 0)
    sentence = " ".join((getdoc(institution) or "").partition("\n\n")[0].split())
    return re.sub(r" \(.*\)\.$", ".", sentence)


def _breach(limit: Limit, game: "Game") -> str:
    """What happens to who picks against a limit."""
    if limit.fine is None:
        return "More cannot be picked."
    noticed = " if it is noticed" * any(isinstance(one, Monitoring) for one in game.institutions)
    return f"Each apple picked against this rule costs {limit.fine:g} apples{noticed}." if limit.fine else ""


def legend_of(games: Iterable["Game"]) -> str:
    """What the signs on the boards of these games mean, in sentences; only signs that can appear."""
    return " ".join(dict.fromkeys(sign for game in games for sign in _signs(game)))


def _signs(game: "Game") -> list[str]:
    signs = [
        "A number on a colour is an agent, its triangle points where it looks.",
        "Green is an apple, dim a place without one.",
    ]
    if game.map.walls:
        signs.append("Grey is a wall.")
    if game.map.river:
        signs.append("Blue is the river, brown its waste.")
    if game.rules.may_fire:
        turns = game.rules.freeze_steps
        leaves = f": an agent that is hit leaves the board for {turns:,} turns" if turns else ""
        signs.append(f"Light dots are a beam{leaves}.")
    if any(isinstance(institution, Boundaries) for institution in game.institutions):
        signs.append("Frames are regions with owners.")
    if any(institution.can_be_broken for institution in game.institutions):
        signs.append("A white diamond marks an agent that breaks a rule.")
    return signs
