"""How to add a rule of your own, as a transform of the environment: an agent's beam costs a fee.
Prints how often agents fire, and what they pay, for three fees."""

from functools import partial

import torch
from torchrl.envs import Transform

import cprl
from cprl import Game, Rules, maps
from cprl.population import Scripted
from cprl.runs.episodes import read_episodes


class Fee(Transform):
    """Whoever fires pays a fee."""

    def __init__(self, fee):
        super().__init__()
        self.fee = fee

    def transform_observation_spec(self, observation_spec):
        for name in ("fines", "transfers"):  # so that tables and metrics have what the rule takes and gives
            observation_spec["agents", name] = observation_spec["agents", "harvest"].clone()
        return observation_spec

    def _reset(self, tensordict, tensordict_reset):
        return self._charge(tensordict_reset)

    def _step(self, tensordict, next_tensordict):
        next_tensordict = self._charge(next_tensordict)
        agents = next_tensordict["agents"]  # of all worlds, [B, N]
        agents["reward"] = agents["reward"] - agents["fines"].unsqueeze(-1)
        return next_tensordict

    def _charge(self, turn):
        agents = turn["agents"]
        agents["fines"] = self.fee * agents["fired"].to(agents["harvest"].dtype)
        agents["transfers"] = torch.zeros_like(agents["harvest"])
        return turn


game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
for fee in (0.0, 0.1, 0.5):
    experiment = cprl.Experiment(
        name=f"fee_{fee}",
        game=game,
        agents=(Scripted("aggressive"),) * 2,  # or who learns what a beam costs
        episodes=5,
        evaluation_episodes=1,
        transforms=(partial(Fee, fee=fee),),
    )
    played = read_episodes(cprl.run(experiment, watch="off"))
    shots, fines = (sum(played[name].to_pylist()) for name in ("shots", "fines"))
    print(f"fee {fee}: {shots} shots, which cost {fines:.1f} apples")
