"""FiniteCheck: finds losses, weights, rewards and observations that are NaN or infinite during a training.

Rewards and losses are summed up as episodes are measured; these sums are looked at every `EVERY_STEPS` steps.
Observations of floating-point numbers are looked at in every step; weights, as all else, at the end of
episodes and before the state of a training is saved. One loss that is infinite is reported, even if the
weights stay finite: most losses are means, so whatever the agent learned from that batch is lost. Weights
that are not finite never become so again. "Weights" are all that a learner keeps of an agent: targets,
critics and the state of its optimiser too.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from itertools import groupby
from math import isfinite
from typing import Any, Final, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from cprl import keys
from cprl.checks import checked, one_of
from cprl.commons.spaces import Spaces
from cprl.experiment import OnNan
from cprl.learners.base import LaneLosses, Learner

EVERY_STEPS: Final = 16
"""Steps between two looks at the sums of rewards and losses; to look in every step took 3 to 8 % of a
training."""

_LEARNED: Final = ("loss", "weights")
_NAMED: Final = 8
"""The largest number of places that a message names."""
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
    """What is not finite, and since when."""

    what: str
    """"loss", "weights", "reward" or the name of an entry that agents observe."""
    replica: int
    """The replica, which is the world of the environment."""
    agent: int
    step: int
    """The step at which it was found."""

    @property
    def place(self) -> tuple[str, int, int]:
        """Everything but the step."""
        return self.what, self.replica, self.agent


class FiniteCheck:
    """Checks the numbers of a training; `Training` calls it.

    Args:
        spaces: what agents observe; entries of integers are not looked at.
    """

    def __init__(
        self, learners: Mapping[tuple[int, ...], Learner], spaces: Spaces, *, on_nan: OnNan = "stop"
    ) -> None:
        checked("on_nan", on_nan, one_of(*get_args(OnNan)))
        self.on_nan, self.learners = on_nan, learners
        self.found: list[NotFinite] = []
        """Each agent and kind of number once, in the order in which they were found."""
        self.saved_step = 0
        """The step of the state that was last saved or loaded, 0 for none."""
        self._places: set[tuple[str, int, int]] = set()
        is_float = "float" in spaces.observation_dtype
        self._names = (*(("observation",) if is_float else ()), *dict(spaces.vectors))
        self._finite_step = 0
        self._is_fresh = True
        self._sums: dict[str, Tensor] = {}

    @staticmethod
    def is_on_cpu(tensor: Tensor) -> bool:
        """Whether looking at a number costs no synchronisation."""
        return tensor.is_cpu

    def check_turn(self, batch: TensorDictBase, step: int) -> None:
        """Checks the observations of a turn, [R].

        Those on a GPU are summed up, which needs no synchronisation, and looked at in `check_weights`.
        """
        if not self._names:
            return
        following = keys.entry(keys.entry(batch, "next"), keys.AGENTS)
        tensors = [(name, keys.entry(following, name)) for name in self._names]
        if self._is_fresh:  # the first observation after a reset was nobody's next
            before = keys.entry(batch, keys.AGENTS)
            tensors += [(name, keys.entry(before, name)) for name in self._names]
            self._is_fresh = False
        for name, tensor in tensors:
            if self.is_on_cpu(tensor):
                array = tensor.numpy(force=True)
                if not _sum_is_finite(array):
                    sound = np.isfinite(array).reshape(*array.shape[:2], -1).all(-1)
                    self._report(_marked(name, ~sound, range(array.shape[1]), step))
            else:
                kept = self._sums.get(name)
                sums = tensor.reshape(*tensor.shape[:2], -1).sum(-1, dtype=torch.float64)
                self._sums[name] = sums if kept is None else kept + sums

    def check_sums(
        self, losses: Mapping[tuple[int, ...], LaneLosses], returns: NDArray[np.float64], step: int
    ) -> None:
        """Checks sums of losses and rewards; where one is not finite, everything else at once.

        Args:
            losses: by the indices of their agents.
            returns: the return of each agent in the running episode of each replica, or in the one that has
                just ended, [R, N].

        Raises:
            NotFiniteError: with "stop", see `OnNan`.
        """
        found: list[NotFinite] = []
        if not _sum_is_finite(returns):
            found += _marked("reward", ~np.isfinite(returns), range(returns.shape[1]), step)
        for agents, own in losses.items():
            if not _sum_is_finite(own.total):
                bad = _marked("loss", ~np.isfinite(own.total), agents, step)
                found += [one for one in bad if ("weights", *one.place[1:]) not in self._places]
        if any(one.place not in self._places for one in found):
            self._report([*found, *self._in_sums(step), *self._in_weights(step)])

    def check_weights(self, step: int) -> None:
        """Checks the weights of all agents, and what `check_turn` has summed up; called when episodes have
        ended, and before the state is saved.

        Raises:
            NotFiniteError: with "stop", see `OnNan`.
        """
        self._is_fresh = True
        self._report([*self._in_sums(step), *self._in_weights(step)])
        self._finite_step = step

    def _in_weights(self, step: int) -> list[NotFinite]:
        found = []
        for agents, learner in self.learners.items():
            sound = learner.finite().numpy(force=True)
            if not sound.all():
                found += _marked("weights", ~sound, agents, step)
        return found

    def _in_sums(self, step: int) -> list[NotFinite]:
        found = []
        for name, sums in self._sums.items():
            array = sums.numpy(force=True)
            found += _marked(name, ~np.isfinite(array), range(array.shape[1]), step)
        return found

    def _report(self, found: Sequence[NotFinite]) -> None:
        new = [one for one in found if one.place not in self._places]
        if not new:
            return
        self.found += new
        self._places |= {one.place for one in new}
        text = f"at step {new[0].step:,} {places(new)} not finite"
        if any(one.what == "weights" for one in new):
            text += f" (weights were last checked at step {self._finite_step:,})"
        if all(one.what in _LEARNED for one in new):
            text += f"; {_ADVICE}" if self.on_nan == "stop" else ""
        else:
            text += f"; {_ADVICE_ON_ENVIRONMENT}"
        if self.on_nan == "continue":
            warnings.warn(f"{text}; the others train on", RuntimeWarning, stacklevel=2)
            return
        saved = f"; what was saved at step {self.saved_step:,} is finite" if self.saved_step else ""
        raise NotFiniteError(text + saved)

    def state_dict(self) -> list[list[Any]]:
        """What was found, so that it is not reported again."""
        return [list(astuple(one)) for one in self.found]

    def load_state_dict(self, state: Sequence[Sequence[Any]], *, step: int) -> None:
        """Continues from what `state_dict` returned at a step."""
        self.found = [NotFinite(*one) for one in state]
        self._places = {one.place for one in self.found}
        self._finite_step = self.saved_step = step


def places(found: Iterable[NotFinite]) -> str:
    """What is not finite, in words: "the loss of agent 1 in replica 0 and the weights of ... are"."""
    listed = sorted(found)
    parts = []
    for (what, replica), of_agents in groupby(listed, key=lambda one: (one.what, one.replica)):
        agents = [str(one.agent) for one in of_agents]
        plural = "s" if len(agents) > 1 else ""
        parts.append(f"the {what} of agent{plural} {', '.join(agents)} in replica {replica}")
    more = [f"{len(parts) - _NAMED} more"] if len(parts) > _NAMED else []
    named = [*parts[:_NAMED], *more]
    is_one = len(listed) == 1 and listed[0].what != "weights"
    return ", and ".join(filter(None, [", ".join(named[:-1]), named[-1]])) + (" is" if is_one else " are")


def summary(found: Sequence[NotFinite]) -> str | None:
    """What was found in a training that went on, as a sentence below its evaluation; None for nothing."""
    if not found:
        return None
    first = min(one.step for one in found)
    return (
        f"From step {first:,} on {places(found)} not finite. What such an agent does means nothing, in this "
        "evaluation too; report.json has the step of each."
    )


def _marked(what: str, bad: NDArray[np.bool_], agents: Sequence[int], step: int) -> list[NotFinite]:
    """One for each marked entry of [R, S]."""
    return [NotFinite(what, int(r), agents[s], step) for r, s in np.argwhere(bad)]


def _sum_is_finite(array: NDArray[Any]) -> bool:
    """False where a number is NaN or infinite; also where finite ones add up to more than the largest."""
    with np.errstate(all="ignore"):
        return isfinite(array.sum())
