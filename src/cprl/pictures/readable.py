"""Say a game's rules and institutions in words, for people who do not know the settings.

`tests/pictures/test_readable.py` plays games to check that the sentences are true of them.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import fields
from html import escape
from itertools import product
from typing import Final

import numpy as np

from cprl.commons.game import Game
from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    Governor,
    GraduatedSanctions,
    Institution,
    Levies,
    Mediation,
    Monitoring,
    Punishment,
    Quota,
    Rotation,
    Sanctioner,
    Tax,
    Vote,
)
from cprl.institutions.institution import Kind
from cprl.institutions.monitoring import ELECTED
from cprl.pictures.image import board_html
from cprl.values import is_number


def game_html(game: Game, custom_rules: str = "") -> str:
    """Return a game as HTML: its rules in words, and its board.

    `custom_rules`: further rules in words, e.g. those of the user's own transforms.
    """
    rules = "; ".join(filter(None, (rules_of(game), custom_rules))) or NO_RULES
    return f"<p>{escape(growth_of(game))} Rules: {escape(rules)}.</p>{board_html(game.map)}"


NO_RULES: Final = "none beyond the game"
"""The text in place of institutions for a game without any."""


def growth_of(game: Game) -> str:
    """Return sentences that say how apples grow back, for readers who are new to the game."""
    rules = game.rules
    river = rules.river
    probs = rules.regrow_prob
    if river is not None:
        return (
            "Agents pick apples. Apples grow slower the more waste is in the river, and not at all where it "
            f"covers {_percent(river.pollution_limit)} of it{'; agents can clean it' * river.may_clean}."
        )
    if not any(probs):
        return "Agents pick apples, which do not grow back."
    if probs[0] > 0:
        return "Agents pick apples, which grow back."
    is_even = rules.regrow_by == "count" and len({*probs[1:]}) == 1
    faster = "" if is_even else ", faster where there are more"
    return (
        f"Agents pick apples. Apples grow back only near other apples{faster}: "
        "a patch that is picked bare stays bare."
    )


def rules_of(game: Game | None) -> str:
    """Return the names and settings of a game's institutions in one line, "" without any.

    Example: "quota (share 0.25, fine 2), monitoring (prob 0.5)".
    """
    return ", ".join(rule_of(institution) for institution in (game.institutions if game else ()))


def rule_of(institution: Institution, *, is_voted_on: bool = False) -> str:
    """Return the name of an institution with its main settings, e.g. "quota (share 0.25, fine 2)".

    These are its first number and all numbers that differ from their defaults. A rate or share is left out if
    it is not used, because agents vote on it or because a tax has brackets.
    """
    text = in_lower_case(type(institution).__name__)
    has_brackets = isinstance(institution, Tax) and len(institution.brackets) > 0
    unused = {"rate", "share"} if is_voted_on or has_brackets else set[str]()
    settings: list[str] = []
    for field in fields(institution):
        value = getattr(institution, field.name)
        numbers = _numbers(value)
        if isinstance(value, Institution):
            settings.append(f"on {rule_of(value, is_voted_on=True)}")
        elif numbers and field.name not in unused and (value != field.default or not (settings or unused)):
            settings.append(f"{field.name.replace('_', ' ')} {' '.join(map(_number, numbers))}")
    return f"{text} ({', '.join(settings)})" if settings else text


def _numbers(value: object) -> list[float]:
    """Return the numbers that a field holds: those of a tuple, or the value itself if it is one."""
    values = value if isinstance(value, tuple) else (value,)
    return list(filter(is_number, values))


def in_lower_case(name: str) -> str:
    """Return the name of a class in words: "closed season" for "ClosedSeason"."""
    return re.sub("(?<=[a-z])(?=[A-Z])", " ", name).lower()


def capitalised(text: str) -> str:
    """Return a text with its first letter in upper case."""
    return text[:1].upper() + text[1:]


def tag_of(game: Game) -> str:
    """Return a clause that says how agents are tagged in a game and what happens to them then.

    Example: "after 2 hits an agent leaves the board for 24 turns". The clause is "" if nobody can be tagged,
    or if a tag has no effect.
    """
    rules = game.rules
    if not rules.may_fire or game.agents == 1:
        return ""
    sanctions = _sanctions_of_tags(game)
    punishment = _first(game, Punishment)
    missed = _turns_missed(game, sanctions)
    effects = []
    if punishment is not None and punishment.fine:
        effects.append(f"is fined {_apples(punishment.fine)} by each who tags it")
    if sanctions is not None and any(sanctions.fines):
        effects.append(f"pays {_by_level(sanctions.fines, 'apple')}")
    if any(missed):
        returning = "" if rules.clashes == "pairwise" else ", longer while its cell is taken"
        if rules.respawn_at_spawns:
            returning = " and returns at a free spawn place"
        effects.append(f"leaves the board for {_missed(missed, sanctions)}{returning}")
    elif rules.respawn_at_spawns:
        effects.append("goes to a free spawn place")
    subject = "an agent that is hit" if rules.hits_to_tag == 1 else f"after {rules.hits_to_tag} hits an agent"
    return f"{subject} {' and '.join(effects)}" if effects else ""


def _turns_missed(game: Game, sanctions: GraduatedSanctions | None) -> tuple[int, ...]:
    """Return the turns that an agent misses after a tag or another offence, by the level of sanctions.

    If the sanctions have a table, its rows for the agents that tag follow one another.
    """
    freeze_steps = game.rules.freeze_steps if sanctions is None else sanctions.freeze_steps
    quirks = game.rules.quirks
    counts_tag_turn = quirks is not None and quirks.freeze_counts_tag_turn
    return tuple(max(0, steps - counts_tag_turn) for steps in np.ravel(freeze_steps).tolist())


def _sanctions_of_tags(game: Game) -> GraduatedSanctions | None:
    """Return the sanctions that replace `Rules.freeze_steps` in a game; None without any."""
    sanctions = _first(game, GraduatedSanctions)
    return sanctions if sanctions is not None and sanctions.is_for_tags else None


def _first(game: Game, kind: type[Kind]) -> Kind | None:
    """Return the first institution of a kind in a game, None without one."""
    return next((institution for institution in game.institutions if isinstance(institution, kind)), None)


def meaning_of(institution: Institution, game: Game) -> str:
    """Return sentences that say what an institution does in a game, for readers who do not know its
    settings."""
    match institution:
        case Boundaries():
            return _boundaries(institution, game)
        case Quota():
            apples = institution.share * _quota_unit(institution, game)
            return _quota(institution, game, _apples(int(apples + 1e-9)))
        case ClosedSeason(period_steps=period, closed_steps=closed):
            text = f"Nobody {_may(institution.fine)} pick in the last {closed:,} of every {_turns(period)}."
            return text + _breach(institution.fine, game)
        case ClosedPatches(below=below):
            few = f"has fewer than {_apples(below)} when a turn begins"
            text = f"Nobody {_may(institution.fine)} pick from a patch of near places that {few}."
            return text + _breach(institution.fine, game)
        case Rotation(window_steps=window):
            text = f"Only one agent {_may(institution.fine)} pick; every {_turns(window)} it is the next one."
            return text + _breach(institution.fine, game)
        case Vote():
            return _vote(institution, game)
        case Governor(every_steps=every):
            options = ", ".join(map(_number, institution.options))
            return f"Every {_turns(every)} a governor sets {institution.controlled.title}: one of {options}."
        case Tax():
            return _tax(institution)
        case Levies(groups=groups, local_rate=local, joint_rate=joint):
            agents = "; ".join(_agents(group) for group in groups)
            text = f"{_percent(local)} of what each agent picks is shared equally within its group ({agents})"
            return f"{text}, and {_percent(joint)} among all."
        case Monitoring(prob=prob, cost=cost):
            text = f"Of the turns in which an agent breaks a rule, {_percent(prob)} are noticed."
            return text + f" That costs {_apples(cost)} a turn, paid by {_payer(institution)}." * (cost > 0)
        case GraduatedSanctions():
            return _graduated_sanctions(institution, game)
        case Mediation(turns=turns, refund=refund):
            text = f"An agent that is tagged and broke no rule in the last {_turns(turns)}"
            return text + f" gets {_apples(refund)} from who tagged it."
        case Punishment(fine=fine, cost=cost, shot_cost=shot_cost):
            hits = game.rules.hits_to_tag
            tag = "A hit" if hits == 1 else f"A tag, which takes {hits} hits,"
            text = f"{tag} costs the agent that is hit {_apples(fine)} and the shooter {_number(cost)}."
            return text + f" Each shot costs {_number(shot_cost)}." * (shot_cost > 0)
        case Sanctioner():
            return _sanctioner(institution)
    raise TypeError(f"{type(institution).__name__} has no sentence in cprl.pictures.readable")


def _boundaries(boundaries: Boundaries, game: Game) -> str:
    fine = boundaries.bite_fine
    step_fine = boundaries.step_fine
    may_not = "cannot" if fine is None else "may not"
    text = f"The board has regions with owners; others {may_not} pick there.{_breach(fine, game)}"
    if step_fine is None:
        return text
    return f"{text} A turn that ends in another's region {_costs(step_fine, game)}."


def _quota_unit(quota: Quota, game: Game) -> float:
    """Return the apples that an agent may pick in a window of turns where the quota's share is 1."""
    return game.sustainable_yield * quota.window_steps / game.agents


