"""TorchRLRolloutLearner: independent on-policy agents that learn by stock parts."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.objectives import LossModule
from torchrl.objectives.value import GAE

from cprl.commons.spaces import Spaces
from cprl.envs.drivers import device_of
from cprl.learners.buffer.storage import torch_dtype
from cprl.learners.checks import check_learner, check_rollouts, refuse_other_parts
from cprl.learners.engine.choice import trial_batch
from cprl.learners.engine.functional import MakeLoss
from cprl.learners.engine.refusals import refuse_other_advantages, refuse_other_outputs
from cprl.learners.lanes import Lanes, StartFrom
from cprl.learners.recurrent import ACTOR, CRITIC, states_in
from cprl.learners.settings import RolloutSettings
from cprl.learners.torchrl.agents import MakeSampler, StockAgent, StockAgents, check_makers, sampler_of
from cprl.learners.torchrl.buffers import nested, plain
from cprl.learners.transitions import wanted_in
from cprl.policies.lanes import LaneActor
from cprl.preferences.values import Preference
from cprl.preferences.wanted import WantedRewards


class TorchRLRolloutLearner:
    """R x S independent agents that learn from the latest steps of their current policies, with TorchRL's
    stock parts: S agents of each of R replicas.

    Every `rollout_steps` steps TorchRL's `GAE` adds advantages, and the loss is taken `epochs` times over
    minibatches from a `TensorDictReplayBuffer` with a `SamplerWithoutReplacement`. First weights and the
    actions that are drawn are those of `RolloutLearner`; the order of minibatches is not, unless
    `make_sampler` says so.

    Args:
        spaces: the shape and dtype of observations, and the number of actions A.
        agents: the indices of the agents that learn.
        replicas: the number of replicas R; each is one world of the environment.
        settings: the hyperparameters.
        make_network: makes an agent's `AgentNetworks`, "actor" and "critic", initialised from torch's
            generator, which is seeded for each agent.
        make_loss: makes an agent's loss from them.
        seed: the seed of the run.
        first_replica: the index of the first replica, so that replica r can be trained alone.
        reward_kind: what they want, see `cprl.preferences`.
        make_sampler: an agent's sampler of minibatches; by default a `SamplerWithoutReplacement`.
        start_from: the weights with which acting networks, and their targets, start, by the lane's name; the
            others, such as critics, are new.
        device: the torch device of networks, buffers and updates.

    Raises:
        ValueError: if the networks are not "actor" and "critic", and for a loss that needs other advantages
            than GAE's with these settings.
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
        seed: int = 0,
        first_replica: int = 0,
        reward_kind: Preference = "individual",
        make_sampler: MakeSampler | None = None,
        start_from: StartFrom | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check_learner(spaces, settings, RolloutSettings, agents, replicas, first_replica, seed, reward_kind)
        check_makers(make_network, make_loss, make_sampler)
        device = device_of(device)
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
        how: dict[str, Any] = {
            "optimizer": settings.optimizer,
            "learning_rate": settings.learning_rate,
            "eps": settings.adam_eps,
            "max_grad_norm": settings.max_grad_norm,
        }
        of_agent = partial(_on_policy, make_loss, settings)
        self._refuse_other_outputs(of_agent, device, **how)
        self.stock = StockAgents(self._lanes, of_agent, device=device, **how)
        self.estimators = [_gae(agent.parts[CRITIC], settings) for agent in self.stock.each]
        size, dtype = (settings.rollout_steps, len(self._lanes)), torch_dtype(spaces.observation_dtype)
        check_rollouts(size, spaces.observation_shape, dtype, device)
        self._generators = self.stock.generators()
        self.buffers = [
            TensorDictReplayBuffer(
                storage=LazyTensorStorage(settings.rollout_steps, device=self.stock.device),
                sampler=sampler_of(make_sampler, lane) if make_sampler else SamplerWithoutReplacement(),
                batch_size=settings.minibatch_size,
                generator=generator,
            )
            for lane, generator in enumerate(self._generators)
        ]
        self.actor = self._lanes.actor(self.stock, compile=False)
        self._rollout: list[TensorDict] = []
        self.steps = 0

    def __repr__(self) -> str:
        return f"TorchRLRolloutLearner(agents={self.agents}, replicas={self.replicas})"

    def _refuse_other_outputs(self, make_loss: MakeLoss, device: torch.device, **how: Any) -> None:
        """Raises a ValueError for a loss that returns none, on synthetic transitions of one agent."""
        with torch.random.fork_rng(devices=[]):
            agent = StockAgent(self._lanes.make_network().to(device), make_loss, **how)
        trial = trial_batch(
            1,
            self._lanes.observation_shape,
            self.spaces.actions,
            action_shape=self._lanes.action_shape,
            observation_dtype=self.spaces.observation_dtype,
            device=device,
        )[0]
        _gae(agent.parts[CRITIC], self.settings)(trial)
        _add_old_policy(trial, agent)
        refuse_other_outputs(agent.loss, trial)

    @property
    def rollout_steps(self) -> int:
        """The length of a rollout, in steps."""
        return self.settings.rollout_steps

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor with the current weights, for `worlds` worlds of each replica."""
        return self._lanes.evaluation_actor(self.stock, worlds, epsilon=0.0)

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each agent's current acting network, by "replica_0/agent_0" and so on."""
        return self._lanes.networks(self.stock)

    def begin(self) -> None:
        """Drops the rollout that an earlier training left unfinished; see `Learner`."""
        self._rollout = []

    def store(self, batch: TensorDictBase) -> None:
        """Stores one step of every replica, as the collector yields it.

        Raises:
            ValueError: if the rollout is full: call `update` after each step, or after a number of steps that
                divides `rollout_steps`.
        """
        if len(self._rollout) == self.rollout_steps:
            raise ValueError(
                f"the rollout already has {self.rollout_steps} steps; call update() before store()"
            )
        self._rollout.append(self.stock.transitions(batch, wanted_in(self.wants, batch)).clone())
        self.steps += 1

    def update(self) -> Tensor | None:
        """Runs all epochs over a full rollout; returns the mean losses [R, S], or None if it is not full."""
        if len(self._rollout) < self.rollout_steps:
            return None
        rollout = torch.stack(self._rollout, 1)
        self._rollout = []
        return self._lanes.by_agent(
            torch.stack([self._learn(lane, rollout[lane].clone()) for lane in range(len(self.stock))])
        )

    def _learn(self, lane: int, rollout: TensorDict) -> Tensor:
        """Runs all epochs of one agent over its rollout, [T]; returns its mean loss."""
        agent, buffer = self.stock.each[lane], self.buffers[lane]
        self.estimators[lane](rollout)
        _add_old_policy(rollout, agent)
        buffer.empty()
        buffer.extend(rollout)
        minibatches = self.settings.epochs * (self.rollout_steps // self.settings.minibatch_size)
        return torch.stack([agent.update(buffer.sample()) for _ in range(minibatches)]).mean()

    def end_episode(self, ended: Tensor) -> None:
        """Does nothing: a rollout continues into the next episode; advantages do not cross the boundary."""

    def finite(self) -> Tensor:
        """Whether the weights, targets and optimiser state of each agent are finite, bool [R, S]."""
        return self._lanes.by_agent(self.stock.finite())

    def values(self, batch: TensorDictBase) -> Tensor:
        """The value that each agent's critic gives to the state after a turn, [R, S]."""
        with torch.no_grad():
            expected = self.stock.outputs(self._lanes.seen_next(batch), part=CRITIC)
        return self._lanes.by_agent(expected.flatten())

    def state_dict(self) -> dict[str, Any]:
        """The full state of all agents; the tensors themselves where possible, not copies.

        The entry "networks" repeats the weights of "agents" in the form that `cprl.load` reads. The
        buffers are refilled from each rollout, so only the states of their generators are stored.
        """
        return {
            "networks": self._lanes.states(self.stock),
            "agents": [agent.state_dict() for agent in self.stock.each],
            "rollout": [plain(turn) for turn in self._rollout],
            "generators": [generator.get_state() for generator in self._generators],
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
            "wants": self.wants.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from the state of a learner made with the same arguments."""
        for agent, own in zip(self.stock.each, state["agents"], strict=True):
            agent.load_state_dict(own)
        self._rollout = [nested(turn).to(self.stock.device) for turn in state["rollout"]]
        for generator, own in zip(self._generators, state["generators"], strict=True):
            generator.set_state(own.cpu())
        self.actor.rng.load_state_dict(state["exploration"])
        self.steps = int(state["steps"])
        self.wants.load_state_dict(state.get("wants", {}))


def _gae(critic: nn.Module, settings: RolloutSettings) -> GAE:
    """TorchRL's GAE with a critic's current weights."""
    return GAE(
        gamma=settings.gamma,
        lmbda=settings.gae_lambda,
        value_network=TensorDictModule(critic, ["observation"], ["state_value"]),
        average_gae=settings.normalize_advantage,
        deactivate_vmap=True,  # a user's network may not support it
    )


def _add_old_policy(rollout: TensorDict, agent: StockAgent) -> None:
    """Adds the "logits" [T, A] of the policy that acted, and its "action_log_prob" [T]."""
    with torch.no_grad():
        logits = agent.parts[ACTOR](rollout["observation"])
        policy = torch.distributions.Categorical(logits=logits)
        chosen = policy.log_prob(rollout["action"])  # type: ignore[no-untyped-call]
    rollout.update({"logits": logits, "action_log_prob": chosen})


def _on_policy(make_loss: MakeLoss, settings: RolloutSettings, network: nn.Module) -> LossModule:
    """Makes the loss; refuses other networks than "actor" and "critic", recurrent ones, and other advantages
    than GAE's."""
    refuse_other_parts(network)
    if states_in(network):
        raise ValueError(
            'the networks are recurrent; allowed with engine="torchrl", whose minibatches are single turns: '
            'MLP, Conv, Custom; engine="compiled" and "eager" learn from sequences'
        )
    loss = make_loss(network)
    refuse_other_advantages(loss, settings)
    return loss
