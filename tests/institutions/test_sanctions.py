"""Monitoring, graduated sanctions and mediation: who is found out, and what follows."""

import numpy as np
import pytest
from boards import Play, only_quirks

from cprl import Observation, Quirks2019, presets
from cprl.institutions import Boundaries, GraduatedSanctions, Mediation, Monitoring, Quota, Tax

OUTSIDE = Boundaries.drawn("........\n...0....", step_fine=1.0)
BOARD = "A.......\n>..^...."
"""Agent 1 stands in the region of agent 0, in the beam of agent 0."""


def detected(*, prob, seed=0, turns=400):
    """The turns in which agent 1, which always violates, pays."""
    play = Play(BOARD, institutions=[OUTSIDE, Monitoring(prob=prob)], seed=seed)
    fines = [play.turn("stay").fines[1] for _ in range(turns)]
    assert play.counts("violations") == [0, turns], "whether it is detected or not"
    assert play.counts("detections") == [0, sum(fines)]
    assert play.violated == [False, True]
    return fines


def test_without_monitoring_and_with_probability_one_all_is_detected_and_with_zero_nothing():
    assert detected(prob=1.0, turns=50) == [1] * 50
    assert detected(prob=0.0, turns=50) == [0] * 50
    play = Play(BOARD, institutions=[OUTSIDE]).turn("stay")
    assert play.fines == [0, 1]


def test_half_of_the_violations_are_detected_by_the_games_chance():
    found = detected(prob=0.5)
    # 400 turns: 200, standard deviation 10.
    assert 160 <= sum(found) <= 240
    assert found == detected(prob=0.5)
    assert found != detected(prob=0.5, seed=1)
    rare = detected(prob=0.1)
    # 40, standard deviation 6.
    assert 16 <= sum(rare) <= 64
    assert all(own <= other for own, other in zip(rare, found, strict=True)), "found at 0.1, found at 0.5"


@pytest.mark.filterwarnings("ignore:no agent can harvest:UserWarning")
def test_agents_are_found_out_independently_of_each_other():
    everywhere = Boundaries.drawn("--------\n--------", owners=("", ""), step_fine=1.0)
    play = Play(BOARD, institutions=[everywhere, Monitoring(prob=0.5)])
    fines = np.array([play.turn("stay").fines for _ in range(400)])
    # Both 100 of 400, standard deviation 8.7.
    assert 65 <= fines.all(1).sum() <= 135


@pytest.mark.parametrize(
    ("monitor", "fines"), [(None, [0.25, 0.25]), (0, [0.5, 0]), (1, [0, 0.5]), ("elected", [0, 0.5])]
)
def test_who_monitors_pays_the_cost_of_every_turn(monitor, fines):
    play = Play(BOARD, institutions=[Monitoring(cost=0.5, monitor=monitor)], freeze_steps=3)
    votes = (1, 1) if monitor == "elected" else None
    assert play.turn("beam", "stay", decisions=votes).fines == fines
    assert play.in_play == [True, False]
    assert play.turn("stay").fines == fines, "in play or not"
    assert play.reward == [-fine for fine in fines]
    assert not any(play.violated)


def test_agents_see_that_they_were_detected_and_that_they_monitor():
    play = Play(BOARD, institutions=[OUTSIDE, Monitoring(prob=1.0, monitor="elected")])
    assert play.shown(2) == [[0, 255], [0, 0]], "agent 0 is in office before the election"
    play.turn("stay", decisions=(1, 1))
    assert play.shown(2) == [[0, 0], [255, 255]]
    play.turn("stay", "right")
    assert play.shown(2) == [[0, 0], [0, 255]], "of the last turn alone"


def missed(play):
    """The turns that agents miss until all are in play again."""
    turns = 0
    while not all(play.in_play):
        play.turn("stay")
        turns += 1
    return turns


