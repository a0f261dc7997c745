"""LOLALearner: teams whose members learn with the others' learning in view."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule
from torchrl.objectives.value.functional import generalized_advantage_estimate

from cprl.commons.spaces import Spaces
from cprl.learners.buffer.rollout import refuse_full, rollout_fields, write_turn
from cprl.learners.checks import check_learner, refuse_other_parts
from cprl.learners.lanes import WEIGHTS, Lanes, StartFrom
from cprl.learners.lola.networks import LOLANetworks
from cprl.learners.lola.settings import LOLASettings
from cprl.learners.transitions import wanted_in
from cprl.objectives import LOLADiCELoss, dice_objective
from cprl.policies.lanes import LaneActor
from cprl.preferences.values import Preference
from cprl.preferences.wanted import WantedRewards

_SMALL: Final = 1e-8


class LOLALearner:
    """R teams of S agents that learn with opponent-learning awareness, from rollouts of T steps.

    An update takes P rollouts, one after the other in the worlds of the training. With `LOLALoss` they are
    two, of the present weights, which are its two independent batches. With `LOLADiCELoss` they are 1 + S:
    one of the present weights; then for each member one in which the others act by their weights ahead.
    Networks, evaluation and checkpoints have the present weights throughout.

    Each replica learns exactly as it would alone. Updates are not compiled.

    Args:
        spaces: the shape and dtype of observations, and the number of actions A.
        agents: the indices of the S members, two or more.
        replicas: the number of replicas R; each is one world of the environment.
        settings: the hyperparameters.
        make_network: makes a member's "actor" and "critic".
        make_loss: makes the loss, a `LOLALoss` or `LOLADiCELoss`, from an `nn.ModuleList` of the members'
            networks.
        seed: the seed of the run.
        first_replica: the index of the first replica, so that replica r can be trained alone.
        reward_kind: what they want, see `cprl.preferences`.
        compile: whether torch compiles acting.
        start_from: the weights with which actors start, by the lane's name; critics are new.
        device: the torch device of networks, rollouts and updates.

    Raises:
        ValueError: if the networks are not "actor" and "critic", or cannot be stacked.
        TooLargeError: if the device has less memory than rollouts and networks take.
    """

    def __init__(
        self,
        spaces: Spaces,
        *,
        agents: Sequence[int],
        replicas: int,
        settings: LOLASettings,
        make_network: Callable[[], nn.Module],
        make_loss: Callable[[nn.Module], LossModule],
        seed: int = 0,
        first_replica: int = 0,
        reward_kind: Preference = "individual",
        compile: bool = True,
        start_from: StartFrom | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check_learner(spaces, settings, LOLASettings, agents, replicas, first_replica, seed, reward_kind)
        self.spaces, self.settings, self.agents = spaces, settings, tuple(agents)
        self.replicas, self.seed, self.wants = replicas, seed, WantedRewards(reward_kind)
        self._lanes = Lanes(
            spaces,
            agents=agents,
            replicas=replicas,
            seed=seed,
            first_replica=first_replica,
            make_network=make_network,
            stochastic=True,
            start_from=start_from,
        )
        networks = self._lanes.new_networks(WEIGHTS, device)
        refuse_other_parts(networks[0])
        self.engine = LOLANetworks(networks, members=len(agents), make_loss=make_loss, settings=settings)
        self._looks_ahead = isinstance(self.engine.loss, LOLADiCELoss)
        self.rollouts = 1 + len(agents) if self._looks_ahead else 2
        """The number P of rollouts that an update takes."""
        self.actor = self._lanes.actor(self.engine.playing, compile=compile)
        size = self.rollouts, settings.rollout_steps
        self._rollouts = rollout_fields(spaces, self._lanes, size, torch.device(device))
        self._size, self._phase = 0, 0
        self.steps = 0

    def __repr__(self) -> str:
        return f"LOLALearner(agents={self.agents}, replicas={self.replicas})"

    @property
    def rollout_steps(self) -> int:
        """The length of a rollout, in steps."""
        return self.settings.rollout_steps

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor with the present weights, for `worlds` worlds of each replica."""
        return self._lanes.evaluation_actor(self.engine.acting, worlds, epsilon=0.0)

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each member's present acting network, by "replica_0/agent_0" and so on."""
        return self._lanes.networks(self.engine.acting)

    def begin(self) -> None:
        """Drops the rollouts that an earlier training left unfinished; see `Learner`."""
        self._size, self._phase = 0, 0
        self.engine.play(None)

    def store(self, batch: TensorDictBase) -> None:
        """Stores one step of every replica, as the collector yields it.

        Raises:
            ValueError: if the rollout is full: call `update` after each step, or after a number of steps that
                divides `rollout_steps`; and if the dtype of observations is not that of the spaces.
        """
        refuse_full(self._size, self.rollout_steps)
        turn = self._lanes.rollout_turn(batch, wanted_in(self.wants, batch))
        write_turn(self._rollouts, (self._phase, self._size), turn, self.spaces)
        self._size += 1
        self.steps += 1

    def update(self) -> Tensor | None:
        """Updates after the last rollout; returns each member's loss, [R, S], or None if there is no update.

        The loss is the mean discounted return of the pieces of rollouts of the present weights, negative.
        """
        if self._size < self.rollout_steps:
            return None
        self._size, self._phase = 0, self._phase + 1
        if self._phase < self.rollouts:
            if self._looks_ahead:
                self._play_ahead(self._phase - 1)
            return None
        self._phase = 0
        observation, rollouts, target = self._batch(self.rollouts)
        losses = self._losses(1 if self._looks_ahead else 2)
        self.engine.update_policies(rollouts.unsqueeze(2) if self._looks_ahead else rollouts)
        for _ in range(self.settings.critic_epochs):
            self.engine.update_critics(observation, target)
        self.engine.play(None)
        return losses

    def _play_ahead(self, member: int) -> None:
        """The next rollout is that of a member whose others have looked ahead."""
        if member == 0:
            _, rollouts, _ = self._batch(1)
            self.engine.look_ahead(rollouts)
        self.engine.play(member)

    def _columns(self, rollouts: int) -> dict[str, Tensor]:
        """The fields of the first rollouts, [R, P, T, S, ...]."""
        size = self.replicas, len(self.agents)
        return {
            name: field[:rollouts].reshape(rollouts, -1, *size, *field.shape[3:]).movedim(2, 0)
            for name, field in self._rollouts.items()
        }

    def _batch(self, rollouts: int) -> tuple[Tensor, TensorDict, Tensor]:
        """Of the first rollouts: observations [R, P, T, S, *shape], the input of the loss [R, P, T], and what
        critics should say, [R, P, T, S, 1]."""
        columns = self._columns(rollouts)
        with torch.no_grad():
            critics = self.engine.critics
            advantage, target = generalized_advantage_estimate(
                self.settings.gamma,
                self.settings.gae_lambda,
                critics.of_members(columns["observation"]),
                critics.of_members(columns["next_observation"]),
                *(columns[name].unsqueeze(-1) for name in ("reward", "done", "terminated")),
                time_dim=2,
            )
        if self.settings.normalize_advantage:
            advantage = advantage - advantage.mean(2, keepdim=True)
            advantage = advantage / (advantage.std(2, keepdim=True) + _SMALL)
        entries = {
            "observation": columns["observation"],
            "action": columns["action"],
            "advantage": advantage,
            "done": columns["done"][..., :1],
        }
        size = (self.replicas, rollouts, self.rollout_steps)
        return columns["observation"], TensorDict(entries, size), target

    def _losses(self, rollouts: int) -> Tensor:
        """The negative mean returns of the first rollouts, [R, S]."""
        columns = self._columns(rollouts)
        reward, done = columns["reward"], columns["done"][..., :1]
        returns = dice_objective(torch.zeros_like(reward), reward, gamma=self.settings.gamma, done=done)
        return -returns.mean(1)

    def end_episode(self, ended: Tensor) -> None:
        """Does nothing: a rollout continues into the next episode; returns do not cross the boundary."""

    def finite(self) -> Tensor:
        """Whether the weights and optimiser state of each member are finite, bool [R, S]."""
        return self.engine.finite()

    def values(self, batch: TensorDictBase) -> Tensor:
        """The value that each member's critic gives to the state after a turn, [R, S]."""
        with torch.no_grad():
            expected = self.engine.critics.outputs(self._lanes.seen_next(batch))
        return expected.reshape(self.replicas, len(self.agents))

    def state_dict(self) -> dict[str, Any]:
        """The full state of all teams; the tensors themselves, not copies.

        The entry "networks" repeats the acting weights of "update" in the form that `cprl.load` reads.
        """
        return {
            "networks": self._lanes.states(self.engine.acting),
            "update": self.engine.state_dict(),
            "rollouts": self._rollouts,
            "size": self._size,
            "phase": self._phase,
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
            "wants": self.wants.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from the state of a learner made with the same arguments."""
        self.engine.load_state_dict(state["update"])
        for name, field in self._rollouts.items():
            field.copy_(state["rollouts"][name])
        self.actor.rng.load_state_dict(state["exploration"])
        self._size, self._phase = int(state["size"]), int(state["phase"])
        self.steps = int(state["steps"])
        self.wants.load_state_dict(state.get("wants", {}))
