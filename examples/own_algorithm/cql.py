"""How to write an algorithm from a loss of TorchRL's with changes: CQL, conservative Q-learning.
Prints what two agents learned the best action to be worth in the first turn."""

from dataclasses import dataclass
from typing import Annotated

from torchrl.objectives import DiscreteCQLLoss

import cprl
from cprl import Game, Rules, maps
from cprl.algorithms import DQNSettings, OffPolicy
from cprl.algorithms.base import q_actor
from cprl.objectives.td import TorchRLDistance
from cprl.population import Learning
from cprl.values import Range


@dataclass(frozen=True, kw_only=True)
class CQL(OffPolicy):
    """TorchRL's `DiscreteCQLLoss` (Kumar et al. 2020): half the temporal-difference loss, plus a conservative
    term that lowers the values of actions that were not taken."""

    conservative_weight: Annotated[float, Range(0, 1e6)] = 0.1
    """The weight of the conservative term. TorchRL's weight is 1, for fixed data sets; with it, agents that
    explore imitate their first random actions (`tests/algorithms/test_optimum.py`)."""
    loss_function: TorchRLDistance = "l2"
    update = "stacked"  # all agents in one batch; without this line, the fastest way that works is found

    def make_loss(self, network):
        actor = q_actor(network)  # of the network of `OffPolicy`, from observations to action values
        options = {"loss_function": self.loss_function, "action_space": "categorical"}
        loss = WeightedCQLLoss(actor, weight=self.conservative_weight, delay_value=True, **options)
        bootstrap_from_target(self.bootstrapped(loss).value_estimator)
        return loss


class WeightedCQLLoss(DiscreteCQLLoss):
    """`DiscreteCQLLoss` with a weight for the conservative term."""

    def __init__(self, actor, *, weight, **options):
        super().__init__(actor, **options)
        self.weight = weight

    def cql_loss(self, tensordict):
        loss, metadata = super().cql_loss(tensordict)
        return self.weight * loss, metadata


def bootstrap_from_target(estimator):
    """Make the estimator of a `DiscreteCQLLoss` bootstrap from the target network.

    The loss passes the target weights as `params`, but its estimator ignores them and would bootstrap from
    the network itself.
    """
    estimate = estimator.value_estimate

    def by_target(tensordict, *, params):
        return estimate(tensordict, target_params=params)

    estimator.value_estimate = by_target


if __name__ == "__main__":
    game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
    settings = DQNSettings(learning_rate=1e-3, gamma=0.9, epsilon_decay_steps=500)
    agent = Learning(CQL(settings=settings))
    experiment = cprl.Experiment(name="cql", game=game, agents=(agent, agent), episodes=10)
    run = cprl.load(cprl.run(experiment, watch="off"))
    seen = run.env(worlds=1).reset()["agents", "observation"][0]
    for (lane, network), observation in zip(run.networks.items(), seen, strict=True):
        print(f"{lane}: {network(observation).max():.2f} apples")