def _quota(quota: Quota, game: Game, most: str) -> str:
    """Return sentences about a quota; `most`: the largest harvest in a window, in words."""
    fewer = ", fewer if the board is not full when it begins" if quota.by_stock else ""
    text = f"Each agent may pick at most {most} in each window of {_turns(quota.window_steps)}{fewer}."
    return text + (" More cannot be picked." if quota.is_stopped else _breach(quota.fine, game))


def _tax(tax: Tax, rate: str = "") -> str:
    """Return a sentence about a tax; `rate`: the rate in words, if agents vote on it."""
    use = "shared equally among all" if tax.redistribution == "equal" else "lost"
    if not tax.brackets:
        return f"{rate or _percent(tax.rate)} of what each agent picks is taken and {use}."
    brackets = ", ".join(f"{_percent(share)} from {_number(apples)} on" for apples, share in tax.brackets)
    text = f"Of the apples that an agent picks in {_turns(tax.period_steps)} a part is taken and {use}"
    return f"{text}: {brackets}."


def _vote(vote: Vote, game: Game) -> str:
    choices = ", ".join(map(_number, vote.choices))
    text = f"Agents vote on {vote.on.voted_on}, {choices}, {_every(vote.period_episodes)}: the median counts"
    text += _override(vote.override_prob)
    if isinstance(vote.on, Tax):
        return f"{text}. {_tax(vote.on, 'That share')}"
    unit = _number(round(_quota_unit(vote.on, game), 1))
    return f"{text}. {_quota(vote.on, game, f'that share of {unit} apples')}"


