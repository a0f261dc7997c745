"""RolloutLearner: independent on-policy agents at some seats of every replica."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives.value.functional import generalized_advantage_estimate

from cprl.commons.game import Game
from cprl.learners.engine.choice import TRIAL_LANES, EngineName, make_engine, trial_batch
from cprl.learners.engine.functional import MakeLoss
from cprl.learners.lanes import SAMPLING, WEIGHTS, Lanes
from cprl.learners.settings import RolloutSettings
from cprl.learners.teams import MakeTeam, Teams
from cprl.learners.transitions import RewardKind
from cprl.networks.agent import AgentNetworks, parts_of
from cprl.policies.lanes import LaneActor
from cprl.policies.rng import LaneRng

ACTOR, CRITIC = range(2)
"""Which of an agent's networks is which."""

_SMALL: Final = 1e-8


class RolloutLearner:
    """R x S independent agents that learn from what their present policies have just done.

    Every `rollout_steps` steps TorchRL's generalised advantage estimate is made of them, and the loss is
    taken `epochs` times over them in minibatches, drawn anew by each lane for itself. A lane's course is the
    one it would take alone.

    Args:
        game: what is played.
        agents: the numbers of the agents that learn.
        replicas: how many replicas R, the worlds of the environment.
        settings: the hyper-parameters.
        make_network: an agent's "actor" and "critic", see `cprl.algorithms.on_policy`.
        make_loss: an agent's loss out of them.
        make_team: where agents learn as a team: its "actor" and "critic" out of its members' networks, see
            `cprl.algorithms.teams`; a lane is then all seats of a replica.
        seed: of the run.
        first_replica: the number of the first replica, so that replica r can be trained alone.
        reward_kind: what they are paid.
        engine: how lanes are updated; by default the fastest that fits, see `cprl.learners.engine.choice`.
        compile: whether acting and the update are compiled.
        device: where they learn.

    Raises:
        ValueError: for networks that are not an actor and a critic.
    """

    def __init__(
        self,
        game: Game,
        *,
        agents: Sequence[int],
        replicas: int,
        settings: RolloutSettings,
        make_network: Callable[[], nn.Module],
        make_loss: MakeLoss,
        make_team: MakeTeam | None = None,
        seed: int = 0,
        first_replica: int = 0,
        reward_kind: RewardKind = "own",
        engine: EngineName | None = None,
        compile: bool = True,
        device: str | torch.device = "cpu",
    ) -> None:
        self.game, self.settings, self.agents = game, settings, tuple(agents)
        self.replicas, self.seed, self.reward_kind = replicas, seed, reward_kind
        lanes = Lanes(
            game,
            agents=agents,
            replicas=replicas,
            seed=seed,
            first_replica=first_replica,
            make_network=make_network,
            stochastic=True,
        )
        self._lanes: Lanes | Teams = Teams(lanes, make_team) if make_team else lanes
        networks = self._lanes.new_networks(WEIGHTS, device)
        _refuse_other_parts(networks[0])
        trial = trial_batch(
            min(self.lanes, TRIAL_LANES),
            self._lanes.observation_shape,
            len(game.actions),
            action_shape=self._lanes.action_shape,
            device=device,
        )
        self.engine = make_engine(
            engine,
            networks,
            make_loss,
            learning_rate=settings.learning_rate,
            adam_eps=settings.adam_eps,
            max_grad_norm=settings.max_grad_norm,
            compile=compile,
            trial=trial_rollout(trial),
        )
        self.actor = self._lanes.actor(self.engine, compile=compile)
        self.rng = LaneRng(self._lanes.seeds(SAMPLING), settings.rollout_steps)
        self._rollout = self._room(torch.device(device))
        self._size = 0
        self.steps = 0

    @property
    def lanes(self) -> int:
        """The number of lanes, replicas x seats, or of teams."""
        return len(self._lanes)

    @property
    def rollout_steps(self) -> int:
        """Steps of a rollout."""
        return self.settings.rollout_steps

    def _room(self, device: torch.device) -> dict[str, Tensor]:
        """Memory for a rollout, [T, L, ...] each."""
        size, shape = (self.rollout_steps, self.lanes), self._lanes.observation_shape
        forms: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
            "observation": (shape, torch.uint8),
            "action": (self._lanes.action_shape, torch.int64),
            "next_observation": (shape, torch.uint8),
            "reward": (self._lanes.action_shape, torch.float32),
            "done": ((), torch.bool),
            "terminated": ((), torch.bool),
        }
        return {
            name: torch.zeros((*size, *of_one), dtype=kind, device=device)
            for name, (of_one, kind) in forms.items()
        }

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor by the present weights, for so many worlds of each replica."""
        return self._lanes.evaluation_actor(self.engine, worlds, epsilon=0.0)

    def networks(self) -> dict[str, nn.Module]:
        """A copy of every lane's acting network as it is now, by "replica_0/agent_0" and so on."""
        return self._lanes.networks(self.engine)

    def store(self, batch: TensorDictBase) -> None:
        """Takes a turn of every replica, as the collector yields it.

        Raises:
            ValueError: where the rollout is full: agents learn after each step, or a number of steps that
                divides `rollout_steps`.
        """
        if self._size == self.rollout_steps:
            raise ValueError(f"a rollout has {self.rollout_steps} steps; learn from it before the next")
        turn = self._lanes.rollout_turn(batch, self.reward_kind)
        for name, room in self._rollout.items():
            room[self._size] = torch.as_tensor(getattr(turn, name))
        self._size += 1
        self.steps += 1

    def update(self) -> Tensor | None:
        """All epochs over a full rollout; the mean losses [R, S], or None while it is not full."""
        if self._size < self.rollout_steps:
            return None
        batch, size = self._batch(), self.settings.minibatch_size
        lane = torch.arange(self.lanes, device=batch["action"].device)[:, None]
        losses = []
        for _ in range(self.settings.epochs):
            order = self.rng.next().argsort(-1).to(lane.device)
            for first in range(0, self.rollout_steps, size):
                place = order[:, first : first + size]
                losses.append(self.engine.update_from(batch[lane, place]))
        self._size = 0
        return self._lanes.by_agent(torch.stack(losses).mean(0))

    def _batch(self) -> TensorDict:
        """The rollout with advantages, [L, T], as TorchRL's losses read it; normalised within each lane."""
        columns = {name: room.transpose(0, 1) for name, room in self._rollout.items()}
        with torch.no_grad():
            chances = self.engine.outputs(columns["observation"], part=ACTOR).log_softmax(-1)
            value = self.engine.outputs(columns["observation"], part=CRITIC)
            advantage, target = generalized_advantage_estimate(
                self.settings.gamma,
                self.settings.gae_lambda,
                value,
                self.engine.outputs(columns["next_observation"], part=CRITIC),
                *(_like(columns[name], value) for name in ("reward", "done", "terminated")),
                time_dim=1,
            )
        if self.settings.normalize_advantage:
            of_lane = tuple(range(1, advantage.ndim))
            spread = advantage.std(of_lane, keepdim=True)
            advantage = (advantage - advantage.mean(of_lane, keepdim=True)) / (spread + _SMALL)
        chosen = chances.gather(-1, columns["action"].unsqueeze(-1)).squeeze(-1)
        return TensorDict(
            {
                "observation": columns["observation"],
                "action": columns["action"],
                "action_log_prob": chosen,
                "advantage": advantage,
                "value_target": target,
                "state_value": value,
            },
            [self.lanes, self.rollout_steps],
        )

    def end_episode(self, ended: Tensor) -> None:
        """Nothing: rollouts go on over the ends of episodes, which cut them."""

    def values(self, batch: TensorDictBase) -> Tensor:
        """What each agent's critic expects from the end of a turn on, [R, S]."""
        with torch.no_grad():
            expected = self.engine.outputs(self._lanes.seen_next(batch), part=CRITIC)
        return expected.reshape(self.replicas, len(self.agents))

    def state_dict(self) -> dict[str, Any]:
        """Everything that the future of all lanes depends on; own tensors, not copies.

        "networks" besides, which says the same as "update" in a form that `cprl.load` reads.
        """
        return {
            "networks": self._lanes.states(self.engine),
            "update": self.engine.state_dict(),
            "rollout": self._rollout,
            "size": self._size,
            "draws": self.rng.state_dict(),
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on where the learner of that state was, which was made with the same arguments."""
        self.engine.load_state_dict(state["update"])
        for name, room in self._rollout.items():
            room.copy_(state["rollout"][name])
        self.rng.load_state_dict(state["draws"])
        self.actor.rng.load_state_dict(state["exploration"])
        self._size, self.steps = int(state["size"]), int(state["steps"])


def _like(column: Tensor, value: Tensor) -> Tensor:
    """What was told of lanes, [L, T], or of the members of teams, [L, T, S], in the form of values, which end
    with an axis of 1."""
    one_each = [1] * (value.ndim - column.ndim)
    return column.reshape(*column.shape, *one_each).expand_as(value)


def _refuse_other_parts(network: nn.Module) -> None:
    parts = list(parts_of(network))
    if not isinstance(network, AgentNetworks) or parts[:2] != ["actor", "critic"]:
        raise ValueError(f'an agent has the networks {parts}; "actor" and "critic" are wanted')


def trial_rollout(transitions: TensorDict) -> TensorDict:
    """A made-up batch of a rollout, out of made-up transitions."""
    chance = torch.Generator().manual_seed(1)
    batch = transitions.select("observation", "action")
    for name in ("advantage", "value_target", "state_value"):
        batch[name] = torch.rand((*batch["action"].shape, 1), generator=chance).to(batch["action"].device)
    batch["action_log_prob"] = batch["advantage"].squeeze(-1) - 2.5
    return batch
