"""DiCE: what rollouts say of returns, as numbers whose derivatives of any order are unbiased estimates.

Source: Foerster, Farquhar, Al-Shedivat, Rocktäschel, Xing and Whiteson, "DiCE: The Infinitely Differentiable
Monte Carlo Estimator" (2018); with advantages: Farquhar, Whiteson and Foerster, "Loaded DiCE: Trading off
Bias and Variance in Any-Order Score Function Gradient Estimators for Reinforcement Learning" (2019).

A rollout of T steps may hold several episodes, each a piece of it. Pieces do not influence each other, and
the discount of a step counts from the begin of its piece.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from cprl.arguments import number, object_of


def magic_box(log_prob: Tensor) -> Tensor:
    """1, with the derivatives of probabilities relative to what they are: exp(x - stop_gradient(x))."""
    object_of("log_prob", log_prob, Tensor, "a tensor of floats")
    return (log_prob - log_prob.detach()).exp()


def dice_objective(
    log_prob: Tensor,
    reward: Tensor,
    *,
    gamma: float,
    done: Tensor | None = None,
    baseline: Tensor | None = None,
) -> Tensor:
    """The mean discounted return of the pieces of each rollout, [.., N], differentiable any number of times.

    Args:
        log_prob: of the actions that were taken, float [.., T, N]; every reward may depend on all of them.
        reward: of N agents, float [.., T, N].
        gamma: the discount per step, 0..1.
        done: whether a piece ends with this step, bool [.., T, 1]; by default none does before the last.
        baseline: what the returns from a step on are compared with, float [.., T, N], without a gradient. It
            may depend on all that was there before the step's actions. It changes no expected derivative of
            any order, and the variance of all: DiCE's own, which serves the first order, has the term
            (1 - box of the step) here, which is (boxes up to the step before - boxes up to the step).

    Raises:
        ValueError: for a discount out of range, and for shapes that do not fit.
    """
    _same("reward", reward, log_prob)
    steps = _steps(log_prob, gamma, done)
    paid = steps.so_far * reward
    if baseline is not None:
        _same("baseline", baseline, log_prob)
        paid = paid + (steps.before - steps.so_far) * baseline.detach()
    return (steps.discount * paid).sum(-2) / steps.pieces


def loaded_dice(log_prob: Tensor, advantage: Tensor, *, gamma: float, done: Tensor | None = None) -> Tensor:
    """Zeros [.., N] with the derivatives, of any order, of the mean discounted return of pieces.

    Args:
        log_prob: of the actions that were taken, float [.., T, N].
        advantage: an estimate of each action's advantage, float [.., T, N], without a gradient. Returns to
            the end of the piece less a baseline are unbiased, and then this is `dice_objective`, less its
            value; what bootstraps, as generalised advantage estimates do, has less variance and a bias.
        gamma: the discount per step, 0..1.
        done: whether a piece ends with this step, bool [.., T, 1]; by default none does before the last.

    Raises:
        ValueError: for a discount out of range, and for shapes that do not fit.
    """
    _same("advantage", advantage, log_prob)
    steps = _steps(log_prob, gamma, done)
    gained = steps.discount * (steps.so_far - steps.before) * advantage.detach()
    return gained.sum(-2) / steps.pieces


class _Steps(NamedTuple):
    """Of each step of rollouts [.., T, 1]."""

    so_far: Tensor
    """The magic box of all actions from the begin of the piece up to the step, all agents'."""
    before: Tensor
    """The same up to the step before."""
    discount: Tensor
    """gamma to the number of steps since the begin of the piece."""
    pieces: Tensor
    """How many pieces the rollout has, [.., 1]."""


def _steps(log_prob: Tensor, gamma: float, done: Tensor | None) -> _Steps:
    number("gamma", gamma, low=0, high=1, allowed="0..1")
    object_of("done", done, Tensor | None, "a tensor of bool, or None")
    joint = log_prob.sum(-1, keepdim=True)
    if done is None:
        done = torch.zeros_like(joint, dtype=torch.bool)
    elif done.shape != joint.shape or done.dtype != torch.bool:
        raise ValueError(f"done is {done.dtype} {list(done.shape)}; allowed: bool {list(joint.shape)}")
    begins = torch.cat([torch.ones_like(done[..., :1, :]), done[..., :-1, :]], -2)
    index = torch.arange(joint.shape[-2], device=joint.device).unsqueeze(-1).expand_as(begins)
    first = torch.where(begins, index, 0).cummax(-2).values
    total = joint.cumsum(-2)
    earlier = (total - joint).gather(-2, first)
    discount = torch.as_tensor(gamma, dtype=joint.dtype, device=joint.device) ** (index - first)
    pieces = begins.sum(-2).to(joint.dtype)
    return _Steps(magic_box(total - earlier), magic_box(total - joint - earlier), discount, pieces)


def _same(name: str, given: Tensor, log_prob: Tensor) -> None:
    for named, value in ((name, given), ("log_prob", log_prob)):
        object_of(named, value, Tensor, "a tensor of floats")
        if not value.is_floating_point():
            raise ValueError(f"{named} is {value.dtype}; allowed: a tensor of floats")
    if given.shape != log_prob.shape or given.ndim < 2:
        raise ValueError(
            f"{name} is {list(given.shape)}, log_prob {list(log_prob.shape)}; allowed: [.., T, N] for both"
        )
