"""Boundaries: who may harvest and stand where, and what it costs."""

import pytest
from boards import Play, drawn

from cprl.institutions import Boundaries, ClosedPatches

BOARD = """
>AA..
..AA<
"""
REGIONS = """
.01..
..01.
"""


def test_nobody_harvests_in_the_region_of_others_and_no_rule_is_broken():
    play = Play(BOARD, institutions=[Boundaries.drawn(REGIONS)])
    assert play.turn("forward").harvest == [1, 1], "each in its own region"
    assert play.turn("forward").harvest == [0, 0], "each in that of the other"
    assert play.board == drawn("""
        ..>..
        ..<..
        """)
    assert play.output.stock[0, 0] == 2
    assert (play.fines, play.transfers, play.violated) == ([0, 0], [0, 0], [False, False])
    assert play.reward == [0, 0]
    assert play.counts("own_bites") == [1, 1]
    assert play.counts("foreign_bites") == [0, 0]
    assert play.counts("trespasses") == [1, 1], "standing there is counted, though it is allowed"


FINED = Boundaries.drawn(REGIONS, bite_fine=1)
CLOSED = Boundaries.drawn(REGIONS, step_fine=0.5)
BOTH = Boundaries.drawn(REGIONS, bite_fine=0.25, step_fine=0.5)


@pytest.mark.parametrize(
    ("boundaries", "second", "harvest", "fines", "foreign_bites"),
    [
        # One apple for 1.5.
        ([Boundaries.drawn(REGIONS, bite_fine=1.5)], "stay", [1, 0], [1.5, 0], [1, 0]),
        ([Boundaries.drawn(REGIONS, bite_fine=0)], "forward", [1, 1], [0, 0], [1, 1]),
        # Step and bite fines of one turn add up to one violation: 2 + 0.5.
        ([Boundaries.drawn(REGIONS, bite_fine=2, step_fine=0.5)], "stay", [1, 0], [2.5, 0], [1, 0]),
        # Of two boundaries the second one stops the bite; or both are fined, 1 + 0.25 + 0.5, and both count.
        ([FINED, CLOSED], "forward", [0, 0], [0.5, 0.5], [0, 0]),
        ([FINED, BOTH], "forward", [1, 1], [1.75, 1.75], [2, 2]),
    ],
)
def test_what_a_second_turn_in_the_region_of_others_costs(boundaries, second, harvest, fines, foreign_bites):
    play = Play(BOARD, institutions=boundaries).turn("forward").turn("forward", second)
    assert (play.harvest, play.fines) == (harvest, fines)
    assert play.reward == [apple - fine for apple, fine in zip(harvest, fines, strict=True)]
    assert play.counts("foreign_bites") == foreign_bites, "once for each boundary"
    broken = [1, int(second == "forward")]
    assert play.counts("trespasses") == [own * len(boundaries) for own in broken]
    assert play.counts("violations") == play.counts("detections") == play.violated == broken


def test_standing_in_the_region_of_others_without_an_apple_costs_no_bite_fine():
    play = Play(BOARD, institutions=[FINED]).turn("forward").turn("forward", "stay").turn("stay")
    assert (play.fines, play.violated) == ([0, 0], [False, False])


def test_each_turn_in_the_region_of_others_costs_the_step_fine_where_bites_are_stopped():
    play = Play(BOARD, institutions=[Boundaries.drawn(REGIONS, step_fine=0.25)])
    assert play.turn("forward").fines == [0, 0]
    for _ in range(2):
        play.turn("forward" if play.places[0] == (0, 1) else "stay")
        assert play.places == [(0, 2), (1, 2)]
        assert (play.harvest, play.fines, play.violated) == ([0, 0], [0.25, 0.25], [True, True])
    play.turn("backward", "stay")
    assert (play.fines, play.reward) == ([0, 0.25], [0, -0.25])
    assert play.counts("trespasses") == play.counts("violations") == [2, 3]