def test_time_outs_and_fines_of_tags_grow_with_each_one():
    sanctions = GraduatedSanctions(freeze_steps=(1, 3), fines=(0, 2, 5), recovery_steps=None, on="tags")
    play, found = Play(BOARD, institutions=[sanctions]), []
    for _ in range(4):
        fine = play.turn("beam", "stay").fines
        assert fine[0] == 0
        found.append((fine[1], missed(play)))
    assert found == [(0, 1), (2, 3), (5, 3), (5, 3)], "the last entry of each holds on"
    assert play.counts("sanctions") == [0, 4]
    assert not any(play.violated)


def test_violations_are_sanctioned_where_they_are_detected():
    sanctions = GraduatedSanctions(freeze_steps=(2,), fines=(0.5, 3), recovery_steps=None, on="violations")
    play = Play(BOARD, institutions=[OUTSIDE, sanctions], freeze_steps=9)
    # The step fine and that of level 0, then of level 1.
    assert play.turn("stay").fines == [0, 1.5]
    assert play.in_play == [True, False]
    assert missed(play) == 2
    assert play.turn("stay").fines == [0, 4]
    play = Play(BOARD, institutions=[OUTSIDE, sanctions], freeze_steps=9).turn("stay", "right")
    assert (play.fines, play.in_play) == ([0, 0], [True, True]), "it left in time"
    hidden = [OUTSIDE, sanctions, Monitoring(prob=0)]
    play = Play(BOARD, institutions=hidden).turn("stay")
    assert (play.fines, play.in_play, play.counts("sanctions")) == ([0, 0], [True, True], [0, 0])


def test_tags_keep_the_freeze_of_the_rules_where_violations_alone_are_offences():
    sanctions = GraduatedSanctions(freeze_steps=(0,), fines=(2,), on="violations")
    play = Play(BOARD, institutions=[Quota(fine=1), sanctions], freeze_steps=4).turn("beam", "stay")
    assert (missed(play), play.counts("sanctions")) == (4, [0, 0])
    play = Play(BOARD, institutions=[OUTSIDE, sanctions]).turn("stay")
    assert (play.fines, play.in_play) == ([0, 3], [True, True]), "a sanction of no turns"


def test_a_tag_and_a_violation_of_one_turn_are_two_offences():
    sanctions = GraduatedSanctions(freeze_steps=(4, 2), fines=(1, 10), recovery_steps=None, on="both")
    play = Play(BOARD, institutions=[OUTSIDE, sanctions]).turn("beam", "stay")
    # The tag at level 0: 4 turns, 1 apple; the violation at level 1: 2 turns, 10 apples; and the step fine.
    assert play.fines == [0, 12]
    assert play.counts("sanctions") == [0, 2]
    assert missed(play) == 4, "the longer of both"


def test_the_level_falls_after_each_recovery_without_an_offence():
    sanctions = GraduatedSanctions(freeze_steps=(0,), fines=(1, 2, 4), recovery_steps=3, on="violations")

    def fine_after(offences, rest):
        play = Play(BOARD, institutions=[OUTSIDE, sanctions])
        for _ in range(offences):
            play.turn("stay")
        play.turn("stay", "right")
        for _ in range(rest - 1):
            play.turn("stay")
        # The turn back is an offence, whose fine shows the level; 1 is the step fine.
        return play.turn("stay", "left").fines[1] - 1

    assert [fine_after(1, rest) for rest in (1, 2, 3, 4)] == [2, 2, 1, 1]
    assert [fine_after(2, rest) for rest in (1, 2, 3, 5, 6, 7)] == [4, 4, 2, 2, 1, 1]


def test_a_recovery_of_one_turn_wants_one_turn_without_an_offence():
    sanctions = GraduatedSanctions(freeze_steps=(0,), fines=(0, 2), recovery_steps=1, on="violations")
    play = Play(BOARD, institutions=[OUTSIDE, sanctions])
    assert [play.turn("stay").fines[1] for _ in range(3)] == [1, 3, 3]
    assert play.turn("stay", "right").turn("stay", "left").fines[1] == 3
    play.turn("stay", "right").turn("stay").turn("stay")
    assert play.turn("stay", "left").fines[1] == 1


