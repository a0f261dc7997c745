"""The pool of GovSim: agents say in each round how much they take of a pool that doubles.

Source: Piatti, Jin, Kleiman-Weiner and others, "Cooperate or Collapse: Emergence of Sustainable Cooperation
in a Society of LLM Agents" (NeurIPS 2024, arXiv 2404.16698), and its program on GitHub, giorgiopiatti/GovSim,
for what happens when agents want more than there is, and for what each may take so that the pool does not
shrink (`simulation/scenarios/common/environment/concurrent_env.py`). Five agents, twelve rounds, 100 units,
which double after each round up to 100; below 5 units the pool has collapsed.

Between rounds the agents of GovSim read what each has caught, and then speak one after the other, at most ten
times. Here all agents observe the catches, and with `talk` each may say one thing with its wish, which the
others read in the next round.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from cprl.envs.drivers import drawn_seed
from cprl.values import Positive, Value

ABOUT = (
    "You fish in a lake with {others} others. Each month all say at once how many tons they want to catch, "
    "from 0 to {capacity}. What is left then doubles, up to {capacity} tons. Below {collapse} tons there is "
    "no fish any more. There are {rounds} months. You observe the tons in the lake, the month, counted from "
    "0, and what you and then the others caught in the last month."
)
"""What a language model is told: `Language(instructions=pool.about, every_steps=1, fallback="random")`."""


@dataclass(frozen=True, kw_only=True)
class FishingPool(Value):
    """A pool of units that doubles after each round. Agents observe, uint8 [2 + N]: the units, the round, and
    what was taken in the last round, their own first. Their action is the number of units that they want."""

    agents: Positive = 5
    rounds: Positive = 12
    capacity: Positive = 100
    collapse: Positive = 5
    """The pool has collapsed if fewer units are left after a round."""
    talk: bool = False
    """Whether agents whose actions a language model chooses send each other messages."""

    @property
    def about(self) -> str:
        """Return the rules in words."""
        return ABOUT.format(others=self.agents - 1, **vars(self))

    def make(self, worlds: int, seed: int, device: Any, first_world: int = 0) -> "FishingEnv":
        """Return its environment, so many worlds."""
        return FishingEnv(self, worlds, seed=seed, device=device, first_world=first_world)


def rounds_survived(episode: Any) -> float:
    """Return the rounds until the pool collapsed, or all."""
    return float(episode.steps)


def has_survived(episode: Any) -> float:
    """Return 1 if the pool outlived the rounds, else 0."""
    return float(not episode.terminated)


def share_of_optimum(episode: Any) -> float:
    """Return what was taken of what the full pool yields for ever, half of 100 units in each of 12 rounds;
    the paper calls it efficiency, 1 - max(0, T f(0) - R) / (T f(0))."""
    return min(1.0, float(episode.harvest.sum()) / (12 * 50))


def over_usage(episode: Any) -> float:
    """Return the share of actions that took more than an equal share of what the pool regrows, see
    `FishingEnv.sustainable`, of all agents and rounds until the end."""
    return float(episode.violations.sum()) / float(len(episode.violations) * episode.steps)


MEASURES = (rounds_survived, has_survived, share_of_optimum, over_usage)
"""The measures of the paper for `Experiment(metrics=MEASURES)`; gain and equality every game has."""


class FishingEnv(EnvBase):
    """B pools, see `FishingPool`. The lot of the last units depends on seed, world, episode, round."""

    batch_locked = True

    def __init__(
        self,
        game: FishingPool,
        worlds: int = 1,
        *,
        seed: int | None = None,
        device: Any = "cpu",
        first_world: int = 0,
    ) -> None:
        super().__init__(device=device, batch_size=torch.Size([worlds]))
        self.game = game
        self.talk = game.talk
        self._first_world = first_world
        each = (worlds, game.agents)
        for name in ("units", "round", "episode"):
            self.register_buffer(name, torch.zeros(worlds, 1, dtype=torch.int64))
        self.register_buffer("taken", torch.zeros(each, dtype=torch.int64))
        self.register_buffer("seed_bits", torch.zeros((), dtype=torch.int64))
        self._set_seed(seed)
        observed = Bounded(0, max(game.capacity, game.rounds), (*each, 2 + game.agents), dtype=torch.uint8)
        violated = Binary(game.agents, each, dtype=torch.bool)
        agents = Composite(observation=observed, harvest=Unbounded(each), violated=violated, shape=each)
        stock = Bounded(0, game.capacity, (worlds, 1), dtype=torch.int64)
        self.observation_spec = Composite(agents=agents, stock=stock, shape=(worlds,))
        self.action_spec = Composite(
            agents=Composite(action=Categorical(game.capacity + 1, each, dtype=torch.int64), shape=each),
            shape=(worlds,),
        )
        self.reward_spec = Composite(
            agents=Composite(reward=Unbounded((*each, 1)), shape=each), shape=(worlds,)
        )
        ends = {end: Binary(1, (worlds, 1), dtype=torch.bool) for end in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=(worlds,))

    def _set_seed(self, seed: int | None) -> None:
        self.seed_bits.fill_(drawn_seed() if seed is None else seed % 2**63)
        self.episode.zero_()

    def sustainable(self) -> torch.Tensor:
        """Return what each agent may take so that the pool does not shrink, int64 [B, 1]."""
        return self.units // 2 // self.game.agents

    def _moment(self, terminated: torch.Tensor, truncated: torch.Tensor, **agents: Any) -> TensorDict:
        """Return what is observed now; what an agent took comes first in its own observation."""
        shifts = torch.arange(self.game.agents)
        taken = self.taken[:, (shifts[:, None] + shifts) % self.game.agents]
        pool = torch.cat([self.units, self.round], 1)[:, None].expand(-1, self.game.agents, -1)
        entries = {
            "observation": torch.cat([pool, taken], -1).to(torch.uint8),
            "harvest": self.taken.float(),
            **agents,
        }
        group = TensorDict(entries, self.taken.shape)
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict({"agents": group, "stock": self.units.clone(), **ends}, self.batch_size)

    def _reset(self, tensordict: Any = None, **_: Any) -> TensorDict:
        begins = None if tensordict is None else tensordict.get("_reset", None)
        begins = torch.ones_like(self.units, dtype=torch.bool) if begins is None else begins.reshape(-1, 1)
        self.units = torch.where(begins, self.game.capacity, self.units)
        self.round = torch.where(begins, 0, self.round)
        self.taken = torch.where(begins, 0, self.taken)
        self.episode = self.episode + begins
        never = torch.zeros_like(begins)
        return self._moment(never, never.clone(), violated=torch.zeros_like(self.taken, dtype=torch.bool))

    def _step(self, tensordict: Any) -> TensorDict:
        wanted = tensordict["agents", "action"]
        taken = wanted.clone()
        for world in torch.nonzero(wanted.sum(1) > self.units[:, 0]).flatten().tolist():
            taken[world] = torch.from_numpy(self._shared(world, wanted[world].numpy()))
        violated = taken > self.sustainable()
        self.taken = taken
        left = self.units - taken.sum(1, keepdim=True)
        self.round = self.round + 1
        terminated = left < self.game.collapse
        truncated = ~terminated & (self.round >= self.game.rounds)
        self.units = torch.where(terminated, left, (2 * left).clamp(max=self.game.capacity))
        reward = taken.float().unsqueeze(-1)
        return self._moment(terminated, truncated, reward=reward, violated=violated)

    def _shared(self, world: int, wanted: Any) -> Any:
        """Return what agents get who want more than there is: each unit goes to one who wants more."""
        place = (
            int(self.seed_bits),
            self._first_world + world,
            int(self.episode[world]),
            int(self.round[world]),
        )
        rng = np.random.default_rng(place)
        taken = np.zeros_like(wanted)
        for _ in range(int(self.units[world])):
            taken[rng.choice(np.flatnonzero(taken < wanted))] += 1
        return taken
