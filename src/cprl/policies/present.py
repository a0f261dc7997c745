"""PresentPolicy: the agents of a training's first replica as they are now, in one world beside it."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.decisions import Decider
from cprl.system.compat import unchecked_tensordict


class FirstReplica(TensorDictModuleBase):
    """The agents of the first of an actor's R replicas alone.

    Reads and writes the entries of the actor, [1, S, ...] instead of [R, S, ...]: all replicas see the same,
    and what the others choose is not used.
    """

    def __init__(self, actor: nn.Module, replicas: int) -> None:
        super().__init__()
        self.actor, self.replicas = actor, replicas
        self.state_cells: int = getattr(actor, "state_cells", 0)
        self.in_keys = tuple(getattr(actor, "in_keys", ("observation",)))
        self.out_keys = tuple(getattr(actor, "out_keys", ("action",)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = {}
        for name in self.in_keys:
            value = tensordict.get(name)
            seen[name] = value.expand(self.replicas, *value.shape[1:]).contiguous()
        chosen = self.actor(unchecked_tensordict(seen, torch.Size([self.replicas])))
        for name in self.out_keys:
            tensordict.set(name, chosen.get(name)[:1])
        return tensordict


class PresentPolicy:
    """All agents of the first replica as they are now, exploring as they do now.

    It has random numbers of its own, and leaves torch's generator as it was.

    Args:
        learned: for agents that learn two actors: one with the current weights and random numbers of its own,
            for one world of each replica, with the exploration of evaluation at first; and that of the
            training, whose exploration it takes over.
        others: the actors of the other agents, for one world of the first replica.
        decisions: what agents decide, likewise two: without exploration and with numbers of its own, for one
            world of the first replica; and that of the training. None where they decide nothing.
        replicas: the number of replicas R.
        device: the device whose generator is left as it was, besides the CPU.
    """

    def __init__(
        self,
        learned: Mapping[AgentIndices, tuple[Any, Any]],
        others: Mapping[AgentIndices, nn.Module],
        *,
        decisions: tuple[Decider, Decider] | None = None,
        replicas: int,
        device: torch.device | None = None,
    ) -> None:
        self._decisions = decisions
        present_decisions = None if decisions is None else decisions[0]
        first = {agents: FirstReplica(present, replicas) for agents, (present, _) in learned.items()}
        self._policy = AgentPolicies({**first, **others}, decisions=present_decisions)
        self._pairs = [
            (present, training)
            for present, training in learned.values()
            if hasattr(present, "epsilon") and not getattr(present, "stochastic", False)
        ]
        self._evaluation = [present.epsilon for present, _ in self._pairs]
        self._devices = [device] if device is not None and device.type == "cuda" else []
        self.is_trained = False
        """Whether the training is over; agents then explore as in evaluation."""

    @property
    def epsilons(self) -> list[float]:
        """The probabilities with which agents now act at random, ascending; empty for agents without any."""
        return sorted({float(present.epsilon) for present, _ in self._pairs})

    def explore_as_now(self) -> None:
        """Sets each agent's exploration to what it is now."""
        for (actor, training), evaluation in zip(self._pairs, self._evaluation, strict=True):
            actor.epsilon = evaluation if self.is_trained else training.epsilon
        if self._decisions is not None:
            present, trained = self._decisions
            present.epsilon[:] = 0.0 if self.is_trained else trained.epsilon[:1]

    def __call__(self, carried: TensorDictBase) -> TensorDictBase:
        """Writes ("agents", "action"), int64 [1, N], for one world, batch size [1]; where agents decide also
        ("agents", "decision"). To be called within `apart`."""
        return self._policy.forward(carried)  # calling a module takes as long as a small network

    @contextmanager
    def apart(self) -> Iterator[None]:
        """A context to play steps in: agents explore as they do when it begins, and nothing changes torch's
        generators for the rest of the process."""
        self.explore_as_now()
        forked = torch.random.fork_rng(devices=self._devices)
        with forked, torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            yield
