"""The replay buffer of many lanes: TorchRL's buffer over `LaneStorage`; each lane samples for itself."""

import logging
from collections.abc import Mapping, Sequence
from math import prod
from typing import Any, Final

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data.replay_buffers import ReplayBuffer, RoundRobinWriter, Sampler

from cprl.custom import Custom
from cprl.learners.buffer.gather import Horizon
from cprl.learners.buffer.storage import LaneStorage, storage_bytes, torch_dtype
from cprl.learners.transitions import LaneTurn, array_of, transitions_in, turn_of
from cprl.policies.rng import DRAWN_AHEAD, LaneRng
from cprl.system.memory import check_memory, free_bytes

NUMBERS_AHEAD: Final = 2**14
"""About as many numbers for losses that sample, or for an epoch, are generated at once for each lane."""


class LaneSampler(Sampler):
    """Samples uniformly from each lane's transitions, with a random number generator for each lane.

    Args:
        seeds: the seed of each lane, e.g. (seed, replica, agent); a lane's samples depend on it alone.
        batch_size: transitions b sampled for each lane.
    """

    def __init__(self, seeds: Sequence[Sequence[int]], batch_size: int) -> None:
        self.batch_size = batch_size
        self.rng = LaneRng(seeds, batch_size)

    def sample(self, storage: LaneStorage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Positions in the ring, int64 [L, b]."""
        if batch_size != self.batch_size:
            raise ValueError(f"batch_size is {batch_size}; allowed: that of the sampler, {self.batch_size}")
        return self.draw(storage), {}

    def draw(self, storage: LaneStorage) -> Tensor:
        """Positions in the ring, int64 [L, b]."""
        oldest, written = storage.oldest()
        written -= storage.steps_after  # the newest transitions have no full return or sequence yet
        shares = array_of(self.rng.next().to(storage.device)) * (written - oldest)[:, None]
        # numpy on the CPU: for so few numbers torch takes three times as long.
        numbers = shares.astype(np.int64) if isinstance(shares, np.ndarray) else shares.long()
        return torch.as_tensor((oldest[:, None] + numbers) % int(storage.max_size))

    def state_dict(self) -> dict[str, Any]:
        """The states of the lanes' random number generators."""
        return self.rng.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self.rng.load_state_dict(state_dict)

    def _empty(self) -> None:
        """Does nothing: the sampler stores nothing about past samples."""

    def dumps(self, path: Any) -> None:
        """Writes `state_dict`."""
        torch.save(self.state_dict(), path)

    def loads(self, path: Any) -> None:
        """Reads what `dumps` wrote."""
        self.load_state_dict(torch.load(path, weights_only=True))


def steps_ahead(count: int) -> int:
    """Steps whose numbers are generated at once, `count` for each: they are part of every checkpoint."""
    return min(DRAWN_AHEAD, max(1, NUMBERS_AHEAD // count))


class Noise:
    """Uniform numbers in 0..1 for losses that sample: a batch of them for each update and lane.

    Args:
        seeds: the seed of each of the L lanes; a lane's numbers depend on it alone.
        batch_size: transitions b of a lane's batch.
        shape: of the numbers of a transition.
        device: the device of the batches.
    """

    def __init__(
        self,
        seeds: Sequence[Sequence[int]],
        batch_size: int,
        shape: Sequence[int],
        device: str | torch.device = "cpu",
    ) -> None:
        self._size, self._device = (len(seeds), batch_size, *shape), torch.device(device)
        count = batch_size * prod(shape)
        self.rng = LaneRng(seeds, count, ahead=steps_ahead(count))

    def next(self) -> Tensor:
        """The numbers of the next batch, float32 [L, b, *shape]."""
        return self.rng.next().view(self._size).to(self._device, torch.float32)


class LaneBuffer(ReplayBuffer):
    """TorchRL's replay buffer, which knows whether it has transforms: to ask takes it some microseconds.

    Its samples have the entry "noise" if it has `noise`; transforms do not see it.
    """

    has_transforms = False
    noise: "Noise | None" = None

    def sample(self, batch_size: int | None = None, return_info: bool = False) -> Any:
        """See `ReplayBuffer`."""
        sampled = super().sample(batch_size, return_info)
        if self.noise is not None:
            batch = sampled[0] if return_info else sampled
            batch.set("noise", self.noise.next())
        return sampled

    def append_transform(self, transform: Any, *, invert: bool = False) -> "LaneBuffer":
        """See `ReplayBuffer`."""
        super().append_transform(transform, invert=invert)
        self.has_transforms = True
        return self

    def insert_transform(self, index: int, transform: Any, *, invert: bool = False) -> "LaneBuffer":
        """See `ReplayBuffer`."""
        super().insert_transform(index, transform, invert=invert)
        self.has_transforms = True
        return self

    def write(self, turn: LaneTurn) -> None:
        """Writes the next transition of every lane; as `extend`, through the inverse of the transforms."""
        if self.has_transforms:
            turn = turn_of(self.transform.inv(transitions_in(turn)))
        self.storage.write(turn)


def lane_buffer(
    *,
    seeds: Sequence[Sequence[int]],
    transitions: int,
    batch_size: int,
    observation_shape: Sequence[int],
    action_shape: Sequence[int] = (),
    reward_shape: Sequence[int] = (),
    noise_shape: Sequence[int] = (),
    noise_seeds: Sequence[Sequence[int]] | None = None,
    observation_dtype: str = "uint8",
    horizon: Horizon | None = None,
    state_cells: int = 0,
    sequence_steps: int = 1,
    device: str | torch.device = "cpu",
) -> LaneBuffer:
    """TorchRL's replay buffer over `LaneStorage` and `LaneSampler`.

    Args:
        seeds: the sampling seed of each of the L lanes.
        transitions: capacity per lane.
        batch_size: transitions sampled per lane, or sequences.
        observation_shape: (C, X, Y); (S, C, X, Y) if a lane is a team of S agents.
        action_shape: the shape of a lane's action: () for one agent, (S,) for a team.
        reward_shape: the shape of a lane's reward: (S,) for a team whose members have their own, else ().
        noise_shape: of the uniform numbers that the loss reads with each transition: the entry "noise",
            float32 [L, b, *noise_shape]; () for none.
        noise_seeds: the seed of the numbers of each lane; by default `seeds`.
        observation_dtype: see `Spaces.observation_dtype`.
        horizon: steps and discount of n-step returns, sampled in place of rewards; None for single steps.
        state_cells: the numbers of the state of a recurrent network; 0 for one without.
        sequence_steps: turns of sampled sequences; 1 for transitions.
        device: the device of the storage.

    The size is logged before allocation, under "cprl", if it is a mebibyte or more.

    Raises:
        TooLargeError: if the device has less free memory than needed; raised before anything is allocated.
    """
    dtype = torch_dtype(observation_dtype)
    shapes: dict[str, Any] = {"action_shape": action_shape, "reward_shape": reward_shape}
    needed = storage_bytes(
        len(seeds),
        transitions,
        observation_shape,
        item_bytes=dtype.itemsize,
        state_cells=state_cells,
        **shapes,
    )
    windows = len(seeds) * batch_size * sequence_steps * 2
    sampled = windows * prod(observation_shape) * (dtype.itemsize + 4)  # and as float32
    check_memory(
        f"the replay buffers of {len(seeds)} learners x {transitions:,} transitions",
        needed + sampled,
        "a smaller buffer_size or batch_size, or fewer replicas",
        device=device,
    )
    if needed >= 2**20:
        logging.getLogger("cprl").info(
            "Replay buffers of %d learners x %s transitions: %.2f GiB of %.1f GiB free",
            len(seeds),
            f"{transitions:,}",
            needed / 2**30,
            free_bytes(device) / 2**30,
        )
    storage = LaneStorage(
        lanes=len(seeds),
        transitions=transitions,
        observation_shape=observation_shape,
        dtype=dtype,
        horizon=horizon,
        state_cells=state_cells,
        sequence_steps=sequence_steps,
        device=device,
        **shapes,
    )
    buffer = LaneBuffer(
        storage=storage,
        sampler=LaneSampler(seeds, batch_size),
        writer=RoundRobinWriter(),
        batch_size=batch_size,
        collate_fn=lambda batch: batch,
    )
    if noise_shape:
        buffer.noise = Noise(noise_seeds or seeds, batch_size, noise_shape, device)
    return buffer


def transformed(batch: TensorDict, transforms: Sequence[Custom]) -> TensorDict:
    """A copy of a batch after the transforms of a replay buffer.

    Raises:
        ValueError: if a transform cannot be constructed or applied; names it.
    """
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
