"""How fast one replica of four agents learns from many worlds of `commons`, in env steps a second and core.

An env step is a turn of one world, in which all four agents act, so four agent steps. One thread; seconds are
those of the processor. Each case is trained in a process of its own; before and after it runs the plain loop:
PPO in sixty lines of torch without this library, with networks, rollouts and minibatches of "PPO, 4 epochs".
Rates are medians of several rounds; "beside" is the median of the ratios to the plain loop of the same round.
"products" are the matrix products alone of what a case computes, on its own shapes.

    python benchmarks/many_worlds.py [--cases ppo-4 dqn-64 ...] [--rounds 3]
"""

import resource
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import replace
from multiprocessing import get_context
from statistics import median
from typing import Any, Final, NamedTuple
from unittest.mock import patch

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import nn

from cprl import CommonsEnv, presets
from cprl.algorithms import DQN, MADDPG, MAPPO, PPO, QMIX, VDN, DQNSettings, RolloutSettings
from cprl.policies.joint_policy import JointPolicy
from cprl.population import AgentSpec, Learning, Team
from cprl.runs.schedule import Schedule
from cprl.system.process import prepare_process
from cprl.training.agents import Population
from cprl.training.training import Training

AGENTS = 4
TURNS = 64
PLAIN_WORLDS = 256
MINIBATCH = 2048
EVERYONE: Final = tuple(range(AGENTS))
GAME: Final = presets.game("commons", variant="as_run")


class Case(NamedTuple):
    """What is trained, in so many worlds, and how many turns a round takes."""

    agents: tuple[AgentSpec, ...]
    worlds: int
    turns: int


def alone(algorithm: Any) -> tuple[AgentSpec, ...]:
    return (Learning(algorithm),) * AGENTS


def team(kind: Any, settings: Any, reward: Any = "team") -> tuple[AgentSpec, ...]:
    return (Team(kind(settings=settings), EVERYONE, reward=reward),)


def rollouts(epochs: int) -> RolloutSettings:
    return RolloutSettings(rollout_steps=TURNS, minibatch_size=MINIBATCH, epochs=epochs)


STUDY: Final = presets.dqn_settings("commons", variant="as_run")
ONE: Final = DQNSettings(steps_per_update=64, batch_size=64)
"""One update a turn of 64 worlds."""
CASES: Final = {
    "ppo-4": Case(alone(PPO(settings=rollouts(4))), 256, 2 * TURNS),
    "ppo-1": Case(alone(PPO(settings=rollouts(1))), 256, 4 * TURNS),
    "dqn-8 x 64": Case(alone(DQN(settings=STUDY)), 64, 150),
    "dqn-512": Case(alone(DQN(settings=replace(STUDY, steps_per_update=64, batch_size=512))), 64, 400),
    "dqn-64": Case(alone(DQN(settings=ONE)), 64, 800),
    "vdn-64": Case(team(VDN, ONE), 64, 400),
    "qmix-64": Case(team(QMIX, ONE), 64, 200),
    "maddpg-64": Case(team(MADDPG, ONE), 64, 100),
    "mappo-4": Case(team(MAPPO, rollouts(4)), 64, TURNS),
}
"""By name: "dqn-8 x 64" is the study's DQN, an update of 8 transitions a step, 64 a turn; "dqn-512" has one
of 512, as many transitions; "dqn-64" one of 64."""

PARTS: Final[dict[str, tuple[type, str]]] = {
    "game": (CommonsEnv, "_step_and_maybe_reset"),
    "acting": (JointPolicy, "forward"),
}


def timed(owner: Any, name: str, part: str, spent: Counter[str]) -> AbstractContextManager[Any]:
    """Return a context in which the processor time of a method is added up, in seconds."""
    plain: Callable[..., Any] = getattr(owner, name)

    def with_clock(*arguments: Any, **options: Any) -> Any:
        started = time.process_time()
        result = plain(*arguments, **options)
        spent[part] += time.process_time() - started  # type: ignore[assignment]
        return result

    return patch.object(owner, name, with_clock)


