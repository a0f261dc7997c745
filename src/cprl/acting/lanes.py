"""Lanes: the agents at some seats of every replica, acting at once. A lane is one agent of one replica."""

from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl.acting.compiling import Compiled
from cprl.acting.draws import LaneDraws
from cprl.acting.networks import AgentNetworks, AtomNetwork, QNetwork
from cprl.commons.game import Game


class LaneQNetwork(nn.Module):
    """L networks like `QNetwork` whose parameters carry a lane axis, [L, in, out] and [L, 1, out].

    A lane is one agent of one replica; nothing crosses lanes: output l follows from input l and the
    parameters l alone.

    Args:
        networks: the networks of the lanes, of one shape; their weights are copied.

    Raises:
        ValueError: where the networks differ in shape.
    """

    def __init__(self, networks: Sequence[QNetwork]) -> None:
        super().__init__()
        first = networks[0]
        forms = {(network.highest, network.relu_on_outputs, *_shapes(network)) for network in networks}
        if len(forms) != 1:
            raise ValueError(f"the networks of the lanes have {len(forms)} different forms; one is wanted")
        self.highest, self.relu_on_outputs = first.highest, first.relu_on_outputs
        self.observation_dims, self.outputs = first.observation_dims, first.outputs
        self._names = [name for name, layer in first.named_modules() if isinstance(layer, nn.Linear)]
        layers = list(zip(*(network.linears for network in networks), strict=True))
        self.weights = nn.ParameterList(
            [torch.stack([layer.weight.detach().T for layer in lanes]).contiguous() for lanes in layers]
        )
        self.biases = nn.ParameterList(
            [torch.stack([layer.bias.detach()[None] for layer in lanes]) for lanes in layers]
        )

    @property
    def lanes(self) -> int:
        """The number of lanes L."""
        return len(self.weights[0])

    def lane_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the weights of one lane, as the state dict of its `QNetwork`."""
        state = {}
        for name, weight, bias in zip(self._names, self.weights, self.biases, strict=True):
            state[f"{name}.weight"] = weight[lane].detach().T.clone()
            state[f"{name}.bias"] = bias[lane, 0].detach().clone()
        return state

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [L, C, X, Y] or [L, b, C, X, Y] to [L, A] or [L, b, A], in the parameters' type."""
        flat = observation.flatten(-self.observation_dims)
        values = flat.reshape(self.lanes, -1, flat.shape[-1]).to(self.weights[0].dtype) / self.highest
        values = through_layers(values, self.weights, self.biases, relu_on_outputs=self.relu_on_outputs)
        return values.reshape(*flat.shape[:-1], values.shape[-1])


def through_layers(
    values: Tensor, weights: Iterable[Tensor], biases: Iterable[Tensor], *, relu_on_outputs: bool
) -> Tensor:
    """[L, b, in] through layers of weights [L, in, out] and biases [L, 1, out] with ReLU between."""
    first = True
    for weight, bias in zip(weights, biases, strict=True):
        values = torch.baddbmm(bias, values if first else values.relu(), weight)
        first = False
    return values.relu() if relu_on_outputs else values


def stack_lanes(networks: Sequence[nn.Module]) -> nn.Module:
    """The networks of all lanes as one whose parameters carry a lane axis; copies.

    Raises:
        ValueError: for other networks than `QNetwork`, alone, in an `AtomNetwork` or in `AgentNetworks`, and
            those that stack themselves, as a team's do.
    """
    first: Any = networks[0]
    if hasattr(first, "stacked"):
        itself: nn.Module = first.stacked(networks)
        return itself
    if all(isinstance(network, AtomNetwork) for network in networks):
        stack = deepcopy(networks[0])
        stack.network = stack_lanes([network.network for network in networks])  # type: ignore[misc]
        return stack
    if all(isinstance(network, AgentNetworks) for network in networks):
        parts = zip(*(network.values() for network in networks), strict=True)  # type: ignore[operator]
        return AgentNetworks(dict(zip(networks[0].keys(), map(stack_lanes, parts), strict=True)))  # type: ignore[operator]
    if not all(isinstance(network, QNetwork) for network in networks):
        raise ValueError(f"a {type(networks[0]).__name__} is no QNetwork")
    return LaneQNetwork(networks)  # type: ignore[arg-type]


def lane_state(stack: nn.Module, lane: int) -> dict[str, Tensor]:
    """Copies of the weights of one lane of what `stack_lanes` gave for acting networks, as the state dict of
    such a network."""
    if isinstance(stack, AtomNetwork):
        own = lane_state(stack.network, lane)
        return {"support": stack.support.clone(), **{f"network.{name}": value for name, value in own.items()}}
    state: dict[str, Tensor] = stack.lane_state(lane)  # type: ignore[operator]
    return state


def _shapes(network: QNetwork) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(layer.weight.shape) for layer in network.linears)