def test_an_agent_that_is_out_of_play_is_not_fined_for_where_it_lies():
    # Agent 1 stands in the region of agent 0, and is tagged there in the first turn.
    boundaries = Boundaries.drawn(".....\n...0.", step_fine=1)
    play = Play("A....\n>..^.", institutions=[boundaries], freeze_steps=2)
    assert play.turn("beam", "stay").fines == [0, 1], "it was in play in this turn"
    assert [play.turn("stay").fines for _ in range(2)] == [[0, 0], [0, 0]]
    assert play.in_play == [True, True]
    assert play.turn("stay").fines == [0, 1]


@pytest.mark.parametrize(
    ("boundaries", "harvests", "own_bites"),
    [
        # Owners are named by the signs of their regions: agent 0 may not bite in a, agent 1 may in both.
        (Boundaries.drawn(".ab..\n..ab.", owners=("b", "ab")), ([0, 1], [1, 1]), [1, 2]),
        # Open ground is everybody's; a bite there counts as an own one.
        (Boundaries.drawn(".....\n...0.", bite_fine=1), ([1, 1], [1, 1]), [2, 1]),
        # A reserve is closed to all.
        (Boundaries.drawn(".-...\n...-.", owners=("", "")), ([0, 0], [1, 1]), [1, 1]),
    ],
)
def test_who_may_bite_where(boundaries, harvests, own_bites):
    play = Play(BOARD, institutions=[boundaries])
    assert tuple(play.turn("forward").harvest for _ in range(2)) == harvests
    assert play.counts("own_bites") == own_bites


def test_drawings_may_be_indented_and_strips_are_as_wide_as_can_be():
    assert Boundaries.drawn(" .0\n 1. \n\n") == Boundaries(regions=(".0", "1."))
    # Column 2 of 5 is left of the middle 2.5, so it is in the first of two strips.
    assert Boundaries.strips(height=2, width=5, agents=2).regions == ("00011", "00011")
    assert Boundaries.strips(height=1, width=4, agents=4, step_fine=1).regions == ("0123",)


def plane(play, agent):
    """The plane of forbidden cells of an agent's window, # for forbidden."""
    seen = play.output.observation[0, agent, play.game.channels.index("forbidden")]
    assert set(seen.reshape(-1).tolist()) <= {0, 255}
    return "\n".join("".join("#" if cell else "." for cell in row) for row in seen)


WINDOW = {"window_rows": 3, "window_columns": 3}


def test_agents_see_where_their_bites_are_forbidden():
    play = Play(BOARD, institutions=[Boundaries.drawn(REGIONS)], **WINDOW)
    # Agent 0 looks right from (0, 0): two rows ahead are (-1, 2) (0, 2) (1, 2), of which (0, 2) is of 1.
    assert plane(play, 0) == ".#.\n...\n..."
    # Agent 1 looks left from (1, 4): two ahead are (2, 2) (1, 2) (0, 2), of which (1, 2) is of 0.
    assert plane(play, 1) == ".#.\n...\n..."
    play.turn("turn_right", "stay")
    # It looks down from (0, 0); (1, 0) is open.
    assert plane(play, 0) == "...\n...\n..."


@pytest.mark.filterwarnings("ignore:no agent can harvest:UserWarning")
def test_only_what_is_observed_is_shown():
    # Site (0, 1) has no other apple near it, so its patch is closed with fewer than 2.
    hidden = Boundaries.drawn("..1..\n.....", observed=False)
    patches = ClosedPatches(below=2)
    rules = {"regrow_radius_cells": 0, **WINDOW}
    assert plane(Play(BOARD, institutions=[hidden, patches], **rules), 0) == ".##\n.#.\n..."
    patches = ClosedPatches(below=2, observed=False)
    shown = Boundaries.drawn("..1..\n.....")
    assert plane(Play(BOARD, institutions=[shown, patches], **rules), 0) == ".#.\n...\n..."
