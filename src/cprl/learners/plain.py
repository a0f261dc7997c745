"""How agents learn, in plain code by TorchRL's stock parts: read this module first.

`train_plainly` is a whole training: agents act, and their learner stores each turn and learns. A learner has
a memory, which says when there is a batch to learn from, and networks, which learn from it. Here every agent
has a TorchRL loss, a torch optimiser and a `TensorDictReplayBuffer` of its own, and agents learn one after
the other. This is engine="torchrl".

`Replay.due` says when an update is due, and `Learner.end_episode` when targets are copied; both also hold
here. The modules `networks`, `ring` and `rollouts` compute the same for all agents at once, and are tested
against this one.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler, Sampler, SamplerWithoutReplacement
from torchrl.envs import EnvBase
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate
from torchrl.objectives.value import GAE

from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.learners.networks import MakeLoss
from cprl.learners.optimizers import UpdateRule, torch_optimizer
from cprl.learners.replay import Replay
from cprl.learners.ring import Noise, stored_bytes
from cprl.learners.rollouts import ACTOR, Rollouts
from cprl.learners.settings import RolloutSettings
from cprl.learners.transitions import LaneTurn, transitions_of
from cprl.networks.agent import networks_by_name
from cprl.networks.finite import all_finite
from cprl.objectives.functional import attributes_of, mark_targets_updated, set_attributes, targets_of, total
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.rng import Purpose, seed_of
from cprl.system.memory import check_memory


def train_plainly(env: EnvBase, learner: Learner, *, episodes: int) -> None:
    """Train all agents of a game.

    Args:
        env: the worlds of all replicas, [B].
        learner: the learner of all agents, e.g. `DQN(settings=settings).make_learner(lanes, "torchrl")`.
            Its actor is a `cprl.policies.actors.LaneActor`.
        episodes: the number of episodes to play, in all worlds together.
    """
    learner.begin()
    policy = JointPolicy({learner.agents: learner.actor})
    # The collector itself never stops, and adds no transforms to the environment.
    options: dict[str, Any] = {"total_frames": -1, "auto_register_policy_transforms": False}
    played = 0
    for turns in Collector(env, policy, frames_per_batch=env.batch_size.numel(), **options):
        turn = turns[:, 0]
        learner.store(turn)
        learner.update()
        ended = turn["next", "done"][:, 0]
        learner.end_episode(ended)
        played += int(ended.sum())
        if played >= episodes:
            return


class PlainNetworks:
    """The networks of all agents, each with a loss of its own, an optimiser, and targets if the loss has any.

    Args:
        networks: the networks of each agent, which are trained in place.
        make_loss: makes TorchRL's loss from a network.
        rule: how a gradient changes weights, and how targets follow.
        target_networks: networks with the initial target weights; by default targets start as copies.
    """

    update = "list"

    def __init__(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        rule: UpdateRule,
        *,
        target_networks: Sequence[nn.Module] | None = None,
    ) -> None:
        self.rule = rule
        self.learning_rate = rule.learning_rate
        self.updates = 0
        self.parts = [list(networks_by_name(network).values()) for network in networks]
        """The networks of each agent, the acting one first."""
        self.losses = [make_loss(network) for network in networks]
        for loss in self.losses:
            mark_targets_updated(loss)
        self.targets = [_new_updater(loss, rule) for loss in self.losses]
        for loss, network in zip(self.losses, target_networks or (), strict=False):
            for name, weights in targets_of(make_loss(network)).items():
                getattr(loss, f"target_{name}").data.copy_(weights.data)
        self.optimizers = [torch_optimizer(rule, loss.parameters()) for loss in self.losses]

    def set_entropy_coeff(self, value: float) -> None:
        """Set the weight of the entropy in the losses of the next steps."""
        for loss in self.losses:
            loss.entropy_coeff.fill_(value)

    def learn(self, batch: TensorDictBase) -> Tensor:
        """Take one step of each agent from a batch of its own, [L, b]; return the losses, [L]."""
        losses = torch.stack([self.learn_agent(agent, batch[agent]) for agent in range(len(batch))])
        self.updates += 1
        period = self.rule.target_every_updates
        if period is not None and self.updates % period == 0:
            self.copy_to_targets(torch.ones(len(losses), dtype=torch.bool))
        return losses

    def learn_agent(self, agent: int, batch: TensorDictBase) -> Tensor:
        """Take one step of an agent along the gradient of its loss, from a batch, [b]; return the loss."""
        module = self.losses[agent]
        optimizer = self.optimizers[agent]
        loss = total(module(batch), module).mean() * self.rule.loss_share
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self.rule.max_grad_norm is not None:
            torch.nn.utils.clip_grad_norm_(module.parameters(), self.rule.max_grad_norm)
        optimizer.param_groups[0]["lr"] = self.learning_rate
        optimizer.step()
        if self.rule.tau is not None:
            self.targets[agent].step()
        return loss.detach()

    def outputs(self, observation: Tensor, *, part: int = ACTOR) -> Tensor:
        """Return the outputs of one network of each agent, by default the acting one, [L, k, ...].

        Args:
            observation: what each agent observes, [L, k, ...].
            part: the index of the network among an agent's networks.
        """
        outputs = []
        for networks, agent_observation in zip(self.parts, observation, strict=True):
            outputs.append(networks[part](agent_observation))
        return torch.stack(outputs)

    def copy_to_targets(self, marked: Tensor) -> None:
        """Copy the weights of the marked agents, bool [L], to their targets."""
        for is_marked, updater in zip(marked.tolist(), self.targets, strict=True):
            if is_marked and updater is not None:
                updater.step()

    def network_state(self, agent: int) -> dict[str, Tensor]:
        """Return copies of the weights of an acting network, as its state dict."""
        return deepcopy(self.parts[agent][ACTOR].state_dict())

    def finite(self) -> Tensor:
        """Return for each agent whether its weights, targets and optimiser state are finite, bool [L]."""
        leaves = [tree_leaves(agent) for agent in self.state_dict()["agents"]]
        return torch.tensor([all_finite(filter(torch.is_tensor, tensors)) for tensors in leaves])

    def state_dict(self) -> dict[str, Any]:
        agents = [
            {
                "loss": dict(loss.state_dict()),
                "attributes": attributes_of(loss),
                "optimizer": optimizer.state_dict(),
            }
            for loss, optimizer in zip(self.losses, self.optimizers, strict=True)
        ]
        return {"agents": agents, "updates": self.updates}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for loss, optimizer, agent in zip(self.losses, self.optimizers, state["agents"], strict=True):
            loss.load_state_dict(agent["loss"])
            set_attributes(loss, agent["attributes"])
            optimizer.load_state_dict(agent["optimizer"])
        self.updates = int(state["updates"])


def _new_updater(loss: LossModule, rule: UpdateRule) -> Any:
    """Return TorchRL's updater of the targets of a loss; None if it has no targets."""
    if not targets_of(loss):
        return None
    if rule.tau is not None:
        return SoftUpdate(loss, tau=rule.tau)
    return HardUpdate(loss, value_network_update_interval=0)  # it copies at every (interval + 1)-th step


