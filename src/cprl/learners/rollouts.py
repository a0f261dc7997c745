"""RolloutLearner: independent on-policy agents, all of them in one update."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from cprl.commons.spaces import Spaces
from cprl.learners.advantages import advantages
from cprl.learners.buffer.rollout import refuse_full, rollout_fields, write_turn
from cprl.learners.buffer.sampler import steps_ahead
from cprl.learners.checks import check_learner, refuse_other_parts
from cprl.learners.engine.base import Engine
from cprl.learners.engine.choice import TRIAL_LANES, EngineName, make_engine, trial_batch, trial_rollout
from cprl.learners.engine.functional import MakeLoss
from cprl.learners.engine.refusals import reads, refuse_other_advantages
from cprl.learners.engine.shared import SharedEngine
from cprl.learners.lanes import SAMPLING, WEIGHTS, StartFrom
from cprl.learners.recurrent import ACTOR, COMPILED_STEPS, CRITIC, Evaluated, States, states_in
from cprl.learners.settings import RolloutSettings
from cprl.learners.teams import MakeTeam, lanes_of
from cprl.learners.transitions import wanted_in
from cprl.policies.lanes import LaneActor
from cprl.policies.rng import LaneRng
from cprl.preferences.values import Preference
from cprl.preferences.wanted import WantedRewards


class RolloutLearner:
    """R x S independent agents that learn from the latest steps of their current policies.

    After every `rollout_steps` steps the learner estimates advantages with TorchRL's GAE and updates for
    `epochs` epochs. Each lane shuffles its own minibatches, and learns exactly as it would alone. Minibatches
    of recurrent networks are consecutive steps, and the update of more than `COMPILED_STEPS` is not compiled.

    Args:
        spaces: the shape and dtype of observations, and the number of actions A.
        agents: the indices of the agents that learn.
        replicas: the number of replicas R; each is one world of the environment.
        settings: the hyperparameters.
        make_network: makes an agent's "actor" and "critic", see `cprl.algorithms.on_policy`.
        make_loss: makes an agent's loss from them.
        make_team: for agents that learn as a team: makes its "actor" and "critic" from the networks of its
            members, see `cprl.algorithms.teams`; a lane is then the team of a replica.
        seed: the seed of the run.
        first_replica: the index of the first replica, so that replica r can be trained alone.
        reward_kind: what they want, see `cprl.preferences`.
        engine: how lanes are updated; None picks the fastest that works, see `cprl.learners.engine.choice`.
        compile: whether torch compiles acting and the update; the engine "list" is never compiled.
        start_from: the weights with which acting networks, and their targets, start, by the lane's name; the
            others, such as critics, are new.
        share_parameters: whether the agents of a replica share one network, which learns from all of them.
        device: the torch device of networks, buffers and updates.

    Raises:
        ValueError: if the networks are not "actor" and "critic".
        TooLargeError: if the device has less memory than rollouts and networks take.
    """

    def __init__(
        self,
        spaces: Spaces,
        *,
        agents: Sequence[int],
        replicas: int,
        settings: RolloutSettings,
        make_network: Callable[[], nn.Module],
        make_loss: MakeLoss,
        make_team: MakeTeam | None = None,
        seed: int = 0,
        first_replica: int = 0,
        reward_kind: Preference = "individual",
        engine: EngineName | None = None,
        compile: bool = True,
        start_from: StartFrom | None = None,
        share_parameters: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        check_learner(spaces, settings, RolloutSettings, agents, replicas, first_replica, seed, reward_kind)
        self.spaces, self.settings, self.agents = spaces, settings, tuple(agents)
        self.replicas, self.seed, self.wants = replicas, seed, WantedRewards(reward_kind)
        self._lanes = lanes_of(
            spaces,
            agents=agents,
            replicas=replicas,
            seed=seed,
            first_replica=first_replica,
            make_network=make_network,
            make_team=make_team,
            stochastic=True,
            start_from=start_from,
            share_parameters=share_parameters,
        )
        self.engine = self._make_engine(engine, make_loss, compile=compile, device=device)
        self.actor = self._lanes.actor(self.engine, compile=compile)
        steps = settings.rollout_steps
        self.rng = LaneRng(self._lanes.seeds(SAMPLING), steps, ahead=steps_ahead(steps))
        size = (settings.rollout_steps,)
        self._rollout = rollout_fields(spaces, self._lanes, size, torch.device(device))
        self._size = 0
        self.steps = 0

    def __repr__(self) -> str:
        return f"RolloutLearner(agents={self.agents}, replicas={self.replicas})"

    def _make_engine(
        self, name: EngineName | None, make_loss: MakeLoss, *, compile: bool, device: str | torch.device
    ) -> Engine:
        """The engine of all lanes, with new networks."""
        settings = self.settings
        networks = self._lanes.new_networks(WEIGHTS, device)
        refuse_other_parts(networks[0])
        shapes = states_in(networks[0])
        sequence = settings.minibatch_size
        self._states = States(shapes, self._lanes, sequence=sequence, device=device) if shapes else None
        loss = make_loss(deepcopy(networks[0]))
        refuse_other_advantages(loss, settings)
        self._reads_logits = reads(loss, "logits")
        trial = trial_batch(
            min(len(networks), TRIAL_LANES),
            self._lanes.observation_shape,
            self.spaces.actions,
            action_shape=self._lanes.action_shape,
            observation_dtype=self.spaces.observation_dtype,
            device=device,
        )
        engine = make_engine(
            name,
            networks,
            make_loss,
            optimizer=settings.optimizer,
            learning_rate=settings.learning_rate,
            adam_eps=settings.adam_eps,
            max_grad_norm=settings.max_grad_norm,
            compile=compile and (not shapes or sequence <= COMPILED_STEPS),
            trial=trial_rollout(
                trial, actions=self.spaces.actions if self._reads_logits else None, states=shapes
            ),
        )
        return SharedEngine(engine, self._lanes.sharing) if self._lanes.sharing > 1 else engine

    @property
    def lanes(self) -> int:
        """The number of lanes L = R x S, or of teams, R."""
        return len(self._lanes)

    @property
    def rollout_steps(self) -> int:
        """The length of a rollout, in steps."""
        return self.settings.rollout_steps

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor with the current weights, for `worlds` worlds of each replica."""
        return self._lanes.evaluation_actor(self.engine, worlds, epsilon=0.0)

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each lane's current acting network, by "replica_0/agent_0" and so on."""
        return self._lanes.networks(self.engine)

    def begin(self) -> None:
        """Drops the rollout that an earlier training left unfinished; see `Learner`."""
        self._size = 0
        if self._states is not None:
            self._states.forget()

    def store(self, batch: TensorDictBase) -> None:
        """Stores one step of every replica, as the collector yields it.

        Raises:
            ValueError: if the rollout is full: call `update` after each step, or after a number of steps that
                divides `rollout_steps`; and if the dtype of observations is not that of the spaces.
        """
        refuse_full(self._size, self.rollout_steps)
        if self._states is not None and not self._size:
            self._states.begin(batch)
        turn = self._lanes.rollout_turn(batch, wanted_in(self.wants, batch))
        write_turn(self._rollout, (self._size,), turn, self.spaces)
        self._size += 1
        self.steps += 1

    def update(self) -> Tensor | None:
        """Runs all epochs over a full rollout; returns the mean losses [R, S], or None if it is not full."""
        if self._size < self.rollout_steps:
            return None
        batch = self._batch()
        lane = torch.arange(self.lanes, device=batch["action"].device)[:, None]
        losses = []
        for _ in range(self.settings.epochs):
            places = self._minibatches(self.rng.next())
            losses += [self.engine.update_from(batch[lane, place.to(lane.device)]) for place in places]
        self._size = 0
        return self._lanes.by_agent(torch.stack(losses).mean(0))

    def _minibatches(self, numbers: Tensor) -> Tensor:
        """The steps of an epoch's minibatches, int64 [minibatches, L, size], from random numbers [L, T]."""
        size = self.settings.minibatch_size
        if self._states is not None:
            return self._states.minibatches(numbers)
        return numbers.argsort(-1).view(len(numbers), -1, size).transpose(0, 1)

    def _batch(self) -> TensorDict:
        """The rollout with advantages, [L, T], under the keys of TorchRL's losses; advantages are normalised
        within each lane if the settings say so."""
        columns = self._columns()
        with torch.no_grad():
            logits, value, next_value, entries = self._evaluated(columns)
            chances = logits.log_softmax(-1)
            advantage, target = advantages(columns, value, next_value, settings=self.settings)
        chosen = chances.gather(-1, columns["action"].unsqueeze(-1)).squeeze(-1)
        return TensorDict(
            {
                "observation": columns["observation"],
                "action": columns["action"],
                "action_log_prob": chosen,
                "advantage": advantage,
                "value_target": target,
                "state_value": value,
                **({"logits": logits} if self._reads_logits else {}),
                **entries,
            },
            [self.lanes, self.rollout_steps],
        )

    def _evaluated(self, columns: Mapping[str, Tensor]) -> Evaluated:
        """What the networks give for a rollout, [L, T, ...]."""
        if self._states is not None:
            return self._states.evaluate(self.engine, columns)
        logits = self.engine.outputs(columns["observation"], part=ACTOR)
        value = self.engine.outputs(columns["observation"], part=CRITIC)
        next_value = self.engine.outputs(columns["next_observation"], part=CRITIC)
        return Evaluated(logits, value, next_value, {})

    def _columns(self) -> dict[str, Tensor]:
        """The fields of the rollout, [L, T, ...]."""
        return {name: field.transpose(0, 1) for name, field in self._rollout.items()}

    def end_episode(self, ended: Tensor) -> None:
        """Does nothing: a rollout continues into the next episode; advantages do not cross the boundary."""

    def finite(self) -> Tensor:
        """Whether the weights, targets and optimiser state of each agent are finite, bool [R, S]."""
        return self._lanes.by_agent(self.engine.finite())

    def values(self, batch: TensorDictBase) -> Tensor:
        """The value that each agent's critic gives to the state after a turn, [R, S]."""
        with torch.no_grad():
            seen = self._lanes.seen_next(batch)
            if self._states is None:
                expected: Tensor = self.engine.outputs(seen, part=CRITIC)
            else:
                expected = self._states.value_next(self.engine, self._columns(), self._size, seen)
        return expected.reshape(self.replicas, len(self.agents))

    def state_dict(self) -> dict[str, Any]:
        """The full state of all lanes; the tensors themselves, not copies.

        The entry "networks" repeats the weights of "update" in the form that `cprl.load` reads.
        """
        return {
            "networks": self._lanes.states(self.engine),
            "update": self.engine.state_dict(),
            "rollout": self._rollout,
            "size": self._size,
            "draws": self.rng.state_dict(),
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
            "wants": self.wants.state_dict(),
            **({} if self._states is None else {"recurrent": self._states.state_dict()}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from the state of a learner made with the same arguments."""
        self.engine.load_state_dict(state["update"])
        for name, field in self._rollout.items():
            field.copy_(state["rollout"][name])
        self.rng.load_state_dict(state["draws"])
        self.actor.rng.load_state_dict(state["exploration"])
        self._size, self.steps = int(state["size"]), int(state["steps"])
        self.wants.load_state_dict(state.get("wants", {}))
        if self._states is not None:
            self._states.load_state_dict(state["recurrent"])
