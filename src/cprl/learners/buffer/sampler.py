"""The replay buffer of many lanes: TorchRL's, over `LaneStorage`; each lane draws for itself."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import psutil
import torch
from torch import Tensor
from torchrl.data.replay_buffers import ReplayBuffer, RoundRobinWriter, Sampler

from cprl.learners.buffer.storage import LaneStorage, storage_bytes
from cprl.learners.transitions import array_of
from cprl.policies.rng import LaneRng


class LaneSampler(Sampler):
    """Each lane draws uniformly among its own transitions, by random numbers of its own.

    Args:
        seeds: of each lane, e.g. (seed, replica, agent): what a lane draws follows from them alone.
        batch_size: b.
    """

    def __init__(self, seeds: Sequence[Sequence[int]], batch_size: int) -> None:
        self.batch_size = batch_size
        self.rng = LaneRng(seeds, batch_size)

    def sample(self, storage: LaneStorage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Places in the ring, int64 [L, b]."""
        if batch_size != self.batch_size:
            raise ValueError(f"batch_size is {batch_size}; this sampler draws {self.batch_size}")
        return self.draw(storage), {}

    def draw(self, storage: LaneStorage) -> Tensor:
        """Places in the ring, int64 [L, b]."""
        oldest, written = storage.oldest()
        shares = array_of(self.rng.next().to(storage.device)) * (written - oldest)[:, None]
        # Through numpy where it can be: on so few numbers torch takes three times as long.
        numbers = shares.astype(np.int64) if isinstance(shares, np.ndarray) else shares.long()
        return torch.as_tensor((oldest[:, None] + numbers) % int(storage.max_size))

    def state_dict(self) -> dict[str, Any]:
        """Where each lane's random numbers stand."""
        return self.rng.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Goes on where the sampler of that state was."""
        self.rng.load_state_dict(state_dict)

    def _empty(self) -> None:
        """Nothing is kept of what was sampled."""

    def dumps(self, path: Any) -> None:
        """Writes `state_dict`."""
        torch.save(self.state_dict(), path)

    def loads(self, path: Any) -> None:
        """Reads what `dumps` wrote."""
        self.load_state_dict(torch.load(path, weights_only=True))


def lane_buffer(
    *,
    seeds: Sequence[Sequence[int]],
    transitions: int,
    batch_size: int,
    observation_shape: Sequence[int],
    action_shape: Sequence[int] = (),
    device: str | torch.device = "cpu",
) -> ReplayBuffer:
    """TorchRL's replay buffer over `LaneStorage` and `LaneSampler`.

    Args:
        seeds: of each lane's sampling; as many as there are lanes.
        transitions: kept for each lane.
        batch_size: drawn for each lane.
        observation_shape: (C, X, Y); of a lane that is a team of S agents (S, C, X, Y).
        action_shape: of a lane's action: () of one agent, (S,) of a team.
        device: where it lies.

    What they take, if it is a mebibyte or more, is logged, as "cprl", before it is allocated.

    Raises:
        MemoryError: where the machine has less memory than it takes, before anything is allocated.
    """
    wanted = storage_bytes(len(seeds), transitions, observation_shape, action_shape=action_shape)
    there = _free_bytes(torch.device(device))
    if wanted > there:
        raise MemoryError(
            f"the replay buffers of {len(seeds)} lanes x {transitions:,} transitions take "
            f"{wanted / 2**30:.2f} GiB; {there / 2**30:.2f} GiB are free: lower buffer_size or replicas"
        )
    if wanted >= 2**20:
        logging.getLogger("cprl").info(
            "Replay buffers of %d lanes x %s transitions: %.2f GiB of %.1f GiB free",
            len(seeds),
            f"{transitions:,}",
            wanted / 2**30,
            there / 2**30,
        )
    storage = LaneStorage(
        lanes=len(seeds),
        transitions=transitions,
        observation_shape=observation_shape,
        action_shape=action_shape,
        device=device,
    )
    return ReplayBuffer(
        storage=storage,
        sampler=LaneSampler(seeds, batch_size),
        writer=RoundRobinWriter(),
        batch_size=batch_size,
        collate_fn=lambda batch: batch,
    )


def _free_bytes(device: torch.device) -> int:
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return int(psutil.virtual_memory().available)
