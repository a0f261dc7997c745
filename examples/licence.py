"""How to write a rule that remembers, as a transform: an agent's first shot in an episode costs a licence.
Prints what agents pay in each episode, in which licences become dearer."""

from functools import partial

import torch
from torchrl.envs import Transform

import cprl
from cprl import Game, Rules, maps
from cprl.population import Scripted
from cprl.runs.episodes import read_episodes


class Licence(Transform):
    """The price rises with each licence sold."""

    def __init__(self, fee=1.0, rise=0.0):
        super().__init__()
        self.fee, self.rise = fee, rise
        self.register_buffer("sold", torch.zeros(()))

    def transform_observation_spec(self, observation_spec):
        agents = observation_spec["agents"]
        agents["licensed"] = agents["fired"].clone()
        for name in {"fines", "transfers"} - set(agents.keys()):  # a game without institutions has neither
            agents[name] = agents["harvest"].clone()
        return observation_spec

    def _reset(self, tensordict, tensordict_reset):
        self.without_payments(tensordict_reset["agents"])
        nobody = torch.zeros_like(tensordict_reset["agents", "fired"])
        begun = None if tensordict is None else tensordict.get("_reset", None)  # bool [B, 1]; None for all
        kept = nobody if begun is None else tensordict.get(("agents", "licensed"), nobody) & ~begun
        tensordict_reset["agents", "licensed"] = kept
        return tensordict_reset

    def _step(self, tensordict, next_tensordict):
        agents, licensed = next_tensordict["agents"], tensordict["agents", "licensed"]
        self.without_payments(agents)
        buys = agents["fired"] & ~licensed
        price = (self.fee + self.rise * self.sold) * buys
        self.sold += buys.sum()
        agents["licensed"] = licensed | agents["fired"]
        agents["fines"] = agents["fines"] + price
        agents["reward"] = agents["reward"] - price.unsqueeze(-1)
        return next_tensordict

    def without_payments(self, agents):
        if not self.parent.base_env.game.institutions:
            agents["fines"] = agents["transfers"] = torch.zeros_like(agents["harvest"])


if __name__ == "__main__":  # so that other modules can import the class
    experiment = cprl.Experiment(
        name="licence",
        game=Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50)),
        agents=(Scripted("aggressive"),) * 2,
        episodes=3,
        evaluation_episodes=1,
        transforms=(partial(Licence, rise=0.5),),
    )
    fines = read_episodes(cprl.run(experiment, watch="off"))["fines"].to_pylist()
    print(f"fines by episode and agent: {fines}")