def _sanctioner(sanctioner: Sanctioner) -> str:
    if sanctioner.agents is not None:
        return f"Only {_agents(sanctioner.agents)} may fire."
    text = f"Only one agent may fire, which all elect {_every(sanctioner.period_episodes)}"
    return f"{text}{_override(sanctioner.override_prob)}."


def _graduated_sanctions(sanctions: GraduatedSanctions, game: Game) -> str:
    is_broken = any(institution.can_be_broken for institution in game.institutions)
    offences = []
    if sanctions.is_for_tags and game.rules.may_fire:
        offences.append("to be tagged")
    if sanctions.on != "tags" and is_broken:
        offences.append(f"a turn in which it breaks a rule{_noticed(game)}")
    turns = _missed(_turns_missed(game, sanctions), sanctions)
    text = f"An agent's offences ({' or '.join(offences)}) cost it a time-out of {turns}"
    text += f" and {_by_level(sanctions.fines, 'apple')}" * any(sanctions.fines)
    if sanctions.recovery_steps is None:
        return f"{text}."
    return f"{text}; each {_turns(sanctions.recovery_steps)} without one take one back."


def _may(fine: float | None) -> str:
    """Return "can" for a rule that makes something impossible, "may" for one that fines it."""
    return "can" if fine is None else "may"


def _breach(fine: float | None, game: Game) -> str:
    """Return a sentence about the cost of breaking the rule just told; "" if it cannot be broken."""
    return "" if fine is None else f" Each apple picked against this rule {_costs(fine, game)}."


