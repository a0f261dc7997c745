"""Vote: agents decide on a tax or a quota. The rules here hold the ballots of all institutions."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, NamedTuple

import numpy as np

from cprl.institutions.institution import MOST_APPLES, Amount, Ballot, Institution, threshold
from cprl.institutions.ledger import Ledger
from cprl.institutions.quotas import Quota
from cprl.institutions.taxes import Tax
from cprl.values import Positive, Share, Where
from cprl.values.array_types import Bool, Float64, Int32, Int64

MOST_DECISIONS: Final = 2**20
"""The largest number of options that an agent chooses from."""

Choices = Annotated[
    tuple[Amount, ...],
    Where(
        lambda choices: len(choices) >= 2 and list(choices) == sorted(set(choices)),
        f"two or more numbers in 0..{MOST_APPLES:g}, ascending",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Vote(Institution):
    """Agents vote on the rate of a tax or on the share of a quota.

    This is Ostrom's principle 3, collective choice. Each agent decides for the index of a choice, and the
    median of the N decisions is put in force; of two middle ones it is the lower. Agents observe the value in
    force.
    """

    on: Tax | Quota
    """The institution whose `rate` or `share` is voted on; the value that it has here is not used."""

    choices: Choices = (0.0, 0.25, 0.5, 0.75, 1.0)
    """The values to choose from, at least two, in ascending order; for a tax in 0..1."""

    period_episodes: Positive = 1
    """The number of episodes from one vote to the next. The first vote is in the first episode, and a result
    stays in force until the next vote."""

    override_prob: Share = 0.0
    """The probability that an outside authority overrides a vote and puts a choice in force by chance, all
    equally likely. This is the opposite of Ostrom's principle 7, the right to organise."""

    entries: ClassVar[tuple[str, ...]] = ("in force",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.on, Tax) and self.on.brackets:
            raise ValueError("Vote.on is a Tax with brackets; allowed: a Tax with one rate")
        self.on.check_choices("Vote.choices", self.choices)

    @property
    def rule(self) -> Institution:
        return self.on

    @property
    def can_be_broken(self) -> bool:
        return self.on.can_be_broken

    def ballot(self, agents: int) -> Ballot:
        return Ballot(
            title=self.on.voted_on,
            choices=self.choices,
            period_episodes=self.period_episodes,
            override_prob=self.override_prob,
        )

    def shown_entries(self, *, number: int, ballot: int, agents: int) -> list[tuple[str, int]]:
        return [("in force", ballot)]


class BallotArrays(NamedTuple):
    """The parameters of all ballots of a game, one of them per index of axis V."""

    options: Annotated[Int32, "V"]
    """The number of choices."""
    choices: Annotated[Float64, "V choices"]
    is_election: Annotated[Bool, "V"]
    period_episodes: Annotated[Int32, "V"]
    """The number of episodes from one time that the ballot is held to the next; 0 for the number that a
    governor sets, on which no agent votes."""
    override_below: Annotated[Int64, "V"]
    """The result is overridden if a uniform 32-bit word is below this threshold."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `BallotArrays` by name."""
    ballots = game.in_force
    most_choices = max((len(ballot.choices) for ballot in ballots), default=1)
    choices = np.zeros((len(ballots), most_choices))
    for index, ballot in enumerate(ballots):
        choices[index, : len(ballot.choices)] = ballot.choices
    return {
        "options": [len(ballot.choices) for ballot in ballots],
        "choices": choices,
        "is_election": [ballot.is_election for ballot in ballots],
        "period_episodes": [ballot.period_episodes for ballot in ballots],
        "override_below": [threshold(ballot.override_prob) for ballot in ballots],
    }


def is_due(ballots: BallotArrays, ballot: int, episode: int) -> bool:
    """Return whether a ballot is held in an episode, counted from 0."""
    return ballots.period_episodes[ballot] > 0 and episode % ballots.period_episodes[ballot] == 0


def has_governor(ballots: BallotArrays) -> bool:
    """Return whether a governor sets the last number in force."""
    last = ballots.period_episodes.shape[0] - 1
    return last >= 0 and ballots.period_episodes[last] == 0


def choice_of(ballots: BallotArrays, ballot: int, decision: int) -> int:
    """Return the index of the choice that a decision makes on a ballot; see `cprl.Game.ballots`."""
    for before in range(ballot):
        decision //= ballots.options[before]
    return decision % ballots.options[ballot]


def votes_for(ballots: BallotArrays, ballot: int, decisions: Int64, choice: int) -> int:
    """Return the number of agents that decide for a choice on a ballot; `decisions`: int64 [N]."""
    votes = 0
    for agent in range(decisions.shape[0]):
        votes += choice_of(ballots, ballot, decisions[agent]) == choice
    return votes


def median_choice(ballots: BallotArrays, ballot: int, decisions: Int64) -> int:
    """Return the index of the median of the N agents' choices; of two middle ones the lower."""
    choice = 0
    votes = votes_for(ballots, ballot, decisions, choice)
    while 2 * votes < decisions.shape[0]:
        choice += 1
        votes += votes_for(ballots, ballot, decisions, choice)
    return choice


def elected_choice(ballots: BallotArrays, ballot: int, decisions: Int64, word: np.uint64) -> int:
    """Return the index of the choice with most votes; a uniform 32-bit word decides between equal ones."""
    most = 0
    tied = 0
    for choice in range(ballots.options[ballot]):
        votes = votes_for(ballots, ballot, decisions, choice)
        if votes > most:
            most = votes
            tied = 1
        elif votes == most:
            tied += 1
    ties_left = np.int64(word % np.uint64(tied))
    for choice in range(ballots.options[ballot]):
        if votes_for(ballots, ballot, decisions, choice) == most:
            if ties_left == 0:
                return choice
            ties_left -= 1
    return 0


def hold_ballot(
    ballots: BallotArrays,
    ledger: Ledger,
    ballot: int,
    decisions: Int64,
    words: tuple[np.uint64, np.uint64, np.uint64, np.uint64],
) -> None:
    """Put the result of a ballot in force: the agents' decision, or a choice drawn by an outside authority.

    `decisions`: int64 [N]; `words`: uniform random 32-bit words.
    """
    if np.int64(words[0]) < ballots.override_below[ballot]:
        choice = np.int64(words[1] % np.uint64(ballots.options[ballot]))
    elif ballots.is_election[ballot]:
        choice = np.int64(elected_choice(ballots, ballot, decisions, words[2]))
    else:
        choice = np.int64(median_choice(ballots, ballot, decisions))
    ledger.in_force[ballot] = ballots.choices[ballot, choice]


def show_in_force(ballots: BallotArrays, ledger: Ledger, ballot: int) -> float:
    """Return what agents observe of a ballot: the value in force, relative to the highest choice."""
    return ledger.in_force[ballot] / ballots.choices[ballot, ballots.options[ballot] - 1]
