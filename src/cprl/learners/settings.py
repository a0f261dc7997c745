"""The hyperparameters of learning agents, with their units and sources."""

from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np

from cprl.networks.mlp import Layers
from cprl.values import MOST_INT64, Natural, Positive, Range, Share, Steps, Value
from cprl.values.array_types import Float64, Int64

Optimizer = Literal["adam", "adamw", "rmsprop", "keras_rmsprop", "sgd"]
"""Optimisers of `torch.optim` with torch's defaults; "keras_rmsprop" is `torch.optim.RMSprop` with the decay
rate of Keras 2.2.4, 0.9 instead of 0.99. Both add epsilon outside of the square root, have no momentum and do
not centre (`keras/optimizers.py` of that version)."""

DEFAULT_HIDDEN_CELLS: Final = (32, 32)
"""Units of each hidden layer in the published study."""

LearningRate = Annotated[float, Range(1e-12, 100)]
# 0, and what float32 rounds to 0, would divide 0 by 0 wherever a gradient is 0.
OptimizerEps = Annotated[float, Range(1e-30, 1)]
NormLimit = Annotated[float, Range(1e-6, 1e12)] | None
LongSteps = Annotated[int, Range(0, MOST_INT64)]
ReturnSteps = Annotated[int, Range(1, 1000)]


def along_line(start: float, end: float, share: float) -> float:
    """Return the number at a share of the way from `start` to `end`, and `end` beyond it."""
    return start + min(1.0, share) * (end - start)


@dataclass(frozen=True, kw_only=True)
class EpsilonGreedy(Value, stored=False):
    """Epsilon-greedy exploration: the probability of a random action is held, then decays linearly."""

    epsilon_start: Share = 1.0
    """Probability of a random action at the start."""
    epsilon_end: Share = 0.1
    """Probability of a random action after the decay; with 0 exploration ends."""
    epsilon_hold_steps: LongSteps = 800
    """Steps at `epsilon_start` before the decay; a turn of W worlds is W steps."""
    epsilon_decay_steps: Steps = 500_000
    """Steps of the linear decay after the hold; a turn of W worlds is W steps."""
    epsilon_evaluation: Share = 0.05
    """Probability of a random action in evaluation."""

    def epsilon(self, step: int) -> float:
        """Return the probability of a random action at a step, counted from 0."""
        steps_of_decay = max(0, step - self.epsilon_hold_steps)
        return along_line(self.epsilon_start, self.epsilon_end, steps_of_decay / self.epsilon_decay_steps)


@dataclass(frozen=True, kw_only=True)
class LearningRateDecay(Value, stored=False):
    """A learning rate that is constant, or changes linearly from one value to another."""

    learning_rate: LearningRate
    """The optimiser's step size."""
    learning_rate_end: Annotated[float, Range(0, 100)] | None = None
    """The optimiser's step size after the linear change; None for a constant one."""
    learning_rate_decay_steps: Steps = 1_000_000
    """Environment steps of the linear change, from the first step on; a turn of W worlds is W steps."""

    def learning_rate_at(self, step: int) -> float:
        """Return the optimiser's step size at a step, counted from 0."""
        if self.learning_rate_end is None:
            return self.learning_rate
        return along_line(self.learning_rate, self.learning_rate_end, step / self.learning_rate_decay_steps)