def test_agents_see_their_level():
    sanctions = GraduatedSanctions(freeze_steps=(0, 0, 0), fines=(0,), recovery_steps=2, on="violations")
    play = Play(BOARD, institutions=[OUTSIDE, sanctions])
    # Of the last level, 2: 0, 1/2, 1, 1, then falling.
    seen = [play.shown(1)[1][0], *(play.turn("stay").shown(1)[1][0] for _ in range(3))]
    assert seen == [0, 128, 255, 255]
    seen = [play.turn("stay", action).shown(1)[1][0] for action in ("right", "stay", "stay", "stay")]
    assert seen == [255, 255, 255, 128], "from level 3 to 2 after two turns, and to 1 after two more"


def test_the_quirk_counts_the_turn_of_the_sanction():
    for on, decides in (("tags", "beam"), ("violations", "stay")):
        sanctions = GraduatedSanctions(freeze_steps=(3,), fines=(0,), on=on)
        quirks = only_quirks(freeze_counts_tag_turn=True)
        play = Play(BOARD, institutions=[OUTSIDE, sanctions], quirks=quirks)
        assert missed(play.turn(decides, "stay")) == 2


def test_a_table_gives_the_time_out_by_who_tagged():
    sanctions = GraduatedSanctions(
        freeze_steps=((1, 4), (9, 9), (2, 3)), fines=(0, 1), recovery_steps=None, on="tags"
    )
    play = Play("A......\n>..^..<", institutions=[sanctions])
    assert missed(play.turn("stay", "stay", "beam")) == 2
    assert missed(play.turn("beam", "stay", "stay")) == 4
    play.again()
    assert missed(play.turn("beam", "stay", "beam")) == 2, "the longer of 1 and 2"
    assert play.counts("sanctions") == [0, 1, 0]


def test_a_return_to_violation_is_one_in_a_later_turn_than_the_sanction():
    sanctions = GraduatedSanctions(freeze_steps=(0,), on="both")
    play = Play(BOARD, institutions=[OUTSIDE, sanctions])
    assert play.turn("beam", "stay").counts("returns_to_violation") == [0, 0], "the violation came first"
    assert play.counts("sanctions") == [0, 2]
    assert play.turn("stay").counts("returns_to_violation") == [0, 1]
    assert play.turn("stay", "right").counts("returns_to_violation") == [0, 1]
    assert play.again().turn("stay").counts("returns_to_violation") == [0, 0], "forgotten in a new episode"


APART = Observation(agents_apart=True)


def mediated(board, *others, turns=3, refund=1.0, **rules):
    return Play(
        board,
        institutions=[*others, Mediation(turns=turns, refund=refund)],
        observation=APART,
        **{"freeze_steps": 0, **rules},
    )


PAIR, DUEL, THREE = "A....\n>..^.", ".....\nA....\n>..<.", "A......\n>..^..<"


