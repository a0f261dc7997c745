"""Votes and elections: what counts, when it is in force, and what an authority from outside does."""

import pytest
from boards import Play

from cprl import Observation
from cprl.institutions import Monitoring, Quota, Sanctioner, Tax, Vote

BOARD = """
>AAAAA
>AAAAA
>AAAAA
>AAAAA
"""
THREE = "\n".join(BOARD.split()[:3])
LOST = Tax(redistribution="none")
CHOICES = (0.0, 0.5, 1.0)


def in_force(play):
    return play.output.in_force[0].tolist()


@pytest.mark.parametrize(
    ("board", "decisions", "rate"),
    [
        (THREE, (2, 0, 1), 0.5),
        (THREE, (2, 2, 0), 1.0),
        (THREE, (0, 2, 0), 0.0),
        (BOARD, (0, 0, 2, 2), 0.0),  # the middle two are 0 and 2: the lower
        (BOARD, (2, 1, 2, 0), 0.5),  # sorted 0 1 2 2: the lower of 1 and 2
        (BOARD, (1, 2, 2, 2), 1.0),
    ],
)
def test_the_median_of_a_vote_is_in_force_in_the_turn_in_which_it_is_held(board, decisions, rate):
    play = Play(board, institutions=[Vote(on=LOST, choices=CHOICES)])
    play.turn("forward", decisions=decisions)
    assert in_force(play) == [rate]
    assert play.fines == [rate] * play.game.agents


def test_decisions_after_the_first_turn_change_nothing():
    play = Play(THREE, institutions=[Vote(on=LOST, choices=CHOICES)])
    play.turn("forward", decisions=(1, 1, 1)).turn("forward", decisions=(2, 2, 2))
    assert in_force(play) == [0.5]
    assert play.fines == [0.5] * 3


def test_before_its_first_vote_a_world_has_the_first_choice_and_then_the_last_result():
    play = Play(THREE, institutions=[Vote(on=LOST, choices=(0.25, 0.75))])
    assert in_force(play) == [0.25]
    play.turn("stay", decisions=(1, 1, 0)).again()
    assert in_force(play) == [0.75], "until the vote of this episode"
    play.turn("stay", decisions=(0, 0, 0))
    assert in_force(play) == [0.25]
    play.turn("stay", decisions=(1, 1, 1))
    play.batch.set_seed(5)
    play.again()
    assert in_force(play) == [0.25], "a new seed begins anew"


@pytest.mark.parametrize(
    ("period", "decisions", "rates"),
    [
        # Votes in the episodes 0, 3 and 6 decide 2; in 1 and 2 the decisions 1 and 0 are not counted.
        (3, (2, 1, 0, 2, 1, 0, 2), [1.0] * 7),
        # Votes in the episodes 0, 2 and 4 decide 0, 2 and 1.
        (2, (0, 1, 2, 0, 1), [0.0, 0.0, 1.0, 1.0, 0.5]),
    ],
)
def test_a_vote_of_every_so_many_episodes_holds_until_the_next(period, decisions, rates):
    play = Play(THREE, institutions=[Vote(on=LOST, choices=CHOICES, period_episodes=period)])
    found = []
    for decision in decisions:
        found += in_force(play.turn("stay", decisions=[decision] * 3))
        play.again()
    assert found == rates


def episodes(institutions, *, count, decisions, seed=0, board=THREE):
    """What is in force in each of so many episodes."""
    play, found = Play(board, institutions=institutions, seed=seed), []
    for _ in range(count):
        found += in_force(play.turn("stay", decisions=decisions))
        play.again()
    return found


def test_an_authority_that_always_overrides_draws_every_choice_by_the_games_chance():
    vote = [Vote(on=LOST, choices=CHOICES, override_prob=1.0)]
    found = episodes(vote, count=150, decisions=(0, 0, 0))
    assert found == episodes(vote, count=150, decisions=(2, 1, 2)), "decisions do not matter"
    assert found != episodes(vote, count=150, decisions=(0, 0, 0), seed=1)
    # 150 draws of 3: 50 each, standard deviation 5.8.
    assert all(25 <= found.count(choice) <= 75 for choice in CHOICES)


def test_an_authority_overrides_with_its_probability():
    vote = [Vote(on=LOST, choices=CHOICES, override_prob=0.3)]
    found = episodes(vote, count=300, decisions=(2, 2, 2))
    # It changes the result with probability 0.3 x 2/3 = 0.2: 60 of 300, standard deviation 6.9.
    assert 30 <= sum(value != 1.0 for value in found) <= 90
    assert set(episodes([Vote(on=LOST, choices=CHOICES)], count=30, decisions=(2, 2, 2))) == {1.0}


def test_a_vote_on_a_quota_decides_its_share_in_the_first_window():
    # 15 sites bear 15/2 a turn, 2.5 for each of three agents: a share of 0.4 is 1 apple a turn.
    vote = Vote(on=Quota(window_steps=1, share=9), choices=(0.0, 0.4))
    play = Play(THREE, institutions=[vote], regrow_prob=(1.0,))
    assert play.turn("forward", decisions=(1, 1, 0)).harvest == [1, 1, 1]
    assert play.turn("forward").harvest == [1, 1, 1]
    play.again()
    assert play.turn("forward", decisions=(1, 0, 0)).harvest == [0, 0, 0]


