"""CurrentPolicy: the agents of a training in their current state, to play a world beside the training."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl.policies.decisions import Decider
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.rng import Purpose
from cprl.system.compat.tensordicts import unchecked_tensordict
from cprl.training.agents import Population


class FirstReplica(TensorDictModuleBase):
    """An actor of R replicas, reduced to the first replica.

    It reads and writes the entries of the actor with shape [1, S, ...] instead of [R, S, ...]. All replicas
    of the actor get the same input, and the output of all but the first is dropped.
    """

    def __init__(self, actor: nn.Module, replicas: int) -> None:
        super().__init__()
        self.actor = actor
        self.replicas = replicas
        self.state_cells: int = getattr(actor, "state_cells", 0)
        self.in_keys = tuple(getattr(actor, "in_keys", ("observation",)))
        self.out_keys = tuple(getattr(actor, "out_keys", ("action",)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Run the actor for all replicas, and write the output of the first one."""
        seen = {}
        for name in self.in_keys:
            value = tensordict.get(name)
            seen[name] = value.expand(self.replicas, *value.shape[1:]).contiguous()
        chosen = self.actor(unchecked_tensordict(seen, torch.Size([self.replicas])))
        for name in self.out_keys:
            tensordict.set(name, chosen.get(name)[:1])
        return tensordict


class CurrentPolicy:
    """A policy of all agents of the first replica, with their current weights and exploration.

    It has its own random numbers, and leaves torch's generators unchanged.

    Args:
        population: the agents of the training. Those that learn share their current weights, and their
            exploration is copied before each play.
    """

    def __init__(self, population: Population) -> None:
        learners = population.learners
        with torch.random.fork_rng(devices=[]):
            actors = {agents: learner.evaluation_actor(1) for agents, learner in learners.items()}
            self._decisions: tuple[Decider, Decider] | None = None
            if population.decisions is not None:
                learned = population.decisions
                alone = learned.without_exploration(Purpose.EXHIBITED_DECISIONS, replicas=1, worlds=1)
                self._decisions = alone, learned
            playing = population.other_actors(Purpose.EXHIBITION, worlds=1, replicas=1)
            for agents, actor in actors.items():
                playing[agents] = FirstReplica(actor, population.replicas)
            self._policy = JointPolicy(
                playing,
                decisions=None if self._decisions is None else self._decisions[0],
                governor=population.governor_actor(1),
            )
        self._pairs = [
            (actor, learners[agents].actor)
            for agents, actor in actors.items()
            if hasattr(actor, "epsilon") and not getattr(actor, "stochastic", False)
        ]
        self._evaluation = [actor.epsilon for actor, _ in self._pairs]
        device = population.device
        self._devices = [device] if device.type == "cuda" else []
        self.is_trained = False
        """True once the training is over; agents then explore as in the evaluation."""

    @property
    def epsilons(self) -> list[float]:
        """Return the current epsilons of the agents, ascending; [] if no agent has one."""
        return sorted({float(current.epsilon) for current, _ in self._pairs})

    def explore_as_now(self) -> None:
        """Copy the exploration of the training, or set that of the evaluation once the training is over."""
        for (actor, training), evaluation in zip(self._pairs, self._evaluation, strict=True):
            actor.epsilon = evaluation if self.is_trained else training.epsilon
        if self._decisions is not None:
            current, trained = self._decisions
            current.epsilon[:] = 0.0 if self.is_trained else trained.epsilon[:1]

    def __call__(self, carried: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action"), int64 [1, N], for one world, batch size [1]; where agents decide also
        ("agents", "decision"). Call it within `apart` only."""
        return self._policy.forward(carried)  # calling a module takes as long as a small network

    @contextmanager
    def apart(self) -> Iterator[None]:
        """Return a context in which steps can be played without changing torch's generators.

        Agents explore in it as the training does when it begins.
        """
        self.explore_as_now()
        forked = torch.random.fork_rng(devices=self._devices)
        with forked, torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            yield
