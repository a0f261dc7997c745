"""engine="torchrl": the same training with TorchRL's stock parts, one agent after the other.

Each agent has a network, the loss of its algorithm, an optimiser of torch.optim, a `HardUpdate` or
`SoftUpdate` and a `TensorDictReplayBuffer`; advantages are those of TorchRL's `GAE`. First weights, first
targets and what actors draw are those of the fast learners, the sampled batches are not. It is the plain way
to say what the fast learners compute, and what these are tested against.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler, Sampler, SamplerWithoutReplacement
from torchrl.objectives.value import GAE

from cprl.learners.base import LearningAgents
from cprl.learners.engine import ListEngine
from cprl.learners.lanes import Lanes, Method
from cprl.learners.replay import ReplayLearner
from cprl.learners.ring import Noise
from cprl.learners.rollouts import ACTOR, CRITIC, RolloutLearner
from cprl.learners.transitions import LaneTurn
from cprl.policies.rng import NOISE, SAMPLING, seed_of
from cprl.system.memory import check_memory
from cprl.values import Custom, made

MakeSampler = Callable[[int], Sampler]
"""Makes a TorchRL sampler for an agent, by its lane = replica x S + position among the agents. Comparisons
with the fast engine pass one that replays given indices."""


class StockBuffers:
    """A `TensorDictReplayBuffer` for each agent, of a `LazyTensorStorage`; the random numbers of each depend
    on its own seed alone.

    Args:
        noise_shape: of the uniform numbers that the loss reads with each transition.
    """

    def __init__(
        self,
        lanes: Lanes,
        make_sampler: MakeSampler,
        *,
        size: int,
        batch_size: int,
        transforms: Sequence[Custom] = (),
        noise_shape: tuple[int, ...] = (),
    ) -> None:
        self._columns = lanes.columns
        device, seeds = torch.device(lanes.who.device), lanes.seeds(SAMPLING)
        self._generators = [torch.Generator(device).manual_seed(seed_of(seed)) for seed in seeds]
        self.each = [
            TensorDictReplayBuffer(
                storage=LazyTensorStorage(size, device=device),
                sampler=make_sampler(lane),
                batch_size=batch_size,
                generator=generator,
            )
            for lane, generator in enumerate(self._generators)
        ]
        for buffer in self.each:
            for transform in transforms:
                buffer.append_transform(made(transform))
        self._noise = None
        if noise_shape:
            self._noise = Noise(lanes.seeds(NOISE), batch_size, noise_shape, device)

    def write(self, turn: LaneTurn) -> None:
        """Stores a turn of every agent in all of its worlds, under TorchRL's default keys."""
        transitions = _transitions(turn._asdict(), [len(turn.done)])
        for columns, buffer in zip(self._columns, self.each, strict=True):
            buffer.extend(transitions[columns])

    def sample(self) -> TensorDict:
        """The next batch of every agent, [L, b]."""
        batch: TensorDict = torch.stack([buffer.sample() for buffer in self.each])
        return batch if self._noise is None else batch.set("noise", self._noise.next())

    def cut(self) -> None:
        """Does nothing: whole transitions know nothing of those after them."""

    def state_dict(self) -> dict[str, Any]:
        """The full state with the written transitions alone; that of `TensorDictReplayBuffer` includes all
        allocated memory."""
        buffers = [
            {
                "transitions": dict(buffer[:].clone().flatten_keys(".").items()) if len(buffer) else {},
                "writer": dict(buffer.writer.state_dict()),
                "sampler": dict(buffer.sampler.state_dict()),
                "transforms": dict(buffer.transform.state_dict()),
                "generator": generator.get_state(),
            }
            for buffer, generator in zip(self.each, self._generators, strict=True)
        ]
        return {"buffers": buffers, "noise": {} if self._noise is None else self._noise.rng.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for buffer, generator, stored in zip(self.each, self._generators, state["buffers"], strict=True):
            buffer.empty()
            if stored["transitions"]:
                size = len(stored["transitions"]["action"])
                transitions = TensorDict(dict(stored["transitions"]), [size]).unflatten_keys(".")
                buffer.storage.set(torch.arange(size), transitions.to(buffer.storage.device))
            buffer.writer.load_state_dict(stored["writer"])
            buffer.sampler.load_state_dict(stored["sampler"])
            buffer.transform.load_state_dict(stored["transforms"])
            generator.set_state(stored["generator"].cpu())
        if self._noise is not None:
            self._noise.rng.load_state_dict(state["noise"])


class TorchRLReplayLearner(ReplayLearner):
    """R x S independent agents that learn from replay, made of TorchRL's stock parts.

    They explore through `LaneActor`, not `EGreedyModule`, which uses torch's global generator: a replica's
    actions would depend on the replicas that train beside it.
    """

    takes_transforms = True
    ways = ()

    def __init__(
        self, who: LearningAgents, method: Method, *, make_sampler: MakeSampler | None = None
    ) -> None:
        _refuse_sharing(who)
        self._make_sampler = make_sampler or (lambda lane: RandomSampler())
        super().__init__(who, method, compile=False)

    def _refuse_other_sequences(self) -> None:
        name = "n_steps" if self.settings.n_steps > 1 else "sequence_steps"
        steps = getattr(self.settings, name)
        if steps > 1 or self._lanes.state_cells:
            raise ValueError(
                f'settings.{name} is {steps}; allowed with engine="torchrl", whose buffers give single '
                'transitions: 1, with MLP, Conv, Custom; engine="compiled" and "eager" learn from sequences '
                "and from returns of several steps"
            )

    def _trial(self, lanes: int) -> TensorDict:
        batch = super()._trial(lanes)
        for custom in self.settings.replay_transforms:
            try:
                batch = custom.make()(batch)
            except Exception as error:  # a user's transform may raise anything
                raise ValueError(
                    f"replay_transforms: {custom.target} cannot transform a sampled batch: {error}"
                ) from error
        return batch

    def _make_buffer(self) -> StockBuffers:
        lanes, settings, form = self._lanes, self.settings, self._form
        # Stock storage holds the observations before and after each transition, and its pages are committed
        # as they fill, so a machine with too little memory would fail hours later.
        check_memory(
            f"the replay buffers of {len(lanes)} agents x {settings.buffer_size:,} transitions",
            2 * form.stored_bytes(len(lanes), settings.buffer_size),
            'a smaller buffer_size, fewer replicas, or engine="compiled", which needs half',
            device=lanes.who.device,
        )
        return StockBuffers(
            lanes,
            self._make_sampler,
            size=settings.buffer_size,
            batch_size=settings.batch_size,
            transforms=settings.replay_transforms,
            noise_shape=form.noise_shape,
        )


class TorchRLRolloutLearner(RolloutLearner):
    """R x S independent agents that learn from the latest steps of their current policies, with TorchRL's
    stock parts.

    Every `rollout_steps` steps TorchRL's `GAE` adds advantages, and the loss is taken `epochs` times over
    minibatches from a `TensorDictReplayBuffer` with a `SamplerWithoutReplacement`.
    """

    engine: ListEngine
    ways = ()

    def __init__(
        self, who: LearningAgents, method: Method, *, make_sampler: MakeSampler | None = None
    ) -> None:
        _refuse_sharing(who)
        super().__init__(who, method, compile=False)
        settings = self.settings
        if self._states is not None:
            raise ValueError(
                'the networks are recurrent; allowed with engine="torchrl", whose minibatches are single '
                'turns: MLP, Conv, Custom; engine="compiled" and "eager" learn from sequences'
            )
        self.estimators = [
            GAE(
                gamma=settings.gamma,
                lmbda=settings.gae_lambda,
                value_network=TensorDictModule(parts[CRITIC], ["observation"], ["state_value"]),
                average_gae=settings.normalize_advantage,
                deactivate_vmap=True,  # a user's network may not support it
            )
            for parts in self.engine.parts
        ]
        make_sampler = make_sampler or (lambda lane: SamplerWithoutReplacement())
        self.buffer = StockBuffers(
            self._lanes,
            make_sampler,
            size=settings.rollout_steps * self.worlds,
            batch_size=settings.minibatch_size,
        )

    def update(self) -> Tensor | None:
        if not self._rollout.is_full:
            return None
        self._rollout.size = 0
        rollout = _transitions(self._rollout.fields, [self.lanes, self.worlds, self.rollout_steps])
        losses = [self._learn(lane, rollout[lane].clone()) for lane in range(self.lanes)]
        return self._lanes.by_agent(torch.stack(losses))

    def _learn(self, lane: int, rollout: TensorDict) -> Tensor:
        """Runs all epochs of one agent over its rollout, [W, T]; returns its mean loss."""
        buffer = self.buffer.each[lane]
        self.estimators[lane](rollout)
        with torch.no_grad():
            logits = self.engine.parts[lane][ACTOR](rollout["observation"])
            policy = torch.distributions.Categorical(logits=logits)
            chosen = policy.log_prob(rollout["action"])  # type: ignore[no-untyped-call]
        buffer.extend(rollout.update({"logits": logits, "action_log_prob": chosen}).flatten())
        minibatches = self.settings.epochs * rollout.numel() // self.settings.minibatch_size
        losses = [self.engine.learn(lane, buffer.sample()) for _ in range(minibatches)]
        buffer.empty()  # a checkpoint holds the rollout once
        return torch.stack(losses).mean()

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), **self.buffer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self.buffer.load_state_dict(state)


def _refuse_sharing(who: LearningAgents) -> None:
    if who.share_parameters:
        raise ValueError(
            'share_parameters is True; allowed with engine="torchrl", which trains independent agents: False'
        )


def _transitions(turn: Mapping[str, Any], size: list[int]) -> TensorDict:
    """The fields of a `LaneTurn` of such a batch size under TorchRL's default keys; rewards and flags are
    [.., 1]."""
    fields = {name: torch.as_tensor(field) for name, field in turn.items() if field is not None}
    following = {name: fields[name].unsqueeze(-1) for name in ("reward", "done", "terminated")}
    following["observation"] = fields["next_observation"]
    now = {name: fields[name] for name in ("observation", "action")}
    return TensorDict({**now, "next": TensorDict(following, size)}, size)
