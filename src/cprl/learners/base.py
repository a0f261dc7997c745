"""What the training loop asks of a learner, whatever it learns by."""

from collections.abc import Mapping
from typing import Any, Protocol

from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.keys import Turn
from cprl.objectives.rewards import RewardModel


class AnyLearner(Protocol):
    """Learns for S agents of each of R replicas in W worlds; `Learner` is one."""

    settings: Any
    """The hyperparameters."""
    agents: tuple[int, ...]
    """The indices of its agents."""
    replicas: int
    worlds: int
    actor: Any
    """Chooses the actions of these agents; callbacks get its `epsilon`."""
    rewards: RewardModel
    """What they want."""
    steps: int
    """Steps of each replica that were stored: a turn of W worlds is W."""

    def begin(self) -> None:
        """Called before the first turn of a training: whatever is stored of an earlier one, the next turn
        begins new episodes."""

    def store(self, batch: TensorDictBase | Turn) -> None:
        """Stores one turn of every world, of batch size [B], as collectors yield it."""

    def update(self) -> Tensor | None:
        """Updates every agent as often as a turn asks for; returns the mean losses [R, S], or None if too
        little is stored."""

    def end_episode(self, ended: Tensor) -> None:
        """Called after an episode has ended in the marked worlds, bool [B]."""

    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        """Each agent's estimate of the value of the state after the turn, [B, S]; for display only."""
        ...

    def finite(self) -> Tensor:
        """Whether everything that the learner keeps of each agent is finite, above all weights and targets,
        bool [R, S]; called at the end of episodes and before the state is saved."""
        ...

    def evaluation_actor(self, worlds: int) -> Any:
        """An actor with the current weights and the exploration of evaluation, for `worlds` worlds of each
        replica."""

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each agent's current acting network, by "replica_0/agent_0" and so on."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """The full state, the tensors themselves, not copies: training continues from it exactly."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
