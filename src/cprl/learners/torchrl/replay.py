"""TorchRLReplayLearner: independent agents that learn from replay with TorchRL's stock parts."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data.replay_buffers import RandomSampler
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater

from cprl.commons.spaces import Spaces
from cprl.envs.drivers import device_of
from cprl.learners.buffer.gather import Horizon
from cprl.learners.buffer.sampler import Noise, transformed
from cprl.learners.checks import check_learner
from cprl.learners.engine.choice import trial_batch
from cprl.learners.engine.functional import MakeLoss, targets_of
from cprl.learners.engine.refusals import refuse_for_replay, refuse_other_outputs
from cprl.learners.lanes import NOISE, TARGET_WEIGHTS, Lanes, StartFrom
from cprl.learners.pace import Pace
from cprl.learners.settings import DQNSettings
from cprl.learners.torchrl.agents import MakeSampler, StockAgents, check_makers
from cprl.learners.torchrl.buffers import StockBuffers, check_buffers
from cprl.learners.transitions import wanted_in
from cprl.networks.agent import acting_part
from cprl.networks.recurrent import state_shape_of
from cprl.policies.lanes import LaneActor
from cprl.preferences.values import Preference
from cprl.preferences.wanted import WantedRewards


class TorchRLReplayLearner:
    """R x S independent agents made of TorchRL's stock parts: S agents of each of R replicas.

    Each has a network, the loss of its algorithm, an optimiser of torch.optim, a `HardUpdate` or
    `SoftUpdate`, and a `TensorDictReplayBuffer` of a `LazyTensorStorage` and a `RandomSampler`. They explore
    through `LaneActor`, not `EGreedyModule`, which uses torch's global generator: a replica's actions would
    depend on the replicas that train beside it. Initial weights, initial targets and exploration equal those
    of `ReplayLearner`; the sampled batches do not, unless `make_sampler` replays them.

    Args:
        spaces: the shape and dtype of observations, and the number of actions A.
        agents: the indices of the agents that learn.
        replicas: the number of replicas R; each is one world of the environment.
        settings: the hyperparameters.
        make_network: makes new networks of one agent, initialised from torch's generator, which is seeded for
            each agent.
        make_loss: makes an agent's loss from its networks.
        seed: the seed of the run.
        first_replica: the index of the first replica, so that replica r can be trained alone.
        stochastic: whether networks output the logits of a policy; else action values.
        reward_kind: what they want, see `cprl.preferences`.
        make_sampler: makes an agent's sampler; by default a `RandomSampler`.
        noise_numbers: see `ReplayLearner`.
        start_from: the weights with which acting networks, and their targets, start, by the lane's name; the
            others, such as critics, are new.
        sees_peers: whether transitions have the actions of all agents, see `transitions.joint_actions`.
        device: the torch device of networks, buffers and updates.

    Raises:
        ValueError: for a loss that needs the latest steps of the current policy, for settings below their
            minimum, and for settings that the loss ignores or contradicts: those of targets if it has none,
            `n_steps`, and with it another gamma.
        TooLargeError: if the device has less memory than the buffers need; raised before allocation.
    """

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
        stochastic: bool = False,
        reward_kind: Preference = "individual",
        make_sampler: MakeSampler | None = None,
        noise_numbers: int = 0,
        start_from: StartFrom | None = None,
        sees_peers: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        check_learner(spaces, settings, DQNSettings, agents, replicas, first_replica, seed, reward_kind)
        check_makers(make_network, make_loss, make_sampler)
        device = device_of(device)
        self.spaces, self.settings, self.agents = spaces, settings, tuple(agents)
        self.replicas, self.seed, self.wants = replicas, seed, WantedRewards(reward_kind)
        self._lanes = Lanes(
            spaces,
            agents=agents,
            replicas=replicas,
            seed=seed,
            first_replica=first_replica,
            make_network=make_network,
            stochastic=stochastic,
            start_from=start_from,
            sees_peers=sees_peers,
        )
        self._refuse_unfit(make_loss, device, noise_numbers)
        self.stock = StockAgents(
            self._lanes,
            make_loss,
            optimizer=settings.optimizer,
            learning_rate=settings.learning_rate,
            eps=settings.adam_eps,
            loss_share=1 / spaces.actions if settings.mean_over_all_outputs else 1.0,
            device=device,
        )
        self.updaters = [_target_updater(agent.loss, settings) for agent in self.stock.each]
        if settings.own_target_weights:
            self._init_targets(make_loss)
        check_buffers(self._lanes, settings, self.stock.device)
        self.buffers = StockBuffers(
            settings, self.stock.generators, make_sampler or _random_sampler, self.stock.device
        )
        of_batch = settings.batch_size, (noise_numbers,), self.stock.device
        self._noise = [Noise([own], *of_batch) for own in self._lanes.seeds(NOISE) if noise_numbers]
        self.actor = self._lanes.actor(self.stock, compile=False)
        self.steps, self._pace = 0, Pace(settings)
        self.actor.epsilon = settings.epsilon(0)

    def __repr__(self) -> str:
        return f"TorchRLReplayLearner(agents={self.agents}, replicas={self.replicas})"

    def _refuse_unfit(self, make_loss: MakeLoss, device: str | torch.device, noise_numbers: int) -> None:
        """The checks of the fast engine, on a loss of its own and synthetic transitions of one agent."""
        settings = self.settings
        with torch.random.fork_rng(devices=[]):
            network = self._lanes.make_network().to(device)
            loss = make_loss(network)
        steps = settings.sequence_steps
        if steps > 1 or state_shape_of(acting_part(network)) is not None:
            raise ValueError(
                f'settings.sequence_steps is {steps}; allowed with engine="torchrl", whose buffers give '
                'single transitions: 1, with MLP, Conv, Custom; engine="compiled" and "eager" learn from '
                "sequences"
            )
        trial = trial_batch(
            1,
            self._lanes.observation_shape,
            self.spaces.actions,
            action_shape=self._lanes.action_shape,
            observation_dtype=self.spaces.observation_dtype,
            horizon=Horizon(settings.n_steps, settings.gamma) if settings.n_steps > 1 else None,
            noise_shape=(noise_numbers,) if noise_numbers else (),
            device=device,
        )
        batch = transformed(trial, settings.replay_transforms)[0]
        refuse_for_replay(loss, settings, batch)
        refuse_other_outputs(loss, batch)

    def _init_targets(self, make_loss: MakeLoss) -> None:
        """Gives targets initial weights of their own; the updaters have made them copies."""
        networks = self._lanes.new_networks(TARGET_WEIGHTS, self.stock.device)
        for agent, network in zip(self.stock.each, networks, strict=True):
            for name, values in targets_of(make_loss(network)).items():
                getattr(agent.loss, f"target_{name}").data.copy_(values.data)

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor with the current weights and `epsilon_evaluation`, for `worlds` worlds of each replica."""
        return self._lanes.evaluation_actor(self.stock, worlds, epsilon=self.settings.epsilon_evaluation)

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each agent's current acting network, by "replica_0/agent_0" and so on."""
        return self._lanes.networks(self.stock)

    def begin(self) -> None:
        """Ends the episodes that an earlier training left unfinished; see `Learner`."""
        self.buffers.end_episodes()

    def store(self, batch: TensorDictBase) -> None:
        """Stores one step of every replica, as the collector yields it."""
        self.buffers.extend(self.stock.transitions(batch, wanted_in(self.wants, batch)))
        self.steps += 1
        self._pace.stored(self.steps)
        self.actor.epsilon = self.settings.epsilon(self.steps)

    def update(self) -> Tensor | None:
        """Updates every agent `updates_per_step` times; returns the mean losses [R, S], or None while fewer
        than `learning_starts` transitions are stored, and between updates, see `steps_per_update`."""
        if not len(self.buffers[0]) or not self._pace.take(self.steps):
            return None
        losses = [self._update(lane) for lane in range(len(self.stock))]
        return self._lanes.by_agent(torch.stack(losses))

    def _update(self, lane: int) -> Tensor:
        losses = []
        for _ in range(self.settings.updates_per_step):
            batch = self.buffers[lane].sample()
            if self._noise:
                batch.set("noise", self._noise[lane].next()[0])
            losses.append(self.stock.each[lane].update(batch))
            updater = self.updaters[lane]
            if isinstance(updater, SoftUpdate):
                updater.step()
        return torch.stack(losses).mean()

    def end_episode(self, ended: Tensor) -> None:
        """Counts an episode of the marked replicas, bool [R]; every `target_every_episodes` episodes a hard
        update of the targets follows."""
        for lane in ended.repeat_interleave(self._lanes.of_replica).nonzero().flatten().tolist():
            updater = self.updaters[lane]
            if isinstance(updater, HardUpdate):
                updater.step()

    def finite(self) -> Tensor:
        """Whether the weights, targets and optimiser state of each agent are finite, bool [R, S]."""
        return self._lanes.by_agent(self.stock.finite())

    def values(self, batch: TensorDictBase) -> Tensor:
        """The highest action value of each agent at the end of a turn, [R, S]; NaN where its network
        outputs a policy."""
        if self._lanes.stochastic:
            return torch.full((self.replicas, len(self.agents)), torch.nan)
        with torch.no_grad():
            return self._lanes.by_agent(self.stock.outputs(self._lanes.seen_next(batch)).amax(-1))

    def state_dict(self) -> dict[str, Any]:
        """The full state of all agents; the tensors themselves where possible, not copies.

        The entry "networks" repeats the weights of "agents" in the form that `cprl.load` reads.
        """
        return {
            "networks": self._lanes.states(self.stock),
            "agents": [agent.state_dict() for agent in self.stock.each],
            "updaters": [updater.state_dict() if updater else {} for updater in self.updaters],
            **self.buffers.state_dict(),
            "noise": [own.rng.state_dict() for own in self._noise],
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
            "owed": self._pace.owed,
            "wants": self.wants.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from the state of a learner made with the same arguments."""
        for agent, own in zip(self.stock.each, state["agents"], strict=True):
            agent.load_state_dict(own)
        for updater, own in zip(self.updaters, state["updaters"], strict=True):
            if updater is not None:
                updater.load_state_dict(own)
        self.buffers.load_state_dict(state)
        for noise, own in zip(self._noise, state.get("noise", ()), strict=True):
            noise.rng.load_state_dict(own)
        self.actor.rng.load_state_dict(state["exploration"])
        self.steps, self._pace.owed = int(state["steps"]), int(state.get("owed", 0))
        self.wants.load_state_dict(state.get("wants", {}))
        self.actor.epsilon = self.settings.epsilon(self.steps)


def _random_sampler(lane: int) -> RandomSampler:
    return RandomSampler()


def _target_updater(loss: LossModule, settings: DQNSettings) -> TargetNetUpdater | None:
    """The target updater of a loss; None if the loss has no targets."""
    if not targets_of(loss):
        return None
    if settings.tau is not None:
        return SoftUpdate(loss, tau=settings.tau)
    # HardUpdate copies at every (interval + 1)-th step.
    return HardUpdate(loss, value_network_update_interval=settings.target_every_episodes - 1)
