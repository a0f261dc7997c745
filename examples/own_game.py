"""How to write a game of your own: two hunters each choose a stag, which takes both, or a hare.
Prints what a hunter gets in fresh worlds, trained and at random."""

from dataclasses import asdict, dataclass

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

import cprl
from cprl.algorithms import DQN, DQNSettings
from cprl.population import Learning

PAYOFF = torch.tensor([[4.0, 0.0], [3.0, 3.0]])  # [own action, other's action]; 0 hunts a stag, 1 a hare


@dataclass(frozen=True)
class StagHunt:
    turns: int = 10
    agents: int = 2

    def to_config(self):
        return asdict(self)

    def make(self, worlds, seed, device):
        return StagHuntEnv(self.turns, worlds, device)


class StagHuntEnv(EnvBase):  # both observe the last actions; the turn is in the TensorDict: no other state
    def __init__(self, turns, worlds, device):
        super().__init__(batch_size=[worlds], device=device)
        self.turns = turns
        batch = (worlds,)
        each = (worlds, 2)
        agents = Composite(observation=Unbounded((*each, 2)), shape=each)
        turn = Unbounded((worlds, 1), dtype=torch.int64)
        self.observation_spec = Composite(agents=agents, turn=turn, shape=batch)
        self.action_spec = Composite(agents=Composite(action=Categorical(2, each), shape=each), shape=batch)
        self.reward_spec = Composite(agents=Composite(reward=Unbounded((*each, 1)), shape=each), shape=batch)
        ends = {end: Binary(1, (worlds, 1), dtype=torch.bool) for end in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=batch)

    def _reset(self, tensordict=None):
        return self.observation_spec.zero().update(self.done_spec.zero())

    def _step(self, tensordict):
        action = tensordict["agents", "action"]
        turn = tensordict["turn"] + 1
        seen = action.float().unsqueeze(1).expand(-1, 2, -1)
        reward = PAYOFF[action, action.flip(1)].unsqueeze(-1)
        agents = TensorDict({"observation": seen, "reward": reward}, action.shape)
        over = turn >= self.turns
        ends = {"done": over, "terminated": torch.zeros_like(over), "truncated": over}
        return TensorDict({"agents": agents, "turn": turn, **ends}, self.batch_size)

    def _set_seed(self, seed): ...  # nothing is left to chance


hunter = Learning(DQN(settings=DQNSettings(buffer_size=200, learning_rate=1e-3)))
short = {"episodes": 10, "replicas": 2}
run = cprl.run(cprl.Experiment(name="stag_hunt", game=StagHunt(turns=5), agents=(hunter, hunter), **short))
print(cprl.estimates(cprl.evaluate_run(run, cprl.Fresh(episodes=5)), "agent_0/return", by="policy"))
