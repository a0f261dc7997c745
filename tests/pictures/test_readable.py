"""What readers are told of a game's rules, compared with the game as it is played."""

import re
from dataclasses import replace

import pytest
from boards import only_quirks
from hypothesis import given, settings, strategies as st
from valid_values import valid

from cprl import CommonsEnv, Game, Rules, maps, presets
from cprl.commons.named_games import GAMES
from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    GraduatedSanctions,
    Levies,
    Monitoring,
    Punishment,
    Quota,
    Rotation,
    Sanctioner,
    Tax,
    Vote,
)
from cprl.institutions.law import INSTITUTION_KINDS
from cprl.pictures.readable import growth_of, legend_of, meaning_of, rule_of, tag_of

COMMONS = presets.game("commons")
AS_RUN = presets.game("commons", variant="as_run")
SHOOTER, TAGGED = 0, 1
RIGHT = 1


def governed(*institutions, game=COMMONS, **rules):
    return replace(game, institutions=institutions, rules=replace(game.rules, **rules))


def numbers(words):
    return [float(number.replace(",", "")) for number in re.findall(r"[\d,.]*\d", words)]


def said(sentence):
    """The hits that a sentence asks for, and the turns and the apples that a tag costs, by level."""
    hits = re.search(r"after (\d+) hits", sentence)
    turns = re.search(r"leaves the board for (\S+ turns?(?: \([^)]*\))?)", sentence)
    paid = re.search(r"pays (\S+ apples?(?: \([^)]*\))?)", sentence)
    fined = re.search(r"is fined (.*?) apples?", sentence)
    return (
        int(hits[1]) if hits else 1,
        numbers(turns[1]) if turns else [0],
        numbers(paid[1]) if paid else [0],
        float(fined[1]) if fined else 0.0,
    )


def face_to_face(game):
    """An environment of a game in which the shooter looks at the agent that it will tag, and the others stand
    elsewhere; the board is full."""
    env = CommonsEnv(game)
    env.reset()
    state = env.worlds.state()
    taken = set(zip(state["row"][0].tolist(), state["col"][0].tolist(), strict=True))
    closed = {*game.map.walls, *taken, *game.map.river}
    row, col = next(
        (row, col)
        for row in range(game.map.height)
        for col in range(game.map.width - 1)
        if not {(row, col), (row, col + 1)} & closed
    )
    for agent, place in ((SHOOTER, col), (TAGGED, col + 1)):
        state["row"][0, agent] = row
        state["col"][0, agent] = place
        state["heading"][0, agent] = RIGHT
    return env, env.load(state)


def played(game, *, tags):
    """The hits until the first tag, and the turns that each of some tags costs, and the apples."""
    env, now = face_to_face(game)
    beam, stay = game.actions.index("beam"), game.actions.index("stay")
    hits, missed, paid, waits = 0, [], [], False
    while len(missed) < tags or waits:
        is_in_play = bool(now["agents", "in_play"][0, TAGGED])
        waits = waits and not is_in_play
        if waits:
            missed[-1] += 1
        elif len(missed) == tags:
            break
        now["agents", "action"] = now["agents", "in_play"].long() * 0 + stay
        if is_in_play:
            now["agents", "action"][0, SHOOTER] = beam
        step, now = env.step_and_maybe_reset(now)
        agents = step["next", "agents"]
        hits += not missed and bool(agents["hit_by"][0, TAGGED].any())
        if agents["tagged_by"][0, TAGGED].any():
            missed.append(0)
            paid.append(float(agents["fines"][0, TAGGED]) if game.institutions else 0.0)
            waits = True
    return hits, missed, paid


def by_level(levels, count):
    return [levels[min(level, len(levels) - 1)] for level in range(count)]


@pytest.mark.integration
@pytest.mark.parametrize(
    "game",
    [
        *(
            presets.game(board, variant=variant)
            for board, variant in GAMES
            if board in ("two_complex", "commons")
        ),
        presets.game("melting_pot/commons_harvest__open-v1"),
        presets.game("ssd/harvest-v1"),
        presets.game("socialjax/harvest_open-v1"),
        presets.game("perolat/open-v1"),
        presets.game("janssen/foraging-v1"),
    ],
    ids=repr,
)
def test_a_tag_in_each_preset_does_what_is_said_of_it(game):
    hits, turns, paid, fined = said(tag_of(game))
    assert played(game, tags=1) == (hits, turns[:1], [paid[0] + fined])


@pytest.mark.integration
@settings(max_examples=15, deadline=None)
@given(
    hits=st.integers(1, 3),
    freeze=st.integers(0, 6),
    counts_tag_turn=st.booleans(),
    levels=st.none() | st.lists(st.integers(0, 6), min_size=1, max_size=4),
    fines=st.lists(st.integers(0, 3), min_size=1, max_size=3),
    fine=st.integers(0, 4),
)
def test_what_is_said_of_a_tag_is_what_tags_do(hits, freeze, counts_tag_turn, levels, fines, fine):
    sanctions = () if levels is None else (GraduatedSanctions(freeze_steps=levels, fines=fines, on="tags"),)
    game = governed(
        *sanctions,
        Punishment(fine=fine, cost=0.0),
        hits_to_tag=hits,
        freeze_steps=freeze,
        quirks=only_quirks(freeze_counts_tag_turn=counts_tag_turn),
        regrow_prob=(0.0,),
    )
    sentence = tag_of(game)
    hits_said, turns, paid, fined = said(sentence)
    if not sentence:
        hits_said = hits
        assert not fine
        assert not levels or not any(fines)
    found = played(game, tags=3)
    assert found == (hits_said, by_level(turns, 3), [apples + fined for apples in by_level(paid, 3)])


