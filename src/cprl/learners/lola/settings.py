"""The hyperparameters of agents that learn with opponent-learning awareness."""

from dataclasses import dataclass
from typing import Final, get_args

from cprl.checks import NONE, SWITCH, Check, check_fields, count, either, number, one_of
from cprl.learners.settings import DEFAULT_HIDDEN_CELLS, Optimizer
from cprl.networks.mlp import LAYERS


@dataclass(frozen=True, kw_only=True)
class LOLASettings:
    """Hyperparameters of the members of a team that learns by LOLA. The study has none; the defaults are
    ours.

    Raises:
        ValueError: if a value is out of range; names the field, its value and the allowed values.
    """

    rollout_steps: int = 250
    """Steps T of a rollout; an update takes several rollouts, see `cprl.algorithms.LOLA.estimator`."""
    gamma: float = 0.995
    """Discount factor per step, 0..1."""
    look_ahead_rate: float = 0.03
    """The size of the step, by plain gradient descent, that each member expects of the others, 0..1e12; 0 is
    naive learning. The papers' 0.3 to 1 are for policies of five numbers; on boards of the commons 0.03 is a
    step as long as a tenth of the weights, 1 a policy that has nothing to do with the present one."""
    optimizer: Optimizer = "adam"
    """The optimiser of the policies, see `cprl.learners.settings.Optimizer`. The papers' is "sgd"."""
    learning_rate: float = 1e-3
    """Its step size, 1e-12..100."""
    adam_eps: float = 1e-5
    """Added to the denominator of Adam, AdamW and both kinds of RMSprop, 1e-30..1."""
    max_grad_norm: float | None = None
    """The norm to which each member's gradient is clipped, 1e-6 or more; None for no clipping."""
    gae_lambda: float = 1.0
    """Lambda of generalised advantage estimation, 0..1: at 1 advantages are returns to the end of the
    episode, or of the rollout, less a value."""
    normalize_advantage: bool = False
    """Whether each member's advantages of a rollout are normalised to mean 0 and standard deviation 1. This
    scales the gradients, and so the steps that are expected of the others."""
    critic_learning_rate: float = 1e-3
    """The step size of Adam for the critics, 1e-12..100."""
    critic_epochs: int = 10
    """Steps of each critic after an update of the policies, over all its rollouts."""
    hidden_cells: tuple[int, ...] = DEFAULT_HIDDEN_CELLS
    """Units of each hidden layer, with ReLU, of the actor and of the critic; used if the algorithm has no
    `network`."""

    def __post_init__(self) -> None:
        check_fields(self, _CHECKS)
        if self.normalize_advantage and self.rollout_steps == 1:
            raise ValueError(
                "LOLASettings.rollout_steps is 1; allowed with normalize_advantage: 2 or more, because one "
                "advantage has no standard deviation"
            )


_RATE: Final = number(1e-12, 100)
_CHECKS: Final[dict[str, Check]] = {
    "rollout_steps": count(1),
    "gamma": number(0, 1),
    "look_ahead_rate": number(0, 1e12),
    "optimizer": one_of(*get_args(Optimizer)),
    "learning_rate": _RATE,
    "adam_eps": number(1e-30, 1),
    "max_grad_norm": either(number(1e-6, 1e12), Check(NONE.fits, "None for no clipping")),
    "gae_lambda": number(0, 1),
    "normalize_advantage": SWITCH,
    "critic_learning_rate": _RATE,
    "critic_epochs": count(0),
    "hidden_cells": LAYERS,
}
