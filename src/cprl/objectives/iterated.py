"""The exact value of a repeated matrix game for policies that remember the last turn."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from cprl.arguments import number, object_of, refusal


def iterated_value(probabilities: Tensor, payoffs: Tensor | Sequence[Any], *, gamma: float) -> Tensor:
    """The discounted return of each of N agents who repeat a matrix game for ever, [.., N].

    It is p_0 (I - gamma P)^-1 r, where p_0 has the chances of the joint actions of the first turn, row a of P
    those of the turn after the joint action a, and r the payoffs. Times (1 - gamma) it is a mean per turn.

    Args:
        probabilities: of the actions of each agent, float [.., N, A**N + 1, A], after each joint action of
            the last turn, whose number is a_1 * A**(N-1) + .. + a_N; in the last row, at the first turn.
            Every agent sees the joint action in the same order.
        payoffs: of the joint actions, [A, .., A, N]; nested tuples or a tensor.
        gamma: the discount per turn, 0 or more and below 1.

    Raises:
        ValueError: for a discount out of range, and for shapes that do not fit.

    Source: Foerster et al., "Learning with Opponent-Learning Awareness" (2018), whose exact learners use it.
    """
    number("gamma", gamma, low=0, high=1 - 1e-9, allowed="0 or more, below 1")
    object_of("probabilities", probabilities, Tensor, "a tensor of floats")
    try:
        paid = torch.as_tensor(payoffs, dtype=probabilities.dtype, device=probabilities.device)
    except (TypeError, ValueError, RuntimeError):
        raise refusal("payoffs", payoffs, "numbers [A, .., A, N]") from None
    agents, actions = max(0, paid.ndim - 1), paid.shape[0] if paid.ndim else 0
    joint = actions**agents
    wanted = (agents, joint + 1, actions)
    is_game = agents > 0 < actions and paid.shape == (*[actions] * agents, agents)
    if not is_game or not probabilities.is_floating_point() or probabilities.shape[-3:] != wanted:
        raise ValueError(
            f"payoffs are {list(paid.shape)}, probabilities {list(probabilities.shape)}; allowed: "
            "[A, .., A, N] and [.., N, A**N + 1, A]"
        )
    chances = probabilities[..., 0, :, :]
    for agent in range(1, agents):
        chances = (chances.unsqueeze(-1) * probabilities[..., agent, :, None, :]).flatten(-2)
    after, first = chances[..., :joint, :], chances[..., joint, :]
    visits: Tensor = torch.linalg.solve(torch.eye(joint).to(after) - gamma * after.mT, first)
    return visits @ paid.reshape(joint, agents)