class Plain:
    """PPO of four agents with networks of their own in 256 worlds, as a loop of plain torch."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.env = CommonsEnv(GAME, PLAIN_WORLDS, seed=0)
        self.now = self.env.reset()
        self.inputs = torch.Size(GAME.observation_shape).numel()
        self.actor = self._network(GAME.spaces.actions)
        self.critic = self._network(1)
        self.adam = torch.optim.Adam([*self.actor, *self.critic], lr=3e-4, fused=True)
        self.loss = torch.compile(self._loss)

    def _network(self, outputs: int) -> list[nn.Parameter]:
        sizes = ((self.inputs, 32), (32, 32), (32, outputs))
        return [nn.Parameter(torch.randn(AGENTS, *size) / size[0] ** 0.5) for size in sizes]

    @staticmethod
    def _outputs(layers: Sequence[torch.Tensor], seen: torch.Tensor) -> torch.Tensor:
        values = seen.float() / 255
        for layer in layers[:-1]:
            values = torch.bmm(values, layer).relu()
        return torch.bmm(values, layers[-1])

    def _loss(
        self,
        seen: torch.Tensor,
        action: torch.Tensor,
        before: torch.Tensor,
        gain: torch.Tensor,
        target: torch.Tensor,
    ) -> torch.Tensor:
        log_probs = self._outputs(self.actor, seen).log_softmax(-1)
        ratio = (log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1) - before).exp()
        entropy = -(log_probs.exp() * log_probs).sum(-1).mean()
        error = (self._outputs(self.critic, seen).squeeze(-1) - target).square().mean()
        gained = torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
        return 0.5 * error - gained - 0.01 * entropy

    def rollout(self) -> None:
        """Play one rollout, and learn four epochs over it."""
        columns: dict[str, list[torch.Tensor]] = {
            name: [] for name in ("seen", "action", "log_prob", "reward", "done")
        }
        with torch.no_grad():
            for _ in range(TURNS):
                seen = self._by_agent(self.now["agents", "observation"])
                log_probs = self._outputs(self.actor, seen).log_softmax(-1)
                action = (log_probs - torch.empty_like(log_probs).exponential_().log()).argmax(-1)
                self.now["agents", "action"] = action.t().contiguous()
                turn, self.now = self.env.step_and_maybe_reset(self.now)
                log_prob = log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1)
                reward = turn["next", "agents", "reward"].squeeze(-1).t()
                done = turn["next", "done"].squeeze(-1)
                for column, value in zip(
                    columns.values(), (seen, action, log_prob, reward, done), strict=True
                ):
                    column.append(value)
            last = self._by_agent(self.now["agents", "observation"])
            values = [self._outputs(self.critic, seen).squeeze(-1) for seen in (*columns["seen"], last)]
            gains = []
            gain = torch.zeros(AGENTS, PLAIN_WORLDS)
            for turn in reversed(range(TURNS)):
                goes_on = ~columns["done"][turn]
                error = columns["reward"][turn] + 0.99 * values[turn + 1] * goes_on - values[turn]
                gain = error + 0.99 * 0.95 * goes_on * gain
                gains.append(gain)
        batch = [torch.stack(columns[name], 1).flatten(1, 2) for name in ("seen", "action", "log_prob")]
        advantage = torch.stack(gains[::-1], 1).flatten(1, 2)
        batch += [advantage, advantage + torch.stack(values[:-1], 1).flatten(1, 2)]
        for _ in range(4):
            for places in torch.randperm(TURNS * PLAIN_WORLDS).split(MINIBATCH):
                self.adam.zero_grad()
                self.loss(*(column[:, places] for column in batch)).backward()
                self.adam.step()

    def _by_agent(self, seen: torch.Tensor) -> torch.Tensor:
        return seen.view(PLAIN_WORLDS, AGENTS, self.inputs).transpose(0, 1)

    def rate(self) -> float:
        started = time.process_time()
        for _ in range(2):
            self.rollout()
        return 2 * TURNS * PLAIN_WORLDS / (time.process_time() - started)


def products_s(case: Case) -> float:
    """Return the processor seconds of the matrix products alone of a turn of all worlds of a case of
    independent agents: of acting, evaluating rollouts or targets, and updates forwards and backwards."""
    settings = case.agents[0].algorithm.settings  # type: ignore[union-attr]
    inputs = torch.Size(GAME.observation_shape).numel()

    def seconds(rows: int, outputs: int, *, back: bool) -> float:
        sizes = ((inputs, 32), (32, 32), (32, outputs))
        pairs = [(torch.rand(AGENTS, rows, size[0]), torch.rand(AGENTS, *size)) for size in sizes]

        def once() -> None:
            for place, (values, weight) in enumerate(pairs):
                product = torch.bmm(values, weight)
                if back:
                    torch.bmm(values.transpose(1, 2), product)
                    if place:
                        torch.bmm(product, weight.transpose(1, 2))

        once()
        started = time.process_time()
        count = 0
        while time.process_time() - started < 0.3:
            once()
            count += 1
        return (time.process_time() - started) / count

    acting = seconds(case.worlds, GAME.spaces.actions, back=False)
    if isinstance(settings, RolloutSettings):
        minibatches = TURNS * case.worlds // MINIBATCH
        both = (GAME.spaces.actions, 1)
        evaluating = minibatches * sum(seconds(MINIBATCH, outputs, back=False) for outputs in both)
        updating = settings.epochs * minibatches * sum(seconds(MINIBATCH, out, back=True) for out in both)
        return acting + (evaluating + updating) / TURNS
    updates = case.worlds // settings.steps_per_update
    rows = settings.batch_size
    return acting + updates * (
        seconds(rows, GAME.spaces.actions, back=True) + seconds(rows, GAME.spaces.actions, back=False)
    )


def measure(name: str, rounds: int) -> dict[str, float]:
    """Return the rate of a case, beside the plain loop's, its memory in MiB, and the shares of its time."""
    prepare_process(0)
    case = CASES[name]
    plain = Plain()
    env = CommonsEnv(GAME, case.worlds, seed=0)
    population = Population(env, case.agents, seed=0, worlds=case.worlds)
    training = Training(env, population.learners, Schedule(steps=2**60, worlds=case.worlds))
    (learner,) = population.learners.values()
    plain.rollout()
    for _ in range(max(case.turns, TURNS + 2)):  # compiles
        training.step()
    results: dict[str, list[float]] = {}
    for _ in range(rounds):
        before = plain.rate()
        spent = Counter[str]()
        started = time.process_time()
        for _ in range(case.turns):
            training.step()
        seconds = time.process_time() - started
        rate = case.turns * case.worlds / seconds
        numbers = {"env steps/s": rate, "beside": 2 * rate / (before + plain.rate()), "plain": before}
        clocks = [timed(owner, method, part, spent) for part, (owner, method) in PARTS.items()]
        clocks.append(timed(learner, "update", "learning", spent))
        for clock in clocks:
            clock.__enter__()
        started = time.process_time()
        for _ in range(case.turns):
            training.step()
        seconds = time.process_time() - started
        for clock in clocks:
            clock.__exit__(None, None, None)
        numbers |= {part: spent[part] / seconds for part in (*PARTS, "learning")}
        numbers["products"] = products_s(case) * rate / case.worlds if len(case.agents) > 1 else float("nan")
        for what, value in numbers.items():
            results.setdefault(what, []).append(value)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {**{what: median(values) for what, values in results.items()}, "memory": memory}


def main(cases: tuple[str, ...] = tuple(CASES), rounds: int = 3) -> None:
    """Print the table.

    Args:
        cases: which, by name.
        rounds: of each.
    """
    heads = ("case", "worlds", "env steps/s", "agent steps/s", "beside plain")
    table = Table(*heads, "game", "acting", "learning", "products", "peak MiB")
    plain = []
    for name in cases:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            numbers = pool.submit(measure, name, rounds).result()
        rate = numbers["env steps/s"]
        shares = [f"{numbers[part]:.0%}" for part in (*PARTS, "learning")]
        products = "" if numbers["products"] != numbers["products"] else f"{numbers['products']:.0%}"
        table.add_row(name, str(CASES[name].worlds), f"{rate:,.0f}", f"{AGENTS * rate:,.0f}",
                      f"{numbers['beside']:.2f}", *shares, products, f"{numbers['memory']:,.0f}")  # fmt: skip
        plain.append(numbers["plain"])
    console = Console(width=120)
    console.print(table)
    console.print(f"plain loop: {median(plain):,.0f} env steps/s")


if __name__ == "__main__":
    tyro.cli(main)
