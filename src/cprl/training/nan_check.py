"""Find losses, weights, rewards and observations that are NaN or infinite during a training.

Rewards, losses and observations of floating-point numbers are summed. The sums are checked every
`EVERY_TURNS` turns, when episodes end, and before the state of a training is saved; at episode ends and
before saving, weights are checked too. A single infinite loss is reported even if the weights stay finite:
most losses are means over a batch, so the agent learned nothing from it. Weights that are not finite never
recover. "Weights" include all that a learner keeps of an agent: targets, critics and the state of the
optimiser.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from itertools import groupby
from math import isfinite
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cprl.commons.spaces import Spaces
from cprl.keys import Turn
from cprl.learners.learner import Learner
from cprl.runs.schedule import OnNan
from cprl.training.learning import LaneLosses
from cprl.values.array_types import Float64

EVERY_TURNS: Final = 16
"""Turns between two checks of the sums; checking every step took 3 to 8 % of a training."""

_KINDS_OF_LEARNING: Final = ("loss", "weights")
_MOST_NAMED: Final = 8
"""The most findings that a message names."""
_ADVICE: Final = (
    'to try: a lower learning_rate; or on_nan="continue" (--on-nan continue), with which the others train on'
)
_ADVICE_ON_ENVIRONMENT: Final = (
    "it comes from the environment, not from learning: look at its transforms, or at a game of your own"
)


class NotFiniteError(ValueError):
    """A loss, weight, reward or observation is NaN or infinite; names replica, agent and step."""


@dataclass(frozen=True, order=True)
class NotFinite:
    """A finding: what is not finite, and since when."""

    what: str
    """"loss", "weights", "reward" or "observation"."""
    replica: int
    """The replica, in any of its worlds."""
    agent: int
    step: int
    """The step at which it was found."""

    @property
    def key(self) -> tuple[str, int, int]:
        """Return everything but the step."""
        return self.what, self.replica, self.agent


class FiniteCheck:
    """The check of a training's numbers, which `Training` calls.

    Args:
        spaces: what agents observe; observations of integers are not checked.
        worlds: the worlds W of each replica.
    """

    def __init__(
        self,
        learners: Mapping[tuple[int, ...], Learner],
        spaces: Spaces,
        *,
        worlds: int = 1,
        on_nan: OnNan = "stop",
    ) -> None:
        self.on_nan = on_nan
        self.learners = learners
        self._worlds = worlds
        self.reported: list[NotFinite] = []
        """All findings so far, each agent and kind of number once."""
        self.saved_step = 0
        """The step of the state that was last saved or loaded, 0 for none."""
        self._observes_floats = "float" in spaces.observation_dtype
        self._sums: Tensor | None = None
        self._is_fresh = True
        self._weights_step = 0

    def add(self, turn: Turn) -> None:
        """Sum up the observations after a turn, [B], without synchronisation with a GPU."""
        if not self._observes_floats:
            return
        observed = [turn.next_agents]
        if self._is_fresh:  # the first observation is no turn's next one
            observed.append(turn.agents)
            self._is_fresh = False
        for agents in observed:
            observation = torch.as_tensor(agents["observation"])
            sums = observation.reshape(*observation.shape[:2], -1).sum(-1, dtype=torch.float64)
            self._sums = sums if self._sums is None else sums + self._sums

    def check(
        self,
        losses: Mapping[tuple[int, ...], LaneLosses],
        returns: Float64,
        step: int,
        *,
        weights: bool = False,
    ) -> None:
        """Check the sums; also weights, if a sum is not finite.

        Args:
            losses: the losses by the indices of their agents.
            returns: the return of each agent in the running episode of each world, or in the one that has
                just ended, [B, N].
            weights: whether to check weights in any case.

        Raises:
            NotFiniteError: for a new finding with "stop", see `OnNan`.
        """
        known = {finding.key for finding in self.reported}
        findings = _not_finite("reward", self._by_replica(returns), range(returns.shape[1]), step)
        for agents, lane_losses in losses.items():
            in_losses = _not_finite("loss", lane_losses.total, agents, step)
            findings += [loss for loss in in_losses if ("weights", *loss.key[1:]) not in known]
        if self._sums is not None:
            sums = self._by_replica(self._sums.numpy(force=True))
            findings += _not_finite("observation", sums, range(sums.shape[1]), step)
        if weights or any(finding.key not in known for finding in findings):
            for agents, learner in self.learners.items():
                sound = np.where(learner.finite().numpy(force=True), 0.0, np.nan)
                findings += _not_finite("weights", sound, agents, step)
        self._report([finding for finding in findings if finding.key not in known])
        if weights:
            self._is_fresh = True
            self._weights_step = step

    def _by_replica(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return the sums over the worlds of each replica, of numbers [B, N]; not finite where one is not."""
        with np.errstate(all="ignore"):
            sums: NDArray[Any] = numbers.reshape(-1, self._worlds, numbers.shape[1]).sum(1)
        return sums

    def _report(self, findings: Sequence[NotFinite]) -> None:
        if not findings:
            return
        self.reported += findings
        text = f"at step {findings[0].step:,} {describe_findings(findings)} not finite"
        kinds = {finding.what for finding in findings}
        if "weights" in kinds:
            text += f" (weights were last checked at step {self._weights_step:,})"
        if not kinds <= set(_KINDS_OF_LEARNING):
            text += f"; {_ADVICE_ON_ENVIRONMENT}"
        elif self.on_nan == "stop":
            text += f"; {_ADVICE}"
        if self.on_nan == "continue":
            warnings.warn(f"{text}; the others train on", RuntimeWarning, stacklevel=2)
            return
        saved = f"; what was saved at step {self.saved_step:,} is finite" if self.saved_step else ""
        raise NotFiniteError(text + saved)

    def state_dict(self) -> dict[str, Any]:
        """Return the findings, so that they are not reported again, and the step of the state."""
        return {"reported": [list(astuple(finding)) for finding in self.reported], "step": self.saved_step}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.reported = [NotFinite(*values) for values in state["reported"]]
        self._weights_step = self.saved_step = state["step"]


