"""LOLA: agents that learn with the others' learning in view."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from torch import nn
from torchrl.objectives import LossModule

from cprl.algorithms.actor_critic import policy
from cprl.algorithms.base import TeamAlgorithm, TrainingEngine
from cprl.algorithms.on_policy import actor_and_critic
from cprl.commons.spaces import Spaces
from cprl.custom import Custom
from cprl.learners.base import Learner
from cprl.learners.lola.learner import LOLALearner
from cprl.learners.lola.settings import LOLASettings
from cprl.networks.specification import Network
from cprl.objectives import LOLADiCELoss, LOLALoss
from cprl.preferences.values import Preference


@dataclass(frozen=True, kw_only=True)
class LOLA(TeamAlgorithm):
    """Learning with opponent-learning awareness: each member expects the others to take a naive learning
    step, which depends on what it does, and learns what is good for it after that step.

    Members read each other's weights when they learn; they act on their own observations. Meant for rewards
    of their own, `Team(LOLA(...), agents=(0, 1), reward="individual")`. With more than two members the terms
    of all pairs are summed. Losses: `cprl.objectives.LOLALoss`, `LOLADiCELoss`. The engine "compiled"
    compiles acting alone.

    Source: Foerster et al., "Learning with Opponent-Learning Awareness" (2018), and "DiCE: The Infinitely
    Differentiable Monte Carlo Estimator" (2018); docs/algorithms.md lists the departures.
    """

    settings: LOLASettings
    estimator: Literal["policy_gradient", "dice"] = "policy_gradient"
    """How the others' step is judged: "policy_gradient", to first order, from two rollouts of the present
    weights; "dice", by a rollout for each member in which the others act as after their step. All rollouts
    are turns of the training's own episodes; evaluation always has the present weights."""
    entropy_coeff: float = 0.0
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    settings_kind: ClassVar[type[Any]] = LOLASettings
    stochastic: ClassVar[bool] = True
    shares_reward: ClassVar[bool] = False
    fewest_members: ClassVar[int] = 2

    def make_network(self, spaces: Spaces) -> nn.Module:
        """New networks of one member: "actor" and "critic"."""
        return actor_and_critic(spaces, self.settings, self.network)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        """The members' networks in a row, as `make_loss` reads them."""
        return nn.ModuleList(members)

    def make_loss(self, network: nn.Module) -> LossModule:
        """The loss of a team, from `make_team`."""
        of_members: Any = network
        actors = [policy(own["actor"]) for own in of_members]
        how: dict[str, Any] = {
            "look_ahead_rate": self.settings.look_ahead_rate,
            "gamma": self.settings.gamma,
            "entropy_coeff": self.entropy_coeff,
        }
        return LOLADiCELoss(actors, **how) if self.estimator == "dice" else LOLALoss(actors, **how)

    def make_learner(
        self,
        spaces: Spaces,
        *,
        agents: Sequence[int],
        engine: TrainingEngine = "compiled",
        reward_kind: Preference = "individual",
        **how: Any,
    ) -> Learner:
        """See `Algorithm`."""
        self._refuse_torchrl(engine)
        self._check_settings()
        self._check_team(len(agents), reward_kind)
        return LOLALearner(
            spaces,
            agents=agents,
            settings=self.settings,
            make_network=lambda: self.make_network(spaces),
            make_loss=self.make_loss,
            reward_kind=reward_kind,
            compile=engine == "compiled",
            **how,
        )
