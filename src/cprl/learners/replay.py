"""Replay: the memory of off-policy agents, which learn from the latest turns in any order."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import LossModule

from cprl.keys import Turn, recurrent_state
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes
from cprl.learners.networks import LaneNetworks
from cprl.learners.refusals import refuse_for_replay
from cprl.learners.ring import Ring
from cprl.learners.settings import DQNSettings
from cprl.learners.transitions import LaneTurn, TransitionForm, randomized
from cprl.policies.rng import Purpose

_EXAMPLE_SAMPLES: Final = 8
"""The samples of each lane in a synthetic batch."""


class Replay:
    """A memory that stores the latest turns in a ring, and yields a batch every `steps_per_update` steps.

    Recurrent networks learn from sequences of `sequence_steps` turns; each begins with the recurrent state
    that the agent had when it acted in that turn.

    Args:
        lanes: the agents that learn.
        settings: say when an update is due, and how large the buffer and its samples are.
        form: the shapes of what is stored of a turn and sampled.
        loss: the loss of one lane; refused if it cannot learn from replay.
        stochastic: true if networks output the logits of a policy; else they output action values.
    """

    def __init__(
        self, lanes: Lanes, settings: DQNSettings, form: TransitionForm, loss: LossModule, *, stochastic: bool
    ) -> None:
        settings.refuse_worlds(lanes.worlds)
        self.lanes = lanes
        self.settings = settings
        self.form = form
        self.stochastic = stochastic
        self._refuse_other_sequences()
        refuse_for_replay(loss, settings, lambda: self.example(1)[0])
        self.buffer = self._make_buffer()
        self._steps = 0
        """The steps stored for each replica; a turn of W worlds is W steps."""
        self._steps_owed = 0
        """The steps from `_first_update` on for which no update was taken yet; not read where every step has
        one."""
        self._first_update = max(settings.learning_starts, (form.steps_ahead + 1) * lanes.worlds)
        """The step of the first update: `learning_starts`, or the step at which each world has stored enough
        turns for one sample."""

    def _refuse_other_sequences(self) -> None:
        """Raise a ValueError unless recurrent networks, and they alone, learn from sequences."""
        steps = self.settings.sequence_steps
        is_recurrent = self.form.state_cells > 0
        if is_recurrent != (steps > 1):
            kind, allowed = ("a", "2 or more") if is_recurrent else ("no", "1")
            raise ValueError(
                f"settings.sequence_steps is {steps}; allowed with {kind} recurrent network: {allowed}"
            )
        if is_recurrent and self.lanes.are_teams:
            raise ValueError("the networks are recurrent; allowed for teams that learn from replay: others")

    def _make_buffer(self) -> Any:
        lanes = self.lanes
        return Ring(
            self.form,
            seeds=lanes.seeds(Purpose.SAMPLING),
            noise_seeds=lanes.seeds(Purpose.NOISE),
            transitions=self.settings.buffer_size,
            batch_size=self.settings.batch_size,
            columns=lanes.columns,
            device=lanes.device,
        )

    def write(self, turn: Turn, lane_turn: LaneTurn) -> None:
        """Store a turn; `Memory.write` says the arguments."""
        worlds = self.lanes.worlds
        self.buffer.write(lane_turn)
        self._steps += worlds
        if self._steps >= self._first_update:
            self._steps_owed += worlds

    def due(self, networks: LaneNetworks) -> Iterator[Draw]:
        """Yield the batches of the updates that are due: `updates_per_step` for every `steps_per_update`
        steps from the first update on."""
        period = self.settings.steps_per_update
        worlds = self.lanes.worlds
        # With an update after every step a caller may ask for updates at any time, also without a new turn.
        updates = worlds if period == 1 else min(self._steps_owed // period, worlds)
        if self._steps < self._first_update or not updates:
            return
        self._steps_owed = max(0, self._steps_owed - period * updates)
        for _ in range(updates * self.settings.updates_per_step):
            yield self.buffer.draw()

    def example(self, lanes: int) -> TensorDict:
        """Return a synthetic batch of a number of lanes, [lanes, 8], in the shapes of those that are due."""
        form = self.form
        turns = _EXAMPLE_SAMPLES + form.steps_ahead
        seeds = [(lane,) for lane in range(lanes)]
        ring = Ring(
            form, seeds=seeds, transitions=turns, batch_size=_EXAMPLE_SAMPLES, device=self.lanes.device
        )
        return randomized(ring.sample(), self.lanes.spaces.actions)

    def values(self, networks: LaneNetworks, turn: Turn) -> Tensor:
        """Return the highest action value after a turn, [L, W, ..]; NaN for networks that output a policy."""
        if self.stochastic:
            return torch.full((len(self.lanes), self.lanes.worlds, *self.lanes.members), torch.nan)
        cells = self.form.state_cells
        states = [self.lanes.by_lane(self.lanes.states(turn, recurrent_state.AFTER, cells))] if cells else []
        outputs = networks.outputs(self.lanes.next_observations(turn), *states)
        return (outputs[0] if cells else outputs).amax(-1)

    def cut(self, networks: LaneNetworks) -> None:
        """End the episodes that a training left unfinished: the next turn that is stored does not follow
        them."""
        self.buffer.cut()

    def state_dict(self) -> dict[str, Any]:
        return {**self.buffer.state_dict(), "steps": self._steps, "owed": self._steps_owed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.buffer.load_state_dict(state)
        self._steps = int(state["steps"])
        self._steps_owed = int(state["owed"])
