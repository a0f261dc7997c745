"""ReplayLearner: independent agents that learn from replay, all of them in one update."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cprl.keys import Turn
from cprl.learners.base import LearningAgents
from cprl.learners.engine import COMPILED_STEPS, UpdateRule
from cprl.learners.lanes import STATE, LaneLearner, Method
from cprl.learners.ring import Horizon, Ring
from cprl.learners.settings import DQNSettings
from cprl.learners.trial import refuse_for_replay, trial_batch
from cprl.policies.rng import EXPLORATION, NOISE, SAMPLING, TARGET_WEIGHTS, WEIGHTS


class ReplayLearner(LaneLearner):
    """R x S independent agents, such as those of DQN: S agents of each of R replicas.

    Each lane has its own network, target network, optimiser state, replay buffer and random numbers, and
    learns exactly as it would alone. The loss is TorchRL's, see `cprl.learners.engine`. Recurrent networks
    learn from sequences of `sequence_steps` turns, which begin with the states by which agents acted; the
    update of more than `COMPILED_STEPS` is not compiled.

    Args:
        compile: whether torch compiles acting and the update.
    """

    settings: DQNSettings
    buffer: Any
    takes_transforms = False
    """Whether batches pass through `DQNSettings.replay_transforms`."""

    def __init__(self, who: LearningAgents, method: Method, *, compile: bool = True) -> None:
        super().__init__(who, method)
        settings: DQNSettings = method.settings
        if settings.replay_transforms and not self.takes_transforms:
            raise ValueError(
                f"settings.replay_transforms is {settings.replay_transforms}; allowed: (), or with "
                'Experiment(engine="torchrl") any'
            )
        lanes = self._lanes
        networks = lanes.new_networks(WEIGHTS)
        self._refuse_other_sequences()
        horizon = Horizon(settings.n_steps, settings.gamma) if settings.n_steps > 1 else None
        self._form = lanes.form(horizon, settings.sequence_steps)
        loss = method.make_loss(deepcopy(networks[0]))
        refuse_for_replay(loss, settings, lambda: self._trial(1)[0])
        targets = lanes.new_networks(TARGET_WEIGHTS) if settings.own_target_weights else None
        share = 1 / self.spaces.actions if settings.mean_over_all_outputs else 1.0
        rule = UpdateRule.of(settings, loss_share=share)
        is_short = settings.sequence_steps <= COMPILED_STEPS
        self.engine = self._make_engine(networks, targets, rule=rule, compile=compile and is_short)
        self.buffer = self._make_buffer()
        self.actor = lanes.actor(self.engine, EXPLORATION, worlds=self.worlds, compile=compile)
        self.actor.epsilon = settings.epsilon(0)
        self._episodes = torch.zeros(self.replicas, dtype=torch.int64)
        self._owed = 0
        """Steps since the last update, of those that count, from `learning_starts` on."""
        self._first_update = max(settings.learning_starts, (self._form.steps_ahead + 1) * self.worlds)
        """The steps before the first update, by when each world has stored what a sample reads."""

    def _refuse_other_sequences(self) -> None:
        """Raises a ValueError unless recurrent networks, and they alone, learn from sequences."""
        steps, is_recurrent = self.settings.sequence_steps, self._lanes.state_cells > 0
        if is_recurrent != (steps > 1):
            kind, allowed = ("a", "2 or more") if is_recurrent else ("no", "1")
            raise ValueError(
                f"settings.sequence_steps is {steps}; allowed with {kind} recurrent network: {allowed}"
            )
        if is_recurrent and self._lanes.is_team:
            raise ValueError("the networks are recurrent; allowed for teams that learn from replay: others")

    def _trial(self, lanes: int) -> TensorDict:
        return trial_batch(lanes, self._form, self.spaces.actions, device=self.who.device)

    def _make_buffer(self) -> Any:
        """What transitions are stored in and sampled from: `write`, `cut`, and what the engine asks for."""
        return Ring(
            self._form,
            seeds=self._lanes.seeds(SAMPLING),
            noise_seeds=self._lanes.seeds(NOISE),
            transitions=self.settings.buffer_size,
            batch_size=self.settings.batch_size,
            columns=self._lanes.columns,
            device=self.who.device,
        )

    def begin(self) -> None:
        """Ends the episodes that an earlier training left unfinished; see `Learner`."""
        self.buffer.cut()

    def store(self, batch: TensorDictBase | Turn) -> None:
        turn = Turn.of(batch)
        self.buffer.write(self._lanes.turn(turn, self._wanted(turn)))
        self.steps += self.worlds
        self._owed += self.worlds * (self.steps >= self._first_update)
        self.actor.explore_with(self.settings.epsilon(self.steps))

    def update(self) -> Tensor | None:
        """Updates every lane as often as a turn asks for: `updates_per_step` times for every
        `steps_per_update` of the W steps; returns the mean losses [R, S], or None before the first update and
        between updates."""
        every = self.settings.steps_per_update
        # One that updates after every step may do so whenever it asks.
        due = self.worlds if every == 1 else min(self._owed // every, self.worlds)
        if self.steps < self._first_update or not due:
            return None
        self._owed = max(0, self._owed - every * due)
        losses = self.engine.update(self.buffer)
        if (updates := due * self.settings.updates_per_step) > 1:
            others = [self.engine.update(self.buffer) for _ in range(updates - 1)]
            losses = torch.stack([losses, *others]).mean(0)
        return self._lanes.by_agent(losses)

    def end_episode(self, ended: Tensor) -> None:
        """Counts an episode of the marked worlds, bool [B]: the weights of a replica are copied to targets
        every `target_every_episodes` episodes. With `tau` these move after every update instead."""
        before = self._episodes
        self._episodes = before + ended.view(self.replicas, self.worlds).sum(1)
        if self.settings.tau is not None:
            return
        every = self.settings.target_every_episodes
        due = self._episodes // every > before // every
        if due.any():
            self.engine.copy_to_targets(self._lanes.of_replicas(due))

    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        """The highest action value of each agent at the end of a turn, [B, S]; NaN where its network
        outputs a policy."""
        if self._lanes.method.stochastic:
            return torch.full((self.replicas * self.worlds, len(self.agents)), torch.nan)
        turn, is_recurrent = Turn.of(batch), self._lanes.state_cells > 0
        states = [self._lanes.by_lane(self._lanes.states_in(turn, STATE))] if is_recurrent else []
        with torch.no_grad():
            outputs = self.engine.outputs(self._lanes.seen_next(turn), *states)
        return self._lanes.by_world((outputs[0] if is_recurrent else outputs).amax(-1))

    def state_dict(self) -> dict[str, Any]:
        return {
            **super().state_dict(),
            **self.buffer.state_dict(),
            "owed": self._owed,
            "episodes": self._episodes,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self.buffer.load_state_dict(state)
        self._owed = int(state["owed"])
        self.actor.epsilon = self.settings.epsilon(self.steps)
        self._episodes = state["episodes"].clone()
