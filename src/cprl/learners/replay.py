"""ReplayLearner: independent agents at some seats of every replica, learning from replay in one step."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.commons.game import Game
from cprl.learners.buffer.sampler import lane_buffer
from cprl.learners.engine.choice import TRIAL_LANES, EngineName, make_engine, trial_batch
from cprl.learners.engine.functional import MakeLoss, refuse_on_policy
from cprl.learners.lanes import SAMPLING, TARGET_WEIGHTS, WEIGHTS, Lanes
from cprl.learners.settings import DQNSettings
from cprl.learners.single import dqn_loss, q_network
from cprl.learners.teams import MakeTeam, Teams
from cprl.learners.transitions import RewardKind
from cprl.policies.lanes import LaneActor


class ReplayLearner:
    """R x S independent agents, DQN by default: seats S of each of R replicas.

    A lane has its own network, target, optimiser state, replay buffer, and randomness; its course is the
    one it would take alone. Learns through TorchRL's loss and replay buffer, see `cprl.learners.engine.base`.

    Args:
        game: what is played.
        agents: the numbers of the agents that learn.
        replicas: how many replicas R, the worlds of the environment.
        settings: the hyper-parameters.
        seed: of the run.
        first_replica: the number of the first replica, so that replica r can be trained alone.
        make_network: a lane's network; by default `MLPNetwork` by the settings. It draws its weights from
            torch's generator, which is seeded for each lane.
        make_loss: a lane's loss out of its network; by default `dqn_loss`.
        make_team: where agents learn as a team: its networks out of its members', see
            `cprl.algorithms.teams`; a lane is then all agents of a replica.
        stochastic: whether networks give the logits of a policy, from which agents that explore draw their
            actions, else values; then `epsilon` of the settings is none.
        reward_kind: what they are paid.
        engine: how lanes are updated; by default the fastest that fits, see `cprl.learners.engine.choice`.
        compile: whether acting and the update are compiled, for the first two ways.
        device: where they learn.

    Raises:
        ValueError: for a loss that wants what the present policy has just done; see
            `cprl.learners.rollouts`; for a team that is not paid for the group.
    """

    def __init__(
        self,
        game: Game,
        *,
        agents: Sequence[int],
        replicas: int,
        settings: DQNSettings,
        seed: int = 0,
        first_replica: int = 0,
        make_network: Callable[[], nn.Module] | None = None,
        make_loss: MakeLoss | None = None,
        make_team: MakeTeam | None = None,
        stochastic: bool = False,
        reward_kind: RewardKind = "own",
        engine: EngineName | None = None,
        compile: bool = True,
        device: str | torch.device = "cpu",
    ) -> None:
        _refuse_what_does_not_fit(settings, is_team=make_team is not None, reward_kind=reward_kind)
        self.game, self.settings, self.agents = game, settings, tuple(agents)
        self.replicas, self.seed, self.reward_kind = replicas, seed, reward_kind
        actions, shape = len(game.actions), game.observation_shape
        make_loss = make_loss or partial(dqn_loss, gamma=settings.gamma)
        lanes = Lanes(
            game,
            agents=agents,
            replicas=replicas,
            seed=seed,
            first_replica=first_replica,
            make_network=make_network
            or partial(q_network, shape, actions, settings=settings, highest=game.observation.highest),
            stochastic=stochastic,
        )
        self._lanes: Lanes | Teams = Teams(lanes, make_team) if make_team else lanes
        networks = self._lanes.new_networks(WEIGHTS, device)
        refuse_on_policy(make_loss(deepcopy(networks[0])))
        shapes = {
            "observation_shape": self._lanes.observation_shape,
            "action_shape": self._lanes.action_shape,
        }
        own_targets = settings.own_target_weights
        self.engine = make_engine(
            engine,
            networks,
            make_loss,
            target_networks=self._lanes.new_networks(TARGET_WEIGHTS, device) if own_targets else None,
            learning_rate=settings.learning_rate,
            adam_eps=settings.adam_eps,
            loss_share=1 / actions if settings.mean_over_all_outputs else 1.0,
            compile=compile,
            trial=trial_batch(min(self.lanes, TRIAL_LANES), actions=actions, **shapes, device=device),
        )
        self.buffer = lane_buffer(
            seeds=self._lanes.seeds(SAMPLING),
            transitions=settings.buffer_size,
            batch_size=settings.batch_size,
            **shapes,
            device=device,
        )
        self.actor = self._lanes.actor(self.engine, compile=compile)
        self.steps = 0
        self.actor.epsilon = settings.epsilon(0)
        self._episodes = torch.zeros(replicas, dtype=torch.int64)

    @property
    def lanes(self) -> int:
        """The number of lanes, replicas x seats, or of teams."""
        return len(self._lanes)

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor by the present weights, with `epsilon_evaluation`, for so many worlds of each replica."""
        return self._lanes.evaluation_actor(self.engine, worlds, epsilon=self.settings.epsilon_evaluation)

    def networks(self) -> dict[str, nn.Module]:
        """A copy of every lane's acting network as it is now, by "replica_0/agent_0" and so on."""
        return self._lanes.networks(self.engine)

    def store(self, batch: TensorDictBase) -> None:
        """Stores a turn of every replica, as the collector yields it."""
        self.buffer.storage.write(self._lanes.turn(batch, self.reward_kind))
        self.steps += 1
        self.actor.explore_with(self.settings.epsilon(self.steps))

    def update(self) -> Tensor | None:
        """One update of every lane; their losses [R, S], or None while too little is stored."""
        if self.steps < self.settings.learning_starts:
            return None
        return self._lanes.by_agent(self.engine.update(self.buffer))

    def end_episode(self, ended: Tensor) -> None:
        """Counts an episode of the marked replicas, bool [R]; targets are replaced after every so many."""
        self._episodes += ended
        due = ended & (self._episodes % self.settings.target_every_episodes == 0)
        if due.any():
            self.engine.copy_to_targets(due.repeat_interleave(self._lanes.of_replica))

    def values(self, batch: TensorDictBase) -> Tensor:
        """The highest value of each agent's actions at the end of a turn, [R, S]; NaN where its network gives
        a policy."""
        if self._lanes.stochastic:
            return torch.full((self.replicas, len(self.agents)), torch.nan)
        with torch.no_grad():
            highest = self.engine.outputs(self._lanes.seen_next(batch)).amax(-1)
        return highest.view(self.replicas, len(self.agents))

    def state_dict(self) -> dict[str, Any]:
        """Everything that the future of all lanes depends on; own tensors, not copies.

        "networks" besides, which says the same as "update" in a form that `cprl.load` reads.
        """
        return {
            "networks": self._lanes.states(self.engine),
            "update": self.engine.state_dict(),
            "storage": self.buffer.storage.state_dict(),
            "sampler": self.buffer.sampler.state_dict(),
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
            "episodes": self._episodes,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on where the learner of that state was, which was made with the same arguments."""
        self.engine.load_state_dict(state["update"])
        self.buffer.storage.load_state_dict(state["storage"])
        self.buffer.sampler.load_state_dict(state["sampler"])
        self.actor.rng.load_state_dict(state["exploration"])
        self.steps = int(state["steps"])
        self.actor.epsilon = self.settings.epsilon(self.steps)
        self._episodes = state["episodes"].clone()


def _refuse_what_does_not_fit(settings: DQNSettings, *, is_team: bool, reward_kind: RewardKind) -> None:
    if settings.priority_alpha:
        raise ValueError(
            f"priority_alpha is {settings.priority_alpha}; lanes sample uniformly, 0 is what fits, or a "
            "plain DQNLearner for each agent"
        )
    if is_team and reward_kind != "group":
        raise ValueError(
            f'paid is "{reward_kind}"; a team that learns from replay shares one reward, "group"'
        )
