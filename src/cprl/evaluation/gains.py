"""gains: what a focal agent gains over the agent whose place it takes, and what it costs the others.

Who exploits whom: among agents of run j, an agent of run i gets more than the agent of j that would have been
there, and leaves the others less.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import fmean

from cprl.arguments import object_of
from cprl.evaluation.cross_play import CrossPlay, Whose
from cprl.measuring.statistics import Estimate, difference


@dataclass(frozen=True, kw_only=True)
class Gain:
    """Differences of returns from those of the same background agents among themselves, paired by replica: in
    cross-play from the diagonal cell."""

    focal: Estimate
    """Of the focal agent, from the agent of the background agents' run with the same index."""
    background: Estimate
    """Of the mean of the background agents, from the same agents among themselves."""

    @property
    def exploits(self) -> bool:
        """Whether the focal agent gains and the background agents lose, both by intervals without 0."""
        return self.focal.low > 0 and self.background.high < 0


def gains(played: CrossPlay) -> dict[tuple[str, str], Gain]:
    """The gains of all cells but the diagonal, by the names of the focal and of the background agents' run.

    Each number is first averaged over a replica's episodes and focal agents; replicas are paired, because
    both cells have the same background agents and worlds. With `diagonal="cross_seed"` the agent whose place
    is taken was not trained with the background agents either, so that a gain is due to the run alone.

    Args:
        played: the cross-play.
    """
    object_of("played", played, CrossPlay, "what crossplay() gave")

    means: dict[Whose, dict[tuple[str, str], list[float]]] = {
        whose: {at: _means(played, at, whose) for at in played.cells} for whose in ("focal", "background")
    }

    def gain(focal: str, background: str, whose: Whose) -> Estimate:
        own, usual = means[whose][focal, background], means[whose][background, background]
        return difference(own, usual, paired=True)

    return {
        (focal, background): Gain(
            focal=gain(focal, background, "focal"), background=gain(focal, background, "background")
        )
        for focal, background in played.cells
        if focal != background
    }


def diagonal_returns(played: CrossPlay) -> Mapping[str, float]:
    """The mean return of an agent in each diagonal cell, by the name of the run."""
    return {name: fmean(_means(played, (name, name), "focal")) for name in played.runs}


def _means(played: CrossPlay, at: tuple[str, str], whose: Whose) -> list[float]:
    """The mean return of each replica in a cell, [R]."""
    returns = played.cell(*at).returns(whose)
    return [fmean(returns[replica]) for replica in played.replicas]
