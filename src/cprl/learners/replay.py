"""ReplayLearner: independent agents that learn from replay, all of them in one update."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl import keys
from cprl.commons.spaces import Spaces
from cprl.learners.buffer.gather import Horizon
from cprl.learners.buffer.sampler import lane_buffer, transformed
from cprl.learners.checks import check_learner, refuse_unshared_reward
from cprl.learners.engine.base import Engine
from cprl.learners.engine.choice import TRIAL_LANES, EngineName, make_engine, trial_batch
from cprl.learners.engine.functional import MakeLoss
from cprl.learners.engine.refusals import refuse_for_replay
from cprl.learners.engine.shared import SharedEngine
from cprl.learners.lanes import NOISE, SAMPLING, TARGET_WEIGHTS, WEIGHTS, Lanes, StartFrom
from cprl.learners.pace import Pace
from cprl.learners.recurrent import COMPILED_STEPS
from cprl.learners.settings import DQNSettings
from cprl.learners.single import dqn_loss, q_network
from cprl.learners.teams import MakeTeam, Teams, lanes_of
from cprl.learners.transitions import wanted_in
from cprl.networks.agent import acting_part
from cprl.networks.recurrent import state_cells_of
from cprl.policies.lanes import LaneActor
from cprl.preferences.values import Preference
from cprl.preferences.wanted import WantedRewards


class ReplayLearner:
    """R x S independent agents, DQN by default: S agents of each of R replicas.

    Each lane has its own network, target network, optimiser state, replay buffer and random numbers, and
    learns exactly as it would alone. The loss and the replay buffer are TorchRL's, see
    `cprl.learners.engine.base`. Recurrent networks learn from sequences of `sequence_steps` turns, which
    begin with the states by which agents acted; the update of more than `COMPILED_STEPS` is not compiled.

    Args:
        spaces: the shape and dtype of observations, and the number of actions A.
        agents: the indices of the agents that learn.
        replicas: the number of replicas R; each is one world of the environment.
        settings: the hyperparameters.
        seed: the seed of the run.
        first_replica: the index of the first replica, so that replica r can be trained alone.
        make_network: makes a lane's network; by default an `MLPNetwork` with the settings. It draws weights
            from torch's generator, which is seeded for each lane.
        make_loss: makes a lane's loss from its network; by default `dqn_loss`.
        make_team: for agents that learn as a team: makes the team's networks from those of its members, see
            `cprl.algorithms.teams`; a lane is then the team of a replica.
        own_rewards: whether each member of a team learns from what it wants itself, with rewards [.., S, 1];
            else all have the team reward, [.., 1].
        noise_numbers: how many uniform numbers the loss reads for each transition, of each member of a team:
            the entry "noise", float32 [.., noise_numbers] or [.., S, noise_numbers], from random numbers of
            each lane's own; 0 for a loss that samples nothing.
        stochastic: whether networks output the logits of a policy from which actions are sampled, with no
            epsilon; else action values, with `epsilon` of the settings.
        reward_kind: what they want, see `cprl.preferences`.
        engine: how lanes are updated; None picks the fastest that works, see `cprl.learners.engine.choice`.
        compile: whether torch compiles acting and the update; the engine "list" is never compiled.
        start_from: the weights with which acting networks, and their targets, start, by the lane's name; the
            others, such as critics, are new.
        share_parameters: whether the agents of a replica share one network, which learns from all of them.
        sees_peers: whether transitions have the actions of all agents, see `transitions.joint_actions`.
        device: the torch device of networks, buffers and updates.

    Raises:
        ValueError: for a loss that needs the latest steps of the current policy (see
            `cprl.learners.rollouts`), and for settings of targets if it has none; for a team without the team
            reward, unless it has `own_rewards`, and for one that sees its peers; for a recurrent network
            without sequences, or of a team, and for sequences without such a network.
    """

    def __init__(
        self,
        spaces: Spaces,
        *,
        agents: Sequence[int],
        replicas: int,
        settings: DQNSettings,
        seed: int = 0,
        first_replica: int = 0,
        make_network: Callable[[], nn.Module] | None = None,
        make_loss: MakeLoss | None = None,
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
        refuse_unshared_reward(is_sharing=bool(make_team) and not own_rewards, reward_kind=reward_kind)
        check_learner(spaces, settings, DQNSettings, agents, replicas, first_replica, seed, reward_kind)
        self.spaces, self.settings, self.agents = spaces, settings, tuple(agents)
        self.replicas, self.seed, self.wants = replicas, seed, WantedRewards(reward_kind)
        self._lanes = lanes_of(
            spaces,
            agents=agents,
            replicas=replicas,
            seed=seed,
            first_replica=first_replica,
            make_network=make_network or partial(_default_network, spaces, settings),
            make_team=make_team,
            own_rewards=own_rewards,
            stochastic=stochastic,
            start_from=start_from,
            share_parameters=share_parameters,
            sees_peers=sees_peers,
        )
        make_loss = make_loss or partial(dqn_loss, gamma=settings.gamma)
        self._shapes: dict[str, Any] = {
            "observation_shape": self._lanes.observation_shape,
            "action_shape": self._lanes.action_shape,
            "reward_shape": self._lanes.reward_shape,
            "noise_shape": (*self._lanes.member_shape, noise_numbers) if noise_numbers else (),
            "observation_dtype": spaces.observation_dtype,
            "horizon": Horizon(settings.n_steps, settings.gamma) if settings.n_steps > 1 else None,
            "device": device,
        }
        self.engine = self._make_engine(engine, make_loss, compile=compile)
        self.buffer = lane_buffer(
            seeds=self._lanes.seeds(SAMPLING),
            noise_seeds=self._lanes.seeds(NOISE),
            transitions=settings.buffer_size,
            batch_size=settings.batch_size,
            **self._shapes,
        )
        for transform in settings.replay_transforms:
            self.buffer.append_transform(transform.make())
        self.actor = self._lanes.actor(self.engine, compile=compile)
        self.steps, self._pace = 0, Pace(settings)
        self.actor.epsilon = settings.epsilon(0)
        self._episodes = torch.zeros(replicas, dtype=torch.int64)

    def __repr__(self) -> str:
        return f"ReplayLearner(agents={self.agents}, replicas={self.replicas})"

    def _make_engine(self, name: EngineName | None, make_loss: MakeLoss, *, compile: bool) -> Engine:
        """The engine of all lanes, with new networks."""
        settings, device = self.settings, self._shapes["device"]
        actions, own_targets = self.spaces.actions, settings.own_target_weights
        networks = self._lanes.new_networks(WEIGHTS, device)
        self._state_cells = state_cells_of(acting_part(networks[0]))
        self._refuse_other_sequences()
        self._shapes |= {"state_cells": self._state_cells, "sequence_steps": settings.sequence_steps}
        trial = trial_batch(min(len(networks), TRIAL_LANES), actions=actions, **self._shapes)
        trial = transformed(trial, settings.replay_transforms)
        refuse_for_replay(make_loss(deepcopy(networks[0])), settings, trial[0])
        engine = make_engine(
            name,
            networks,
            make_loss,
            target_networks=self._lanes.new_networks(TARGET_WEIGHTS, device) if own_targets else None,
            optimizer=settings.optimizer,
            learning_rate=settings.learning_rate,
            adam_eps=settings.adam_eps,
            tau=settings.tau,
            loss_share=1 / actions if settings.mean_over_all_outputs else 1.0,
            compile=compile and settings.sequence_steps <= COMPILED_STEPS,
            trial=trial,
        )
        return SharedEngine(engine, self._lanes.sharing) if self._lanes.sharing > 1 else engine

    def _refuse_other_sequences(self) -> None:
        """Raises a ValueError unless recurrent networks, and they alone, learn from sequences."""
        steps, is_recurrent = self.settings.sequence_steps, self._state_cells > 0
        if is_recurrent != (steps > 1):
            kind, allowed = ("a", "2 or more") if is_recurrent else ("no", "1")
            raise ValueError(
                f"settings.sequence_steps is {steps}; allowed with {kind} recurrent network: {allowed}"
            )
        if is_recurrent and isinstance(self._lanes, Teams):
            raise ValueError("the networks are recurrent; allowed for teams that learn from replay: others")

    @property
    def lanes(self) -> int:
        """The number of lanes L = R x S, or of teams, R."""
        return len(self._lanes)

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor with the current weights and `epsilon_evaluation`, for `worlds` worlds of each replica."""
        return self._lanes.evaluation_actor(self.engine, worlds, epsilon=self.settings.epsilon_evaluation)

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each lane's current acting network, by "replica_0/agent_0" and so on."""
        return self._lanes.networks(self.engine)

    def begin(self) -> None:
        """Ends the episodes that an earlier training left unfinished; see `Learner`."""
        self.buffer.storage.cut()

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

        Every `target_every_episodes` episodes the weights of a replica are copied to its targets.

        With `tau` they move after every update instead.
        """
        self._episodes += ended
        if self.settings.tau is not None:
            return
        due = ended & (self._episodes % self.settings.target_every_episodes == 0)
        if due.any():
            self.engine.copy_to_targets(due.repeat_interleave(self._lanes.of_replica))

    def finite(self) -> Tensor:
        """Whether the weights, targets and optimiser state of each agent are finite, bool [R, S]."""
        return self._lanes.by_agent(self.engine.finite())

    def values(self, batch: TensorDictBase) -> Tensor:
        """The highest action value of each agent at the end of a turn, [R, S]; NaN where its network
        outputs a policy."""
        if self._lanes.stochastic:
            return torch.full((self.replicas, len(self.agents)), torch.nan)
        seen = [self._lanes.seen_next(batch)]
        if self._state_cells:
            assert isinstance(self._lanes, Lanes)
            seen.append(self._lanes.recurrent_state(batch, keys.RECURRENT_STATE).unsqueeze(1))
        with torch.no_grad():
            outputs = self.engine.outputs(*seen)
        highest: Tensor = (outputs[0] if self._state_cells else outputs).amax(-1)
        return highest.view(self.replicas, len(self.agents))

    def state_dict(self) -> dict[str, Any]:
        """The full state of all lanes; the tensors themselves, not copies.

        The entry "networks" repeats the weights of "update" in the form that `cprl.load` reads.
        """
        transforms = {"transforms": self.buffer.transform.state_dict()} if self.buffer.has_transforms else {}
        noise = {"noise": self.buffer.noise.rng.state_dict()} if self.buffer.noise else {}
        return {
            **transforms,
            **noise,
            "networks": self._lanes.states(self.engine),
            "update": self.engine.state_dict(),
            "storage": self.buffer.storage.state_dict(),
            "sampler": self.buffer.sampler.state_dict(),
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
            "owed": self._pace.owed,
            "episodes": self._episodes,
            "wants": self.wants.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from the state of a learner made with the same arguments."""
        self.engine.load_state_dict(state["update"])
        self.buffer.storage.load_state_dict(state["storage"])
        self.buffer.sampler.load_state_dict(state["sampler"])
        if self.buffer.noise:
            self.buffer.noise.rng.load_state_dict(state["noise"])
        if self.buffer.has_transforms:
            self.buffer.transform.load_state_dict(state["transforms"])
        self.actor.rng.load_state_dict(state["exploration"])
        self.steps, self._pace.owed = int(state["steps"]), int(state.get("owed", 0))
        self.actor.epsilon = self.settings.epsilon(self.steps)
        self._episodes = state["episodes"].clone()
        self.wants.load_state_dict(state.get("wants", {}))


def _default_network(spaces: Spaces, settings: DQNSettings) -> nn.Module:
    return q_network(
        spaces.observation_shape, spaces.actions, settings=settings, highest=spaces.observation_scale
    )
