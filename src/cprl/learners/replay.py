"""ReplayLearner: independent agents that learn from replay, all of them in one update."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from cprl import keys
from cprl.commons.spaces import Spaces
from cprl.learners.engine import COMPILED_STEPS, Engine, MakeLoss
from cprl.learners.lanes import (
    NOISE,
    SAMPLING,
    TARGET_WEIGHTS,
    WEIGHTS,
    LaneLearner,
    Lanes,
    MakeTeam,
    StartFrom,
    Teams,
)
from cprl.learners.preferences import Preference
from cprl.learners.ring import Horizon, Ring
from cprl.learners.settings import DQNSettings
from cprl.learners.transitions import wanted_in
from cprl.learners.trial import (
    TRIAL_LANES,
    EngineName,
    make_engine,
    refuse_for_replay,
    trial_batch,
)
from cprl.policies.lanes import LaneActor


class Pace:
    """When learners from replay update: from `learning_starts` steps on, after every `steps_per_update`."""

    def __init__(self, settings: DQNSettings) -> None:
        self._settings = settings
        self.owed = 0
        """Steps since the last update, of those that count."""

    def stored(self, steps: int) -> None:
        """Counts a step; it is the one of this number, from 1."""
        self.owed += steps >= self._settings.learning_starts

    def take(self, steps: int) -> bool:
        """Whether to update now, after so many steps; that update is then owed no more. One that updates
        after every step may do so whenever it asks."""
        every = self._settings.steps_per_update
        if steps < self._settings.learning_starts or (every > 1 and self.owed < every):
            return False
        self.owed = max(0, self.owed - every)
        return True


class ReplayLearner(LaneLearner):
    """R x S independent agents, such as those of DQN: S agents of each of R replicas.

    Each lane has its own network, target network, optimiser state, replay buffer and random numbers, and
    learns exactly as it would alone. The loss is TorchRL's, see `cprl.learners.engine`. Recurrent networks
    learn from sequences of `sequence_steps` turns, which begin with the states by which agents acted; the
    update of more than `COMPILED_STEPS` is not compiled.

    Args:
        spaces: the shape and dtype of observations, and the number of actions A.
        agents: the indices of the agents that learn.
        replicas: the number of replicas R; each is one world of the environment.
        make_network: makes a lane's network. It draws weights from torch's generator, which is seeded for
            each lane.
        make_loss: makes a lane's loss from its network.
        seed: the seed of the run.
        first_replica: the index of the first replica, so that replica r can be trained alone.
        make_team: for agents that learn as a team: makes the team's networks from those of its members, see
            `cprl.algorithms.teams`; a lane is then the team of a replica.
        own_rewards: whether each member of a team learns from what it wants itself, with rewards [.., S, 1];
            else all have the team reward, [.., 1].
        noise_numbers: how many uniform numbers the loss reads for each transition, of each member of a team:
            the entry "noise", float32 [.., noise_numbers] or [.., S, noise_numbers], from random numbers of
            each lane's own; 0 for a loss that samples nothing.
        stochastic: whether networks output the logits of a policy from which actions are sampled, with no
            epsilon; else action values, with `epsilon` of the settings.
        reward_kind: what they want, see `cprl.learners.preferences`.
        engine: how lanes are updated; None picks the fastest that works, see `cprl.learners.trial`.
        compile: whether torch compiles acting and the update; the engine "list" is never compiled.
        start_from: the weights with which acting networks, and their targets, start, by the lane's name; the
            others, such as critics, are new.
        share_parameters: whether the agents of a replica share one network, which learns from all of them.
        sees_peers: whether transitions have the actions of all agents, see `transitions.joint_actions`.
        device: the torch device of networks, buffers and updates.
    """

    settings: DQNSettings
    buffer: Any
    takes_transforms = False
    """Whether batches pass through `DQNSettings.replay_transforms`."""

    def __init__(
        self,
        spaces: Spaces,
        *,
        agents: Sequence[int],
        replicas: int,
        settings: DQNSettings,
        make_network: Callable[[], nn.Module],
        make_loss: MakeLoss,
        seed: int = 0,
        first_replica: int = 0,
        make_team: MakeTeam | None = None,
        own_rewards: bool = False,
        noise_numbers: int = 0,
        stochastic: bool = False,
        reward_kind: Preference = "individual",
        engine: EngineName | None = None,
        compile: bool = True,
        start_from: StartFrom | None = None,
        share_parameters: bool = False,
        sees_peers: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__(
            spaces, settings, agents=agents, replicas=replicas, seed=seed, reward_kind=reward_kind
        )
        if settings.replay_transforms and not self.takes_transforms:
            raise ValueError(
                f"settings.replay_transforms is {settings.replay_transforms}; allowed: (), or with "
                'Experiment(engine="torchrl") any'
            )
        how: dict[str, Any] = {
            "agents": agents,
            "replicas": replicas,
            "seed": seed,
            "first_replica": first_replica,
            "make_network": make_network,
            "stochastic": stochastic,
            "start_from": start_from,
            "share_parameters": share_parameters,
            "sees_peers": sees_peers,
        }
        self._lanes = (
            Teams(spaces, make_team=make_team, own_rewards=own_rewards, **how)
            if make_team
            else Lanes(spaces, **how)
        )
        self._shapes: dict[str, Any] = {
            "observation_shape": self._lanes.observation_shape,
            "action_shape": self._lanes.action_shape,
            "reward_shape": self._lanes.reward_shape,
            "noise_shape": (*self._lanes.member_shape, noise_numbers) if noise_numbers else (),
            "observation_dtype": spaces.observation_dtype,
            "horizon": Horizon(settings.n_steps, settings.gamma) if settings.n_steps > 1 else None,
            "device": device,
        }
        networks = self._lanes.new_networks(WEIGHTS, device)
        self._refuse_other_sequences()
        self._shapes |= {"state_cells": self._lanes.state_cells, "sequence_steps": settings.sequence_steps}
        trial = self._trial(min(len(networks), TRIAL_LANES))
        refuse_for_replay(make_loss(deepcopy(networks[0])), settings, trial[0])
        targets = self._lanes.new_networks(TARGET_WEIGHTS, device) if settings.own_target_weights else None
        self.engine = self._make_engine(
            networks, make_loss, trial, name=engine, compile=compile, target_networks=targets
        )
        self.buffer = self._make_buffer()
        self.actor = self._lanes.actor(self.engine, compile=compile)
        self._pace = Pace(settings)
        self.actor.epsilon = settings.epsilon(0)
        self._episodes = torch.zeros(replicas, dtype=torch.int64)

    def _refuse_other_sequences(self) -> None:
        """Raises a ValueError unless recurrent networks, and they alone, learn from sequences."""
        steps, is_recurrent = self.settings.sequence_steps, self._lanes.state_cells > 0
        if is_recurrent != (steps > 1):
            kind, allowed = ("a", "2 or more") if is_recurrent else ("no", "1")
            raise ValueError(
                f"settings.sequence_steps is {steps}; allowed with {kind} recurrent network: {allowed}"
            )
        if is_recurrent and isinstance(self._lanes, Teams):
            raise ValueError("the networks are recurrent; allowed for teams that learn from replay: others")

    def _trial(self, lanes: int) -> TensorDict:
        """Synthetic transitions of so many lanes."""
        return trial_batch(lanes, actions=self.spaces.actions, **self._shapes)

    def _make_engine(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        trial: TensorDict,
        *,
        name: EngineName | None,
        compile: bool,
        target_networks: Sequence[nn.Module] | None,
    ) -> Engine:
        """The engine of all lanes."""
        engine = make_engine(
            name,
            networks,
            make_loss,
            target_networks=target_networks,
            compile=compile and self.settings.sequence_steps <= COMPILED_STEPS,
            trial=trial,
            **self._of_engine(),
        )
        return self._lanes.by_lane(engine)

    def _of_engine(self) -> dict[str, Any]:
        """The arguments of an engine that the settings say."""
        settings = self.settings
        return {
            "optimizer": settings.optimizer,
            "learning_rate": settings.learning_rate,
            "adam_eps": settings.adam_eps,
            "tau": settings.tau,
            "loss_share": 1 / self.spaces.actions if settings.mean_over_all_outputs else 1.0,
        }

    def _make_buffer(self) -> Any:
        """What transitions are stored in and sampled from: `write`, `cut`, and what the engine asks for."""
        return Ring(
            seeds=self._lanes.seeds(SAMPLING),
            noise_seeds=self._lanes.seeds(NOISE),
            transitions=self.settings.buffer_size,
            batch_size=self.settings.batch_size,
            **self._shapes,
        )

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor with the current weights and `epsilon_evaluation`, for `worlds` worlds of each replica."""
        return self._lanes.evaluation_actor(self.engine, worlds, epsilon=self.settings.epsilon_evaluation)

    def begin(self) -> None:
        """Ends the episodes that an earlier training left unfinished; see `Learner`."""
        self.buffer.cut()

    def store(self, batch: TensorDictBase) -> None:
        """Stores one step of every replica, as the collector yields it."""
        self.buffer.write(self._lanes.turn(batch, wanted_in(self.wants, batch)))
        self.steps += 1
        self._pace.stored(self.steps)
        self.actor.explore_with(self.settings.epsilon(self.steps))

    def update(self) -> Tensor | None:
        """Updates every lane `updates_per_step` times; returns the mean losses [R, S], or None while fewer
        than `learning_starts` transitions are stored, and between updates, see `steps_per_update`."""
        if not self._pace.take(self.steps):
            return None
        losses = self.engine.update(self.buffer)
        if self.settings.updates_per_step > 1:
            others = [self.engine.update(self.buffer) for _ in range(self.settings.updates_per_step - 1)]
            losses = torch.stack([losses, *others]).mean(0)
        return self._lanes.by_agent(losses)

    def end_episode(self, ended: Tensor) -> None:
        """Counts an episode of the marked replicas, bool [R].

        Every `target_every_episodes` episodes the weights of a replica are copied to its targets. With `tau`
        they move after every update instead.
        """
        self._episodes += ended
        if self.settings.tau is not None:
            return
        due = ended & (self._episodes % self.settings.target_every_episodes == 0)
        if due.any():
            self.engine.copy_to_targets(self._lanes.of_replicas(due))

    def values(self, batch: TensorDictBase) -> Tensor:
        """The highest action value of each agent at the end of a turn, [R, S]; NaN where its network
        outputs a policy."""
        if self._lanes.stochastic:
            return torch.full((self.replicas, len(self.agents)), torch.nan)
        seen = [self._lanes.seen_next(batch)]
        is_recurrent = self._lanes.state_cells > 0
        if is_recurrent:
            seen.append(self._lanes.recurrent_state(batch, keys.RECURRENT_STATE).unsqueeze(1))
        with torch.no_grad():
            outputs = self.engine.outputs(*seen)
        highest: Tensor = (outputs[0] if is_recurrent else outputs).amax(-1)
        return highest.view(self.replicas, len(self.agents))

    def state_dict(self) -> dict[str, Any]:
        return {
            **super().state_dict(),
            **self.buffer.state_dict(),
            "owed": self._pace.owed,
            "episodes": self._episodes,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self.buffer.load_state_dict(state)
        self._pace.owed = int(state["owed"])
        self.actor.epsilon = self.settings.epsilon(self.steps)
        self._episodes = state["episodes"].clone()
