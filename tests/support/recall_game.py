"""A game that needs memory: what pays at the end is shown in the first turn alone."""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase


class RecallEnv(EnvBase):
    """B worlds of N agents. The first turn shows each agent a cue, 0 or 1, as one of two flags; the last of
    `turns` turns raises a third flag and pays 1 to whoever takes the action of its cue."""

    batch_locked = True

    def __init__(self, worlds: int, agents: int, turns: int, seed: int) -> None:
        super().__init__(batch_size=torch.Size([worlds]))
        self.turns, size = turns, (worlds, agents)
        self.group_map = {"agents": [f"agent_{agent}" for agent in range(agents)]}
        self.register_buffer("turn", torch.zeros(worlds, 1, dtype=torch.int64))
        self.register_buffer("cue", torch.zeros(size, dtype=torch.int64))
        self.register_buffer("episode", torch.zeros(worlds, 1, dtype=torch.int64))
        self.register_buffer("seed", torch.tensor(seed))

        def group(**specs):
            return Composite(agents=Composite(**specs, shape=size), shape=(worlds,))

        self.action_spec = group(action=Categorical(2, shape=size, dtype=torch.int64))
        self.reward_spec = group(reward=Unbounded(shape=(*size, 1)))
        self.observation_spec = group(observation=Bounded(0, 1, shape=(*size, 3), dtype=torch.float32))
        flags = {
            name: Categorical(2, shape=(worlds, 1), dtype=torch.bool)
            for name in ("done", "terminated", "truncated")
        }
        self.done_spec = Composite(flags, shape=(worlds,))

    def _seen(self):
        seen = torch.zeros(*self.cue.shape, 3)
        first, last = self.turn == 0, self.turn == self.turns - 1
        seen[..., 0], seen[..., 1] = first & (self.cue == 0), first & (self.cue == 1)
        seen[..., 2] = last
        return seen

    def _moment(self, agents, done):
        ends = {"done": done, "terminated": done, "truncated": torch.zeros_like(done)}
        size = self.cue.shape
        return TensorDict({"agents": TensorDict(agents, size), **ends}, self.batch_size)

    def _reset(self, tensordict=None, **kwargs):
        which = torch.ones_like(self.turn, dtype=torch.bool)
        if tensordict is not None and tensordict.get("_reset", None) is not None:
            which = tensordict["_reset"].reshape(-1, 1)
        self.turn = torch.where(which, 0, self.turn)
        self.episode = self.episode + which
        world, agent = (torch.arange(count) for count in self.cue.shape)
        mixed = (self.seed + 7919 * self.episode + 104729 * world[:, None]) * 2654435761 + 97 * agent
        mixed = (mixed ^ (mixed >> 13)) * 1274126177
        self.cue = torch.where(which, (mixed >> 17) & 1, self.cue)
        return self._moment({"observation": self._seen()}, torch.zeros_like(which))

    def _step(self, tensordict):
        done = self.turn >= self.turns - 1
        right = tensordict["agents", "action"] == self.cue
        paid = (right & done).float().unsqueeze(-1)
        self.turn = torch.where(done, self.turn, self.turn + 1)
        return self._moment({"observation": self._seen(), "reward": paid}, done)

    def _set_seed(self, seed):
        self.seed.fill_(seed or 0)


@dataclass(frozen=True)
class Recall:
    """The game as a value, as `Experiment.game` takes it."""

    turns: int = 4
    agents: int = 1

    def to_config(self) -> dict[str, Any]:
        return {"turns": self.turns, "agents": self.agents}

    def make(self, worlds, seed, device):
        return RecallEnv(worlds, self.agents, self.turns, seed)
