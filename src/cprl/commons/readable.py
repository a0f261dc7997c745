"""A game for readers: its rules and institutions in words, beside its board."""

import re
from dataclasses import fields
from html import escape
from inspect import getdoc
from typing import TYPE_CHECKING, Final

from cprl.commons.svg import board_svg
from cprl.institutions import Institution

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


def meaning_of(institution: Institution) -> str:
    """What an institution does, in a sentence."""
    return " ".join((getdoc(institution) or "").partition("\n\n")[0].split())
