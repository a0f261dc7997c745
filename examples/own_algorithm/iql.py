"""How to write an algorithm of several networks: IQL, implicit Q-learning, which draws from a policy.
Prints how likely each of two agents takes its likeliest action in the first turn."""

from dataclasses import dataclass
from typing import Annotated

from torchrl.objectives import DiscreteIQLLoss

import cprl
from cprl import Game, Rules, maps
from cprl.algorithms import DQNSettings, OffPolicy
from cprl.algorithms.base import module_of, policy
from cprl.objectives.td import TorchRLDistance
from cprl.population import Learning
from cprl.values import Range


@dataclass(frozen=True, kw_only=True)
class IQL(OffPolicy):
    """TorchRL's `DiscreteIQLLoss` (Kostrikov, Nair and Levine 2021), which never asks for the value of an
    action that was not taken. Implicit, not independent."""

    expectile: Annotated[float, Range(0.5, 0.999)] = 0.7
    """The expectile of the action values that the state value estimates, 0.5..0.999."""
    temperature: Annotated[float, Range(0, 1e6)] = 3.0
    """The inverse temperature of the advantage weights, in 1/reward (1/apples)."""
    loss_function: TorchRLDistance = "l2"
    stochastic = True  # the acting network gives logits, from which actions are drawn
    update = "vmapped"  # each agent by itself, at once; without this line, the fastest way is found

    def make_network(self, spaces):
        actions = spaces.actions
        return self.new_networks(spaces, actor=actions, critic_0=actions, critic_1=actions, value=1)

    def make_loss(self, network):
        self.refuse_relu()
        loss = DiscreteIQLLoss(
            policy(network["actor"]),
            [module_of(network[name], "state_action_value") for name in ("critic_0", "critic_1")],
            module_of(network["value"], "state_value"),
            action_space="categorical",
            num_qvalue_nets=2,
            loss_function=self.loss_function,
            temperature=self.temperature,
            expectile=self.expectile,
        )
        return self.bootstrapped(loss)


if __name__ == "__main__":
    game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
    agent = Learning(IQL(settings=DQNSettings(learning_rate=1e-3, gamma=0.9, tau=0.05)))
    experiment = cprl.Experiment(name="iql", game=game, agents=(agent, agent), episodes=10)
    run = cprl.load(cprl.run(experiment, watch="off"))
    seen = run.env(worlds=1).reset()["agents", "observation"][0]
    for (lane, network), observation in zip(run.networks.items(), seen, strict=True):
        print(f"{lane}: {network(observation).softmax(-1).max():.2f}")
