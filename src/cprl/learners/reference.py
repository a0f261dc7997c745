"""engine="torchrl": the same training with TorchRL's stock parts, one agent after the other.

Each agent has a network, the loss of its algorithm, an optimiser of torch.optim, a `HardUpdate` or
`SoftUpdate` and a `TensorDictReplayBuffer`; advantages are those of TorchRL's `GAE`. First weights, first
targets and what actors draw are those of the fast learners, the sampled batches are not. It is the plain way
to say what the fast learners compute, and what these are tested against.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from math import prod
from typing import Any, Final

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler, Sampler, SamplerWithoutReplacement
from torchrl.envs.transforms import MultiStepTransform, UnsqueezeTransform
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.objectives.value import GAE

from cprl.custom import Custom, made
from cprl.learners.engine import Engine, ListEngine, MakeLoss, UpdateRule, targets_of, torch_optimizer
from cprl.learners.lanes import NOISE, SAMPLING, Lanes, LearningAgents, Method, seed_of
from cprl.learners.replay import ReplayLearner
from cprl.learners.ring import Noise, torch_dtype
from cprl.learners.rollouts import ACTOR, CRITIC, RolloutLearner, states_in
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.learners.transitions import LaneTurn
from cprl.learners.trial import EngineName, refuse_other_advantages, refuse_other_outputs
from cprl.networks.agent import parts_of
from cprl.system.memory import check_memory

MakeSampler = Callable[[int], Sampler]
"""Makes a TorchRL sampler for an agent, by its lane = replica x S + position among the agents. Comparisons
with the fast engine pass one that replays given indices."""

_BYTES_BESIDE: Final = 4 + 1 + 1
"""Bytes of a transition without its observations and actions: reward, done, terminated."""


class StockEngine(ListEngine):
    """A `ListEngine` with the target updaters of TorchRL and torch's default form of the optimiser."""

    def __init__(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        rule: UpdateRule,
        *,
        target_networks: Sequence[nn.Module] | None = None,
    ) -> None:
        super().__init__(networks, make_loss, replace(rule, tau=None))
        self.optimizers = [torch_optimizer(rule, loss.parameters(), fused=None) for loss in self.losses]
        self.updaters = [_target_updater(loss, rule.tau) for loss in self.losses]
        self._start_targets(target_networks or (), make_loss)  # the updaters have made them copies

    def update(self, ring: "Any") -> Tensor:
        return torch.stack([self.learn(lane, ring.sample(lane)) for lane in range(len(self.losses))])

    def learn(self, lane: int, batch: TensorDictBase) -> Tensor:
        loss = super().learn(lane, batch)
        updater = self.updaters[lane]
        if isinstance(updater, SoftUpdate):
            updater.step()
        return loss

    def copy_to_targets(self, which: Tensor) -> None:
        for lane in which.nonzero().flatten().tolist():
            updater = self.updaters[lane]
            if updater is not None:
                updater.step()


def _target_updater(loss: LossModule, tau: float | None) -> TargetNetUpdater | None:
    if not targets_of(loss):
        return None
    # HardUpdate copies at every (interval + 1)-th step.
    return HardUpdate(loss, value_network_update_interval=0) if tau is None else SoftUpdate(loss, tau=tau)


