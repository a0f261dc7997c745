"""The numbers of learning agents, with their units and sources."""

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Exploring:
    """The chance of a random action: it stays for a while, and then falls in a straight line."""

    epsilon_start: float = 1.0
    """Chance of a random action at first."""
    epsilon_end: float = 0.1
    """Chance of a random action after the decay."""
    epsilon_hold_steps: int = 800
    """Steps at `epsilon_start` before the decay."""
    epsilon_decay_steps: int = 500_000
    """Steps of the linear decay that follow."""
    epsilon_evaluation: float = 0.05
    """Chance of a random action in evaluation."""

    def epsilon(self, step: int) -> float:
        """The chance of a random action at a step, counted from 0."""
        done = min(1.0, max(0.0, (step - self.epsilon_hold_steps) / self.epsilon_decay_steps))
        return self.epsilon_start + done * (self.epsilon_end - self.epsilon_start)


@dataclass(frozen=True, kw_only=True)
class DQNSettings(Exploring):
    """Hyper-parameters of one independent DQN agent; the defaults are the published ones.

    Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), appendix A,
    and, for the last five, the program it was run with.
    """

    buffer_size: int = 100_000
    """Transitions kept by the replay buffer."""
    batch_size: int = 8
    """Transitions sampled for an update."""
    learning_starts: int = 16
    """Transitions stored before the first update; from then on one update per environment step."""
    gamma: float = 0.995
    """Discount per step."""
    learning_rate: float = 1e-5
    """Adam's step size."""
    adam_eps: float = 1e-8
    """Added to Adam's denominator; 1e-7 as run."""
    hidden_cells: tuple[int, ...] = (32, 32)
    """Units of each hidden layer, with ReLU."""
    priority_alpha: float = 0.0
    """How much transitions of a large error are preferred in sampling (Schaul et al., "Prioritized Experience
    Replay", 2016); 0 for not at all. Above 0 wants TorchRL's compiled extension and a `DQNLearner`."""
    target_every_episodes: int = 3
    """Episodes between copies of the network to its target; experiment 5 was run with 3 or 10."""
    relu_on_outputs: bool = False
    """[run] ReLU on the Q values too."""
    glorot_uniform: bool = False
    """[run] Glorot-uniform weights and zero biases, else torch's default initialisation."""
    own_target_weights: bool = False
    """[run] The target network starts from weights of its own, else as a copy."""
    mean_over_all_outputs: bool = False
    """[run] The squared error is averaged over all outputs, of which all but the chosen one count zero;
    else over the batch alone."""


@dataclass(frozen=True, kw_only=True)
class RolloutSettings:
    """Hyper-parameters of one independent agent that learns from rollouts; ours, the study has none.

    Raises:
        ValueError: names the field, what came and what fits.
    """

    rollout_steps: int = 250
    """Steps T that are collected before the agent learns from them, each `epochs` times."""
    epochs: int = 4
    """Times that each step of a rollout is learned from."""
    minibatch_size: int = 50
    """Steps of an update; divides `rollout_steps`."""
    gamma: float = 0.995
    """Discount per step."""
    gae_lambda: float = 0.95
    """Of the generalised advantage estimate (Schulman et al. 2016)."""
    normalize_advantage: bool = True
    """Whether the advantages of a rollout get mean 0 and deviation 1, each agent's by themselves."""
    learning_rate: float = 3e-4
    """Adam's step size."""
    adam_eps: float = 1e-5
    """Added to Adam's denominator."""
    max_grad_norm: float | None = 0.5
    """To which an agent's gradient is shortened; None for never."""
    hidden_cells: tuple[int, ...] = (32, 32)
    """Units of each hidden layer, with ReLU, of the actor and of the critic."""

    def __post_init__(self) -> None:
        for name in ("rollout_steps", "epochs", "minibatch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; at least 1 is wanted")
        if self.rollout_steps % self.minibatch_size:
            raise ValueError(
                f"minibatch_size is {self.minibatch_size}; it must divide rollout_steps, {self.rollout_steps}"
            )


@dataclass(frozen=True, kw_only=True)
class TabularSettings(Exploring):
    """Hyper-parameters of one tabular agent; the study names none for it, so defaults are ours.

    Raises:
        ValueError: names the field, what came and what fits.
    """

    gamma: float = 0.995
    """Discount per step, as `DQNSettings.gamma`."""
    learning_rate: float | Literal["1/visits"] = 0.1
    """alpha: a number in 0..1, or one divided by the visits of that action in that state."""
    visits_power: float = 1.0
    """With "1/visits" alpha is 1 / visits ** this. Below 1 early targets, learned from values that were wrong
    themselves, are forgotten sooner: 0.5..1 takes far fewer steps (Even-Dar and Mansour 2003)."""
    epsilon_decay_steps: int = 50_000
    """Steps of the linear decay that follow."""
    max_states: int = 100_000
    """States that an agent may meet; with one more it is refused to go on. Each takes its observation's bytes
    and 16 per action, and some 150."""

    def __post_init__(self) -> None:
        if self.learning_rate != "1/visits":
            _check_within("learning_rate", self.learning_rate, " or '1/visits'")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("gamma", "epsilon_start", "epsilon_end", "epsilon_evaluation"):
                _check_within(field.name, value)
            elif field.name in ("epsilon_decay_steps", "max_states") and value < 1:
                raise ValueError(f"{field.name} is {value}; at least 1 is wanted")
        _check_within("visits_power", self.visits_power)

    def rates(self, visits: NDArray[np.int64]) -> NDArray[np.float64]:
        """alpha of values that have been learned so often, this time included."""
        if self.learning_rate == "1/visits":
            return 1.0 / visits.astype(np.float64) ** self.visits_power
        return np.full(visits.shape, self.learning_rate)


def _check_within(name: str, value: Any, other: str = "") -> None:
    if isinstance(value, str) or not 0 <= value <= 1:
        raise ValueError(f"{name} is {value!r}; a number in 0..1{other} is wanted")
