"""What a vote or an election decides, on one world."""

import numpy as np

from cprl.institutions.memory import InstitutionTables, Longs, Memory


def is_due(tables: InstitutionTables, ballot: int, episode: int) -> bool:
    """Whether a ballot is held in an episode, counted from 0."""
    return episode % tables.ballot_episodes[ballot] == 0


def choice_of(tables: InstitutionTables, ballot: int, decision: int) -> int:
    """The choice that a decision makes on a ballot; see `cprl.institutions.choice.ballots`."""
    for before in range(ballot):
        decision //= tables.ballot_options[before]
    return decision % tables.ballot_options[ballot]


def votes_for(tables: InstitutionTables, ballot: int, decisions: Longs, choice: int) -> int:
    """The number of agents whose decision makes this choice; `decisions`: int64 [N]."""
    votes = 0
    for i in range(decisions.shape[0]):
        votes += choice_of(tables, ballot, decisions[i]) == choice
    return votes


def median_choice(tables: InstitutionTables, ballot: int, decisions: Longs) -> int:
    """The median of the N choices, of two middle ones the lower."""
    votes, choice = votes_for(tables, ballot, decisions, 0), 0
    while 2 * votes < decisions.shape[0]:
        choice += 1
        votes += votes_for(tables, ballot, decisions, choice)
    return choice


def elected_choice(tables: InstitutionTables, ballot: int, decisions: Longs, word: np.uint64) -> int:
    """The choice with most votes; a uniform 32-bit word decides among those with equally many."""
    most, tied = 0, 0
    for choice in range(tables.ballot_options[ballot]):
        votes = votes_for(tables, ballot, decisions, choice)
        if votes > most:
            most, tied = votes, 1
        elif votes == most:
            tied += 1
    ties_left = np.int64(word % np.uint64(tied))
    for choice in range(tables.ballot_options[ballot]):
        if votes_for(tables, ballot, decisions, choice) == most:
            if ties_left == 0:
                return choice
            ties_left -= 1
    return 0


def hold_ballot(
    memory: Memory,
    tables: InstitutionTables,
    ballot: int,
    decisions: Longs,
    words: tuple[np.uint64, np.uint64, np.uint64, np.uint64],
) -> None:
    """Puts the result of a ballot in force: what agents decided, or what the authority from outside draws."""
    if np.int64(words[0]) < tables.ballot_override[ballot]:
        choice = np.int64(words[1] % np.uint64(tables.ballot_options[ballot]))
    elif tables.ballot_is_election[ballot]:
        choice = np.int64(elected_choice(tables, ballot, decisions, words[2]))
    else:
        choice = np.int64(median_choice(tables, ballot, decisions))
    memory.in_force[ballot] = tables.ballot_choice[ballot, choice]


def appoint(memory: Memory, tables: InstitutionTables) -> None:
    """Writes who may fire: the elected agent, or those that the game names."""
    for i in range(memory.may_fire.shape[0]):
        if tables.fire_ballot >= 0:
            memory.may_fire[i] = memory.in_force[tables.fire_ballot] == i
        else:
            memory.may_fire[i] = tables.may_fire[i]