def test_a_tag_in_words_has_hits_turns_and_what_is_paid():
    assert tag_of(AS_RUN) == "after 2 hits an agent leaves the board for 24 turns"
    assert tag_of(COMMONS).startswith("an agent that is hit leaves the board for 25 turns, longer")
    sanctioned = governed(GraduatedSanctions(on="tags"), game=AS_RUN)
    assert tag_of(sanctioned).endswith("leaves the board for 4 turns (24, then 99 as offences add up)")
    of_violations = governed(GraduatedSanctions(on="violations"), Quota(fine=0.0), game=AS_RUN)
    assert tag_of(of_violations) == tag_of(AS_RUN)
    by_shooter = GraduatedSanctions(on="tags", freeze_steps=((1, 2), (3, 4), (5, 6), (7, 8)), fines=(0,))
    assert "1 to 8 turns, by who tags it" in tag_of(governed(by_shooter))
    assert tag_of(governed(may_fire=False)) == ""
    assert tag_of(governed(freeze_steps=0)) == ""
    assert tag_of(governed(Punishment(fine=2.0), freeze_steps=0)) == (
        "an agent that is hit is fined 2 apples by each who tags it"
    )


@pytest.mark.parametrize("kind", [kind.__name__ for kind in INSTITUTION_KINDS])
def test_every_institution_has_sentences(kind):
    game = Game(map=maps.parse("A>.<A\n.....\n....."), rules=Rules())
    sentence = meaning_of(valid(kind), game)
    assert re.fullmatch(r"[A-Z0-9].*\.", sentence)
    assert "Ostrom" not in sentence


@pytest.mark.parametrize(
    "limit",
    [ClosedSeason(), Rotation(), ClosedPatches(), Boundaries.strips(height=12, width=24, agents=4)],
    ids=lambda limit: type(limit).__name__,
)
def test_what_cannot_be_picked_is_said_to_be_more_under_a_quota_alone(limit):
    def sentence(limit):
        return meaning_of(limit, governed(limit))

    assert "More cannot be picked." in sentence(Quota())
    assert "More" not in sentence(limit)
    assert re.search("can pick|cannot pick", sentence(limit))
    name = "bite_fine" if isinstance(limit, Boundaries) else "fine"
    fined = sentence(replace(limit, **{name: 2.0}))
    assert "may" in fined
    assert "costs 2 apples." in fined
    assert "nothing by itself" in sentence(replace(limit, **{name: 0.0}))


def test_a_vote_says_what_is_voted_on_and_no_number_that_is_not_used():
    vote = Vote(on=Tax(rate=0.3, redistribution="none"), choices=(0.0, 0.5), override_prob=0.125)
    sentence = meaning_of(vote, governed(vote))
    assert "30%" not in sentence
    assert re.search("tax rate, 0, 0.5,.*12.5% chance decides.*picks is taken and lost", sentence)
    assert rule_of(vote) == "vote (on tax, choices 0 0.5, override prob 0.125)"
    quota = Vote(on=Quota(window_steps=50), choices=(0.5, 1.0))
    game = governed(quota)
    (apples,) = map(float, re.findall(r"share of ([\d.]+) apples", meaning_of(quota, game)))
    assert apples == pytest.approx(game.sustainable_yield * 50 / 4, abs=0.05)
    assert "More cannot be picked." in meaning_of(quota, game)


def test_brackets_are_said_in_place_of_the_rate_that_they_replace():
    tax = Tax(rate=0.7, period_steps=10, brackets=((0.0, 0.1), (5.0, 0.3)))
    assert "10% from 0 on, 30% from 5 on" in meaning_of(tax, governed(tax))
    assert "0.7" not in rule_of(tax)


def test_who_may_fire_who_pays_and_who_shares_is_said():
    named, elected = Sanctioner(agents=(0, 2)), Sanctioner(period_episodes=3)
    assert meaning_of(named, governed(named)) == "Only agents 0 and 2 may fire."
    assert rule_of(named) == "sanctioner (agents 0 2)"
    assert "all elect every 3 episodes" in meaning_of(elected, governed(elected))
    watch = Monitoring(prob=0.005, cost=0.5, monitor=1)
    sentence = meaning_of(watch, governed(watch))
    assert "0.5% are noticed" in sentence
    assert "costs 0.5 apples a turn, paid by agent 1" in sentence
    levies = Levies(groups=((0, 1), (2, 3)))
    assert "agents 0 and 1; agents 2 and 3" in meaning_of(levies, governed(levies))


def test_growth_is_said_as_it_is():
    assert "do not grow back" in growth_of(governed(regrow_prob=(0.0, 0.0)))
    assert "faster" not in growth_of(governed(regrow_prob=(0.0, 0.1)))
    assert "faster" in growth_of(governed(regrow_prob=(0.0, 0.1), regrow_by="share"))
    assert "40%" in growth_of(presets.game("ssd/cleanup-v1"))


def test_the_legend_of_a_beam_is_what_a_tag_does():
    assert "are a beam: after 2 hits an agent leaves the board for 24 turns." in legend_of([AS_RUN])
    assert "are a beam. " in legend_of([governed(Quota(fine=1.0), freeze_steps=0)])
