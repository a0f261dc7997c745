"""How far gradients through sampled actions are from that of the expected value, for the actors of MADDPG.

A policy of 8 actions, with logits from N(0, 1), and a critic of the one-hot action and 24 other numbers. The
gradient of the expected value by the logits is enumerated; so is the average of the straight-through gradient
of `MADDPGLoss`. That of Gumbel-softmax, as in the published program of Lowe et al. (2017) with temperature 1,
is averaged over samples, also with one-hot samples that have its gradient ("one-hot Gumbel"). A critic is
linear, or has two hidden layers of 64 with torch's first weights, or the same after it was fitted to values
from N(0, 1) of the eight actions.

    python benchmarks/straight_through.py
"""

from collections.abc import Callable

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

ACTIONS, OTHERS, CELLS = 8, 24, 64


def critic_of(kind: str) -> Callable[[Tensor], Tensor]:
    """A critic: actions [.., 8] to values [..]."""
    others = torch.randn(OTHERS)
    if kind == "linear":
        layers: nn.Module = nn.Linear(ACTIONS + OTHERS, 1)
    else:
        inner = nn.Linear(CELLS, CELLS), nn.ReLU(), nn.Linear(CELLS, 1)
        layers = nn.Sequential(nn.Linear(ACTIONS + OTHERS, CELLS), nn.ReLU(), *inner)

    def values(action: Tensor) -> Tensor:
        seen = torch.cat([action, others.expand(*action.shape[:-1], OTHERS)], -1)
        return layers(seen).squeeze(-1)  # type: ignore[no-any-return]

    if kind == "fitted":
        wanted, optimizer = torch.randn(ACTIONS), torch.optim.Adam(layers.parameters(), lr=3e-3)
        for _ in range(300):
            optimizer.zero_grad()
            (values(torch.eye(ACTIONS)) - wanted).square().mean().backward()  # type: ignore[no-untyped-call]
            optimizer.step()
    return values


def of_logits(value: Callable[[Tensor], Tensor], logits: Tensor) -> Tensor:
    """The gradient of a value by logits."""
    logits = logits.clone().requires_grad_()
    (slope,) = torch.autograd.grad(value(logits), logits)
    return slope


def gradients(critic: Callable[[Tensor], Tensor], logits: Tensor, samples: int) -> dict[str, Tensor]:
    """The gradient of the expected value, "exact", and the average of each estimate."""
    every, probs = torch.eye(ACTIONS), logits.softmax(-1)
    noise = torch.rand(samples, ACTIONS).clamp(1e-12, 1 - 1e-7)
    gumbel = -(-noise.log()).log()

    def straight_through(own: Tensor) -> Tensor:
        through = every + own.softmax(-1) - probs
        return (probs * critic(through)).sum()

    def relaxed(own: Tensor, temperature: float) -> Tensor:
        return critic(((own + gumbel) / temperature).softmax(-1)).mean()

    def hard(own: Tensor, temperature: float) -> Tensor:
        soft = ((own + gumbel) / temperature).softmax(-1)
        one_hot = nn.functional.one_hot(soft.argmax(-1), ACTIONS).to(soft.dtype)
        return critic(one_hot + soft - soft.detach()).mean()

    return {
        "exact": of_logits(lambda own: (own.softmax(-1) * critic(every)).sum(), logits),
        "straight-through": of_logits(straight_through, logits),
        "Gumbel 1": of_logits(lambda own: relaxed(own, 1.0), logits),
        "Gumbel 0.5": of_logits(lambda own: relaxed(own, 0.5), logits),
        "one-hot Gumbel 1": of_logits(lambda own: hard(own, 1.0), logits),
    }


def main(*, policies: int = 100, samples: int = 20_000) -> None:
    """Prints medians over policies: the length of an estimate along the exact gradient, as a share of it; its
    distance from the exact one, likewise; and the cosine between them.

    Args:
        policies: each with a critic of its own.
        samples: of Gumbel-softmax for each.
    """
    torch.manual_seed(0)
    torch.set_num_threads(1)
    table = Table("critic", "estimate", "along the exact one", "distance", "cosine")
    for kind in ("linear", "first weights", "fitted"):
        along: dict[str, list[list[float]]] = {}
        for _ in range(policies):
            found = gradients(critic_of(kind), torch.randn(ACTIONS), samples)
            exact = found.pop("exact")
            for name, own in found.items():
                dot, lengths = float(own @ exact), float(own.norm() * exact.norm())
                away = float((own - exact).norm() / exact.norm())
                along.setdefault(name, []).append([dot / float(exact @ exact), away, dot / lengths])
        for name, rows in along.items():
            medians = torch.tensor(rows).median(0).values.tolist()
            table.add_row(kind, name, *(f"{own:.3f}" for own in medians))
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