@pytest.mark.parametrize(
    ("board", "others", "rules", "turns", "fines", "transfers", "unjust"),
    [
        # The shooter refunds an unjust tag, detected or not; a miss costs nothing.
        (PAIR, (), {"refund": 0.75}, ["beam stay"], [0.75, 0], [0, 0.75], [1, 0]),
        (PAIR, (Monitoring(prob=0),), {}, ["beam stay"], [1, 0], [0, 1], [1, 0]),
        (PAIR, (), {}, ["beam stay", "turn_left stay", "beam stay"], [0, 0], [0, 0], [1, 0]),
        # Only the hit that tags is judged.
        (PAIR, (), {"hits_to_tag": 2}, ["beam stay"], [0, 0], [0, 0], [0, 0]),
        (PAIR, (), {"hits_to_tag": 2}, ["beam stay", "beam stay"], [1, 0], [0, 1], [1, 0]),
        # An unjust tag justifies one in return; two at once are both unjust, whatever their numbers.
        (DUEL, (), {}, ["beam stay", "stay beam"], [0, 0], [0, 0], [1, 0]),
        (DUEL, (), {}, ["beam beam"], [1, 1], [1, 1], [1, 1]),
        (DUEL, (), {"order": (1, 0)}, ["beam beam"], [1, 1], [1, 1], [1, 1]),
        # Shooters share the refund of one tag. In reading order agent 1 of the last board is the shooter, who
        # pays for each of several.
        (THREE, (), {}, ["beam stay beam"], [0.5, 0, 0.5], [0, 1, 0], [1, 0, 1]),
        ("A.^....\n>..^...", (), {}, ["stay beam stay"], [0, 2, 0], [1, 0, 1], [0, 2, 0]),
    ],
)
def test_tags_are_refunded_by_who_tagged_unjustly(board, others, rules, turns, fines, transfers, unjust):
    play = mediated(board, *others, **rules)
    for turn in turns:
        play.turn(*turn.split())
    assert (play.fines, play.transfers) == (fines, transfers)
    assert play.reward == [given - taken for given, taken in zip(transfers, fines, strict=True)]
    assert play.violated == [fine > 0 for fine in fines]
    assert play.counts("unjust_tags") == unjust
    assert play.counts("violations") == [min(1, tags) for tags in unjust]
    assert play.counts("detections") == ([0, 0] if others else [min(1, tags) for tags in unjust])


def test_a_violation_justifies_tags_for_so_many_turns():
    def refunded(waited):
        """Whether a tag so many turns after a violation, 0 for the same turn, is refunded."""
        play = mediated(BOARD.replace("^", ">"), OUTSIDE, turns=3)
        if waited:
            play.turn("stay").turn("stay", "forward")
        for _ in range(waited - 1):
            play.turn("stay")
        return play.turn("beam", "stay").transfers[1] > 0

    # The turn after the violation is spent on leaving: so these are 0, 2, 3 and 4 turns after it. A violation
    # justifies in its own turn and the two after it.
    assert [refunded(waited) for waited in (0, 1, 2, 3)] == [False, False, True, True]


def test_an_unjust_shooter_is_sanctioned():
    sanctions = GraduatedSanctions(freeze_steps=(2,), fines=(0.5,), on="violations")
    play = mediated("A....\n>..^.", sanctions).turn("beam", "stay")
    assert play.fines == [1.5, 0]
    assert play.in_play == [False, True]
    assert missed(play) == 2


def test_agents_see_who_violated_a_rule_of_late_their_own_mark_first():
    play = mediated("A....\n>..^.", turns=2)
    assert play.shown(2) == [[0, 0], [0, 0]]
    assert play.turn("beam", "stay").shown(2) == [[255, 0], [0, 255]], "agent 0 did, in the last turn"
    assert play.turn("stay").shown(2) == [[0, 0], [0, 0]], "a tag in the coming turn would be unjust"


def test_as_run_everything_follows_in_the_same_way():
    # Two hits tag, and the turn of the tag counts: 25 missed turns are 24. The level of the tag is 0.
    rules = presets.game("two_complex", variant="as_run").rules
    assert (rules.hits_to_tag, rules.clashes, rules.quirks) == (2, "pairwise", Quirks2019())
    quirks = only_quirks(freeze_counts_tag_turn=True)
    as_run = {"hits_to_tag": 2, "clashes": "pairwise", "growth": "before_bites", "quirks": quirks}
    sanctions = GraduatedSanctions(freeze_steps=(25, 2), fines=(1,), recovery_steps=None, on="tags")
    play = Play(BOARD, institutions=[sanctions, Tax(rate=0.5)], **as_run)
    assert play.turn("beam", "stay").fines == [0, 0]
    assert play.turn("beam", "stay").fines == [0, 1]
    assert missed(play) == 24
    play.turn("beam", "stay").turn("beam", "stay")
    assert missed(play) == 1