class PlainBuffers:
    """A `TensorDictReplayBuffer` for each agent, with its own random generator.

    Args:
        lanes: the agents that learn.
        make_sampler: makes the sampler of a buffer.
        size: the capacity of each buffer, in transitions.
        batch_size: the transitions b in each batch.
        noise_shape: the shape of the uniform numbers that the loss reads with each transition; () for none.
    """

    def __init__(
        self,
        lanes: Lanes,
        make_sampler: Callable[[], Sampler],
        *,
        size: int,
        batch_size: int,
        noise_shape: tuple[int, ...] = (),
    ) -> None:
        if lanes.share_parameters:
            raise ValueError(
                'share_parameters is True; allowed with engine="torchrl", which trains independent agents: '
                "False"
            )
        self.columns = lanes.columns
        device = torch.device(lanes.device)
        self.generators = [
            torch.Generator(device).manual_seed(seed_of(seed)) for seed in lanes.seeds(Purpose.SAMPLING)
        ]
        self.each = [
            TensorDictReplayBuffer(
                storage=LazyTensorStorage(size, device=device),
                sampler=make_sampler(),
                batch_size=batch_size,
                generator=generator,
            )
            for generator in self.generators
        ]
        self.noise = None
        if noise_shape:
            self.noise = Noise(lanes.seeds(Purpose.NOISE), batch_size, noise_shape, device)

    def write(self, turn: LaneTurn) -> None:
        """Store a turn of every agent in all of its worlds."""
        self.extend(transitions_of(turn._asdict())[self.columns])

    def extend(self, transitions: TensorDictBase) -> None:
        """Store transitions of every agent, [L, n]."""
        for buffer, rows in zip(self.each, transitions, strict=True):
            buffer.extend(rows)

    def draw(self) -> TensorDict:
        """Return a batch of every agent, [L, b]."""
        batch: TensorDict = torch.stack([buffer.sample() for buffer in self.each])
        return batch if self.noise is None else batch.set("noise", self.noise.next())

    def cut(self) -> None:
        """Do nothing: stored transitions do not refer to the turns after them."""

    def state_dict(self) -> dict[str, Any]:
        """Return the full state, with the transitions that were written; the state of TorchRL's buffer would
        include all allocated memory."""
        buffers = [
            {
                "transitions": buffer[:].clone().to_dict() if len(buffer) else {},
                "writer": dict(buffer.writer.state_dict()),
                "generator": generator.get_state(),
            }
            for buffer, generator in zip(self.each, self.generators, strict=True)
        ]
        return {"buffers": buffers, "noise": {} if self.noise is None else self.noise.rng.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for buffer, generator, stored in zip(self.each, self.generators, state["buffers"], strict=True):
            buffer.empty()
            if transitions := stored["transitions"]:
                buffer.extend(TensorDict(transitions, [len(transitions["action"])]))
            buffer.writer.load_state_dict(stored["writer"])
            generator.set_state(stored["generator"].cpu())
        if self.noise is not None:
            self.noise.rng.load_state_dict(state["noise"])


class PlainReplay(Replay):
    """A `Replay` with TorchRL's replay buffers: the memory of DQN (Mnih et al. 2015)."""

    def _refuse_other_sequences(self) -> None:
        name = "n_steps" if self.settings.n_steps > 1 else "sequence_steps"
        steps = getattr(self.settings, name)
        if steps > 1 or self.form.state_cells:
            raise ValueError(
                f'settings.{name} is {steps}; allowed with engine="torchrl", whose buffers give single '
                'transitions: 1, with MLP, Conv, Custom; engine="compiled" and "eager" learn from sequences '
                "and from returns of several steps"
            )

    def _make_buffer(self) -> PlainBuffers:
        lanes = self.lanes
        settings = self.settings
        # The system gives out memory as a buffer fills: without this check it could run out hours later.
        check_memory(
            f"the replay buffers of {len(lanes)} agents x {settings.buffer_size:,} transitions",
            2 * stored_bytes(self.form, len(lanes), settings.buffer_size),
            'a smaller buffer_size, fewer replicas, or engine="compiled", which needs half',
            device=lanes.device,
        )
        return PlainBuffers(
            lanes,
            RandomSampler,
            size=settings.buffer_size,
            batch_size=settings.batch_size,
            noise_shape=self.form.noise_shape,
        )


class PlainRollouts(Rollouts):
    """A `Rollouts` with TorchRL's replay buffers and its `GAE`: the memory of PPO (Schulman et al. 2017)."""

    def __init__(self, lanes: Lanes, settings: RolloutSettings, network: nn.Module, loss: LossModule) -> None:
        super().__init__(lanes, settings, network, loss)
        if settings.only_in_play:
            raise ValueError(
                'settings.only_in_play is True; allowed with engine="torchrl", whose losses are of whole '
                "batches: False"
            )
        if self.states is not None:
            raise ValueError(
                'the networks are recurrent; allowed with engine="torchrl", whose minibatches are single '
                'turns: MLP, Conv, Custom; engine="compiled" and "eager" learn from sequences'
            )
        size = settings.rollout_steps * lanes.worlds
        self.buffers = PlainBuffers(
            lanes, SamplerWithoutReplacement, size=size, batch_size=settings.minibatch_size
        )

    def due(self, networks: Any) -> Iterator[TensorDict]:
        """Yield the minibatches of all epochs over a full rollout; none while it is not full."""
        if not self.rollout.is_full:
            return
        self.rollout.size = 0
        steps = self._batch(networks)
        self.buffers.extend(steps)
        for _ in range(self.settings.epochs * steps.shape[1] // self.settings.minibatch_size):
            yield self.buffers.draw()
        for buffer in self.buffers.each:
            buffer.empty()  # a checkpoint holds the rollout once

    def _batch(self, networks: Any) -> TensorDict:
        """Return the rollout with advantages, [L, W x T], under the keys of TorchRL's losses."""
        rollouts = zip(networks.parts, transitions_of(self.rollout.fields), strict=True)
        return torch.stack([self._with_advantages(rollout, *parts[:2]) for parts, rollout in rollouts])

    @torch.no_grad()
    def _with_advantages(self, rollout: TensorDict, actor: nn.Module, critic: nn.Module) -> TensorDict:
        """Return the rollout of an agent, [W, T], as steps [W x T] with advantages, logits and log-probs."""
        add_advantages = GAE(
            gamma=self.settings.gamma,
            lmbda=self.settings.gae_lambda,
            value_network=TensorDictModule(critic, ["observation"], ["state_value"]),
            average_gae=self.settings.normalize_advantage,
            deactivate_vmap=True,  # a user's network may not support it
        )
        add_advantages(rollout)
        rollout["logits"] = actor(rollout["observation"])
        policy = torch.distributions.Categorical(logits=rollout["logits"])
        rollout["action_log_prob"] = policy.log_prob(rollout["action"])  # type: ignore[no-untyped-call]
        return rollout.flatten()

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), **self.buffers.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self.buffers.load_state_dict(state)
