"""Vote: agents decide on a tax or a quota; and how ballots of all institutions are held."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, NamedTuple

import numpy as np

from cprl.institutions.base import MOST_APPLES, Amount, Ballot, Institution, threshold
from cprl.institutions.ledger import Ledger
from cprl.institutions.quotas import Quota
from cprl.institutions.taxes import Tax
from cprl.values import Positive, Share, Where
from cprl.values.arrays import Bool, Float64, Int32, Int64

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
    """Agents vote on the rate of a tax or the share of a quota (Ostrom's principle 3, collective choice).

    Each agent's decision is the index of a choice; the median of the N decisions counts, of two middle ones
    the lower. Agents observe the value in force.
    """

    on: Tax | Quota
    """The institution whose `rate` or `share` is voted on; its own value is not used."""

    choices: Choices = (0.0, 0.25, 0.5, 0.75, 1.0)
    """The values to choose from, ascending, at least two; of a tax 0..1."""

    period_episodes: Positive = 1
    """A vote is held in every such number of episodes, from the first one; its result stays in force until
    the next."""

    override_prob: Share = 0.0
    """The probability that an authority from outside puts a choice in force by chance, all equally likely, in
    place of the result of a vote (the opposite of Ostrom's principle 7, the right to organise)."""

    entries: ClassVar[tuple[str, ...]] = ("in force",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.on, Tax) and (self.on.brackets or self.choices[-1] > 1):
            raise ValueError(
                "Vote.on is a Tax with brackets; allowed: a Tax with one rate"
                if self.on.brackets
                else f"Vote.choices has {self.choices[-1]:g}; allowed for a Tax: 0..1"
            )

    @property
    def rule(self) -> Institution:
        return self.on

    @property
    def can_be_broken(self) -> bool:
        return self.on.can_be_broken

    def ballot(self, agents: int) -> Ballot:
        return Ballot(self.on.voted_on, self.choices, False, self.period_episodes, self.override_prob)

    def shows(self, *, number: int, ballot: int, agents: int) -> list[tuple[str, int]]:
        return [("in force", ballot)]


class Arrays(NamedTuple):
    """All ballots of a game, one per index of axis V."""

    options: Annotated[Int32, "V"]
    """The number of choices."""
    choices: Annotated[Float64, "V choices"]
    is_election: Annotated[Bool, "V"]
    episodes: Annotated[Int32, "V"]
    """Held in every such number of episodes."""
    override: Annotated[Int64, "V"]
    """Overridden if a uniform 32-bit word is below this threshold."""


def parameters(game: Any) -> dict[str, Any]:
    ballots = game.ballots
    choices = np.zeros((len(ballots), max((len(ballot.choices) for ballot in ballots), default=1)))
    for number, ballot in enumerate(ballots):
        choices[number, : len(ballot.choices)] = ballot.choices
    return {
        "options": [len(ballot.choices) for ballot in ballots],
        "choices": choices,
        "is_election": [ballot.is_election for ballot in ballots],
        "episodes": [ballot.period_episodes for ballot in ballots],
        "override": [threshold(ballot.override_prob) for ballot in ballots],
    }


def is_due(ballots: Arrays, ballot: int, episode: int) -> bool:
    """Return whether a ballot is held in an episode, counted from 0."""
    return episode % ballots.episodes[ballot] == 0


def choice_of(ballots: Arrays, ballot: int, decision: int) -> int:
    """Return the choice that a decision makes on a ballot; see `cprl.Game.ballots`."""
    for before in range(ballot):
        decision //= ballots.options[before]
    return decision % ballots.options[ballot]


def votes_for(ballots: Arrays, ballot: int, decisions: Int64, choice: int) -> int:
    """Return the number of agents whose decision makes this choice; `decisions`: int64 [N]."""
    votes = 0
    for i in range(decisions.shape[0]):
        votes += choice_of(ballots, ballot, decisions[i]) == choice
    return votes


def median_choice(ballots: Arrays, ballot: int, decisions: Int64) -> int:
    """Return the median of the N choices, of two middle ones the lower."""
    votes, choice = votes_for(ballots, ballot, decisions, 0), 0
    while 2 * votes < decisions.shape[0]:
        choice += 1
        votes += votes_for(ballots, ballot, decisions, choice)
    return choice


def elected_choice(ballots: Arrays, ballot: int, decisions: Int64, word: np.uint64) -> int:
    """Return the choice with most votes; a uniform 32-bit word decides among those with equally many."""
    most, tied = 0, 0
    for choice in range(ballots.options[ballot]):
        votes = votes_for(ballots, ballot, decisions, choice)
        if votes > most:
            most, tied = votes, 1
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
    ballots: Arrays,
    ledger: Ledger,
    ballot: int,
    decisions: Int64,
    words: tuple[np.uint64, np.uint64, np.uint64, np.uint64],
) -> None:
    """Put the result of a ballot in force: what agents decided, or what the authority from outside draws."""
    if np.int64(words[0]) < ballots.override[ballot]:
        choice = np.int64(words[1] % np.uint64(ballots.options[ballot]))
    elif ballots.is_election[ballot]:
        choice = np.int64(elected_choice(ballots, ballot, decisions, words[2]))
    else:
        choice = np.int64(median_choice(ballots, ballot, decisions))
    ledger.in_force[ballot] = ballots.choices[ballot, choice]


def show_in_force(ballots: Arrays, ledger: Ledger, ballot: int) -> float:
    """Return the value in force, relative to the highest choice."""
    return ledger.in_force[ballot] / ballots.choices[ballot, ballots.options[ballot] - 1]
