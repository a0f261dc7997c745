"""LaneLearner: independent DQN agents at some seats of every replica, learning in one step."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.acting.lanes import LaneActor
from cprl.commons.game import Game
from cprl.learning.dqn import dqn_loss, q_network
from cprl.learning.functional import MakeLoss
from cprl.learning.replay import lane_buffer
from cprl.learning.settings import DQNSettings
from cprl.learning.transitions import lane_turn, seen_next
from cprl.learning.updates import ListUpdate
from cprl.learning.ways import TRIAL_LANES, Way, make_update, trial_buffer

WEIGHTS, TARGET_WEIGHTS, EXPLORATION, SAMPLING, EVALUATION = range(5)
"""What a lane's random numbers are for."""

_LARGEST_SEED: Final = 2**63 - 1


def lane_seeds(
    seed: int, *, replicas: Sequence[int], seats: Sequence[int], purpose: int
) -> list[tuple[int, int, int, int]]:
    """A seed for each lane, replica by replica, of the run's seed, the replica, the agent and the purpose."""
    return [(seed, replica, agent, purpose) for replica in replicas for agent in seats]


class LaneLearner:
    """R x S independent DQN agents: seats S of each of R replicas.

    A lane has its own network, target, optimiser state, replay buffer, and randomness; its course is the
    one it would take alone. Learns through TorchRL's loss and replay buffer, see `cprl.learning.updates`.

    Args:
        game: what is played.
        seats: the numbers of the agents that learn.
        replicas: how many replicas R, the worlds of the environment.
        settings: the hyper-parameters.
        seed: of the run.
        first_replica: the number of the first replica, so that replica r can be trained alone.
        make_network: a lane's network; by default `QNetwork` by the settings. It draws its weights from
            torch's generator, which is seeded for each lane.
        make_loss: a lane's loss out of its network; by default `dqn_loss`.
        way: how lanes are updated; by default the fastest that fits, see `cprl.learning.ways`.
        compile: whether acting and the update are compiled, for the first two ways.
        device: where they learn.
    """

    def __init__(
        self,
        game: Game,
        *,
        seats: Sequence[int],
        replicas: int,
        settings: DQNSettings,
        seed: int = 0,
        first_replica: int = 0,
        make_network: Callable[[], nn.Module] | None = None,
        make_loss: MakeLoss | None = None,
        way: Way | None = None,
        compile: bool = True,
        device: str | torch.device = "cpu",
    ) -> None:
        self.game, self.settings, self.seats = game, settings, tuple(seats)
        self.replicas, self._numbers = replicas, range(first_replica, first_replica + replicas)
        self.seed = seed
        actions, shape = len(game.actions), game.observation_shape
        self._make_network = make_network or partial(
            q_network, shape, actions, settings=settings, highest=game.observation.highest
        )
        self.update = make_update(
            way,
            self._networks(WEIGHTS, device),
            make_loss or partial(dqn_loss, gamma=settings.gamma),
            target_networks=self._networks(TARGET_WEIGHTS, device) if settings.own_target_weights else None,
            learning_rate=settings.learning_rate,
            adam_eps=settings.adam_eps,
            loss_share=1 / actions if settings.mean_over_all_outputs else 1.0,
            compile=compile,
            trial=trial_buffer(min(self.lanes, TRIAL_LANES), shape, actions, device=device),
        )
        self.buffer = lane_buffer(
            seeds=self._seeds(SAMPLING),
            transitions=settings.buffer_size,
            batch_size=settings.batch_size,
            observation_shape=shape,
            device=device,
        )
        self.actor = LaneActor(
            self.update.outputs,
            actions,
            seeds=self._seeds(EXPLORATION),
            seats=len(self.seats),
            compile=compile and not isinstance(self.update, ListUpdate),
        )
        self.steps = 0
        self.actor.epsilon = settings.epsilon(0)
        self._episodes = torch.zeros(replicas, dtype=torch.int64)

    @property
    def lanes(self) -> int:
        """The number of lanes, replicas x seats."""
        return self.replicas * len(self.seats)

    def _networks(self, purpose: int, device: str | torch.device) -> list[nn.Module]:
        """A new network for each lane."""
        return [_drawn(self._make_network, own).to(device) for own in self._seeds(purpose)]

    def _seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        return lane_seeds(self.seed, replicas=self._numbers, seats=self.seats, purpose=purpose)

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor by the present weights, with `epsilon_evaluation`, for so many worlds of each replica."""
        actor = LaneActor(
            self.update.outputs,
            len(self.game.actions),
            seeds=self._seeds(EVALUATION),
            seats=len(self.seats),
            worlds=worlds,
        )
        actor.epsilon = self.settings.epsilon_evaluation
        return actor

    def networks(self) -> dict[str, nn.Module]:
        """A copy of every lane's network with its present weights, by "replica_0/agent_0" and so on."""
        made = {}
        for name, weights in self._weights().items():
            made[name] = self._make_network()
            made[name].load_state_dict(weights)
        return made

    def _weights(self) -> dict[str, dict[str, Tensor]]:
        """The state dict of each lane's network, by the name in `networks`."""
        names = [f"replica_{replica}/agent_{agent}" for _, replica, agent, _ in self._seeds(WEIGHTS)]
        return {name: self.update.network_state(lane) for lane, name in enumerate(names)}

    def remember(self, batch: TensorDictBase) -> None:
        """Stores a turn of every replica, as the collector yields it."""
        self.buffer.storage.write(lane_turn(self.seats, batch))
        self.steps += 1
        self.actor.explore_with(self.settings.epsilon(self.steps))

    def learn(self) -> Tensor | None:
        """One update of every lane; their losses [R, S], or None while too little is stored."""
        if self.steps < self.settings.learning_starts:
            return None
        return self.update.learn(self.buffer).view(self.replicas, len(self.seats))

    def end_episode(self, ended: Tensor) -> None:
        """Counts an episode of the marked replicas, bool [R]; targets are replaced after every so many."""
        self._episodes += ended
        due = ended & (self._episodes % self.settings.target_every_episodes == 0)
        if due.any():
            self.update.copy_to_targets(due.repeat_interleave(len(self.seats)))

    def values(self, batch: TensorDictBase) -> Tensor:
        """The highest value of each agent's actions at the end of a turn, [R, S]."""
        seen = seen_next(batch)[:, list(self.seats)].flatten(0, 1).unsqueeze(1)
        with torch.no_grad():
            return self.update.outputs(seen).amax(-1).view(self.replicas, len(self.seats))

    def state_dict(self) -> dict[str, Any]:
        """Everything that the future of all lanes depends on; own tensors, not copies.

        "networks" besides, which says the same as "update" in a form that `cprl.load` reads.
        """
        return {
            "networks": self._weights(),
            "update": self.update.state_dict(),
            "storage": self.buffer.storage.state_dict(),
            "sampler": self.buffer.sampler.state_dict(),
            "exploration": self.actor.draws.state_dict(),
            "steps": self.steps,
            "episodes": self._episodes,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on where the learner of that state was, which was made with the same arguments."""
        self.update.load_state_dict(state["update"])
        self.buffer.storage.load_state_dict(state["storage"])
        self.buffer.sampler.load_state_dict(state["sampler"])
        self.actor.draws.load_state_dict(state["exploration"])
        self.steps = int(state["steps"])
        self.actor.epsilon = self.settings.epsilon(self.steps)
        self._episodes = state["episodes"].clone()


def _drawn(make_network: Callable[[], nn.Module], seed: Sequence[int]) -> nn.Module:
    """A network whose weights follow from a seed alone; torch's generator goes on as if nothing happened."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] & _LARGEST_SEED))
        return make_network()