@dataclass(frozen=True, kw_only=True)
class DQNSettings(EpsilonGreedy, LearningRateDecay):
    """Hyperparameters of one independent DQN agent; the defaults are the published ones.

    Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), appendix A,
    and, for fields marked [run], the program of the study.
    """

    buffer_size: Annotated[int, Range(1, 2**40 - 1)] = 100_000
    """Capacity of the replay buffer, in transitions of all worlds of a replica. In W worlds the largest
    multiple of W up to this number is used."""
    batch_size: Positive = 8
    """Transitions in a minibatch, or sequences of `sequence_steps` transitions."""
    learning_starts: Steps = 16
    """The step from which on steps count for updates; a turn of W worlds is W steps. `updates_per_step`
    updates follow every `steps_per_update` steps that count, this step included. So the first update comes at
    this step, or, if `steps_per_update` is larger than W, up to `steps_per_update` - 1 steps later: after
    step 19 for 16, in one world with `steps_per_update=4`."""
    gamma: Share = 0.995
    """Discount factor per step."""
    learning_rate: LearningRate = 1e-5
    """The optimiser's step size."""
    adam_eps: OptimizerEps = 1e-8
    """Added to the denominator of Adam, AdamW and both kinds of RMSprop; [run] 1e-7, Keras's."""
    hidden_cells: Layers = DEFAULT_HIDDEN_CELLS
    """Units of each hidden layer, with ReLU; used if the algorithm has no `network`."""
    updates_per_step: Positive = 1
    """Updates per step, or after `steps_per_update` of them, each with a new minibatch."""
    steps_per_update: Steps = 1
    """Steps from one update to the next. The study updates after every step, Mnih et al. (2015) after every
    fourth, with minibatches of 32. In W worlds the default is W updates per turn; `steps_per_update=W` is one
    update per turn, and samples as many transitions per step as the study if `batch_size` is W times as
    large."""
    n_steps: ReturnSteps = 1
    """Rewards that a target sums before it bootstraps, or fewer if the episode ends sooner, as in TorchRL's
    `MultiStepTransform`. The study used 1."""
    sequence_steps: ReturnSteps = 1
    """Consecutive turns T of each sampled sequence, through which gradients of a recurrent network run: 2 or
    more for such a network, 1 for any other. A minibatch then has `batch_size` sequences. Hausknecht and
    Stone (2015) took 10 turns, Kapturowski et al. (2019) 80."""
    optimizer: Optimizer = "adam"
    """See `Optimizer`; [run] "adam", and "keras_rmsprop" in some versions of experiment 5."""
    tau: Annotated[float, Range(1e-6, 1)] | None = None
    """The fraction by which targets move towards the network after each update (soft target updates); None
    for a copy every `target_every_updates` updates or `target_every_episodes` episodes."""
    target_every_updates: Annotated[int, Range(1, MOST_INT64)] | None = None
    """Updates between copies of the network to its target; unlike `target_every_episodes` it does not depend
    on the length of episodes. None for a copy every `target_every_episodes` episodes. A turn of W worlds has
    W x `updates_per_step` / `steps_per_update` updates. Mnih et al. (2015) took 10,000."""
    target_every_episodes: Steps = 3
    """Episodes, of all W worlds together, between copies of the network to its target, if `tau` and
    `target_every_updates` are None; experiment 5 used 3 or 10."""
    relu_on_outputs: bool = False
    """[run] True if the Q values pass through ReLU too; refused for SAC."""
    glorot_uniform: bool = False
    """[run] True if weights are initialised Glorot-uniform and biases to zero; else torch's default."""
    own_target_weights: bool = False
    """[run] True if the target network has its own initial weights; else it starts as a copy."""
    mean_over_all_outputs: bool = False
    """[run] True if the loss is averaged over all A outputs, of which all but the chosen action contribute
    zero: then every loss is divided by A, with any loss function. Else it is averaged over the batch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tau is not None and self.target_every_updates is not None:
            raise ValueError(
                f"DQNSettings.target_every_updates is {self.target_every_updates}; allowed with tau "
                f"{self.tau}, by which targets move after each update: None"
            )
        longest = max(1, min(self.learning_starts, self.buffer_size // 2))
        for name, turns in {"n_steps": self.n_steps, "sequence_steps": self.sequence_steps}.items():
            if turns > longest:
                raise ValueError(
                    f"DQNSettings.{name} is {turns}; allowed: up to learning_starts, "
                    f"{self.learning_starts}, and half of buffer_size, {self.buffer_size}"
                )
        if self.sequence_steps > 1 and self.n_steps > 1:
            raise ValueError(
                f"DQNSettings.sequence_steps is {self.sequence_steps}; allowed with n_steps {self.n_steps}: 1"
            )

    def updates_in(self, steps: int, *, worlds: int) -> int:
        """Return the number of updates that an agent takes in a number of steps of its replica.

        Args:
            steps: the steps of all worlds together.
            worlds: the number of worlds W of the replica.
        """
        return steps // self.steps_per_update * self.updates_per_step

    def refuse_worlds(self, worlds: int) -> None:
        """Raise a ValueError if agents with these settings cannot learn in this number of worlds."""
        fewest = worlds * 2 * max(1, self.n_steps, self.sequence_steps) if worlds > 1 else 1
        if self.buffer_size < fewest:
            raise ValueError(
                f"DQNSettings.buffer_size is {self.buffer_size}; allowed in {worlds} worlds: {fewest} or more"
            )


@dataclass(frozen=True, kw_only=True)
class _RolloutSettingsBase(Value, stored=False):
    """The settings of all agents that learn from rollouts of their current policies. The study has no such
    agents; the defaults are cprl's."""

    rollout_steps: Positive = 250
    """Turns T of each world collected between updates, so T x W steps of W worlds; an update of LOLA takes
    several rollouts, see `cprl.algorithms.LOLA.estimator`."""
    gamma: Share = 0.995
    """Discount factor per step."""
    optimizer: Optimizer = "adam"
    """See `cprl.learners.settings.Optimizer`; LOLA's papers have "sgd"."""
    learning_rate: LearningRate = 3e-4
    """The optimiser's step size."""
    adam_eps: OptimizerEps = 1e-5
    """Added to the denominator of Adam, AdamW and both kinds of RMSprop."""
    max_grad_norm: NormLimit = 0.5
    """The norm to which an agent's gradient is clipped; None for no clipping."""
    gae_lambda: Share = 0.95
    """Lambda of generalised advantage estimation (Schulman et al. 2016). At 1 advantages are returns to the
    end of the episode, or of the rollout, less a value."""
    normalize_advantage: bool = True
    """True if each agent's advantages of a rollout are normalised to mean 0 and standard deviation 1."""
    hidden_cells: Layers = DEFAULT_HIDDEN_CELLS
    """Units of each hidden layer, with ReLU, of the actor and of the critic; used if the algorithm has no
    `network`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.normalize_advantage and self.rollout_steps == 1:
            raise ValueError(
                f"{type(self).__name__}.rollout_steps is 1; allowed with normalize_advantage: 2 or more, "
                "because one advantage has no standard deviation"
            )


@dataclass(frozen=True, kw_only=True)
class RolloutSettings(_RolloutSettingsBase, LearningRateDecay):
    """Hyperparameters of one independent on-policy agent."""

    only_in_play: bool = False
    """True if losses and the normalisation of advantages leave out the turns in which an agent was out of
    play, so that its actions had no effect. Else agents learn from these turns too, as in the study."""

    epochs: Positive = 4
    """Passes over each rollout."""
    minibatch_size: Positive = 50
    """Steps in a minibatch, of all worlds of a replica; must divide the `rollout_steps` x W steps of its W
    worlds, and `rollout_steps` or be a multiple of it."""

    def updates_in(self, steps: int, *, worlds: int) -> int:
        """Return the number of updates that an agent takes in a number of steps of its replica.

        Args:
            steps: the steps of all worlds together.
            worlds: the number of worlds W of the replica.
        """
        rollout_steps = self.rollout_steps * worlds
        return steps // rollout_steps * self.epochs * (rollout_steps // self.minibatch_size)

    def __post_init__(self) -> None:
        super().__post_init__()
        longest = max(self.rollout_steps, self.minibatch_size)
        if longest % self.rollout_steps or longest % self.minibatch_size:
            raise ValueError(
                f"RolloutSettings.minibatch_size is {self.minibatch_size}; it must divide rollout_steps, "
                f"{self.rollout_steps}, or be a multiple of it, of agents in several worlds"
            )

    def refuse_worlds(self, worlds: int) -> None:
        """Raise a ValueError if agents with these settings cannot learn in this number of worlds."""
        if (self.rollout_steps * worlds) % self.minibatch_size:
            raise ValueError(
                f"RolloutSettings.minibatch_size is {self.minibatch_size}; it must divide rollout_steps x "
                f"worlds, {self.rollout_steps} x {worlds}"
            )


@dataclass(frozen=True, kw_only=True)
class TabularSettings(EpsilonGreedy):
    """Hyperparameters of one tabular agent. The study does not say them; the defaults are cprl's."""

    gamma: Share = 0.995
    """Discount factor per step, as `DQNSettings.gamma`."""
    learning_rate: Share | Literal["1/visits"] = 0.1
    """The step size alpha: a number, or "1/visits", one divided by the number of visits of the action in the
    state."""
    visits_power: Share = 1.0
    """With "1/visits", alpha is 1 / visits ** visits_power. A power below 1 forgets early targets sooner,
    which were computed from values that were still wrong: powers in 0.5..1 need far fewer steps (Even-Dar and
    Mansour 2003)."""
    epsilon_decay_steps: Steps = 50_000
    """Steps of the linear decay after the hold."""
    max_states: Positive = 100_000
    """The largest number of states in an agent's table; one more raises a MemoryError. A state takes the
    bytes of its observation, 16 per action and about 150 more."""

    def rates(self, visits: Int64) -> Float64:
        """Return the step size alpha of each value, by its number of visits, the current one included."""
        if self.learning_rate == "1/visits":
            return 1.0 / visits.astype(np.float64) ** self.visits_power
        return np.full(visits.shape, self.learning_rate)


@dataclass(frozen=True, kw_only=True)
class LOLASettings(_RolloutSettingsBase):
    """Hyperparameters of the members of a team that learns by LOLA."""

    look_ahead_rate: Annotated[float, Range(0, 1e12)] = 0.03
    """The size of the step, by plain gradient descent, that each member expects of the others; 0 is
    naive learning. The papers' 0.3 to 1 are for policies of five numbers; on boards of the commons 0.03 is a
    step as long as a tenth of the weights, 1 a policy that has nothing to do with the current one."""
    learning_rate: LearningRate = 1e-3
    max_grad_norm: NormLimit = None
    gae_lambda: Share = 1.0
    normalize_advantage: bool = False
    """True if advantages are normalised as for other agents; it scales the gradients, and so the steps that
    are expected of the others."""
    critic_learning_rate: LearningRate = 1e-3
    """The step size of Adam for the critics."""
    critic_epochs: Natural = 10
    """Steps of each critic after an update of the policies, over all its rollouts."""