class StockBuffers:
    """A `TensorDictReplayBuffer` for each agent, of a `LazyTensorStorage`.

    Args:
        noise_shape: of the numbers that the loss reads with each transition; () for none.
    """

    def __init__(
        self, lanes: Lanes, settings: DQNSettings, make_sampler: MakeSampler, noise_shape: Sequence[int]
    ) -> None:
        self._lanes, self._settings, self._make_sampler = lanes, settings, make_sampler
        self._device = torch.device(lanes.who.device)
        of_batch = settings.batch_size, noise_shape, self._device
        self._noise = [Noise([seed], *of_batch) for seed in lanes.seeds(NOISE) if noise_shape]
        self._clear()

    def __len__(self) -> int:
        """Transitions stored for each agent."""
        return len(self.each[0])

    def _clear(self) -> None:
        self._generators = _generators(self._lanes)
        self.each = [self._buffer(lane, generator) for lane, generator in enumerate(self._generators)]
        self._last: list[TensorDict] = []  # turns that `MultiStepTransform` holds back

    def _buffer(self, lane: int, generator: torch.Generator) -> TensorDictReplayBuffer:
        settings = self._settings
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(settings.buffer_size, device=self._device),
            sampler=self._make_sampler(lane),
            batch_size=settings.batch_size,
            generator=generator,
        )
        if settings.n_steps > 1:
            buffer.append_transform(self._multi_step())
            # `DistributionalDQNLoss` would read [b] as one discount for each atom.
            buffer.append_transform(UnsqueezeTransform(dim=-1, in_keys=["steps_to_next_obs"]))
        for transform in settings.replay_transforms:
            buffer.append_transform(made(transform))
        return buffer

    def _multi_step(self) -> MultiStepTransform:
        # With its default `done_keys` a transition would keep the flags of its first step, and bootstrap from
        # the end of an episode that terminated within its n steps.
        return MultiStepTransform(self._settings.n_steps, self._settings.gamma, done_keys=[])

    def _hold_back(self, lane: int) -> None:
        """Gives a new `MultiStepTransform` the latest turns."""
        for turn in self._last:
            self.each[lane].transform.inv(turn[lane : lane + 1].clone())

    def write(self, turn: LaneTurn) -> None:
        """Stores a turn of every agent, [L], under TorchRL's default keys."""
        transitions = _transitions(turn._asdict(), [len(turn.done)]).to(self._device)
        if self._settings.n_steps > 1:
            self._last = [*self._last, transitions.clone()][-self._settings.n_steps :]
        for lane, buffer in enumerate(self.each):
            buffer.extend(transitions[lane : lane + 1])

    def sample(self, lane: int) -> TensorDictBase:
        """The next batch of an agent, [b]."""
        batch: TensorDictBase = self.each[lane].sample()
        if self._noise:
            batch.set("noise", self._noise[lane].next()[0])
        return batch

    def cut(self) -> None:
        """Ends the episodes that an earlier training left unfinished: whole transitions know nothing of those
        after them; `MultiStepTransform` sums up to the last that it holds back."""
        if self._last:
            self._last[-1]["next", "done"].fill_(True)
            for lane, buffer in enumerate(self.each):
                buffer.transform.pop(0)
                buffer.transform.insert(0, self._multi_step())
                self._hold_back(lane)

    def state_dict(self) -> dict[str, Any]:
        """The entries "buffers", "last" and "noise" of a learner's state."""
        return {
            "buffers": [_state_of(*pair) for pair in zip(self.each, self._generators, strict=True)],
            "last": [_plain(turn) for turn in self._last],
            "noise": [noise.rng.state_dict() for noise in self._noise],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._clear()
        self._last = [_nested(turn) for turn in state["last"]]
        for lane, buffer in enumerate(self.each):
            self._hold_back(lane)
            _load(buffer, self._generators[lane], state["buffers"][lane])
        for noise, numbers in zip(self._noise, state["noise"], strict=True):
            noise.rng.load_state_dict(numbers)


class TorchRLReplayLearner(ReplayLearner):
    """R x S independent agents that learn from replay, made of TorchRL's stock parts.

    They explore through `LaneActor`, not `EGreedyModule`, which uses torch's global generator: a replica's
    actions would depend on the replicas that train beside it.
    """

    takes_transforms = True
    engine: StockEngine

    def __init__(
        self, who: LearningAgents, method: Method, *, make_sampler: MakeSampler | None = None
    ) -> None:
        _refuse_sharing(who)
        self._make_sampler = make_sampler or _random_sampler
        super().__init__(who, method)

    def _refuse_other_sequences(self) -> None:
        steps = self.settings.sequence_steps
        if steps > 1 or self._lanes.state_cells:
            raise ValueError(
                f'settings.sequence_steps is {steps}; allowed with engine="torchrl", whose buffers give '
                'single transitions: 1, with MLP, Conv, Custom; engine="compiled" and "eager" learn from '
                "sequences"
            )

    def _trial(self, lanes: int) -> TensorDict:
        return _transformed(super()._trial(lanes), self.settings.replay_transforms)

    def _make_engine(
        self,
        networks: Sequence[nn.Module],
        targets: Sequence[nn.Module] | None,
        trial: TensorDict,
        *,
        name: EngineName | None,
        compile: bool,
    ) -> Engine:
        make_loss = self._lanes.method.make_loss
        refuse_other_outputs(make_loss(deepcopy(networks[0])), trial[0])
        return StockEngine(networks, make_loss, self._rule(), target_networks=targets)

    def _make_buffer(self) -> StockBuffers:
        _check_buffers(self._lanes, self.settings)
        return StockBuffers(self._lanes, self.settings, self._make_sampler, self._form.noise_shape)

    def update(self) -> Tensor | None:
        return super().update() if len(self.buffer) else None


def _refuse_sharing(who: LearningAgents) -> None:
    if who.share_parameters:
        raise ValueError(
            'share_parameters is True; allowed with engine="torchrl", which trains independent agents: False'
        )


def _random_sampler(lane: int) -> RandomSampler:
    return RandomSampler()


class TorchRLRolloutLearner(RolloutLearner):
    """R x S independent agents that learn from the latest steps of their current policies, with TorchRL's
    stock parts.

    Every `rollout_steps` steps TorchRL's `GAE` adds advantages, and the loss is taken `epochs` times over
    minibatches from a `TensorDictReplayBuffer` with a `SamplerWithoutReplacement`.
    """

    engine: StockEngine

    def __init__(
        self, who: LearningAgents, method: Method, *, make_sampler: MakeSampler | None = None
    ) -> None:
        _refuse_sharing(who)
        super().__init__(who, method)
        settings = self.settings
        self.estimators = [_gae(parts[CRITIC], settings) for parts in self.engine.parts]
        self._generators = _generators(self._lanes)
        self.buffers = [
            TensorDictReplayBuffer(
                storage=LazyTensorStorage(settings.rollout_steps, device=who.device),
                sampler=make_sampler(lane) if make_sampler else SamplerWithoutReplacement(),
                batch_size=settings.minibatch_size,
                generator=generator,
            )
            for lane, generator in enumerate(self._generators)
        ]

    def _make_engine(
        self, networks: Sequence[nn.Module], *, name: EngineName | None, compile: bool
    ) -> Engine:
        if states_in(networks[0]):
            raise ValueError(
                'the networks are recurrent; allowed with engine="torchrl", whose minibatches are single '
                'turns: MLP, Conv, Custom; engine="compiled" and "eager" learn from sequences'
            )
        network, make_loss = deepcopy(networks[0]), self._lanes.method.make_loss
        loss, parts, trial = make_loss(network), list(parts_of(network).values()), self._trial(1)[0]
        refuse_other_advantages(loss, self.settings)
        _gae(parts[CRITIC], self.settings)(trial)
        _add_old_policy(trial, parts[ACTOR])
        refuse_other_outputs(loss, trial)
        return StockEngine(networks, make_loss, UpdateRule.of(self.settings))

    def update(self) -> Tensor | None:
        if self._size < self.rollout_steps:
            return None
        self._size = 0
        rollout = _transitions(self._columns(), [self.lanes, self.rollout_steps])
        losses = [self._learn(lane, rollout[lane].clone()) for lane in range(self.lanes)]
        return self._lanes.by_agent(torch.stack(losses))

    def _learn(self, lane: int, rollout: TensorDict) -> Tensor:
        """Runs all epochs of one agent over its rollout, [T]; returns its mean loss."""
        buffer = self.buffers[lane]
        self.estimators[lane](rollout)
        _add_old_policy(rollout, self.engine.parts[lane][ACTOR])
        buffer.empty()
        buffer.extend(rollout)
        minibatches = self.settings.epochs * (self.rollout_steps // self.settings.minibatch_size)
        return torch.stack([self.engine.learn(lane, buffer.sample()) for _ in range(minibatches)]).mean()

    def state_dict(self) -> dict[str, Any]:
        """The full state of all agents. The buffers are refilled from each rollout, so only the states of
        their generators are stored."""
        return {
            **super().state_dict(),
            "generators": [generator.get_state() for generator in self._generators],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        for generator, drawn in zip(self._generators, state["generators"], strict=True):
            generator.set_state(drawn.cpu())


def _gae(critic: nn.Module, settings: RolloutSettings) -> GAE:
    return GAE(
        gamma=settings.gamma,
        lmbda=settings.gae_lambda,
        value_network=TensorDictModule(critic, ["observation"], ["state_value"]),
        average_gae=settings.normalize_advantage,
        deactivate_vmap=True,  # a user's network may not support it
    )


def _add_old_policy(rollout: TensorDict, actor: nn.Module) -> None:
    """Adds the "logits" [T, A] of the policy that acted, and its "action_log_prob" [T]."""
    with torch.no_grad():
        logits = actor(rollout["observation"])
        policy = torch.distributions.Categorical(logits=logits)
        chosen = policy.log_prob(rollout["action"])  # type: ignore[no-untyped-call]
    rollout.update({"logits": logits, "action_log_prob": chosen})


def _generators(lanes: Lanes) -> list[torch.Generator]:
    """A random number generator for the sampling of each agent, seeded by its own seed alone."""
    device = lanes.who.device
    return [torch.Generator(device).manual_seed(seed_of(seed)) for seed in lanes.seeds(SAMPLING)]


def _transitions(turn: Mapping[str, Any], size: list[int]) -> TensorDict:
    """The fields of a `LaneTurn` of such a batch size under TorchRL's default keys; rewards and flags are
    [.., 1]."""
    fields = {name: torch.as_tensor(field) for name, field in turn.items() if field is not None}
    following = {name: fields[name].unsqueeze(-1) for name in ("reward", "done", "terminated")}
    following["observation"] = fields["next_observation"]
    now = {name: fields[name] for name in ("observation", "action")}
    return TensorDict({**now, "next": TensorDict(following, size)}, size)


def _check_buffers(lanes: Lanes, settings: DQNSettings) -> None:
    """Checks memory in advance: stock storage holds the observations before and after each transition, and
    its pages are only committed as they fill, so a machine with too little would fail hours later.
    """
    spaces = lanes.spaces
    observation = prod(spaces.observation_shape) * torch_dtype(spaces.observation_dtype).itemsize
    beside = 8 * prod(lanes.action_shape) + _BYTES_BESIDE
    wanted = len(lanes) * settings.buffer_size * (2 * observation + beside)
    wanted += settings.batch_size * 2 * (observation + 4 * prod(spaces.observation_shape))
    check_memory(
        f"the replay buffers of {len(lanes)} agents x {settings.buffer_size:,} transitions",
        wanted,
        'a smaller buffer_size or batch_size, fewer replicas, or engine="compiled", which needs half',
        device=lanes.who.device,
    )


def _transformed(batch: TensorDict, transforms: Sequence[Custom]) -> TensorDict:
    """A copy of a batch after the transforms of a replay buffer."""
    for custom in transforms:
        transform = custom.make()
        if not callable(transform):
            raise ValueError(
                f"replay_transforms: {custom.target} makes a {type(transform).__name__}; allowed: a "
                "torchrl.envs.Transform"
            )
        try:
            batch = transform(batch.clone())
        except Exception as error:  # a user's transform may raise anything
            raise ValueError(
                f"replay_transforms: {custom.target} cannot transform a sampled batch: {error}"
            ) from error
    return batch


def _state_of(buffer: TensorDictReplayBuffer, generator: torch.Generator) -> dict[str, Any]:
    """The full state of a replay buffer, with the written transitions only: the state dict of
    `TensorDictReplayBuffer` includes all allocated memory."""
    size = len(buffer)
    transitions = buffer.storage.get(slice(0, size)) if size else None
    if transitions is not None and size < buffer.storage.max_size:
        transitions = transitions.clone()
    return {
        "transitions": {} if transitions is None else _plain(transitions),
        "writer": dict(buffer.writer.state_dict()),
        "sampler": dict(buffer.sampler.state_dict()),
        "transforms": dict(buffer.transform.state_dict()),
        "generator": generator.get_state(),
    }


def _load(buffer: TensorDictReplayBuffer, generator: torch.Generator, state: Mapping[str, Any]) -> None:
    if state["transitions"]:
        transitions = _nested(state["transitions"]).to(buffer.storage.device)
        buffer.storage.set(torch.arange(len(transitions)), transitions)
    buffer.writer.load_state_dict(state["writer"])
    buffer.sampler.load_state_dict(state["sampler"])
    buffer.transform.load_state_dict(state["transforms"])
    generator.set_state(state["generator"].cpu())


def _plain(transitions: TensorDictBase) -> dict[str, Tensor]:
    """Entries by name, those of "next" as "next.reward" and so on."""
    return dict(transitions.flatten_keys(".").items())


def _nested(entries: Mapping[str, Tensor]) -> TensorDict:
    """The inverse of `_plain`: a TensorDict [transitions]."""
    size = [len(next(iter(entries.values())))]
    nested: TensorDict = TensorDict(dict(entries), size).unflatten_keys(".")
    return nested