def _costs(fine: float, game: Game) -> str:
    return f"costs {_apples(fine)}{_noticed(game)}" if fine else "is a violation, but costs nothing by itself"


def _noticed(game: Game) -> str:
    return " if it is noticed" if _first(game, Monitoring) else ""


def _payer(monitoring: Monitoring) -> str:
    if monitoring.monitor is None:
        return "all in equal parts"
    if monitoring.monitor == ELECTED:
        return f"an agent that all elect {_every(monitoring.period_episodes)}"
    return f"agent {monitoring.monitor}"


def _every(episodes: int) -> str:
    return "in each episode" if episodes == 1 else f"every {episodes:,} episodes"


def _override(prob: float) -> str:
    return f", but with a probability of {_percent(prob)} chance decides" if prob else ""


def _agents(indices: Sequence[int]) -> str:
    return f"agent{'s' * (len(indices) > 1)} {' and '.join(map(str, indices))}"


def _missed(missed: Sequence[int], sanctions: GraduatedSanctions | None) -> str:
    """Return the length of a time-out in words: by level, or its range if it also depends on the shooter."""
    if sanctions is not None and sanctions.is_table:
        return f"{min(missed):,} to {_turns(max(missed))}, by who tags it and how often it was tagged"
    return _by_level(missed, "turn")


def _by_level(numbers: Sequence[float], unit: str) -> str:
    """Return amounts by level in words, e.g. "4 turns (24, then 99 as offences add up)".

    The last amount applies to all higher levels, so that repetitions of it are left out.
    """
    amounts = [*numbers]
    while len(amounts) > 1 and amounts[-1] == amounts[-2]:
        amounts.pop()
    later_amounts = ", then ".join(map(_number, amounts[1:]))
    return _amount(amounts[0], unit) + (f" ({later_amounts} as offences add up)" if later_amounts else "")


def _number(value: float) -> str:
    return f"{value:,.10g}"


def _turns(count: int) -> str:
    return _amount(count, "turn")


def _apples(amount: float) -> str:
    return _amount(amount, "apple")


def _amount(amount: float, unit: str) -> str:
    return f"{_number(amount)} {unit}{'s' * (amount != 1)}"


def _percent(share: float) -> str:
    return f"{_number(100 * share)}%"


def legend_of(games: Iterable[Game]) -> str:
    """Return sentences that explain the signs on the boards of games; only signs that can appear there."""
    return " ".join(dict.fromkeys(sentence for game in games for sentence in _sign_sentences(game)))


def _sign_sentences(game: Game) -> list[str]:
    """Return a sentence for each sign that can appear on the board of a game."""
    signs = [
        "A number on a colour is an agent, its triangle points where it looks.",
        "Green is an apple, dim a place without one.",
    ]
    if game.map.walls:
        signs.append("Grey is a wall.")
    if game.map.river:
        signs.append("Blue is the river, brown its waste.")
    if game.rules.may_fire:
        tag = tag_of(game)
        signs.append(f"Light dots are a beam{f': {tag}' * bool(tag)}.")
    if any(isinstance(institution, Boundaries) for institution in game.institutions):
        signs.append("Frames are regions with owners.")
    if any(institution.can_be_broken for institution in game.institutions):
        signs.append("A white diamond marks an agent that breaks a rule.")
    return signs


def instructions_of(game: Game, view: str) -> list[str]:
    """Return the rules of a game in sentences, for those who play it."""
    tag = tag_of(game)
    seen = "the whole board" if view == "board" else "the cells around you, your heading up"
    sentences = [growth_of(game), f"You see {seen}.", *([f"{capitalised(tag)}."] if tag else [])]
    sentences += [meaning_of(institution, game) for institution in game.institutions]
    steps = game.rules.episode_steps
    return [*sentences, f"A round has {steps:,} turns at most; it ends earlier if no apple is left."]


def options_of(game: Game) -> list[str] | None:
    """Return the decisions of a game in words, in the order of their numbers; None without ballots."""
    words = []
    for ballot in game.ballots:
        elected = "agent " * ballot.is_election
        words.append([f"{ballot.title}: {elected}{choice:g}" for choice in ballot.choices])
    # The first ballot changes fastest.
    return ["; ".join(reversed(choices)) for choices in product(*reversed(words))] if words else None
