"""AnyLearner: the interface between the training loop and learners of any kind."""

from collections.abc import Mapping
from typing import Any, Protocol

from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.keys import Turn
from cprl.objectives.rewards import RewardModel


class AnyLearner(Protocol):
    """A learner of S agents of each of R replicas, which play in W worlds each; e.g. a `Learner`.

    The training loop calls `begin` once, then in each turn `store`, `update` and `end_episode`.
    """

    settings: Any
    """The hyperparameters."""
    agents: tuple[int, ...]
    """The indices of its agents in the game."""
    replicas: int
    """The number of replicas R."""
    worlds: int
    """The number of worlds W in which each replica plays."""
    actor: Any
    """Chooses the actions of these agents; callbacks get its `epsilon`."""
    rewards: RewardModel
    """Computes the shaped rewards of these agents from the rewards of all agents."""
    steps: int
    """The steps stored for each replica; a turn of W worlds is W steps."""

    def begin(self) -> None:
        """Prepare for a training: its first turn begins new episodes and does not follow a stored turn."""

    def store(self, batch: TensorDictBase | Turn) -> None:
        """Store one turn of every world, a TensorDict [B] as TorchRL's collectors yield it."""

    def update(self) -> Tensor | None:
        """Take all updates that are due after a turn; return the mean loss of each agent, [R, S], or None if
        no update is due."""

    def end_episode(self, ended: Tensor) -> None:
        """Count the episodes that have ended in the marked worlds, bool [B]."""

    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        """Estimate the value of the state after the turn for each agent, [B, S]; for display only."""
        ...

    def finite(self) -> Tensor:
        """Return for each agent whether all its numbers, above all weights and targets, are finite, bool
        [R, S]; called at the end of episodes and before the state is saved."""
        ...

    def evaluation_actor(self, worlds: int) -> Any:
        """Return an actor with the current weights and the exploration of evaluations, which plays in
        `worlds` worlds of each replica."""

    def networks(self) -> dict[str, nn.Module]:
        """Return copies of the agents' current acting networks, by name: "replica_0/agent_0" and so on."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return the full state, from which training continues exactly; the tensors are not copied."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that `state_dict` returned."""
