"""A game for readers: its rules and institutions in words, beside its board.

What these sentences say holds in the game that they are about; `tests/test_readable.py` plays it.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import fields
from html import escape
from typing import Final

import numpy as np

from cprl.commons.game import Game
from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
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
from cprl.institutions.base import Kind
from cprl.institutions.monitoring import ELECTED
from cprl.pictures.svg import board_svg


def game_html(game: Game, own_rules: str = "") -> str:
    """Return a game's board and rules in words, as HTML; `own_rules`: rules of the user's own, in words."""
    rules = "; ".join(filter(None, (rules_of(game), own_rules))) or NO_RULES
    return f"<p>{escape(growth_of(game))} Rules: {escape(rules)}.</p>{board_svg(game.map)}"


NO_RULES: Final = "none beyond the game"


def growth_of(game: Game) -> str:
    """Say how apples grow back, for readers who see the game for the first time."""
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
    """Name the institutions of a game, each with its first number and all that are not the defaults, e.g.
    "quota (share 0.25, fine 2), monitoring (prob 0.5)"."""
    return ", ".join(rule_of(institution) for institution in (game.institutions if game else ()))


def rule_of(institution: Institution, *, is_voted_on: bool = False) -> str:
    """Name an institution with its first number and all that are not the defaults; without a rate or share
    that is not used, since it is voted on or there are brackets."""
    words = in_lower_case(type(institution).__name__)
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
    return f"{words} ({', '.join(settings)})" if settings else words


def _numbers(value: object) -> list[float]:
    """Return the numbers that a field holds: those of a tuple, or the value itself if it is one."""
    values = value if isinstance(value, tuple) else (value,)
    return [each for each in values if isinstance(each, int | float) and not isinstance(each, bool)]


def in_lower_case(name: str) -> str:
    """Return the name of a class in words, e.g. "closed season"."""
    return re.sub("(?<=[a-z])(?=[A-Z])", " ", name).lower()


def tag_of(game: Game) -> str:
    """Say what it takes to tag an agent in this game and what that does to it, e.g. "after 2 hits an agent
    leaves the board for 24 turns"; "" where nobody can be tagged, or nothing follows."""
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
        place = "" if rules.clashes == "pairwise" else ", longer while its cell is taken"
        place = " and returns at a free spawn place" if rules.respawn_at_spawns else place
        effects.append(f"leaves the board for {_missed(missed, sanctions)}{place}")
    elif rules.respawn_at_spawns:
        effects.append("goes to a free spawn place")
    who = "an agent that is hit" if rules.hits_to_tag == 1 else f"after {rules.hits_to_tag} hits an agent"
    return f"{who} {' and '.join(effects)}" if effects else ""


def _turns_missed(game: Game, sanctions: GraduatedSanctions | None) -> tuple[int, ...]:
    """Return the turns that an agent misses after a tag, or after any other offence, by the level of
    sanctions, and by who tags it where sanctions have a table."""
    steps = np.ravel(game.rules.freeze_steps if sanctions is None else sanctions.freeze_steps).tolist()
    quirks = game.rules.quirks
    counts_tag_turn = quirks is not None and quirks.freeze_counts_tag_turn
    return tuple(max(0, each - counts_tag_turn) for each in steps)


def _sanctions_of_tags(game: Game) -> GraduatedSanctions | None:
    """Return the sanctions of a game that take the place of `Rules.freeze_steps`."""
    sanctions = _first(game, GraduatedSanctions)
    return None if sanctions is None or sanctions.on == "violations" else sanctions


def _first(game: Game, kind: type[Kind]) -> Kind | None:
    """Return the institution of a kind of which a game has one at most."""
    return next((each for each in game.institutions if isinstance(each, kind)), None)


def meaning_of(institution: Institution, game: Game) -> str:
    """Say what an institution does in this game, in sentences for readers who do not know its settings."""
    match institution:
        case Boundaries():
            return _boundaries(institution, game)
        case Quota():
            apples = institution.share * _quota_unit(institution, game)
            return _quota(institution, game, _apples(int(apples + 1e-9)))
        case ClosedSeason(period_steps=period, closed_steps=closed):
            words = f"Nobody {_may(institution.fine)} pick in the last {closed:,} of every {_turns(period)}."
            return words + _breach(institution.fine, game)
        case ClosedPatches(below=below):
            few = f"has fewer than {_apples(below)} when a turn begins"
            words = f"Nobody {_may(institution.fine)} pick from a patch of near places that {few}."
            return words + _breach(institution.fine, game)
        case Rotation(window_steps=window):
            words = (
                f"Only one agent {_may(institution.fine)} pick; every {_turns(window)} it is the next one."
            )
            return words + _breach(institution.fine, game)
        case Vote():
            return _vote(institution, game)
        case Tax():
            return _tax(institution)
        case Levies(groups=groups, local_rate=local, joint_rate=joint):
            who = "; ".join(_agents(group) for group in groups)
            words = f"{_percent(local)} of what each agent picks is shared equally within its group ({who}), "
            return words + f"and {_percent(joint)} among all."
        case Monitoring(prob=prob, cost=cost):
            words = f"Of the turns in which an agent breaks a rule, {_percent(prob)} are noticed."
            return words + f" That costs {_apples(cost)} a turn, paid by {_payer(institution)}." * (cost > 0)
        case GraduatedSanctions():
            return _graduated_sanctions(institution, game)
        case Mediation(turns=turns, refund=refund):
            words = f"An agent that is tagged and broke no rule in the last {_turns(turns)}"
            return words + f" gets {_apples(refund)} from who tagged it."
        case Punishment(fine=fine, cost=cost, shot_cost=shot_cost):
            hits = game.rules.hits_to_tag
            tag = "A hit" if hits == 1 else f"A tag, which takes {hits} hits,"
            words = f"{tag} costs the agent that is hit {_apples(fine)} and the shooter {_number(cost)}."
            return words + f" Each shot costs {_number(shot_cost)}." * (shot_cost > 0)
        case Sanctioner():
            return _sanctioner(institution)
    raise TypeError(f"{type(institution).__name__} has no sentence in cprl.pictures.readable")


