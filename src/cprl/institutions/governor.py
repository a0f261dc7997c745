"""Governor: sets a number of another institution every few turns, by what anybody could observe.

No agent votes on the number. An experiment says by what the governor decides, see `Experiment.governor`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np

from cprl.institutions.equality import equality
from cprl.institutions.institution import Ballot, Institution
from cprl.institutions.quotas import Quota
from cprl.institutions.sanctions import GraduatedSanctions
from cprl.institutions.taxes import Tax
from cprl.institutions.votes import Choices
from cprl.values import Custom, Positive, Share, Where
from cprl.values.array_types import AnyArray, Float32

Number = Literal["quota.share", "tax.rate", "sanctions.level"]
CONTROLLED: Final[dict[str, type[Institution]]] = {
    "quota.share": Quota,
    "tax.rate": Tax,
    "sanctions.level": GraduatedSanctions,
}
"""The kind of institution that has each number which a governor can control."""
Feature = Literal["stock", "harvest", "lowest_harvest", "equality", "violations", "time"]
Objective = Literal["income", "lowest_income", "income_times_equality"]
Features = Annotated[
    tuple[Feature, ...],
    Where(lambda sees: sees and len(set(sees)) == len(sees), "one or more names, each once"),
]


@dataclass(frozen=True, kw_only=True)
class Governor(Institution):
    """A governor sets the share of a quota, the rate of a tax, or the level at which `GraduatedSanctions`
    punish a first offence, in each world by itself.

    It decides before the first turn of a training or an evaluation, and then after every `every_steps` turns.
    Its number stays in force until it decides again, also where a new episode begins. Without a governor in
    `Experiment.governor` the first option stays in force.

    Agents observe the number that was in force in the last turn: in the first turn of a new number they
    still observe the old one.
    """

    sets: Number
    """The controlled number, of the first institution of its kind in the game; its value there is not
    used."""

    options: Choices = (0.0, 0.25, 0.5, 0.75, 1.0)
    """The values to choose from, at least two, in ascending order: for a tax in 0..1, for sanctions whole
    numbers up to the highest level."""

    every_steps: Positive = 50
    """The length of a period: the turns from one decision to the next."""

    sees: Features = ("stock", "harvest", "lowest_harvest", "violations", "time")
    """The features of a world that it observes, all but the first of the episode so far:

    - "stock": the share of all sites that hold an apple, 0..1;
    - "harvest": the apples per turn of all agents together;
    - "lowest_harvest": the lowest harvest of an agent relative to the mean, 0..1; 1 before any harvest;
    - "equality": 1 - Gini of the harvests, see `cprl.institutions.equality`; 1 before any harvest;
    - "violations": the share of turns in which an agent broke a rule, 0..1, a mean over agents;
    - "time": the part of the longest episode that is over, 0..1.
    """

    objective: Objective | Custom = "income"
    """What it wants of a period, see `cprl.measuring.welfare`; or a function of its own, which returns a
    number for each world, [B], of the incomes [B, N] and the turns played [B]."""

    least_stock: Share = 0.0
    """The share of all sites below which the stock must not fall: the objective of a period that ends below
    it is 0."""

    most_in_game: ClassVar[int | None] = 1

    def shown_entries(self, *, number: int, ballot: int, agents: int) -> list[tuple[str, int]]:
        return [("in force", ballot)]

    def governed(self, game: Any) -> Institution | None:
        """Return the institution whose number it sets; None if the game has none."""
        kind = CONTROLLED[self.sets]
        return next((other for other in game.institutions if type(other) is kind), None)

    @property
    def controlled(self) -> Ballot:
        """Return the controlled number with its options, as a ballot that is never held."""
        return Ballot(title=CONTROLLED[self.sets].voted_on, choices=self.options)

    def check(self, game: Any) -> None:
        governed = self.governed(game)
        if governed is None:
            raise ValueError(
                f'Governor.sets is "{self.sets}"; allowed: a number of an institution of the game, on which '
                "no agent votes"
            )
        governed.check_choices("Governor.options", self.options)
        if self.every_steps > game.rules.episode_steps:
            raise ValueError(
                f"Governor.every_steps is {self.every_steps}; allowed: up to the {game.rules.episode_steps} "
                "turns of an episode"
            )

    def observe(
        self,
        *,
        stock: AnyArray,
        elapsed_steps: AnyArray,
        harvested: AnyArray,
        violations: AnyArray,
        horizon_steps: int,
    ) -> Float32:
        """Return the features of B worlds, float32 [B, S], in the order of `sees`.

        Args:
            stock: the share of all sites that hold an apple, [B].
            elapsed_steps: the turns of the episode so far, [B].
            harvested: the apples of each agent in the episode so far, [B, N].
            violations: the turns in which each agent broke a rule, [B, N].
            horizon_steps: the turns of the longest episode.
        """
        played = np.maximum(elapsed_steps, 1)
        mean = harvested.mean(1)
        features: dict[str, Callable[[], AnyArray]] = {
            "stock": lambda: stock,
            "harvest": lambda: harvested.sum(1) / played,
            "lowest_harvest": lambda: np.where(mean > 0, harvested.min(1) / np.maximum(mean, 1e-9), 1.0),
            "equality": lambda: np.nan_to_num(equality(harvested), nan=1.0),
            "violations": lambda: violations.mean(1) / played,
            "time": lambda: elapsed_steps / horizon_steps,
        }
        return np.stack([features[name]() for name in self.sees], 1).astype(np.float32)