def test_a_fined_quota_and_a_taxs_period_stay_as_they_are_under_a_vote():
    votes = [Vote(on=Quota(fine=2), choices=(0, 1)), Vote(on=Tax(period_steps=2), choices=(0, 1))]
    # Decision 2: choice 0 of the first ballot, choice 1 of the second one.
    play = Play(THREE, institutions=votes).turn("forward", "stay", "stay", decisions=(2, 2, 2))
    assert in_force(play) == [0, 1]
    assert (play.fines, play.counts("excess_bites")) == ([2, 0, 0], [1, 0, 0])
    # The tax of 1 on 1 apple at the end of the period, a third to each.
    assert play.turn("stay").fines == [1, 0, 0]
    assert play.transfers == pytest.approx([1 / 3] * 3)


def test_one_decision_chooses_on_all_ballots():
    votes = [Vote(on=LOST, choices=CHOICES), Vote(on=LOST, choices=(0.0, 0.25)), Sanctioner()]
    play = Play(THREE, institutions=votes)
    assert play.game.decisions == 3 * 2 * 3
    # 2 + 3 x 1 + 6 x 2 = 17: the third rate, the second rate, agent 2.
    assert in_force(play.turn("forward", decisions=(17, 17, 17))) == [1.0, 0.25, 2.0]
    assert play.fines == [1.25] * 3
    # 1 + 0 + 6 x 1 = 7, 0 + 3 + 6 x 1 = 9, 2 + 3 + 0 = 5: medians 1, 1, and agent 1 has two votes.
    assert in_force(play.again().turn("stay", decisions=(7, 9, 5))) == [0.5, 0.25, 1.0]


DUEL = "A....\n>...<"


def test_only_named_agents_fire():
    play = Play(DUEL, institutions=[Sanctioner(agents=(1,))]).turn("beam")
    assert play.output.fired[0].tolist() == [False, True]
    assert play.in_play == [False, True]
    play = Play(DUEL, institutions=[Sanctioner(agents=(0, 1))]).turn("beam")
    assert play.in_play == [False, False]


@pytest.mark.parametrize(("votes", "elected"), [((1, 1, 0), 1), ((2, 1, 2), 2), ((0, 0, 0), 0)])
def test_most_votes_elect_who_may_fire(votes, elected):
    play = Play(">....A\n>.....\n>.....", institutions=[Sanctioner()]).turn("beam", decisions=votes)
    assert play.output.fired[0].tolist() == [i == elected for i in range(3)]
    assert in_force(play) == [elected]
    play.turn("beam", decisions=((elected + 1) % 3,) * 3)
    assert play.output.fired[0].tolist() == [i == elected for i in range(3)], "until the episode ends"


def test_a_tied_election_is_drawn_by_the_games_chance_among_the_tied():
    found = episodes([Sanctioner()], count=120, decisions=(0, 2, 1))
    # 120 draws of 3: 40 each, standard deviation 5.2.
    assert all(20 <= found.count(agent) <= 60 for agent in range(3))
    assert found == episodes([Sanctioner()], count=120, decisions=(0, 2, 1))
    assert found != episodes([Sanctioner()], count=120, decisions=(0, 2, 1), seed=3)
    winners = episodes([Sanctioner()], count=60, decisions=(3, 1, 1, 3), board=BOARD)
    # Only agents 1 and 3: 30 each, standard deviation 3.9.
    assert set(winners) == {1, 3}
    assert 14 <= winners.count(1) <= 46


def test_an_appointed_sanctioner_holds_office_for_its_period():
    sanctioner = [Sanctioner(override_prob=1.0, period_episodes=2)]
    found = episodes(sanctioner, count=80, decisions=(0, 0, 0))
    assert found[::2] == found[1::2]
    assert all(found[::2].count(agent) >= 5 for agent in range(3))


def test_an_elected_monitor_and_an_elected_sanctioner_are_two_elections():
    both = [Sanctioner(), Monitoring(monitor="elected", cost=0.5)]
    play = Play(THREE, institutions=both)
    # 1 + 3 x 2: agent 1 may fire, agent 2 monitors.
    play.turn("beam", decisions=(7, 7, 7))
    assert in_force(play) == [1, 2]
    assert play.output.fired[0].tolist() == [False, True, False]
    assert play.fines == [0, 0, 0.5]


def test_agents_see_what_is_in_force_and_whether_they_may_fire():
    both = [Vote(on=LOST, choices=(0.0, 0.2, 0.8)), Sanctioner()]
    play = Play(THREE, institutions=both, observation=Observation(encoding="one_hot"))
    assert play.shown(2) == [[0, 255], [0, 0], [0, 0]], "before an election agent 0 is in office"
    # 1 + 3 x 2; 0.2 of at most 0.8 is a quarter: 63.75.
    assert play.turn("stay", decisions=(7, 7, 7)).shown(2) == [[64, 0], [64, 0], [64, 255]]
    hidden = [Vote(on=LOST, choices=CHOICES, observed=False), Sanctioner(observed=False)]
    assert Play(THREE, institutions=hidden).game.channels == ("red", "green", "blue")


def test_a_vote_on_a_quota_shows_the_quota_relative_to_the_largest_choice():
    # As above 2.5 apples a turn at a share of 1; at most 4 x 2.5 = 10 in one turn, 0.4 x 2.5 = 1 in force.
    vote = Vote(on=Quota(window_steps=1), choices=(0.4, 4))
    play = Play(THREE, institutions=[vote], regrow_prob=(1.0,))
    play.turn("stay", decisions=(0, 0, 0))
    # In force 0.4 / 4, left 1 / 10, and the whole window.
    assert play.shown(3) == [[26, 26, 255]] * 3
    hidden = Vote(on=Quota(observed=False), choices=(0.4, 4))
    play = Play(THREE, institutions=[hidden], regrow_prob=(1.0,)).turn("stay", decisions=(0, 0, 0))
    assert play.shown(3) == [[26, 26, 26]] * 3, "in force alone"
