"""One independent DQN agent, out of TorchRL's parts."""

from collections.abc import Sequence
from functools import partial
from typing import Final

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import LazyTensorStorage, PrioritizedSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler, Sampler
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate, ValueEstimators

from cprl.learners.settings import DQNSettings
from cprl.networks.mlp import MLPNetwork
from cprl.policies.single import QActor

PRIORITY_BETA: Final = 0.4
"""How far the weights of a loss make up for preferred transitions, as in Schaul et al. at first."""


class DQNLearner:
    """A network, its actor, a replay buffer, TorchRL's `DQNLoss` with a target network, and Adam.

    Args:
        observation_shape: (C, X, Y) of what the agent sees, `Game.observation_shape`.
        actions: how many actions there are.
        settings: the hyper-parameters; see `presets.learner`.
        highest: the largest value of an observation, `Observation.highest`.
        device: where the agent learns and keeps what it has seen; by default the CPU.
        seed: of the replay buffer's sampling. Weights and exploration draw from torch's global generator,
            as TorchRL's modules do.
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        actions: int,
        *,
        settings: DQNSettings,
        highest: float = 255.0,
        device: str | torch.device = "cpu",
        seed: int = 0,
    ) -> None:
        device = torch.device(device)
        network = partial(q_network, observation_shape, actions, settings=settings, highest=highest)
        self.settings = settings
        self.network = network().to(device)
        self.actor = QActor(self.network, actions, device=device)
        self.actor.epsilon = settings.epsilon(0)
        self.loss = _loss_of(self.actor.greedy, settings.gamma)
        # HardUpdate copies at every (interval + 1)-th step, and once when it is made.
        self._target = HardUpdate(self.loss, value_network_update_interval=settings.target_every_episodes - 1)
        if settings.own_target_weights:
            self._give_target(network().to(device))
        self._loss_share = 1 / actions if settings.mean_over_all_outputs else 1.0
        self._adam = torch.optim.Adam(
            self.loss.parameters(), lr=settings.learning_rate, eps=settings.adam_eps, fused=True
        )
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(settings.buffer_size, device=device),
            sampler=_sampler(settings),
            batch_size=settings.batch_size,
            generator=torch.Generator(device).manual_seed(seed),
        )
        self.steps = 0

    def _give_target(self, network: MLPNetwork) -> None:
        """Puts a network's weights into the target network."""
        weights = dict(network.named_parameters())
        for path, target in self.loss.target_value_network_params.flatten_keys(".").items():
            name = next(name for name in weights if path.endswith(name))
            target.data.copy_(weights[name].data)

    def store(self, transitions: TensorDictBase) -> None:
        """Stores transitions, as `transitions_of` gives them; one environment step each."""
        self.buffer.extend(transitions)
        self.steps += len(transitions)
        self.actor.epsilon = self.settings.epsilon(self.steps)

    def update(self) -> float | None:
        """One update from a sample; the loss, or None while too little is stored."""
        if len(self.buffer) < self.settings.learning_starts:
            return None
        sample = self.buffer.sample()
        loss = self.loss(sample)["loss"] * self._loss_share
        if self.settings.priority_alpha:
            self.buffer.update_tensordict_priority(sample)
        self._adam.zero_grad()
        loss.backward()
        self._adam.step()
        return float(loss.detach())

    def end_episode(self) -> None:
        """Counts an episode; the target network is replaced after every so many."""
        self._target.step()


def _sampler(settings: DQNSettings) -> Sampler:
    if not settings.priority_alpha:
        return RandomSampler()
    try:
        return PrioritizedSampler(settings.buffer_size, alpha=settings.priority_alpha, beta=PRIORITY_BETA)
    except Exception as error:
        raise RuntimeError(
            f"priority_alpha is {settings.priority_alpha}: TorchRL's compiled extension, which it wants, "
            f"does not load with torch {torch.__version__} ({error}); "
            "0 is what fits, or a TorchRL that was built for this torch"
        ) from error


def dqn_loss(network: nn.Module, *, gamma: float) -> DQNLoss:
    """TorchRL's `DQNLoss` of one agent with a target network, squared error and one-step targets.

    Args:
        network: from "observation" to the value of each action; a `StackedMLP` makes it that of many.
        gamma: discount per step.
    """
    return _loss_of(QValueActor(network, spec=None, action_space="categorical"), gamma)


def _loss_of(actor: QValueActor, gamma: float) -> DQNLoss:
    loss = DQNLoss(actor, delay_value=True, loss_function="l2", action_space="categorical")
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss


def q_network(
    observation_shape: Sequence[int], actions: int, *, settings: DQNSettings, highest: float
) -> MLPNetwork:
    """The network of the settings; see `MLPNetwork` for the other arguments."""
    return MLPNetwork(
        observation_shape,
        actions,
        highest=highest,
        hidden_cells=settings.hidden_cells,
        relu_on_outputs=settings.relu_on_outputs,
        glorot_uniform=settings.glorot_uniform,
    )
