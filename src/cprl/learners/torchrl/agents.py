"""The agents of a learner as a plain list of stock parts of TorchRL and torch."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data.replay_buffers import Sampler

from cprl.arguments import callable_of, object_of
from cprl.learners.engine.base import is_finite, stacked_outputs
from cprl.learners.engine.functional import MakeLoss, own_targets, total
from cprl.learners.engine.optimizers import RMSPROP_ALPHAS
from cprl.learners.lanes import SAMPLING, WEIGHTS, Lanes
from cprl.learners.settings import Optimizer
from cprl.networks.agent import parts_of

MakeSampler = Callable[[int], Sampler]
"""Makes a TorchRL sampler for an agent, by its lane = replica x S + position among the agents. Comparisons
with the fast engine pass one that replays given indices."""

_OPTIMIZERS: Final[dict[Optimizer, type[torch.optim.Optimizer]]] = {
    "adam": torch.optim.Adam,
    "adamw": torch.optim.AdamW,
    "rmsprop": torch.optim.RMSprop,
    "keras_rmsprop": torch.optim.RMSprop,
    "sgd": torch.optim.SGD,
}
_LARGEST_SEED: Final = 2**63 - 1


def check_makers(network: object, loss: object, sampler: object) -> None:
    """Raises a ValueError for a maker that cannot be called."""
    callable_of("make_network", network, "a function that makes a network")
    callable_of("make_loss", loss, "a function that makes the loss of a network")
    if sampler is not None:
        callable_of("make_sampler", sampler, "None, or a function that makes the sampler of a lane")


def sampler_of(make_sampler: MakeSampler, lane: int) -> Sampler:
    """The sampler of a lane; raises a ValueError where something else is made."""
    sampler = make_sampler(lane)
    object_of(f"make_sampler({lane})", sampler, Sampler, "a Sampler of torchrl.data")
    return sampler


class StockAgent:
    """One agent: its networks, TorchRL's loss over them, and an optimiser of torch.optim.

    Args:
        network: trained in place; `AgentNetworks` where it has several.
        make_loss: makes the loss from the network.
        optimizer: see `make_optimizer`.
        learning_rate: its step size.
        eps: added to its denominator.
        loss_share: a factor of the loss.
        max_grad_norm: the norm to which the gradient is clipped; None for no clipping.
    """

    def __init__(
        self,
        network: nn.Module,
        make_loss: MakeLoss,
        *,
        optimizer: Optimizer,
        learning_rate: float,
        eps: float,
        loss_share: float = 1.0,
        max_grad_norm: float | None = None,
    ) -> None:
        self.network, self.parts = network, list(parts_of(network).values())
        self.loss = make_loss(network)
        own_targets(self.loss)
        self.optimizer = make_optimizer(
            self.loss.parameters(), optimizer, learning_rate=learning_rate, eps=eps
        )
        self._share, self._max_norm = loss_share, max_grad_norm

    def update(self, batch: TensorDictBase) -> Tensor:
        """One optimiser step on a batch [b]; returns the loss, 0-d."""
        losses = total(self.loss(batch), self.loss)
        loss = losses.mean() * self._share  # some losses give one for each transition
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self._max_norm is not None:
            nn.utils.clip_grad_norm_(self.loss.parameters(), self._max_norm)
        self.optimizer.step()
        return loss.detach()

    def state_dict(self) -> dict[str, Any]:
        """All weights, including targets, and the optimiser's state; the tensors themselves, not copies."""
        return {"loss": dict(self.loss.state_dict()), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from that state."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])


class StockAgents:
    """S agents of each of R replicas, updated one after the other; their actors use its networks.

    They have the seeds, and so the initial weights, of the fast engine.

    Args:
        lanes: the agents, replicas and networks.
        make_loss: see `StockAgent`.
        device: the torch device of networks, buffers and updates.
        how: the other arguments of `StockAgent`.
    """

    def __init__(self, lanes: Lanes, make_loss: MakeLoss, *, device: str | torch.device, **how: Any) -> None:
        self.device = torch.device(device)
        self._lanes = lanes
        self.each = [StockAgent(network, make_loss, **how) for network in lanes.new_networks(WEIGHTS, device)]

    def __len__(self) -> int:
        return len(self.each)

    def generators(self) -> list[torch.Generator]:
        """A random number generator for the sampling of each agent, seeded by its own seed alone."""
        return [
            torch.Generator(self.device).manual_seed(
                int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] & _LARGEST_SEED)
            )
            for seed in self._lanes.seeds(SAMPLING)
        ]

    def transitions(self, batch: TensorDictBase, rewards: Any) -> TensorDict:
        """A turn of every agent, [L], under TorchRL's default keys; rewards and flags are [L, 1].

        Args:
            batch: a turn of every replica, [R], as the collector yields it.
            rewards: the rewards that all agents want, [R, N], see `wanted_in`.
        """
        turn = self._lanes.turn(batch, rewards)
        size = [len(self)]
        flags = {name: torch.as_tensor(getattr(turn, name)) for name in ("reward", "done", "terminated")}
        following = {
            "observation": torch.as_tensor(turn.next_observation),
            **{name: flag.unsqueeze(-1) for name, flag in flags.items()},
        }
        entries = {
            "observation": torch.as_tensor(turn.observation),
            "action": torch.as_tensor(turn.action),
            "next": TensorDict(following, size),
        }
        return TensorDict(entries, size).to(self.device)

    def outputs(self, observation: Tensor, *, part: int = 0) -> Tensor:
        """The outputs of the current networks: [L, k, *shape] to [L, k, ...]; part 0 acts."""
        given: Tensor = stacked_outputs([agent.parts[part] for agent in self.each], observation)
        return given

    def first(self, lanes: int) -> Callable[[Tensor], Tensor]:
        """`outputs` of the first agents alone."""
        return partial(stacked_outputs, [agent.parts[0] for agent in self.each[:lanes]])

    def finite(self) -> Tensor:
        """Whether the weights, targets and optimiser state of each agent are finite, bool [L]."""
        return torch.tensor([is_finite(agent.loss, agent.optimizer) for agent in self.each])

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the current weights of one agent, as the state dict of its acting network."""
        acting = self.each[lane].parts[0].state_dict()
        return {name: value.detach().clone() for name, value in acting.items()}


def make_optimizer(
    parameters: Iterable[nn.Parameter], name: Optimizer, *, learning_rate: float, eps: float
) -> torch.optim.Optimizer:
    """The optimiser of torch.optim.

    Args:
        parameters: the parameters to optimise.
        name: see `Optimizer`.
        learning_rate: its step size.
        eps: added to its denominator; "sgd" has none.

    Raises:
        ValueError: if the name is unknown.
    """
    if name not in _OPTIMIZERS:
        raise ValueError(f"optimizer is {name!r}; allowed: {', '.join(_OPTIMIZERS)}")
    how: dict[str, Any] = {"lr": learning_rate} if name == "sgd" else {"lr": learning_rate, "eps": eps}
    if name == "keras_rmsprop":
        how["alpha"] = RMSPROP_ALPHAS[name]
    return _OPTIMIZERS[name](parameters, **how)