def _boundaries(boundaries: Boundaries, game: Game) -> str:
    bite = boundaries.bite_fine
    step = boundaries.step_fine
    may_not = "cannot" if bite is None else "may not"
    words = f"The board has regions with owners; others {may_not} pick there.{_breach(bite, game)}"
    if step is None:
        return words
    return f"{words} A turn that ends in another's region {_costs(step, game)}."


def _quota_unit(quota: Quota, game: Game) -> float:
    """Return the apples that an agent may pick in a window of turns where the quota's share is 1."""
    return game.sustainable_yield * quota.window_steps / game.agents


def _quota(quota: Quota, game: Game, most: str) -> str:
    """Say what a quota of at most so much means."""
    fewer = ", fewer if the board is not full when it begins" if quota.by_stock else ""
    words = f"Each agent may pick at most {most} in each window of {_turns(quota.window_steps)}{fewer}."
    return words + (" More cannot be picked." if quota.is_stopped else _breach(quota.fine, game))


def _tax(tax: Tax, rate: str = "") -> str:
    """Say what a tax means; `rate`: what is said of it where it is voted on."""
    goes = "shared equally among all" if tax.redistribution == "equal" else "lost"
    if not tax.brackets:
        return f"{rate or _percent(tax.rate)} of what each agent picks is taken and {goes}."
    brackets = ", ".join(f"{_percent(share)} from {_number(apples)} on" for apples, share in tax.brackets)
    words = f"Of the apples that an agent picks in {_turns(tax.period_steps)} a part is taken and {goes}"
    return f"{words}: {brackets}."


def _vote(vote: Vote, game: Game) -> str:
    choices = ", ".join(map(_number, vote.choices))
    words = f"Agents vote on {vote.on.voted_on}, {choices}, {_every(vote.period_episodes)}: the median counts"
    words += _override(vote.override_prob)
    if isinstance(vote.on, Tax):
        return f"{words}. {_tax(vote.on, 'That share')}"
    unit = _number(round(_quota_unit(vote.on, game), 1))
    return f"{words}. {_quota(vote.on, game, f'that share of {unit} apples')}"


def _sanctioner(sanctioner: Sanctioner) -> str:
    if sanctioner.agents is not None:
        return f"Only {_agents(sanctioner.agents)} may fire."
    words = f"Only one agent may fire, which all elect {_every(sanctioner.period_episodes)}"
    return f"{words}{_override(sanctioner.override_prob)}."


def _graduated_sanctions(sanctions: GraduatedSanctions, game: Game) -> str:
    is_broken = any(institution.can_be_broken for institution in game.institutions)
    offences = []
    if sanctions.on != "violations" and game.rules.may_fire:
        offences.append("to be tagged")
    if sanctions.on != "tags" and is_broken:
        offences.append(f"a turn in which it breaks a rule{_noticed(game)}")
    turns = _missed(_turns_missed(game, sanctions), sanctions)
    words = f"An agent's offences ({' or '.join(offences)}) cost it a time-out of {turns}"
    words += f" and {_by_level(sanctions.fines, 'apple')}" * any(sanctions.fines)
    if sanctions.recovery_steps is None:
        return f"{words}."
    return f"{words}; each {_turns(sanctions.recovery_steps)} without one take one back."


def _may(fine: float | None) -> str:
    """Return "can" where a rule stops what it forbids, "may" where that has a price."""
    return "can" if fine is None else "may"


def _breach(fine: float | None, game: Game) -> str:
    """Say what happens to who picks against a rule, after the sentence about the rule; "" if nobody can."""
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
    """Say the turns of a time-out, by level; the least and the most where they depend on who tags, too."""
    if sanctions is not None and sanctions.is_table:
        return f"{min(missed):,} to {_turns(max(missed))}, by who tags it and how often it was tagged"
    return _by_level(missed, "turn")


def _by_level(numbers: Sequence[float], unit: str) -> str:
    """Say the amounts of levels, e.g. "4 turns (24, then 99 as offences add up)"; the last one holds for all
    higher levels."""
    levels = [*numbers]
    while len(levels) > 1 and levels[-1] == levels[-2]:
        levels.pop()
    more = ", then ".join(map(_number, levels[1:]))
    return _amount(levels[0], unit) + (f" ({more} as offences add up)" if more else "")


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
    """Say what the signs on the boards of these games mean, in sentences; only signs that can appear."""
    return " ".join(dict.fromkeys(sign for game in games for sign in _signs(game)))


def _signs(game: Game) -> list[str]:
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
