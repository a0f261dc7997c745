"""StockBuffers: the replay buffers of agents made of TorchRL's stock parts, and their state."""

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import Any, Final

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.transforms import MultiStepTransform, UnsqueezeTransform

from cprl.custom import made
from cprl.learners.buffer.storage import torch_dtype
from cprl.learners.lanes import Lanes
from cprl.learners.settings import DQNSettings
from cprl.learners.torchrl.agents import MakeSampler, sampler_of
from cprl.system.memory import check_memory

_BYTES_BESIDE: Final = 4 + 1 + 1
"""Bytes of a transition without its observations and actions: reward, done, terminated."""


class StockBuffers(Sequence[TensorDictReplayBuffer]):
    """A `TensorDictReplayBuffer` for each agent, of a `LazyTensorStorage`.

    Args:
        settings: the hyperparameters.
        make_generators: makes the random number generator of each agent's sampling, as it is at the start.
        make_sampler: makes an agent's sampler.
        device: the torch device of the buffers.
    """

    def __init__(
        self,
        settings: DQNSettings,
        make_generators: Callable[[], list[torch.Generator]],
        make_sampler: MakeSampler,
        device: torch.device,
    ) -> None:
        self._settings, self._make_generators = settings, make_generators
        self._make_sampler, self._device = make_sampler, device
        self._clear()

    def __len__(self) -> int:
        return len(self._each)

    def __getitem__(self, lane: Any) -> Any:
        return self._each[lane]

    def _clear(self) -> None:
        self._generators = self._make_generators()
        self._each = [self._buffer(lane, own) for lane, own in enumerate(self._generators)]
        self._last: list[TensorDict] = []  # turns that `MultiStepTransform` holds back

    def _buffer(self, lane: int, generator: torch.Generator) -> TensorDictReplayBuffer:
        settings = self._settings
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(settings.buffer_size, device=self._device),
            sampler=sampler_of(self._make_sampler, lane),
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
            self._each[lane].transform.inv(turn[lane : lane + 1].clone())

    def extend(self, turn: TensorDict) -> None:
        """Stores a turn of every agent, [L]."""
        if self._settings.n_steps > 1:
            self._last = [*self._last, turn.clone()][-self._settings.n_steps :]
        for lane, buffer in enumerate(self._each):
            buffer.extend(turn[lane : lane + 1])

    def end_episodes(self) -> None:
        """Ends the episodes that an earlier training left unfinished: whole transitions know nothing of those
        after them; `MultiStepTransform` sums up to the last that it holds back."""
        if self._last:
            self._last[-1]["next", "done"].fill_(True)
            for lane, buffer in enumerate(self._each):
                buffer.transform.pop(0)
                buffer.transform.insert(0, self._multi_step())
                self._hold_back(lane)

    def state_dict(self) -> dict[str, Any]:
        """The entries "buffers" and "last" of a learner's state."""
        return {
            "buffers": [_state_of(*own) for own in zip(self._each, self._generators, strict=True)],
            "last": [plain(turn) for turn in self._last],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from these entries."""
        self._clear()
        self._last = [nested(turn) for turn in state["last"]]
        for lane, buffer in enumerate(self._each):
            self._hold_back(lane)
            _load(buffer, self._generators[lane], state["buffers"][lane])


def check_buffers(lanes: Lanes, settings: DQNSettings, device: torch.device) -> None:
    """Checks memory in advance: stock storage holds the observations before and after each transition, and
    its pages are only committed as they fill, so a machine with too little would fail hours later.

    Raises:
        TooLargeError: if the device has less memory than the buffers need.
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
        device=device,
    )


def _state_of(buffer: TensorDictReplayBuffer, generator: torch.Generator) -> dict[str, Any]:
    """The full state of a replay buffer, with the written transitions only: the state dict of
    `TensorDictReplayBuffer` includes all allocated memory."""
    kept = len(buffer)
    transitions = buffer.storage.get(slice(0, kept)) if kept else None
    if transitions is not None and kept < buffer.storage.max_size:
        transitions = transitions.clone()
    return {
        "transitions": {} if transitions is None else plain(transitions),
        "writer": dict(buffer.writer.state_dict()),
        "sampler": dict(buffer.sampler.state_dict()),
        "transforms": dict(buffer.transform.state_dict()),
        "generator": generator.get_state(),
    }


def _load(buffer: TensorDictReplayBuffer, generator: torch.Generator, state: Mapping[str, Any]) -> None:
    """Fills an empty replay buffer from what `_state_of` gave."""
    if state["transitions"]:
        transitions = nested(state["transitions"]).to(buffer.storage.device)
        buffer.storage.set(torch.arange(len(transitions)), transitions)
    buffer.writer.load_state_dict(state["writer"])
    buffer.sampler.load_state_dict(state["sampler"])
    buffer.transform.load_state_dict(state["transforms"])
    generator.set_state(state["generator"].cpu())


def plain(transitions: TensorDictBase) -> dict[str, Tensor]:
    """Entries by name, those of "next" as "next.reward" and so on."""
    return dict(transitions.flatten_keys(".").items())


def nested(entries: Mapping[str, Tensor]) -> TensorDict:
    """The inverse of `plain`: a TensorDict [transitions]."""
    size = [len(next(iter(entries.values())))]
    nested: TensorDict = TensorDict(dict(entries), size).unflatten_keys(".")
    return nested