class LaneActor(TensorDictModuleBase):
    """Chooses for the agents at some seats of every replica: greedily, or with chance `epsilon` at random.

    It explores under `ExplorationType.RANDOM` alone, by random numbers of each lane's own.

    Args:
        values: the value of each action, from observations [L, k, C, X, Y] to [L, k, A], lane = replica x
            seats + seat; None for agents that choose at random always.
        samples: whether what `values` gives are the logits of a policy, from which agents that explore draw
            their actions; `epsilon` is then none.
        actions: how many actions A there are.
        seeds: of each lane's exploration.
        seats: how many seats S of a replica it takes.
        worlds: how many worlds k of each replica are played at once, side by side in the batch.
        compile: whether exploring is compiled by torch; where that fails a warning says so once.
    """

    in_keys = ("observation",)
    out_keys = ("action",)

    def __init__(
        self,
        values: Callable[[Tensor], Tensor] | None,
        actions: int,
        *,
        seeds: Sequence[Sequence[int]],
        seats: int,
        worlds: int = 1,
        samples: bool = False,
        compile: bool = False,
    ) -> None:
        super().__init__()
        self.values, self.actions, self.samples = values, actions, samples
        self.seats, self.worlds, self.replicas = seats, worlds, len(seeds) // seats
        # As a compiled function takes it: as a tensor, since other numbers are taken for constant.
        self._chance = 0.0 if samples else 1.0
        self._epsilon = torch.tensor(self._chance, dtype=torch.float64)
        self.draws = LaneDraws(seeds, 2 * worlds)
        self._explore = Compiled(LaneActor._explored, what="agents act", enabled=compile)

    @property
    def epsilon(self) -> float:
        """The chance of a random action."""
        return self._chance

    @epsilon.setter
    def epsilon(self, chance: float) -> None:
        self.explore_with(chance)

    def explore_with(self, chance: float) -> None:
        """Sets `epsilon`, of agents that have one; quicker than through a module's attributes."""
        if chance != self._chance and not self.samples:
            self._epsilon.fill_(chance)
            object.__setattr__(self, "_chance", chance)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 [replicas x k, S], for "observation" [replicas x k, S, C, X, Y]."""
        return tensordict.set("action", self.choose(tensordict.get("observation")))

    def choose(self, observation: Tensor) -> Tensor:
        """Actions, int64 [replicas x k, S], for what is seen, [replicas x k, S, C, X, Y]."""
        if self.values is None:
            return self._by_replica(self._random(self.draws.next().to(observation.device)))
        if exploration_type() not in (ExplorationType.RANDOM, None):
            return self._by_replica(self._best(observation))
        device = observation.device
        arguments = observation, self.draws.next().to(device), self._epsilon.to(device)
        chosen: Tensor = self._explore((observation.shape, observation.dtype), self, *arguments)
        return chosen

    def _explored(self, observation: Tensor, numbers: Tensor, epsilon: Tensor) -> Tensor:
        """Sampled actions; or the greedy ones, with chance epsilon random ones; int64 [replicas x k, S]."""
        if self.samples:
            return self._by_replica(self._sampled(observation, numbers))
        explores = numbers.view(-1, self.worlds, 2)[..., 0] < epsilon
        return self._by_replica(torch.where(explores, self._random(numbers), self._best(observation)))

    def _random(self, numbers: Tensor) -> Tensor:
        """Random actions of each lane, int64 [L, k]."""
        return (numbers.view(-1, self.worlds, 2)[..., 1] * self.actions).long()

    def _by_replica(self, actions: Tensor) -> Tensor:
        """From [L, k] to [replicas x k, S]."""
        chosen = actions.view(self.replicas, self.seats, self.worlds).transpose(1, 2)
        return chosen.reshape(-1, self.seats)

    def get_extra_state(self) -> dict[str, Any]:
        """Where its random numbers stand; part of `state_dict`."""
        return self.draws.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See `get_extra_state`."""
        self.draws.load_state_dict(state)

    def _best(self, observation: Tensor) -> Tensor:
        """The greedy actions of each lane, int64 [L, k]."""
        return self._values(observation).argmax(-1)

    def _sampled(self, observation: Tensor, numbers: Tensor) -> Tensor:
        """Actions of each lane drawn from its policy, int64 [L, k]: the first beyond whose share of the
        policy's whole a number in 0..1 does not lie."""
        shares = self._values(observation).double().softmax(-1).cumsum(-1)
        drawn = numbers.view(-1, self.worlds, 2)[..., 1:]
        return (drawn >= shares[..., :-1]).sum(-1)

    def _values(self, observation: Tensor) -> Tensor:
        """What each lane's network gives, [L, k, A]."""
        assert self.values is not None
        shape = observation.shape[-3:]
        by_lane = observation.view(self.replicas, self.worlds, self.seats, *shape).transpose(1, 2)
        with torch.no_grad():
            return self.values(by_lane.reshape(-1, self.worlds, *shape))


def random_seats(
    game: Game, seats: tuple[int, ...], *, replicas: int, seed: int, worlds: int = 1
) -> dict[int | tuple[int, ...], nn.Module]:
    """Agents at some seats of every replica to whom every action is equally likely, by where they sit."""
    seeds = [(seed, replica, agent) for replica in range(replicas) for agent in seats]
    return {seats: random_lanes(len(game.actions), seeds=seeds, seats=len(seats), worlds=worlds)}


def random_lanes(actions: int, *, seeds: Sequence[Sequence[int]], seats: int, worlds: int = 1) -> LaneActor:
    """Agents to whom every action is equally likely; see `LaneActor`."""
    return LaneActor(None, actions, seeds=seeds, seats=seats, worlds=worlds)
