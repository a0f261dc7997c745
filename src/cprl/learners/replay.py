"""Replay: the memory of agents that learn from the latest turns, in any order."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import LossModule

from cprl import recurrent_state
from cprl.keys import Turn
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes
from cprl.learners.networks import LaneNetworks
from cprl.learners.refusals import refuse_for_replay
from cprl.learners.ring import Ring
from cprl.learners.settings import DQNSettings
from cprl.learners.transitions import LaneTurn, TransitionForm, made_up
from cprl.policies.rng import Purpose


class Replay:
    """Stores the latest turns in a ring, and gives a batch every `steps_per_update` steps.

    Recurrent networks learn from sequences of `sequence_steps` turns, which begin with the states by which
    agents acted.

    Args:
        form: what is stored of a turn and sampled.
        loss: of one lane, which is refused if it cannot learn from replay.
        stochastic: whether networks output policies; else they output action values.
    """

    def __init__(
        self, lanes: Lanes, settings: DQNSettings, form: TransitionForm, loss: LossModule, *, stochastic: bool
    ) -> None:
        settings.refuse_worlds(lanes.worlds)
        self.lanes, self.settings, self.form, self.stochastic = lanes, settings, form, stochastic
        self.sequence_steps = settings.sequence_steps
        self._refuse_other_sequences()
        refuse_for_replay(loss, settings, lambda: self.example(1)[0])
        self.buffer = self._make_buffer()
        self._steps, self._owed = 0, 0
        """Steps stored; and those since the last update, of those that count, from `learning_starts` on."""
        self._first_update = max(settings.learning_starts, (form.steps_ahead + 1) * lanes.worlds)
        """The first step that counts, by when each world has stored what a sample reads."""

    def _refuse_other_sequences(self) -> None:
        """Raises a ValueError unless recurrent networks, and they alone, learn from sequences."""
        steps, is_recurrent = self.sequence_steps, self.form.state_cells > 0
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
        """Stores a turn, as all agents had it, and as these lanes did."""
        self.buffer.write(lane_turn)
        self._steps += self.lanes.worlds
        self._owed += self.lanes.worlds * (self._steps >= self._first_update)

    def due(self, networks: LaneNetworks) -> Iterator[Draw]:
        """The batches to learn from after a turn: `updates_per_step` for every `steps_per_update` steps
        that count; none before the first update and between updates."""
        every, worlds = self.settings.steps_per_update, self.lanes.worlds
        # One that updates after every step may do so whenever it asks.
        updates = worlds if every == 1 else min(self._owed // every, worlds)
        if self._steps < self._first_update or not updates:
            return
        self._owed = max(0, self._owed - every * updates)
        for _ in range(updates * self.settings.updates_per_step):
            yield self.buffer.draw()

    def example(self, lanes: int) -> TensorDict:
        """A made-up batch of so many lanes, in the form of those that are due, [lanes, 8]."""
        form = self.form
        turns = 8 + form.steps_ahead
        seeds = [(lane,) for lane in range(lanes)]
        ring = Ring(form, seeds=seeds, transitions=turns, batch_size=8, device=self.lanes.device)
        places = torch.arange(8, device=ring.device).expand(lanes, -1)
        batch = ring.get(places)
        if form.noise_shape:
            batch.set("noise", torch.zeros(*batch.batch_size, *form.noise_shape, device=ring.device))
        return made_up(batch, self.lanes.spaces.actions)

    def values(self, networks: LaneNetworks, turn: Turn) -> Tensor:
        """The highest action value at the end of a turn, [L, W, ..]; NaN where a network outputs a policy."""
        if self.stochastic:
            return torch.full((len(self.lanes), self.lanes.worlds, *self.lanes.members), torch.nan)
        cells = self.form.state_cells
        states = [self.lanes.by_lane(self.lanes.states(turn, recurrent_state.AFTER, cells))] if cells else []
        outputs = networks.outputs(self.lanes.seen_next(turn), *states)
        return (outputs[0] if cells else outputs).amax(-1)  # type: ignore[no-any-return]

    def cut(self, networks: LaneNetworks) -> None:
        """Ends the episodes that a training left unfinished: what is stored next does not follow them."""
        self.buffer.cut()

    def state_dict(self) -> dict[str, Any]:
        return {**self.buffer.state_dict(), "steps": self._steps, "owed": self._owed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.buffer.load_state_dict(state)
        self._steps, self._owed = int(state["steps"]), int(state["owed"])
