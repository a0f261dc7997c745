"""The hyperparameters of learning agents, with their units and sources."""

from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from cprl.custom import Custom

Optimizer = Literal["adam", "adamw", "rmsprop", "sgd"]

DEFAULT_HIDDEN_CELLS: Final = (32, 32)
"""Units of each hidden layer in the published study."""


@dataclass(frozen=True, kw_only=True)
class Exploring:
    """Epsilon-greedy exploration: the probability of a random action is held, then decays linearly."""

    epsilon_start: float = 1.0
    """Probability of a random action at the start, 0..1."""
    epsilon_end: float = 0.1
    """Probability of a random action after the decay, 0..1."""
    epsilon_hold_steps: int = 800
    """Steps at `epsilon_start` before the decay."""
    epsilon_decay_steps: int = 500_000
    """Steps of the linear decay after the hold."""
    epsilon_evaluation: float = 0.05
    """Probability of a random action in evaluation, 0..1."""

    def epsilon(self, step: int) -> float:
        """The probability of a random action at a step, counted from 0."""
        done = min(1.0, max(0.0, (step - self.epsilon_hold_steps) / self.epsilon_decay_steps))
        return self.epsilon_start + done * (self.epsilon_end - self.epsilon_start)


@dataclass(frozen=True, kw_only=True)
class DQNSettings(Exploring):
    """Hyperparameters of one independent DQN agent; the defaults are the published ones.

    Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), appendix A,
    and, for fields marked [run], the program of the study.

    Raises:
        ValueError: if a value is out of range; names the field, its value and the allowed values.
    """

    buffer_size: int = 100_000
    """Capacity of the replay buffer, in transitions."""
    batch_size: int = 8
    """Transitions in a minibatch."""
    learning_starts: int = 16
    """Transitions stored before the first update; after that each environment step is followed by
    `updates_per_step` updates."""
    gamma: float = 0.995
    """Discount factor per step."""
    learning_rate: float = 1e-5
    """The optimiser's step size."""
    adam_eps: float = 1e-8
    """Added to the denominator of Adam, AdamW and RMSprop; [run] 1e-7."""
    hidden_cells: tuple[int, ...] = DEFAULT_HIDDEN_CELLS
    """Units of each hidden layer, with ReLU; used if the algorithm has no `network`."""
    updates_per_step: int = 1
    """Updates per environment step, each with a new minibatch."""
    n_steps: int = 1
    """Rewards that an n-step target sums before it bootstraps; fewer if the episode ends sooner. As TorchRL's
    `MultiStepTransform`; the study used 1."""
    optimizer: Optimizer = "adam"
    """The optimiser of `torch.optim`; its other options are torch's defaults."""
    tau: float | None = None
    """Soft target updates: the fraction by which targets move towards the network after each update; None for
    a copy every `target_every_episodes` episodes."""
    replay_transforms: tuple[Custom, ...] = ()
    """TorchRL transforms of the replay buffer, in order: sampled batches pass through them, and stored
    transitions through their inverse. Random transforms use torch's global generator."""
    target_every_episodes: int = 3
    """Episodes between copies of the network to its target if `tau` is None; experiment 5 used 3 or 10."""
    relu_on_outputs: bool = False
    """[run] Whether the Q values pass through ReLU too."""
    glorot_uniform: bool = False
    """[run] Whether weights are initialised Glorot-uniform and biases to zero; else torch's default."""
    own_target_weights: bool = False
    """[run] Whether the target network has its own initial weights; else it starts as a copy."""
    mean_over_all_outputs: bool = False
    """[run] Whether the squared error is averaged over all outputs, where all but the chosen action
    contribute zero; else over the batch alone."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden_cells", tuple(self.hidden_cells))
        object.__setattr__(self, "replay_transforms", tuple(self.replay_transforms))
        _check_exploring(self)
        _check_optimizer(self)
        _check_at_least(
            self,
            1,
            *("buffer_size", "batch_size", "learning_starts", "updates_per_step", "n_steps"),
            "target_every_episodes",
        )
        _check_within("gamma", self.gamma)
        if self.tau is not None and not 0 < self.tau <= 1:
            raise ValueError(f"tau is {self.tau}; allowed: above 0 and up to 1, or None for hard updates")
        longest = max(1, min(self.learning_starts, self.buffer_size // 2))
        if self.n_steps > longest:
            raise ValueError(
                f"n_steps is {self.n_steps}; allowed: up to learning_starts, {self.learning_starts}, and "
                f"half of buffer_size, {self.buffer_size}"
            )
        for transform in self.replay_transforms:
            if not isinstance(transform, Custom):
                raise ValueError(
                    f"replay_transforms has a {type(transform).__name__}; allowed: "
                    'Custom("torchrl.envs:RewardScaling", arguments={...}); for an instance call '
                    "append_transform on the learner's buffer"
                )


@dataclass(frozen=True, kw_only=True)
class RolloutSettings:
    """Hyperparameters of one independent on-policy agent. The study has none; the defaults are ours.

    Raises:
        ValueError: if a value is out of range; names the field, its value and the allowed values.
    """

    rollout_steps: int = 250
    """Steps T collected between updates."""
    epochs: int = 4
    """Passes over each rollout."""
    minibatch_size: int = 50
    """Steps in a minibatch; must divide `rollout_steps`."""
    gamma: float = 0.995
    """Discount factor per step."""
    optimizer: Optimizer = "adam"
    """The optimiser of `torch.optim`; its other options are torch's defaults."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation, 0..1 (Schulman et al. 2016)."""
    normalize_advantage: bool = True
    """Whether each agent's advantages of a rollout are normalised to mean 0 and standard deviation 1."""
    learning_rate: float = 3e-4
    """The optimiser's step size."""
    adam_eps: float = 1e-5
    """Added to the denominator of Adam, AdamW and RMSprop."""
    max_grad_norm: float | None = 0.5
    """The norm to which an agent's gradient is clipped; None for no clipping."""
    hidden_cells: tuple[int, ...] = DEFAULT_HIDDEN_CELLS
    """Units of each hidden layer, with ReLU, of the actor and of the critic; used if the algorithm has no
    `network`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden_cells", tuple(self.hidden_cells))
        _check_optimizer(self)
        _check_at_least(self, 1, "rollout_steps", "epochs", "minibatch_size")
        for name in ("gamma", "gae_lambda"):
            _check_within(name, getattr(self, name))
        if self.max_grad_norm is not None and self.max_grad_norm <= 0:
            raise ValueError(
                f"max_grad_norm is {self.max_grad_norm}; allowed: above 0, or None for no clipping"
            )
        if self.rollout_steps % self.minibatch_size:
            raise ValueError(
                f"minibatch_size is {self.minibatch_size}; it must divide rollout_steps, {self.rollout_steps}"
            )


@dataclass(frozen=True, kw_only=True)
class TabularSettings(Exploring):
    """Hyperparameters of one tabular agent. The study gives none; the defaults are ours.

    Raises:
        ValueError: if a value is out of range; names the field, its value and the allowed values.
    """

    gamma: float = 0.995
    """Discount factor per step, as `DQNSettings.gamma`."""
    learning_rate: float | Literal["1/visits"] = 0.1
    """alpha: a number in 0..1, or one divided by the number of visits of that action in that state."""
    visits_power: float = 1.0
    """With "1/visits", alpha is 1 / visits ** visits_power. Powers below 1 forget early targets sooner, which
    came from values that were still wrong: 0.5..1 needs far fewer steps (Even-Dar and Mansour 2003)."""
    epsilon_decay_steps: int = 50_000
    """Steps of the linear decay after the hold."""
    max_states: int = 100_000
    """The largest number of states in an agent's table; one more raises a MemoryError. A state takes the
    bytes of its observation, 16 per action and about 150 more."""

    def __post_init__(self) -> None:
        _check_exploring(self)
        if self.learning_rate != "1/visits":
            _check_within("learning_rate", self.learning_rate, " or '1/visits'")
        _check_within("gamma", self.gamma)
        _check_at_least(self, 1, "max_states")
        _check_within("visits_power", self.visits_power)

    def rates(self, visits: NDArray[np.int64]) -> NDArray[np.float64]:
        """alpha of values with these numbers of visits, the current one included."""
        if self.learning_rate == "1/visits":
            return 1.0 / visits.astype(np.float64) ** self.visits_power
        return np.full(visits.shape, self.learning_rate)


def _check_within(name: str, value: Any, other: str = "") -> None:
    if isinstance(value, str) or not 0 <= value <= 1:
        raise ValueError(f"{name} is {value!r}; allowed: a number in 0..1{other}")


def _check_at_least(settings: Any, lowest: int, *names: str) -> None:
    for name in names:
        if getattr(settings, name) < lowest:
            raise ValueError(f"{name} is {getattr(settings, name)}; allowed: an integer >= {lowest}")


def _check_exploring(settings: Exploring) -> None:
    for name in ("epsilon_start", "epsilon_end", "epsilon_evaluation"):
        _check_within(name, getattr(settings, name))
    _check_at_least(settings, 0, "epsilon_hold_steps")
    _check_at_least(settings, 1, "epsilon_decay_steps")


def _check_optimizer(settings: DQNSettings | RolloutSettings) -> None:
    if settings.optimizer not in get_args(Optimizer):
        raise ValueError(f"optimizer is {settings.optimizer!r}; allowed: {', '.join(get_args(Optimizer))}")
    if not settings.learning_rate > 0:
        raise ValueError(f"learning_rate is {settings.learning_rate}; allowed: above 0")
    if settings.adam_eps < 0:
        raise ValueError(f"adam_eps is {settings.adam_eps}; allowed: at least 0")
    if any(cells < 1 for cells in settings.hidden_cells):
        raise ValueError(f"hidden_cells is {settings.hidden_cells}; allowed: at least 1 in each layer")