def describe_findings(findings: Iterable[NotFinite]) -> str:
    """Return in words what is not finite: "the loss of agent 1 in replica 0 and the weights of ... are"."""
    ordered = sorted(findings)
    subjects = []
    for (what, replica), group in groupby(ordered, key=lambda finding: (finding.what, finding.replica)):
        agents = [str(finding.agent) for finding in group]
        plural = "s" if len(agents) > 1 else ""
        subjects.append(f"the {what} of agent{plural} {', '.join(agents)} in replica {replica}")
    if len(subjects) > _MOST_NAMED:
        subjects[_MOST_NAMED:] = [f"{len(subjects) - _MOST_NAMED} more"]
    *others, last = subjects
    listed = f"{', '.join(others)}, and {last}" if others else last
    is_one = len(ordered) == 1 and ordered[0].what != "weights"
    return f"{listed} is" if is_one else f"{listed} are"


def findings_note(findings: Sequence[NotFinite]) -> str | None:
    """Return a sentence below the evaluation about the findings of a training that went on; None for none."""
    if not findings:
        return None
    first = min(finding.step for finding in findings)
    return (
        f"From step {first:,} on {describe_findings(findings)} not finite. What such an agent does means "
        "nothing, in this evaluation too; report.json has the step of each."
    )


def _not_finite(what: str, numbers: NDArray[Any], agents: Sequence[int], step: int) -> list[NotFinite]:
    """Return a finding for each number of [R, S] that is NaN or infinite."""
    with np.errstate(all="ignore"):
        if isfinite(numbers.sum()):  # the usual case: finite numbers hardly ever have an infinite sum
            return []
    return [
        NotFinite(what, int(replica), agents[column], step)
        for replica, column in np.argwhere(~np.isfinite(numbers))
    ]
