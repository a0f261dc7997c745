"""A game that is no commons: two agents, two actions, a matrix of payoffs; no more than TorchRL asks for."""

import torch
from tensordict import TensorDict
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

PAYOFFS = torch.tensor([[[3.0, 3.0], [0.0, 4.5]], [[4.5, 0.0], [1.0, 1.0]]])
"""[own action, other's action, agent], of a prisoner's dilemma: 0 cooperates, 1 defects."""
DONES = ("done", "terminated", "truncated")


class MatrixGame(EnvBase):
    """B worlds of a repeated matrix game; an agent observes the last joint action, one-hot, zeros at first.

    World b plays `steps + b` turns. A world that has ended must be reset: it refuses to be stepped.

    Args:
        worlds: B.
        steps: turns of an episode of the first world.
        with_harvest: whether the entry "harvest" comes along, here the reward.
    """

    batch_locked = True

    def __init__(self, worlds=1, *, steps=5, with_harvest=False):
        super().__init__(batch_size=torch.Size([worlds]))
        self.steps, self.with_harvest = steps + torch.arange(worlds)[:, None], with_harvest
        self.register_buffer("turn", torch.zeros(worlds, 1, dtype=torch.int64))
        of_agents = (worlds, 2)

        def group(**specs):
            return Composite(agents=Composite(**specs, shape=of_agents), shape=(worlds,))

        seen = {"observation": Unbounded(shape=(*of_agents, 4), dtype=torch.float32)}
        if with_harvest:
            seen["harvest"] = Unbounded(shape=of_agents, dtype=torch.float32)
        self.observation_spec = group(**seen)
        self.action_spec = group(action=Categorical(2, shape=of_agents, dtype=torch.int64))
        self.reward_spec = group(reward=Unbounded(shape=(*of_agents, 1), dtype=torch.float32))
        self.done_spec = Composite(
            {name: Categorical(2, shape=(worlds, 1), dtype=torch.bool) for name in DONES}, shape=(worlds,)
        )

    def _moment(self, observation, ended, **agents):
        (worlds,) = self.batch_size
        if self.with_harvest:
            agents.setdefault("harvest", torch.zeros(worlds, 2))
        dones = {"done": ended, "terminated": torch.zeros_like(ended), "truncated": ended.clone()}
        group = TensorDict({"observation": observation, **agents}, [worlds, 2])
        return TensorDict({"agents": group, **dones}, [worlds])

    def _reset(self, tensordict=None, **kwargs):
        (worlds,) = self.batch_size
        which = None if tensordict is None else tensordict.get("_reset", None)
        which = torch.ones(worlds, 1, dtype=torch.bool) if which is None else which.reshape(worlds, 1)
        self.turn = torch.where(which, 0, self.turn)
        return self._moment(torch.zeros(worlds, 2, 4), torch.zeros(worlds, 1, dtype=torch.bool))

    def _step(self, tensordict):
        if (self.turn >= self.steps).any():
            raise RuntimeError("a world that has ended is stepped")
        self.turn = self.turn + 1
        first, second = tensordict["agents", "action"].unbind(1)
        joint = torch.nn.functional.one_hot(2 * first + second, 4).to(torch.float32)
        paid = PAYOFFS[first, second]
        harvest = {"harvest": paid.clone()} if self.with_harvest else {}
        observation = joint[:, None].expand(-1, 2, -1).clone()
        ended = self.turn >= self.steps
        return self._moment(observation, ended, reward=paid.unsqueeze(-1), **harvest)

    def _set_seed(self, seed):
        """Nothing is left to chance."""


def tit_for_tat(tensordict):
    """Agent 0 begins by cooperating and copies what agent 1 did last; agent 1 always defects."""
    seen = tensordict["agents", "observation"][:, 0]
    action = torch.ones(len(seen), 2, dtype=torch.int64)
    action[:, 0] = (seen[:, 1] + seen[:, 3]).long()
    return tensordict.set(("agents", "action"), action)
